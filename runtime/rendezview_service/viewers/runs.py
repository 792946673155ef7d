"""Reads the moments of a run from JSON lines of any sensor or a log of the service."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rendezview.errors import RendezviewError, optional
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.io.results import read_json_lines
from rendezview.io.sequences import Frame, Sequence
from rendezview.io.sequences.frame import GreyImage


@dataclass(frozen=True, slots=True, eq=False)
class Moment:
    """One line of a log, with the frame's other data."""

    index: int  # frame number, else line number
    time_s: float | None
    record: dict[str, Any]
    camera: Camera | None = None
    image: GreyImage | None = None
    truth: Pose | None = None  # camera_from_target


def moments(log: Path, scene: Sequence | None = None) -> Iterator[Moment]:
    """The moments of a run, in order.

    Args:
        log: JSON lines of ``track``, ``ring``, ``reflectors``, ``stereo`` or ``fuse``, or a log
            (``.mcap``) of the service.
        scene: the pictures, where the log does not hold them: those of the same ``im_id``.

    Raises:
        RendezviewError: a file is missing or wrong, or the log is not of this scene.
    """
    if log.suffix.lower() == ".mcap":
        return _of_service(log)
    return _of_lines(log, scene)


def _of_lines(log: Path, scene: Sequence | None) -> Iterator[Moment]:
    frames: dict[int, Frame] = {} if scene is None else {f.im_id: f for f in scene}
    records = read_json_lines(log)
    if not records:
        raise RendezviewError(f"{log}: holds no line: give the log of a run")
    for number, record in enumerate(records):
        im_id, time_s = record.get("im_id"), record.get("time_s")
        if not ("status" in record and (time_s is None or isinstance(time_s, int | float))):
            raise RendezviewError(
                f"{log}: line {number + 1}: has no status or no time: this is no log of a run"
            )
        index = im_id if isinstance(im_id, int) else number
        frame = frames.get(index) if isinstance(im_id, int) else None
        if frame is None and scene is not None:
            raise RendezviewError(
                f"{log}: line {number + 1}: im_id {im_id} is no frame of {scene.source}: give the "
                "scene of this run"
            )
        if frame is None:
            yield Moment(index, time_s, record)
            continue
        try:
            image = frame.read()
        except RendezviewError:
            image = None  # the record's status gives the reason
        yield Moment(index, time_s, record, frame.camera, image, frame.camera_from_target)


def _of_service(log: Path) -> Iterator[Moment]:
    with optional(f"{log}: logs of the service need", "service"):
        from rendezview_service.logs.replay import read_log
        from rendezview_service.messages.frames import read_frame
    opened = read_log(log)
    camera, number = opened.camera, 0
    for frame in opened.frames():
        if frame.state is None:
            continue
        image = None
        if frame.image is not None and camera is not None:
            image = read_frame(frame.image, camera)
        yield Moment(frame.state["frame"], frame.time_s, frame.state, camera, image)
        number += 1
    if not number:
        raise RendezviewError(f"{log}: holds no state: was it recorded by `rendezview serve`?")
