"""A connection to each slot that only says when the slot's process ends.

Ray reports the end of an actor up to seconds later: it waits for news of the cause. The system
closes a connection at once.
"""

from __future__ import annotations

import asyncio
import contextlib
from typing import Any

import ray

_CONNECT_S = 2.0  # s, for the connection. Source: chosen


async def beacon() -> tuple[str, int, asyncio.Server]:
    """The end at the slot: where it listens."""
    host = ray.util.get_node_ip_address()
    server = await asyncio.start_server(_stay, host, 0)
    return host, server.sockets[0].getsockname()[1], server


async def _stay(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Until the other end closes it, or is gone; nothing is sent."""
    with contextlib.suppress(OSError):
        await reader.read()
    writer.close()


class Heartbeats:
    """The ends at a gateway, one for each slot that it uses."""

    def __init__(self) -> None:
        self._ends: dict[str, asyncio.Task[None]] = {}
        self._processes: dict[str, int] = {}

    async def end_of(self, slot: str, actor: Any) -> asyncio.Task[None]:
        """A task that is done when the slot has ended.

        Raises:
            OSError: it has ended already, or cannot be reached.
        """
        known = self._ends.get(slot)
        if known is None:
            host, port, self._processes[slot] = await asyncio.wait_for(
                actor.beacon.remote(), _CONNECT_S
            )
            reader, writer = await asyncio.wait_for(asyncio.open_connection(host, port), _CONNECT_S)
            known = self._ends[slot] = asyncio.create_task(_stay(reader, writer))
        if known.done():
            raise ConnectionError("the slot has ended")
        return known

    def renew(self, slot: str) -> None:
        """The orchestrator says that the slot is there, perhaps again."""
        if slot in self._ends and self._ends[slot].done():
            del self._ends[slot]

    def keep(self, processes: dict[str, int]) -> None:
        """Forget ended connections to other processes than these, by slot."""
        for slot, end in list(self._ends.items()):
            if end.done() and processes.get(slot) != self._processes[slot]:
                del self._ends[slot]
