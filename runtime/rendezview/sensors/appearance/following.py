"""A whole sequence through the tracker, one observation for each frame."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import Any

import numpy.typing as npt

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose
from rendezview.io.results import ResultRow
from rendezview.io.sequences import Frame
from rendezview.io.sequences.frame import GreyImage
from rendezview.sensors.appearance.integrity.monitor import IntegrityMonitor, IntegrityOptions
from rendezview.sensors.appearance.model.view_model import ViewModel
from rendezview.sensors.appearance.observation import AppearanceObservation
from rendezview.sensors.appearance.outline.silhouette import SilhouetteOptions
from rendezview.sensors.appearance.recognizer import Recognizer
from rendezview.sensors.appearance.tracker import Tracker, TrackerOptions
from rendezview.sensors.run import observe


def follow(
    model: ViewModel,
    sequence: Iterable[Frame],
    *,
    prior: Pose | None = None,
    independent: bool = False,
    silhouette: SilhouetteOptions | None = None,
    options: TrackerOptions | None = None,
    sun_camera: npt.ArrayLike | None = None,
    refine: bool = True,
    sketch: bool = True,
    integrity: IntegrityOptions | None = None,
    expected: Callable[[Frame], tuple[Pose, Array] | None] | None = None,
    where: Callable[[Frame], npt.ArrayLike | None] | None = None,
    first_where: npt.ArrayLike | None = None,
    watch: Callable[[Frame, GreyImage | None, AppearanceObservation], None] | None = None,
) -> Iterator[tuple[Frame, AppearanceObservation]]:
    """One observation for each frame, in order.

    Args:
        model: of the target.
        sequence: frames; without times they count as one second apart.
        prior: camera_from_target of the first frame, right to about 20°; ``None``: all
            attitudes are searched.
        independent: each frame on its own, no memory, and no prior but the expected pose.
        silhouette: how to find the target.
        options: of the tracker.
        sun_camera: (3,) towards the Sun, camera frame, if it is known.
        refine: move poses onto the edges, if the model has contour points.
        sketch: search on a sketch of the frame where the edges give no pose, see ``Recognizer``.
        integrity: each pose gets a protection level and alarms.
        expected: the pose of a frame by other sensors, camera_from_target with its covariance
            (6, 6): where a target that is lost is searched, see `Tracker.expect`.
        where: the target is in each frame, as for `Recognizer.recognize`'s ``roi``.
        first_where: the same in the first frames, until there is a pose; in all if
            ``independent``.
        watch: called with every frame, its picture (None: unreadable) and its observation.

    A frame that cannot be read gives the status ``UNREADABLE``; the run goes on.

    Raises:
        RendezviewError: the times of the frames do not rise.
    """
    recognizers: dict[Camera, Recognizer] = {}
    tracker: Tracker | None = None

    def seen_in(frame: Frame, time_s: float, image: GreyImage) -> AppearanceObservation:
        nonlocal tracker
        if frame.camera not in recognizers:
            recognizers[frame.camera] = Recognizer(
                model, frame.camera, silhouette, refine=refine, sketch=sketch
            )
        recognizer = recognizers[frame.camera]
        roi = first_where if where is None else where(frame)
        if independent:
            known = None if expected is None else expected(frame)
            near = None if known is None else known[0]
            alone = recognizer.recognize(image, near, sun_camera=sun_camera, time_s=time_s, roi=roi)
            if integrity is None:
                return alone
            look = partial(recognizer.second_estimate, image)
            monitor = IntegrityMonitor(integrity)
            return monitor.protected(alone, time_s, None, model.centre_m, look)
        tracker = tracker or Tracker(recognizer, prior, options, integrity)
        tracker.recognizer = recognizer
        if expected is not None and tracker.lost and (known := expected(frame)) is not None:
            tracker.expect(*known)
        if where is None and tracker.prior is not None:
            roi = None  # it knows where to look
        return tracker.update(time_s, image, sun_camera, roi)

    for frame, image, observation in observe(
        sequence, seen_in, AppearanceObservation, ordered=not independent
    ):
        if watch is not None:
            watch(frame, image, observation)
        yield frame, observation


def result_row(scene_id: int, frame: Frame, observation: AppearanceObservation) -> ResultRow | None:
    """One frame as a row of the results; ``None`` without a pose."""
    if observation.pose is None:
        return None
    spent_s = 1e-3 * sum(observation.stage_ms.values())
    return ResultRow(
        scene_id, frame.im_id, frame.obj_id, observation.score, observation.pose, spent_s
    )


def record(frame: Frame, observation: AppearanceObservation) -> dict[str, Any]:
    """One frame as a line of a JSON log."""
    # A frame without a time is tracked as one second after the last, but logged without.
    return (
        {"im_id": frame.im_id, "image": frame.name}
        | observation.record()
        | {"time_s": frame.time_s}
    )
