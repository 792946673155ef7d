"""Whether the service can track, what is wrong, what is in use; and the state of a session."""

from __future__ import annotations

import time
from collections.abc import Callable
from importlib import metadata

from rendezview_service.hub.history import Histories
from rendezview_service.hub.sessions import Session
from rendezview_service.messages.frame_sensor_messages import FrameSensorsRequest
from rendezview_service.messages.message_parts import BudgetUse, Health
from rendezview_service.messages.messages import RecordingState, SessionInfo
from rendezview_service.settings import Settings

Budgets = dict[str, Callable[[], BudgetUse]]
VERSION = metadata.version("rendezview")


def health_of(
    sessions: dict[str, Session], uses: Budgets, reasons: list[str], started_s: float, stops: bool
) -> Health:
    """The health of a service.

    Args:
        reasons: why it cannot track.
        started_s: monotonic.
        stops: it ends.
    """
    failing, troubles = troubles_of(list(sessions.values()))
    budgets = {name: use() for name, use in uses.items()}
    over = [name for name, budget in budgets.items() if budget.exceeded]
    troubles += [f"budget {name} is used up: whoever has the most is refused" for name in over]
    status = "stopping" if stops else "not ready" if reasons else "ok"
    if status == "ok" and troubles:
        status = "degraded"
    return Health(
        status=status,  # type: ignore[arg-type]
        reasons=reasons + troubles,
        version=VERSION,
        uptime_s=time.monotonic() - started_s,
        sessions=len(sessions),
        recording_failures=failing,
        budgets=budgets,
    )


def budgets_of(sessions: dict[str, Session], histories: Histories, settings: Settings) -> Budgets:
    """What is in use of the budgets of sessions; those of requests come from the guard."""

    def barred() -> int:
        return sum(one.bar.left_s > 0.0 for one in sessions.values())

    return {
        "history_bytes": lambda: BudgetUse(used=histories.held, most=histories.most),
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


def info_of(session: Session) -> SessionInfo:
    """The present state of a session."""
    assert session.request.camera is not None
    progress = session.progress
    own = "id", "model", "source", "created_unix_s", "drops", "finished", "reason"
    so_far = "phase", "frames", "last_frame", "last_time_s", "since_pose_s", "age_s"
    return SessionInfo(
        **{name: getattr(session, name) for name in own},
        **{name: getattr(progress, name) for name in so_far},
        model_sha256=session.stored.sha256,
        camera=session.request.camera,
        found_fraction=progress.found / progress.frames if progress.frames else None,
        watchers=len(session.watchers),
        alarms=session.events.alarms,
        sensors=session.sensors(),
        on_frames=session.request.sensors or FrameSensorsRequest(),
        recording=session.log.recording,
        warnings=list(dict.fromkeys(session.request.notes)),
        flight=session.flight.report,
    )
