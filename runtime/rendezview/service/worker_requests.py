"""What the service asks a worker for, beside frames and lines of sensors."""

from __future__ import annotations

from rendezview.service.model_store import StoredModel
from rendezview.service.sessions import Session
from rendezview.service.settings import Settings
from rendezview.service.wire import Header


def open_request(session: Session, settings: Settings) -> Header:
    """Track a session from its next frame on, and record it if it has a log."""
    log_path = session.log.base
    return {
        "kind": "open",
        "session": session.id,
        "request": session.request_now.model_dump(mode="json"),
        "sight": sight_of(session),
        "model_file": session.stored.path.name,
        "sensors": settings.sensors,
        "forgotten": session.is_fused or session.was_fused,
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
        },
    }


def sight_of(session: Session) -> Header:
    """What its recognizer is made for."""
    camera, trees = session.request.camera, session.request.trees
    assert camera is not None
    asked = {"camera": camera.model_dump(mode="json"), "trees": trees}
    return asked | {"model_path": str(session.stored.copy)}


def prepare_request(sights: list[Header]) -> Header:
    """Have these recognizers ready, and no others without a session."""
    return {"kind": "prepare", "session": "", "sights": sights}


def warm_request(model: StoredModel) -> Header:
    """Read a model, and compile the loops that it needs."""
    return {"kind": "warm", "session": "", "model_path": str(model.copy)}
