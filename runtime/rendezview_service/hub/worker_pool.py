"""All worker processes: they are started, warmed up and replaced here."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Awaitable, Callable, Coroutine, Iterable
from typing import Any

from rendezview.errors import RendezviewError
from rendezview_service.hub.inputs import NotReady
from rendezview_service.hub.metrics import Metrics
from rendezview_service.hub.model_store import StoredModel
from rendezview_service.hub.sessions import Session
from rendezview_service.hub.worker_handle import WorkerGone, WorkerHandle, sight_of
from rendezview_service.messages.wire import Header
from rendezview_service.settings import Settings

log = logging.getLogger("rendezview_service")

COMPILING = "loops are being compiled, which takes minutes, once: /readyz reports when it is done"
_MOST_PREPARED = 4  # recognizers, 90 MB each, that the spare worker has ready. Source: chosen
_SPARE_PAUSE_S = 1.0  # s, in which moved sessions have the processor alone. Source: chosen
_RESTART_PAUSE_S = 1.0  # s, between attempts to replace a worker. Source: chosen
_LOOK_S = 0.2  # s; between questions whether loops are compiled. Source: chosen
_STOP_S = 3.0  # s, for a process to end, then it is killed. Source: chosen


class WorkerPool:
    """A fixed number of workers, and a spare one that takes the place of one that ends.

    Sessions of a worker that ended continue at once, with the spare one or with another.
    """

    def __init__(
        self,
        settings: Settings,
        metrics: Metrics,
        orphaned: Callable[[list[Session], WorkerHandle | None], Awaitable[list[Session]]],
    ) -> None:
        """A pool whose workers are not started yet.

        Args:
            orphaned: receives the sessions of a worker that ended, once another is ready, and
                the spare one if it takes its place; returns those that have to wait.
        """
        self._settings = settings
        self._metrics = metrics
        self._orphaned = orphaned
        self._workers: list[WorkerHandle] = []
        self._spare: WorkerHandle | None = None
        self._sights: list[Header] = []  # what the spare worker has ready
        self._replacing: set[asyncio.Task[None]] = set()
        self._stopping = False
        self.progress = "the worker processes start"
        # Whether the loops of sessions' own sensors are still being compiled.
        self.without_sensors: Callable[[], bool] = lambda: False

    async def start(self, count: int) -> None:
        """Start ``count`` workers and warm them up.

        Raises:
            RendezviewError: a worker does not start.
        """
        self._workers = [self._new() for _ in range(count)]
        try:
            # One first: the others then read its compiled code.
            await self._start_one(self._workers[0])
            if len(self._workers) > 1:
                self.progress = f"1 of {len(self._workers)} worker processes is ready"
            await asyncio.gather(*map(self._start_one, self._workers[1:]))
            if self._settings.spare_worker:
                self._spawn(self._replace(None, []))
        except (WorkerGone, TimeoutError, OSError) as error:
            raise RendezviewError(
                f"the worker processes do not start ({error or type(error).__name__}): see the log"
            ) from None

    async def stop(self) -> None:
        """Stop all workers."""
        workers = [*self._workers, *([] if self._spare is None else [self._spare])]
        for worker in workers:
            worker.stop()
        await asyncio.gather(*(worker.join(_STOP_S) for worker in workers))

    def stay_down(self) -> None:
        """Replace no worker from now on."""
        self._stopping = True
        for task in self._replacing:
            task.cancel()

    @property
    def none_ready(self) -> bool:
        """Whether no worker is ready."""
        return not any(worker.ready for worker in self._workers)

    def least_busy(self) -> WorkerHandle:
        """The worker with the fewest sessions.

        Raises:
            NotReady: there is none.
        """
        ready = [worker for worker in self._workers if worker.ready]
        if not ready:
            raise NotReady
        return min(ready, key=lambda worker: len(worker.sessions))

    async def prepare(self, sessions: Iterable[Session]) -> None:
        """Have the spare worker ready for these sessions, so that it can take over at once."""
        found: list[Header] = []
        for session in sessions:
            sight = sight_of(session.request, session.stored.copy)
            if sight not in found:
                found.append(sight)
        self._sights = found[-_MOST_PREPARED:]
        if self._spare is not None and self._spare.ready:
            with contextlib.suppress(WorkerGone):
                await self._spare.ask({"kind": "prepare", "sights": self._sights})

    async def expect(self, sights: list[Header]) -> None:
        """Have all workers ready for sessions that may come; see `sight_of`."""
        await self._ask_all({"kind": "prepare", "sights": sights[-_MOST_PREPARED:]})

    async def read(self, model: StoredModel) -> None:
        """Have all workers read a model, before a session uses it."""
        await self._ask_all({"kind": "read", "model_path": str(model.copy)})

    async def _ask_all(self, request: Header) -> None:
        for worker in self._workers:
            if worker.ready:
                with contextlib.suppress(WorkerGone):
                    await worker.ask(request)

    async def sensors_compiled(self, within_s: float | None) -> None:
        """Wait until the loops of sessions' own sensors are compiled; None: for any time.

        Raises:
            NotReady: it takes longer.
        """
        try:
            async with asyncio.timeout(within_s):
                while self.without_sensors():
                    await asyncio.sleep(_LOOK_S)
        except TimeoutError:
            raise NotReady(COMPILING) from None

    def _new(self) -> WorkerHandle:
        worker = WorkerHandle(self._settings)
        worker.on_gone = self._gone
        worker.on_progress = self._compiled
        return worker

    def _compiled(self, loops: int) -> None:
        """A worker has compiled so many loops."""
        self.progress = f"{loops} loops compiled so far; this takes minutes, once a machine"
        log.info("compiling", extra={"loops": loops})

    async def _start_one(self, worker: WorkerHandle) -> None:
        """Start a worker with its loops; if it had to compile, again, to read them from the cache.

        Raises:
            RendezviewError: they cannot be compiled.
        """
        await worker.start()
        request = {"kind": "warm", "sensors": not self.without_sensors()}
        answer = await worker.ask(request)
        if answer["kind"] == "fault":
            raise RendezviewError(answer["error"])
        if answer["compiled"]:
            log.info("compiled", extra={"loops": answer["compiled"]})
            await worker.restart()
            await worker.ask(request)

    def _gone(self, worker: WorkerHandle) -> None:
        known = worker is self._spare or worker in self._workers
        if self._stopping or not known:  # who starts another one sees its end
            return
        log.error("a worker process has ended and is being replaced")
        self._metrics.restarts.inc()
        orphans = list(worker.sessions)
        for session in orphans:
            session.worker = None
        if worker is self._spare:
            self._spare = None
            self._spawn(self._replace(None, []))
            return
        if self._spare is not None and self._spare.ready:
            takes_over, self._spare = self._spare, None
            self._workers[self._workers.index(worker)] = takes_over
            self._spawn(self._replace(None, orphans, takes_over))
        else:
            self._spawn(self._replace(worker, orphans))

    async def _replace(
        self,
        gone: WorkerHandle | None,
        orphans: list[Session],
        takes_over: WorkerHandle | None = None,
    ) -> None:
        """Start a worker in place of one that ended, or as the spare one.

        Its sessions continue with new trackers, as soon as any worker is ready.
        """
        if orphans and not self.none_ready:
            orphans = await self._orphaned(orphans, takes_over)
            if takes_over is not None:
                with contextlib.suppress(WorkerGone):
                    await takes_over.ask({"kind": "prepare", "sights": []})
                await asyncio.sleep(_SPARE_PAUSE_S)
        fresh = self._new()
        while True:
            try:
                await self._start_one(fresh)
                break
            except RendezviewError as error:  # it runs
                log.warning("not warmed up", extra={"reason": str(error)})
                break
            except (WorkerGone, TimeoutError, OSError):
                await asyncio.sleep(_RESTART_PAUSE_S)
                fresh = self._new()
        if gone is not None:
            self._workers[self._workers.index(gone)] = fresh
        else:
            self._spare = fresh
            with contextlib.suppress(WorkerGone):
                await fresh.ask({"kind": "prepare", "sights": self._sights})
                log.info("a spare worker is ready")
        while orphans := await self._orphaned(orphans, None):
            await asyncio.sleep(_RESTART_PAUSE_S)

    def _spawn(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.create_task(work)
        self._replacing.add(task)
        task.add_done_callback(self._replacing.discard)
