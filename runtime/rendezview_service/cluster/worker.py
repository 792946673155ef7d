"""A slot: a process of the cluster with the whole service for one session, and its tracker warm.

A new process needs seconds to import and to read compiled loops. So slots exist before they have a
session: a session takes a free one, and takes another one when its own ends.
"""

from __future__ import annotations

import asyncio
import os
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

from starlette.types import Message, Scope

from rendezview_service.cluster.tunnel import Sockets, exchange
from rendezview_service.http.app import make_routes
from rendezview_service.hub.checkpoint import checkpoint_path, read_checkpoint
from rendezview_service.hub.model_store import BY_HASH
from rendezview_service.hub.model_store import SUFFIX as RVM
from rendezview_service.hub.service import Service
from rendezview_service.hub.worker_handle import sight_of
from rendezview_service.json_logging import set_up_logging
from rendezview_service.messages.messages import SessionRequest
from rendezview_service.settings import Settings

# Of a slot, whatever the cluster's settings say.
_OWN = {
    "workers": 1, "spare_worker": False, "foxglove_port": None, "rerun_port": None,
    "ros_endpoint": None,
}  # fmt: skip


class Gone(LookupError):
    """The slot does not have this session."""


class Slot:
    """Has one session or none. The orchestrator and the gateways call it."""

    def __init__(self, settings: dict[str, Any]) -> None:
        self._settings = Settings.model_validate(settings | _OWN)
        set_up_logging(self._settings.log_level)
        assert self._settings.state_folder is not None
        self._folder = self._settings.state_folder
        self._service = Service(self._settings, shares_models=True)
        self._app = make_routes(self._service)
        self._sockets = Sockets(self._app)
        self._held: str | None = None
        self._begun = False

    async def state(self) -> tuple[int, bool, str | None, list[str]]:
        """Its process, whether it can take a session, the one that it has, and what is wrong.

        The first call starts its worker. The checkpoint of an ended session goes first.
        """
        if not self._begun:
            self._begun = True
            # The orchestrator repairs old logs.
            self._service.settings = self._settings.model_copy(update={"record": None})
            await self._service.start()
            self._service.settings = self._settings
        if self._held is not None and not self._service.has(self._held):
            self._held = None
        health = self._service.health()
        return os.getpid(), health.status in ("ok", "degraded"), self._held, health.reasons

    async def expect(self, sessions: list[str], copy: str | None = None) -> None:
        """Be ready to continue one of these sessions, with another model if one is given."""
        models, sights = self._service.models.folder / BY_HASH, []
        for name in sessions:
            kept = read_checkpoint(checkpoint_path(self._folder, name))
            if kept is not None and kept.request.model is not None:
                path = models / f"{kept.model_sha256}{RVM}" if copy is None else Path(copy)
                stored = self._service.models.know(kept.request.model, path)
                await asyncio.to_thread(getattr, stored, "model")
                sights.append(sight_of(kept.request, path))
        await self._service.workers.expect(sights)

    async def take(self, request: dict[str, Any], copy: str, resumes: bool) -> str:
        """Open a session, or continue one where its checkpoint says; its name.

        Raises:
            RendezviewError, Full, NotReady: as `Service.open`.
        """
        asked = SessionRequest.model_validate(request)
        assert asked.id is not None
        assert asked.model is not None
        self._service.models.know(asked.model, Path(copy))
        path = checkpoint_path(self._folder, asked.id)
        self._held = asked.id
        try:
            await self._service.open(asked, read_checkpoint(path) if resumes else None)
        except BaseException:
            self._held = None
            raise
        return asked.id

    async def let_go(self, name: str) -> None:
        """End a session here, so that another slot continues it."""
        session = self._service.sessions.get(name)
        if session is not None:
            self._held = None
            await self._service.close(session, "another node continues it", goes_on=True)

    async def http(self, session: str, scope: Scope, body: bytes) -> tuple[int, list[Any], bytes]:
        """The answer to a request about the session.

        Raises:
            Gone: it is not here.
        """
        if session not in self._service.sessions:
            raise Gone(session)
        return await exchange(self._app, scope, body)

    async def socket(self, session: str, key: str, scope: Scope) -> AsyncIterator[Message]:
        """What a WebSocket of the session sends.

        Raises:
            Gone: it is not here.
        """
        if session not in self._service.sessions:
            raise Gone(session)
        async for message in self._sockets.messages(key, scope):
            yield message

    async def give(self, key: str, message: Message) -> bool:
        """A message to a WebSocket; False if it has ended."""
        return await self._sockets.give(key, message)
