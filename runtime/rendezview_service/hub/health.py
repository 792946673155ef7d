"""Whether the service can track, what is wrong, and what is in use."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol

from rendezview_service.hub.history import Histories
from rendezview_service.hub.sessions import Session
from rendezview_service.messages.message_parts import BudgetUse
from rendezview_service.messages.messages import Health, RecordingState
from rendezview_service.settings import Settings


class Observed(Protocol):
    """What health is made of."""

    settings: Settings
    sessions: dict[str, Session]
    histories: Histories
    budgets: dict[str, Callable[[], BudgetUse]]
    watchers: int
    stopping: bool
    started_s: float
    version: str


def health_of(service: Observed, reasons: list[str]) -> Health:
    """The health of a service.

    Args:
        reasons: why it cannot track.
    """
    failing, troubles = troubles_of(list(service.sessions.values()))
    budgets = {name: use() for name, use in service.budgets.items()}
    over = [name for name, budget in budgets.items() if budget.exceeded]
    troubles += [f"budget {name} is used up: whoever has the most is refused" for name in over]
    status = "stopping" if service.stopping else "not ready" if reasons else "ok"
    if status == "ok" and troubles:
        status = "degraded"
    return Health(
        status=status,  # type: ignore[arg-type]
        reasons=reasons + troubles,
        version=service.version,
        uptime_s=time.monotonic() - service.started_s,
        sessions=len(service.sessions),
        recording_failures=failing,
        budgets=budgets,
    )


def budgets_of(service: Observed) -> dict[str, Callable[[], BudgetUse]]:
    """What is in use of the budgets of sessions; those of requests come from the guard."""
    sessions, settings = service.sessions, service.settings

    def barred() -> int:
        return sum(one.bar.left_s > 0.0 for one in sessions.values())

    return {
        "history_bytes": lambda: BudgetUse(
            used=service.histories.held, most=settings.history_bytes
        ),
        "watchers": lambda: BudgetUse(used=service.watchers, most=settings.watchers),
        "sessions": lambda: BudgetUse(used=len(sessions), most=settings.sessions),
        "barred_sessions": lambda: BudgetUse(used=barred(), most=settings.sessions),
    }


def troubles_of(sessions: list[Session]) -> tuple[int, list[str]]:
    """How many sessions are not recorded, and what is wrong with any of them."""
    found = [said for session in sessions if (said := session.blind_reason)]
    barred = [(session.id, left_s) for session in sessions if (left_s := session.bar.left_s)]
    found += [f"session {name} is barred for {s:.0f} s: it ended a worker" for name, s in barred]
    logs = {session.id: session.log.recording for session in sessions}
    failed = {name: r for name, r in logs.items() if r.state is RecordingState.FAILED}
    found += [f"session {name} is not recorded: {r.reason}" for name, r in failed.items()]
    logs = {name: r for name, r in logs.items() if r.fault and name not in failed}
    found += [f"session {name} is recorded again: {r.fault}" for name, r in logs.items()]
    stays = {session.id: session.keeper.reason for session in sessions if session.keeper}
    found += [f"session {n} cannot go on elsewhere: {why}" for n, why in stays.items() if why]
    return len(failed), found
