"""A session as a message."""

from __future__ import annotations

from rendezview_service.hub.sessions import Session
from rendezview_service.messages.frame_sensor_messages import FrameSensorsRequest
from rendezview_service.messages.messages import SessionInfo


def info_of(session: Session) -> SessionInfo:
    """The present state of a session."""
    assert session.request.camera is not None
    progress = session.progress
    return SessionInfo(
        id=session.id,
        model=session.model,
        model_sha256=session.stored.sha256,
        camera=session.request.camera,
        source=session.source,
        phase=progress.phase,
        created_unix_s=session.created_unix_s,
        frames=progress.frames,
        drops=session.drops,
        found_fraction=progress.found / progress.frames if progress.frames else None,
        watchers=len(session.watchers),
        last_frame=progress.last_frame,
        last_time_s=progress.last_time_s,
        since_pose_s=progress.since_pose_s,
        age_s=progress.age_s,
        alarms=session.events.alarms,
        sensors=session.sensors(),
        on_frames=session.request.sensors or FrameSensorsRequest(),
        recording=session.log.recording,
        finished=session.finished,
        reason=session.reason,
        warnings=list(dict.fromkeys(session.request.notes)),
        flight=session.flight.report,
    )
