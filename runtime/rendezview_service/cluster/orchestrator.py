"""The orchestrator: which session has which slot. One of a cluster; gateways ask it."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import secrets
import time
from collections import Counter
from collections.abc import Coroutine
from pathlib import Path
from typing import Any

import ray
from starlette.types import Scope

from rendezview.errors import RendezviewError
from rendezview_service.cluster.tunnel import exchange
from rendezview_service.cluster.worker import Slot
from rendezview_service.http.app import make_routes
from rendezview_service.hub.checkpoint import SUFFIX, checkpoint_path, read_checkpoint
from rendezview_service.hub.inputs import Full, NotReady, Refused
from rendezview_service.hub.model_store import BY_HASH
from rendezview_service.hub.service import Service
from rendezview_service.json_logging import set_up_logging
from rendezview_service.logs.log_folder import keep_logs
from rendezview_service.messages.messages import SessionRequest
from rendezview_service.settings import Settings

log = logging.getLogger("rendezview_service")

NAMESPACE, ORCHESTRATOR = "rendezview", "orchestrator"
_HEAD = "node:__internal_head__"  # a resource of Ray's head node. Source: Ray's name for it
_LOOK_S = 0.5  # s, between looks at nodes and slots. Source: chosen
_START_S = 300.0  # s, for a slot's first answer. Source: a chosen limit
_ANSWER_S = 10.0  # s, for an answer of a slot; then it counts as dead. Source: chosen
_TAKE_S = 30.0  # s, the same to open a session: its worker may have a model to read. Source: chosen


_Expected = dict[str, Path | None]  # sessions and their models


class Orchestrator:
    """Gives slots to sessions, and another one when a slot ends. Keeps nothing of its own: after a
    restart it asks the slots, and the checkpoints say which sessions are open."""

    def __init__(self, settings: dict[str, Any]) -> None:
        self._settings = Settings.model_validate(settings)
        set_up_logging(self._settings.log_level)
        assert self._settings.state_folder is not None
        self._folder = self._settings.state_folder
        self._folder.mkdir(parents=True, exist_ok=True)
        self._service = Service(self._settings, shares_models=True)  # models only: not started
        self._app = make_routes(self._service)
        self._nodes: dict[str, str] = {}  # of a slot
        self._ready: set[str] = set()
        self._held: dict[str, str] = {}  # session: slot
        self._locks: dict[str, asyncio.Lock] = {}
        self._processes: dict[str, int] = {}  # of the slots
        self._changes: Counter[str] = Counter()  # of what a slot has: an older answer is too old
        self._asked: set[str] = set()  # slots, at least once
        self._knows = False  # what all slots have: after a restart it takes a moment
        self._copies: dict[str, Path] = {}  # of the sessions: their models
        self._expects: dict[str, _Expected] = {}  # what a slot is ready for
        self._reasons: dict[str, list[str]] = {}  # what is wrong at a slot
        self._busy: dict[str, asyncio.Task[None]] = {}  # slots and sessions
        self._looking: asyncio.Task[None] | None = None

    async def start(self) -> None:
        """Begin to look after nodes and slots."""
        self._start()

    def _start(self) -> None:
        if self._looking is None:
            self._looking = asyncio.create_task(self._look())
            folder = self._settings.record_folder
            if folder is not None:
                limits = self._settings.logs_bytes, self._settings.logs_s
                self._repairing = asyncio.create_task(keep_logs(folder, *limits))

    async def _look(self) -> None:
        while True:
            try:
                await self._look_once()
            except Exception:
                log.exception("the orchestrator failed at a look at the cluster")
            await asyncio.sleep(_LOOK_S)

    async def _look_once(self) -> None:
        found = await asyncio.to_thread(ray.nodes)
        nodes = {n["NodeID"]: int(n["Resources"].get("CPU", 0)) for n in found if n["Alive"]}
        wanted = {f"slot-{node[:12]}-{k}": node for node, c in nodes.items() for k in range(c)}
        for slot in set(self._nodes) - set(wanted):
            self._forget(slot)
            del self._nodes[slot]
        for slot, node in wanted.items():
            if slot not in self._nodes:
                self._nodes[slot] = node
                make_slot(slot, node, self._settings)
            self._begin(slot, self._ask(slot))
        used = set(self._held) | set(self._busy)
        self._locks = {n: lock for n, lock in self._locks.items() if n in used or lock.locked()}
        # After a restart the slots must have said what they have, before a session gets another.
        self._knows = self._knows or set(wanted) <= self._asked
        if not self._knows:
            return
        for path in self._folder.glob(f"*{SUFFIX}"):
            name = path.name.removesuffix(SUFFIX)
            if name not in self._held:
                self._begin(name, self._continue(name))

    def _must_know(self) -> None:
        """A orchestrator that has just started must not give a session a second slot.

        Nobody starts one that Ray has started again: the first call does.
        """
        self._start()
        if not self._knows:
            raise NotReady(
                "the orchestrator has just started and asks the slots: try again in a moment"
            )

    def _begin(self, name: str, work: Coroutine[Any, Any, None]) -> None:
        """Do something about a slot or session, unless it is being done."""
        if name in self._busy:
            work.close()
            return
        self._busy[name] = asyncio.create_task(work)
        self._busy[name].add_done_callback(lambda _: self._busy.pop(name))

    async def _continue(self, name: str) -> None:
        """Give a slot to a session that is open and has none."""
        try:
            await self.where(name, None)
        except (Refused, RendezviewError) as error:
            log.warning("a session waits", extra={"session": name, "reason": str(error)})
            await asyncio.sleep(_LOOK_S)

    async def _ask(self, slot: str) -> None:
        """Whether a slot is ready, and the session it has; a free one prepares for the others."""
        changes = self._changes[slot]
        try:
            actor = ray.get_actor(slot, NAMESPACE)
            limit_s = _ANSWER_S if slot in self._ready else _START_S
            known = await asyncio.wait_for(actor.state.remote(), limit_s)
        except (ray.exceptions.RayError, ValueError, TimeoutError):
            self._asked.add(slot)
            for name in self._forget(slot):
                self._begin(name, self._move(name, slot))
            return
        self._asked.add(slot)
        self._processes[slot], is_ready, held, reasons = known
        if changes != self._changes[slot]:
            return
        self._reasons[slot] = reasons
        if is_ready or held is not None:  # its worker may be starting again
            self._ready.add(slot)
        else:
            self._ready.discard(slot)
        if held is None:
            for name in [n for n, s in self._held.items() if s == slot]:
                del self._held[name]
            if not is_ready:
                return
            wanted = self._wanted()
            if self._expects.get(slot) != wanted:
                with contextlib.suppress(ray.exceptions.RayError):
                    await actor.expect.remote(list(wanted))
                    self._expects[slot] = wanted
        elif self._held.setdefault(held, slot) != slot:
            self._end(slot)  # the session has another slot by now

    async def _move(self, name: str, slot: str) -> None:
        """Give another slot to a session whose slot does not answer; the old one is ended."""
        self._held.setdefault(name, slot)
        with contextlib.suppress(Refused, RendezviewError):
            await self.where(name, slot)

    def _forget(self, slot: str) -> list[str]:
        """A slot cannot be used now; its sessions."""
        self._changes[slot] += 1
        self._ready.discard(slot)
        self._expects.pop(slot, None)
        self._reasons.pop(slot, None)
        names = [n for n, s in self._held.items() if s == slot]
        for name in names:
            del self._held[name]
        return names

    def _wanted(self) -> _Expected:
        """The open sessions; one that is being opened has no checkpoint yet."""
        there = [n for n in self._held if checkpoint_path(self._folder, n).exists()]
        return {name: self._copies.get(name) for name in there}

    def _lock(self, name: str) -> asyncio.Lock:
        return self._locks.setdefault(name, asyncio.Lock())

    def _free(self, not_on: str | None = None, copy: Path | None = None) -> list[str]:
        """Free slots: first those that have read a model, then those of other nodes."""
        free = [slot for slot in self._ready if slot not in self._held.values()]
        busy = list(self._held.values())
        load = {n: sum(self._nodes.get(s) == n for s in busy) for n in self._nodes.values()}

        def cost(slot: str) -> tuple[bool, bool, int, str]:
            node = self._nodes[slot]
            has_read = copy in self._expects.get(slot, {}).values()
            return not has_read, node == not_on, load[node], slot

        return sorted(free, key=cost)

    async def open(self, request: dict[str, Any], key: str | None) -> tuple[str, str]:
        """Open a session, once for a key; its name and slot.

        Raises:
            RendezviewError, Full, NotReady: as `Service.open`.
        """
        asked = SessionRequest.model_validate(request)

        async def opened() -> str:
            return await self._open(asked)

        name = await self._service.once.do(key, asked.model_dump_json(), opened)
        slot = await self.where(name, None)
        if slot is None:
            raise NotReady("the session has ended meanwhile: open another one")
        return name, slot

    async def _open(self, asked: SessionRequest) -> str:
        self._must_know()
        name = asked.id or f"s-{secrets.token_hex(4)}"
        stored = self._service.model_named(asked.model)
        async with self._lock(name):
            if name in self._held or checkpoint_path(self._folder, name).exists():
                raise RendezviewError(f"session {name}: there is one already: choose another id")
            if not self._ready:
                raise NotReady("no slot is ready: the cluster's nodes start")
            if len(self._free()) <= self._settings.spare_seats:
                raise Full
            copy = await asyncio.to_thread(lambda: stored.copy)
            named = asked.model_copy(update={"id": name, "model": stored.name})
            await self._placed(named, copy, None, resumes=False)
            return name

    async def where(self, name: str, dead: str | None) -> str | None:
        """The slot of a session; None if it is not open.

        Args:
            dead: a slot that did not answer: it is ended, and the session takes another one.

        Raises:
            NotReady: no slot is free, or the orchestrator does not know yet.
        """
        self._must_know()
        async with self._lock(name):
            slot = self._held.get(name)
            if slot is not None and slot != dead:
                return slot
            kept = read_checkpoint(checkpoint_path(self._folder, name))
            if kept is None:
                return None
            node = None
            if dead is not None:
                node = self._nodes.get(dead)
                self._end(dead)
            copy = self._service.models.folder / BY_HASH / f"{kept.model_sha256}.rvm"
            return await self._placed(kept.request, copy, node, resumes=True)

    def _end(self, slot: str) -> None:
        """A slot that may still run must not go on beside its session's next one."""
        self._forget(slot)
        with contextlib.suppress(ValueError):  # it is gone
            ray.kill(ray.get_actor(slot, NAMESPACE), no_restart=False)

    async def _placed(
        self, request: SessionRequest, copy: Path, not_on: str | None, resumes: bool
    ) -> str:
        assert request.id is not None
        for slot in self._free(not_on, copy):
            self._held[request.id], start_s = slot, time.monotonic()
            self._changes[slot] += 1
            try:
                actor = ray.get_actor(slot, NAMESPACE)
                taken = actor.take.remote(request.model_dump(mode="json"), str(copy), resumes)
                await asyncio.wait_for(taken, _TAKE_S)
            except (ray.exceptions.RayActorError, ValueError, TimeoutError):
                self._held.pop(request.id, None)
                self._end(slot)
                continue
            except BaseException:
                self._held.pop(request.id, None)
                raise
            self._changes[slot] += 1
            self._copies[request.id] = copy
            took = {"session": request.id, "took_s": round(time.monotonic() - start_s, 3)}
            log.info("a slot is taken", extra=took | {"seat": slot})
            return slot
        raise NotReady("no slot is free: add a node")

    async def roll(self, model: str) -> int:
        """Move the sessions of a model to its present file, one after the other; how many.

        Each takes a free slot that has read the file before, with its last pose as prior.
        """
        self._must_know()
        stored = self._service.model_named(model)
        copy, moved = await asyncio.to_thread(lambda: stored.copy), 0
        for name, slot in list(self._held.items()):
            kept = read_checkpoint(checkpoint_path(self._folder, name))
            if kept is None or kept.request.model != model:
                continue
            if kept.model_sha256 == copy.stem:
                continue
            free = self._free(copy=copy)
            if not free:
                raise NotReady("no slot is free: add a node")
            await ray.get_actor(free[0], NAMESPACE).expect.remote([name], str(copy))
            self._expects[free[0]] = {name: copy}
            async with self._lock(name):
                if self._held.get(name) != slot:
                    continue
                self._changes[slot] += 1
                await ray.get_actor(slot, NAMESPACE).let_go.remote(name)
                self._changes[slot] += 1
                await self._placed(kept.request, copy, None, resumes=True)
            moved += 1
        return moved

    async def sessions(self) -> dict[str, str]:
        """Slots by session; raises NotReady if it does not know yet."""
        self._must_know()
        return dict(self._held)

    async def slots(self) -> list[dict[str, Any]]:
        """The slots that are ready: node, session, and whether it has read the models in use.

        Raises:
            NotReady: it does not know yet.
        """
        self._must_know()
        held = {slot: name for name, slot in self._held.items()}
        wanted = self._wanted()
        return [
            {
                "seat": slot,
                "node": self._nodes[slot],
                "process": self._processes[slot],
                "session": held.get(slot),
                "warm": self._expects.get(slot, {}) == wanted,
                "reasons": self._reasons.get(slot, []),
            }
            for slot in sorted(self._ready & set(self._nodes))
        ]

    async def http(self, scope: Scope, body: bytes) -> tuple[int, list[Any], bytes]:
        """The answer to a request about models, trainings or recordings."""
        return await exchange(self._app, scope, body)


def make_slot(name: str, node: str, settings: Settings) -> None:
    """Create a slot on a node; if its process ends, Ray starts it again there."""
    place = ray.util.scheduling_strategies.NodeAffinitySchedulingStrategy(node, soft=False)
    _actor(Slot, name, settings, num_cpus=1, scheduling_strategy=place)


def join(settings: Settings) -> Any:
    """Join the cluster of the settings; its orchestrator, which the first gateway starts."""
    ray.init(address=settings.cluster, namespace=NAMESPACE, log_to_driver=False)
    on_head = {_HEAD: 0.001}  # without the head there is no cluster
    return _actor(Orchestrator, ORCHESTRATOR, settings, num_cpus=0, resources=on_head)


def _actor(kind: type, name: str, settings: Settings, **place: Any) -> Any:
    """The actor of a name; it is made if there is none, and stays."""
    stays = {"lifetime": "detached", "get_if_exists": True, "max_restarts": -1}
    options = {"namespace": NAMESPACE, "max_concurrency": 1000} | stays | place
    return ray.remote(kind).options(name=name, **options).remote(settings.model_dump(mode="json"))
