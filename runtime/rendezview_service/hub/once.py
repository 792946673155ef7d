"""Requests that are done once, however often they arrive."""

from __future__ import annotations

import asyncio
from collections import OrderedDict
from collections.abc import Awaitable, Callable, Hashable
from typing import Generic, TypeVar

from rendezview.errors import RendezviewError

ResultT = TypeVar("ResultT")


class Once(Generic[ResultT]):
    """The results of the last requests, by the keys that their senders chose.

    A request that is refused by an error has done nothing: its key is forgotten.
    """

    def __init__(self, most: int) -> None:
        """No results yet; at most ``most`` are remembered, the oldest is forgotten first."""
        self._most = most
        self._results: OrderedDict[str, tuple[Hashable, asyncio.Future[ResultT]]] = OrderedDict()

    async def do(
        self, key: str | None, about: Hashable, work: Callable[[], Awaitable[ResultT]]
    ) -> ResultT:
        """The result of the first request with this key, or of ``work``.

        Args:
            about: what the request is, not None; a repeat is the same.

        Raises:
            RendezviewError: the key belongs to another request.
            Exception: those of ``work``.
        """
        if key is None:
            return await work()
        if key in self._results:
            known, future = self._results[key]
            if known is not None and known != about:
                raise RendezviewError(
                    "Idempotency-Key: another request has had this key: give each its own"
                )
            return await asyncio.shield(future)
        future = asyncio.ensure_future(work())
        self._results[key] = about, future
        while len(self._results) > self._most:
            self._results.popitem(last=False)
        try:
            return await asyncio.shield(future)
        except Exception:
            self._results.pop(key, None)
            raise

    def know(self, key: str, result: ResultT) -> None:
        """A result of another service, which has compared the request."""
        future: asyncio.Future[ResultT] = asyncio.get_running_loop().create_future()
        future.set_result(result)
        self._results[key] = None, future
