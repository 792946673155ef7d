"""The ring sensor: frames in, the ring's pose out, with memory from frame to frame."""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rendezview.geometry.camera import Camera
from rendezview.sensors.observation import Status
from rendezview.sensors.ring.choice import Choice, MotionChooser, by_attitude, by_plane, only_one
from rendezview.sensors.ring.circle_pose import CirclePose, shape_of_circle
from rendezview.sensors.ring.concentric import joint_poses
from rendezview.sensors.ring.detector import Detection, RingDetector, RingEdge, RingOptions
from rendezview.sensors.ring.ellipse import Ellipse
from rendezview.sensors.ring.observation import RingObservation

Array = npt.NDArray[np.float64]

_MOST_COMPANIONS = 5  # Source: by construction, a bound of time
# Of the ring's radius, or its inverse: other edges are a nozzle's rim or a flange, not in its plane
_LEAST_COMPANION = 0.8
_FORGET_FRAMES = 5  # frames without a pose, after which the last one is forgotten
_RANGE_TOLERANCE = 0.15  # of the laser's range: it may meet another part of the target
_PLACE_TOLERANCE = 0.35  # of the semi-axis: how far a ring may have moved since it was known


@dataclass(frozen=True, slots=True, eq=False)
class RingPrior:
    """Knowledge of other sensors before a frame; any of it may be None."""

    centre_m: Array | None = None  # (3,) of the ring, camera frame
    axis: Array | None = None  # (3,) camera frame
    range_m: float | None = None  # to the ring's centre; counts while its place is not known


