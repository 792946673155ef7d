"""What the service asks a worker for, beside frames and lines of sensors."""

from __future__ import annotations

from pathlib import Path

from rendezview_service.hub.model_store import StoredModel
from rendezview_service.hub.sessions import Session
from rendezview_service.messages.messages import SessionRequest
from rendezview_service.messages.wire import Header
from rendezview_service.settings import Settings


def open_request(session: Session, settings: Settings) -> Header:
    """Track a session from its next frame on, and record it if it has a log."""
    log_path = session.log.base
    return {
        "kind": "open",
        "session": session.id,
        "opened_unix_s": session.created_unix_s,
        "request": session.request_now.model_dump(mode="json"),
        "sight": sight_of(session.request, session.stored.copy),
        "model_file": session.stored.path.name,
        "sensors": settings.sensors,
        "forgotten": session.is_fused,
        "handover": session.handover,
        "first_frame": session.frame_base,
        "log": session.log.id,
        "log_path": None if log_path is None else str(log_path),
        "log_model": settings.record_model,
        "recording": {
            "images": settings.record_images,
            "sync": settings.sync,
            "compression": settings.compression,
            "part_bytes": settings.log_part_bytes,
            "part_s": settings.log_part_s,
            "wait_s": settings.log_wait_s,
            "memory_bytes": settings.log_memory_bytes,
        },
    }


def sight_of(request: SessionRequest, model: Path) -> Header:
    """What a session's recognizer is made for; the file of the model is named by its hash."""
    assert request.camera is not None
    camera = request.camera.model_dump(mode="json", exclude={"checked"})
    return {"camera": camera, "trees": request.trees, "model_path": str(model)}


def prepare_request(sights: list[Header]) -> Header:
    """Have these recognizers ready, and no others without a session."""
    return {"kind": "prepare", "session": "", "sights": sights}


def read_request(model: StoredModel) -> Header:
    """Read a model, before a session uses it."""
    return {"kind": "read", "session": "", "model_path": str(model.copy)}


def warm_request(*, sensors: bool) -> Header:
    """Load the loops of trackers, or compile them; and those of sessions' own sensors."""
    return {"kind": "warm", "session": "", "sensors": sensors}
