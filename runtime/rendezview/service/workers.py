"""The processes that track, together: how they come up, are warmed up, and are replaced."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable

from rendezview.errors import RendezviewError
from rendezview.service.metrics import Metrics
from rendezview.service.model_store import StoredModel
from rendezview.service.pool import Worker, WorkerGone
from rendezview.service.sessions import Session
from rendezview.service.settings import Settings

log = logging.getLogger("rendezview.service")

COMPILING = "loops are being compiled, some minutes, once: /readyz says when that is done"
_RESTART_PAUSE_S = 1.0
_WARM_WAIT_S = 20.0  # for loops that are only read from their cache
_STOP_S = 10.0


class NotReady(Exception):
    """There is no worker to track with, for the moment."""

    def __init__(self, reason: str = "no process that tracks is up: come back in a moment") -> None:
        super().__init__(reason)


class Workers:
    """As many as there are cores, or as the settings say; one that ends is replaced."""

    def __init__(
        self,
        settings: Settings,
        metrics: Metrics,
        orphaned: Callable[[list[Session]], Awaitable[None]],
    ) -> None:
        """None of them is started yet.

        Args:
            orphaned: gets the sessions of one that ended when there is another.
        """
        self._settings = settings
        self._metrics = metrics
        self._orphaned = orphaned
        self._workers: list[Worker] = []
        self._warm_with: StoredModel | None = None  # its loops are compiled in each worker
        self._warming: asyncio.Task[None] | None = None
        self._replacing: set[asyncio.Task[None]] = set()
        self._stopping = False

    async def start(self, count: int, model: StoredModel | None) -> None:
        """Start so many; a model warms them up.

        Raises:
            RendezviewError: one does not come up.
        """
        self._warm_with = model
        self._workers = [self._new() for _ in range(count)]
        try:
            # One first: what it compiles the others find compiled.
            await self._come_up(self._workers[0])
            await asyncio.gather(*map(self._come_up, self._workers[1:]))
        except (WorkerGone, TimeoutError, OSError) as error:
            raise RendezviewError(
                f"the processes that track do not start ({error or type(error).__name__})"
            ) from None

    async def stop(self) -> None:
        """End them all."""
        for worker in self._workers:
            worker.stop()
        await asyncio.gather(*(worker.join(_STOP_S) for worker in self._workers))

    def stay_down(self) -> None:
        """From now on none is replaced."""
        self._stopping = True
        for task in self._replacing:
            task.cancel()

    @property
    def none_ready(self) -> bool:
        """No worker is up."""
        return not any(worker.ready for worker in self._workers)

    @property
    def compiling(self) -> bool:
        """Loops are being compiled for the first model that came."""
        return self._warming is not None and not self._warming.done()

    def least_busy(self) -> Worker:
        """The worker with the fewest sessions.

        Raises:
            NotReady: none is up.
        """
        up = [worker for worker in self._workers if worker.ready]
        if not up:
            raise NotReady
        return min(up, key=lambda worker: len(worker.sessions))

    async def warmed(self, model: StoredModel) -> None:
        """Warm the workers up with the first model there is, if there was none at the start.

        Raises:
            RendezviewError: it is no model.
            NotReady: that takes longer, because loops have to be compiled.
        """
        if self._warm_with is None:
            self._warm_with = model
            self._warming = asyncio.create_task(self._warm_all(model))
        if self._warming is None:
            return
        try:
            await asyncio.wait_for(asyncio.shield(self._warming), _WARM_WAIT_S)
        except TimeoutError:
            raise NotReady(COMPILING) from None

    def _new(self) -> Worker:
        worker = Worker(self._settings.frame_bytes, self._settings.frame_timeout_s)
        worker.on_gone = self._gone
        return worker

    async def _come_up(self, worker: Worker) -> None:
        """Start a worker and warm it up."""
        await worker.start()
        if self._warm_with is not None:
            await self._warm(worker, self._warm_with)

    async def _warm(self, worker: Worker, model: StoredModel) -> None:
        """Have a worker compile what it needs; if it had to, in a process that only reads it."""
        request = {"kind": "warm", "session": "", "model_path": str(model.path)}
        answer = await worker.ask(request)
        if answer["kind"] == "fault":
            raise RendezviewError(answer["error"])
        if answer["compiled"]:
            log.info("compiled", extra={"loops": answer["compiled"]})
            await worker.restart()
            await worker.ask(request)

    async def _warm_all(self, model: StoredModel) -> None:
        first, *others = self._workers
        try:
            await self._warm(first, model)
            await asyncio.gather(*(self._warm(worker, model) for worker in others))
        except RendezviewError:
            self._warm_with = self._warming = None
            raise
        except (WorkerGone, TimeoutError, OSError):
            pass  # what comes up in its place warms up

    def _gone(self, worker: Worker) -> None:
        if self._stopping:
            return
        log.error("a process that tracks has ended; it is started anew")
        self._metrics.restarts.inc()
        task = asyncio.create_task(self._replace(worker))
        self._replacing.add(task)
        task.add_done_callback(self._replacing.discard)

    async def _replace(self, worker: Worker) -> None:
        """Another process for one that ended; its sessions go on, their trackers anew."""
        orphans = list(worker.sessions)
        for session in orphans:
            session.worker = None
        fresh = self._new()
        while True:
            try:
                await self._come_up(fresh)
                break
            except RendezviewError as error:
                # It is up; the model to warm it up with has gone, and the next one does that.
                log.warning("not warmed up", extra={"reason": str(error)})
                self._warm_with = self._warming = None
                break
            except (WorkerGone, TimeoutError, OSError):
                await asyncio.sleep(_RESTART_PAUSE_S)
                fresh = self._new()
        self._workers[self._workers.index(worker)] = fresh
        await self._orphaned(orphans)