class RingSensor:
    """Follows one ring through the frames of a camera.

    Threads may share an instance: their calls run one after the other.

    Args:
        camera: of the frames.
        radius_m: of the ring's edge; None: ellipses only.
        options: of the detector.
    """

    def __init__(
        self, camera: Camera, radius_m: float | None = None, options: RingOptions | None = None
    ) -> None:
        if radius_m is not None and not (math.isfinite(radius_m) and radius_m > 0.0):
            raise ValueError(f"radius_m must be positive, not {radius_m}")
        self.camera, self.radius_m = camera, radius_m
        self._detector = RingDetector(camera, options)
        self._lock = threading.Lock()
        self.reset()

    def reset(self) -> None:
        """Forget the frames so far, and their times."""
        with self._lock:
            self._last_s = -math.inf
            self._forget()

    def _forget(self) -> None:
        self._last: CirclePose | None = None
        self._pair: tuple[CirclePose, ...] = ()  # of the last frame, where none was chosen
        self._missed = 0
        self._motion = MotionChooser()

    def update(
        self, time_s: float, image: npt.ArrayLike, prior: RingPrior | None = None
    ) -> RingObservation:
        """Look at the next frame, (H, W) uint8.

        Args:
            time_s: of the frame, later than that of the frame before.
            image: the picture.
            prior: what other sensors know; it wins over the memory of the last frame.

        Raises:
            ValueError: the time is not finite, or not later than that of the frame before.
            RendezviewError: the image is not one of this camera's.
        """
        with self._lock:
            if not (math.isfinite(time_s) and time_s > self._last_s):
                raise ValueError(
                    f"frames must come in order of time: {time_s} after {self._last_s}"
                )
            detection = self._detector.detect(image)
            self._last_s = time_s
            return self._read(time_s, detection, prior or RingPrior())

    def _read(self, time_s: float, detection: Detection, prior: RingPrior) -> RingObservation:
        if self.radius_m is None:
            if not detection.edges:
                return self._nothing(time_s, detection, detection.reason or "no ellipse")
            return RingObservation(
                Status.OK, "no radius is given, so no pose", time_s=time_s,
                edges=detection.edges, edge=0, stage_ms=detection.stage_ms,
            )  # fmt: skip
        edge, why = self._select(detection, prior)
        if edge is None:
            return self._nothing(time_s, detection, why)
        circles, misfits = joint_poses(
            self.camera, _companions(detection.edges, edge), self.radius_m
        )
        if not circles:
            return self._nothing(time_s, detection, "the ellipse is no circle's picture")
        choice = self._choose(circles, misfits, prior)
        if choice.index is not None:
            self._last, self._missed = circles[choice.index], 0
        else:
            self._pair = circles
        status = Status.AMBIGUOUS if choice.index is None else Status.OK
        return RingObservation(
            status, choice.reason if choice.index is None else None, time_s=time_s,
            edges=detection.edges, edge=edge, circles=circles, choice=choice,
            stage_ms=detection.stage_ms,
        )  # fmt: skip

    def _nothing(self, time_s: float, detection: Detection, reason: str) -> RingObservation:
        self._missed += 1
        if self._missed >= _FORGET_FRAMES:
            self._forget()
        return RingObservation(
            Status.NOT_FOUND, reason, time_s=time_s,
            edges=detection.edges, stage_ms=detection.stage_ms,
        )  # fmt: skip

    def _select(self, detection: Detection, prior: RingPrior) -> tuple[int | None, str]:
        """Which ellipse is the ring's edge of the known radius."""
        if not detection.edges:
            return None, detection.reason or "no ellipse"
        assert self.radius_m is not None
        expected = None
        centre, axis = prior.centre_m, prior.axis
        if centre is None and self._last is not None:
            centre, axis = self._last.centre_m, self._last.axis
        elif centre is None and self._pair:
            centre, axis = self._pair[0].centre_m, self._pair[0].axis
        if centre is not None:
            if axis is None:
                axis = -np.asarray(centre) / np.linalg.norm(centre)
            expected = shape_of_circle(self.camera, centre, axis, self.radius_m)
        sizes = np.array([edge.ellipse.semi_axes_px[0] for edge in detection.edges])
        if expected is not None:
            half = 0.5 * (expected[2] + expected[4])
            long = half + math.hypot(0.5 * (expected[2] - expected[4]), expected[3])
            off = np.array(
                [
                    math.hypot(*(edge.ellipse.centre_px - expected[:2])) / long
                    for edge in detection.edges
                ]
            )
            cost = off + 2.0 * np.abs(np.log(sizes / long))
            best = int(np.argmin(cost))
            if cost[best] > _PLACE_TOLERANCE:
                return None, "no ellipse where and as large as the ring should be"
            return best, ""
        if prior.range_m is not None:
            spread = np.abs(np.log(sizes / (self._focal * self.radius_m / prior.range_m)))
            worth = np.array([edge.score for edge in detection.edges])
            near = spread < _RANGE_TOLERANCE
            if not near.any():
                return None, "no ellipse as large as the ring should be at that range"
            return int(np.argmax(np.where(near, worth * (1.0 - spread), -1.0))), ""
        return 0, ""

    @property
    def _focal(self) -> float:
        return 0.5 * (self.camera.fx + self.camera.fy)

    def _choose(
        self, poses: tuple[CirclePose, ...], misfits: tuple[float, ...], prior: RingPrior
    ) -> Choice:
        single = only_one(poses)
        if prior.axis is not None:
            return by_attitude(poses, prior.axis)
        if single is not None:
            return single
        planar = by_plane(misfits)
        if planar.index is not None:
            return planar
        moved = self._motion.update(poses)
        if self._last is not None and self._motion.decided is None:
            return by_attitude(poses, self._last.axis, "the axis of the last frame")
        return moved


def _companions(edges: tuple[RingEdge, ...], first: int) -> list[Ellipse]:
    """An edge's ellipse, then those that may be other edges of the same ring.

    Edges of the same group come first, then edges at about the same place, because a short arc
    gives a poor place. All are of similar size: near head-on a smaller circle of another plane fits
    as well, with a false tilt. Of a lip fitted as a pair one edge is enough. The joint fit leaves
    out an edge that does not belong there.
    """
    main, pairs = edges[first].ellipse, {edges[first].pair}
    near: list[tuple[bool, float, Ellipse]] = []
    for k, edge in enumerate(edges):
        if k == first or (edge.pair >= 0 and edge.pair in pairs):
            continue
        ratio = edge.ellipse.semi_axes_px[0] / main.semi_axes_px[0]
        aside = float(np.linalg.norm(edge.ellipse.centre_px - main.centre_px))
        if not _LEAST_COMPANION < ratio < 1.0 / _LEAST_COMPANION:
            continue
        same = edge.group == edges[first].group
        if same or aside < 0.3 * main.semi_axes_px[0]:
            near.append((not same, -edge.arc_rad, edge.ellipse))
            pairs.add(edge.pair)
    near.sort(key=lambda item: item[:2])
    return [main, *(ellipse for *_, ellipse in near[:_MOST_COMPANIONS])]
