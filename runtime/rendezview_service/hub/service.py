"""The service without HTTP: models, sessions, sources and training jobs."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import secrets
import time
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

from rendezview.errors import RendezviewError
from rendezview.io.files import make_folder
from rendezview_service.hub.checkpoint import (
    Checkpoint,
    CheckpointKeeper,
    checkpoint_path,
    kept_in,
    lock_state,
    names_in,
)
from rendezview_service.hub.health import budgets_of, health_of
from rendezview_service.hub.history import Histories
from rendezview_service.hub.inputs import Full, NotReady, Refused
from rendezview_service.hub.jobs import Jobs
from rendezview_service.hub.metrics import Metrics
from rendezview_service.hub.model_store import ModelStore, StoredModel
from rendezview_service.hub.once import Once
from rendezview_service.hub.session_defaults import SessionDefaults
from rendezview_service.hub.session_log import log_path
from rendezview_service.hub.sessions import Session
from rendezview_service.hub.source_process import SourceProcess
from rendezview_service.hub.viewers import Viewers
from rendezview_service.hub.worker_handle import WorkerGone, WorkerHandle, open_request
from rendezview_service.hub.worker_pool import WorkerPool
from rendezview_service.logs.log_folder import keep_logs
from rendezview_service.logs.recordings import Recordings
from rendezview_service.messages.message_parts import BudgetUse, Health
from rendezview_service.messages.messages import SessionRequest
from rendezview_service.settings import Settings
from rendezview_service.tracker.tracking import camera_message

log = logging.getLogger("rendezview_service")

_CLOSE_S, _STOP_S = 30.0, 4.0  # s, for a log to be completed; when all end. Source: chosen
_MOST_ENDED_PROCESSES = 3  # by frames of one session, as `Bar` has them. Source: a chosen limit
_REMEMBERED = 256  # openings and trainings, for requests that are repeated. Source: a chosen limit
# s; enough to read compiled loops from the cache; between checks for idle sessions. Source: chosen
_START_WAIT_S, _IDLE_CHECK_S = 20.0, 5.0


class Service:
    """Models, sessions, sources and jobs: the state that the routes act on."""

    def __init__(
        self,
        settings: Settings,
        model: Path | None = None,
        sources: list[str] | None = None,
        speed: float = 1.0,
        *,
        shares_models: bool = False,
    ) -> None:
        """A service that is not started yet.

        Args:
            model: a model file; clients can upload others.
            sources: each has its own session.
            shares_models: other services use the folders of the models and of the state too.
            speed: of sources that are files, as a multiple of their own rate; 0: no pauses.

        Raises:
            RendezviewError: a model, camera, source or folder is missing or wrong.
        """
        self.settings = settings
        self.metrics = Metrics()
        self.sessions: dict[str, Session] = {}
        self.ended: dict[str, str] = {}  # why the last ones ended, by id
        self.resuming: set[str | None] = set()  # of an earlier run, that will go on
        self.watchers, self.stopping = 0, False
        self.metrics.sessions.set_function(lambda: len(self.sessions))
        self.metrics.watchers.set_function(lambda: self.watchers)
        self.started_s = time.monotonic()
        self._sources: list[SourceProcess] = []
        self._alone = not shares_models
        logs = settings.record_folder
        if logs is not None and logs == settings.record:
            make_folder(logs)
        elif logs is not None and not logs.is_dir():
            reason = "its folder does not exist: create it first"
            raise RendezviewError(f"{settings.record}: {reason}")
        try:
            state, folder = settings.state_folder if self._alone else None, settings.models_folder
            self._state_lock = None if state is None else lock_state(state)
            self.resuming |= set() if state is None else names_in(state)
            self.models = ModelStore(folder, state if self._alone else folder, shared=shares_models)
            self.given: StoredModel | None = None if model is None else self.models.give(model)
            self.defaults = SessionDefaults(settings)
            for name in sources or []:
                self._sources.append(SourceProcess(name, self.defaults.camera))
            if self._sources and self.given is None:
                raise RendezviewError("a source needs a model to track with: name one")
        except RendezviewError:
            for source in self._sources:
                source.close()
            raise
        self.recordings = Recordings(logs)
        self._viewers, self.histories = Viewers(settings), Histories(settings.history_bytes)
        self._speed = speed
        self.jobs = Jobs(self.models, settings)
        self.workers = WorkerPool(settings, self.metrics, self._reopen)
        self._fed: dict[str, SourceProcess] = {}  # by session
        self._opening: set[str] = set()
        self.budgets = budgets_of(self.sessions, self.histories, settings)
        self.budgets["watchers"] = lambda: BudgetUse(used=self.watchers, most=settings.watchers)
        self._ending: dict[str, CheckpointKeeper] = {}  # of sessions that have ended
        self.once: Once[str] = Once(_REMEMBERED)  # ids of what requests have begun
        self._tasks: set[asyncio.Task[None]] = set()
        self._logs = 0  # new ones so far
        self._begun: asyncio.Task[None] | None = None
        self.failure: BaseException | None = None  # why the start failed
        self.on_failure: Callable[[], None] = lambda: None

    # Start and stop

    async def start(self) -> None:
        """Begin to start workers and sources, and to repair logs of an earlier run.

        It returns at once; `health` has the progress. If the start fails, `failure` says why.
        """
        folder = self.settings.record_folder
        if folder is not None:
            self._spawn(keep_logs(folder, self.settings.logs_bytes, self.settings.logs_s))
        self._begun = asyncio.create_task(self._begin())
        self._begun.add_done_callback(self._begin_done)
        self._spawn(self._housekeeping())

    async def _begin(self) -> None:
        start_s = time.monotonic()
        model = self.given or await asyncio.to_thread(self.models.first_readable)
        viewers = asyncio.to_thread(self._viewers.start)
        workers = self.workers.start(self.settings.workers or os.cpu_count() or 1)
        await asyncio.gather(viewers, workers)
        if model is not None:
            await self.workers.read(model)
        if self._alone and self.settings.state_folder is not None:
            await self._go_on(self.settings.state_folder)
        for number, source in enumerate(self._sources):
            name = "main" if number == 0 else f"source-{number + 1}"
            if source.camera is None:
                raise RendezviewError(f"{source.name}: no camera: give --camera")
            assert self.given is not None
            camera = camera_message(source.camera, checked=True)
            request = SessionRequest(id=name, model=self.given.name, camera=camera)
            request.notes.extend(source.notes or source.camera.doubts)
            session = await self._open(request, source)
            self._fed[session.id] = source
            source.feed(session, self._speed)
        log.info("ready", extra={"after_s": round(time.monotonic() - start_s, 1)})

    async def _go_on(self, folder: Path) -> None:
        """Continue the sessions of an earlier run."""
        used = set()
        for kept in await asyncio.to_thread(kept_in, folder):
            name, sha256 = kept.request.model, kept.model_sha256
            used.add(sha256)
            try:
                stored = self.models.kept(name or "model", sha256)
                await self._open(kept.request, resumed=kept, stored=stored)
            except (RendezviewError, Refused) as error:
                about = {"session": kept.request.id, "reason": str(error)}
                log.warning("a session does not go on", extra=about)
            self.resuming.discard(kept.request.id)
        self.resuming.clear()
        self.models.prune(used)

    def _begin_done(self, begun: asyncio.Task[None]) -> None:
        if begun.cancelled() or (error := begun.exception()) is None:
            return
        log.error("the service does not start", extra={"reason": str(error)})
        self.failure = error
        self.on_failure()

    async def stop(self) -> None:
        """Complete the logs, notify the watchers, end the processes."""
        self.stopping = True
        self.workers.stay_down()
        for task in (*self._tasks, *([] if self._begun is None else [self._begun])):
            task.cancel()
        sessions = list(self.sessions.values())
        await asyncio.gather(*(self.close(s, "the service ends", goes_on=True) for s in sessions))
        for source in self._sources:
            await asyncio.to_thread(source.close)
        await self.jobs.stop()
        await self.workers.stop()
        await asyncio.to_thread(self._viewers.close)

    def health(self) -> Health:
        """Whether frames can be tracked, and the reasons if not."""
        reasons = ["no worker process is ready"] * self.workers.none_ready
        if self._begun is not None and not self._begun.done():
            reasons = [f"starting: {self.workers.progress}"]
        known = self.sessions, self.budgets, reasons
        return health_of(*known, self.started_s, self.stopping)

    # Sessions

    async def open(self, request: SessionRequest, resumed: Checkpoint | None = None) -> Session:
        """Open a session, or go on with one of before; while the service starts, wait for that.

        Raises:
            RendezviewError: the request is wrong.
            Full: too many sessions are open.
            NotReady: no worker is ready, or loops are being compiled.
        """
        if self._begun is not None and not self._begun.done():
            try:
                await asyncio.wait_for(asyncio.shield(self._begun), _START_WAIT_S)
            except TimeoutError:
                raise NotReady(f"starting: {self.workers.progress}") from None
        return await self._open(request, resumed=resumed)

    async def _open(
        self,
        request: SessionRequest,
        source: SourceProcess | None = None,
        resumed: Checkpoint | None = None,
        stored: StoredModel | None = None,
    ) -> Session:
        if len(self.sessions) + len(self._opening) >= self.settings.sessions or self.stopping:
            raise Full
        name = request.id or f"s-{secrets.token_hex(4)}"
        if self.has(name):
            raise RendezviewError(f"session {name}: there is one already: choose another id")
        stored = stored or self.model_named(request.model)
        self._opening.add(name)
        try:
            request = await asyncio.to_thread(self.defaults.filled, request, name, stored)
            if request.sensors is not None and request.sensors.any:
                # One that is known already waits as long as it takes.
                known = source is not None or resumed is not None
                await self.workers.sensors_compiled(None if known else _START_WAIT_S)
            of = None if source is None else source.name
            shared = self.settings, self.metrics, self.histories
            session = Session(name, stored, request, *shared, of)
            if resumed is not None:
                session.resume(resumed)
            try:
                await self._place(session)
            except BaseException as error:
                session.end("it could not be opened")
                if isinstance(error, WorkerGone):
                    raise NotReady from None
                raise
        finally:
            self._opening.discard(name)
        self.sessions[name] = session
        if self.settings.state_folder is not None and source is None:
            keeper = CheckpointKeeper(checkpoint_path(self.settings.state_folder, name))
            kept = asyncio.Event()
            keeper.keep(session.checkpoint(), kept.set)
            session.keeper = keeper
            await kept.wait()
            if keeper.reason is not None and resumed is None:
                await self.close(session, "it has no checkpoint")
                raise RendezviewError(f"session {name} cannot be opened: {keeper.reason}")
        self._spawn(self.workers.prepare(list(self.sessions.values())))
        if self._viewers.any:
            self._spawn(self._viewers.follow(session))
        log.info("session", extra={"session": name, "model": stored.name, "state": "opened"})
        return session

    def has(self, name: str) -> bool:
        """Whether a session is open, or being opened or ended."""
        ending = self._ending.get(name)
        open_now = name in self.sessions or name in self._opening
        return open_now or (ending is not None and not ending.is_ended)

    async def close(self, session: Session, reason: str, *, goes_on: bool = False) -> None:
        """End a session and complete its log; with its checkpoint it may go on elsewhere."""
        if self.sessions.pop(session.id, None) is None:
            return
        self.ended = dict([*self.ended.items(), (session.id, reason)][-_REMEMBERED:])
        if (source := self._fed.pop(session.id, None)) is not None:
            await asyncio.to_thread(source.close)  # a driver may keep its process for seconds
        worker, keeper = session.worker, session.keeper
        if keeper is not None:
            self._ending[session.id] = keeper
        session.worker = None
        session.end(reason, 503 if goes_on and keeper is not None else 410)
        if worker is not None:
            worker.forget(session)
            with contextlib.suppress(WorkerGone, TimeoutError):
                asked = worker.ask({"kind": "close", "session": session.id})
                await asyncio.wait_for(asked, _STOP_S if self.stopping else _CLOSE_S)
        if keeper is not None:
            if goes_on:
                keeper.keep(session.checkpoint())
            if await asyncio.to_thread(keeper.end, remove=not goes_on):
                self._ending.pop(session.id, None)
        self.release()
        log.info("session", extra={"session": session.id, "state": "closed", "reason": reason})

    def release(self) -> None:
        """A session, or a name, does not need a model any more."""
        if not self.stopping:
            self.models.prune({session.stored.sha256 for session in self.sessions.values()})
            self._spawn(self.workers.prepare(list(self.sessions.values())))

    def model_named(self, name: str | None) -> StoredModel:
        """A model; None: the only one.

        Raises:
            RendezviewError: there is none, or several.
        """
        stored = self.given or self.models.only() if name is None else self.models.get(name)
        if stored is None:
            known = ", ".join(one.name for one in self.models.all()) or "none"
            said = "model: name one" if name is None else f"model {name}: not here"
            raise RendezviewError(f"{said} (there are: {known})")
        return stored

    async def _place(self, session: Session, worker: WorkerHandle | None = None) -> None:
        """Give a session to a worker; None: the one with the fewest sessions."""
        if worker is None or not worker.ready:
            worker = self.workers.least_busy()
        worker.sessions.add(session)
        place = self.settings.record
        if place is not None and session.request_now.record and session.log.base is None:
            session.log.base = log_path(place, session.id, first=self._logs == 0)
            self._logs += 1
        try:
            answer = await worker.ask(open_request(session))
        except WorkerGone:
            worker.sessions.discard(session)
            raise
        if answer["kind"] == "fault":
            worker.sessions.discard(session)
            raise RendezviewError(answer["error"])
        session.worker = worker
        session.recorded(answer)
        if session.waiting:
            worker.wake(session)

    async def _reopen(self, orphans: list[Session], worker: WorkerHandle | None) -> list[Session]:
        """Continue the sessions of a worker that ended with another one, or end them.

        Returns:
            those that have to wait, because no worker is ready.
        """
        start_s, left = time.monotonic(), []
        for session in orphans:
            if session.id not in self.sessions:
                continue
            if len(session.bar.ended_at_s) >= _MOST_ENDED_PROCESSES:
                await self.close(session, "its frames ended the tracker's process repeatedly")
                continue
            session.reopened()
            try:
                await self._place(session, worker)
                took_s = round(time.monotonic() - start_s, 3)
                log.warning("session moved", extra={"session": session.id, "took_s": took_s})
            except NotReady:
                left.append(session)
            except WorkerGone:
                pass  # its sessions, this one too, come here again
            except (RendezviewError, OSError) as error:
                await self.close(session, f"its tracker cannot be restarted: {error}")
        return left

    async def _housekeeping(self) -> None:
        while True:
            await asyncio.sleep(_IDLE_CHECK_S)
            used = [session.stored for session in self.sessions.values()]
            await asyncio.to_thread(self.models.rest, used)
            now_s = time.monotonic()
            for session in list(self.sessions.values()):
                if now_s - session.used_s > session.idle_s and session.id not in self._fed:
                    await self.close(session, f"no frame for {session.idle_s:g} s")

    def _spawn(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
