"""The ring sensor: frames in, the ring's pose out, with memory from frame to frame."""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from rendezview.geometry.camera import Camera
from rendezview.sensors.observation import Status
from rendezview.sensors.ring.choice import Choice, MotionChooser, by_attitude, by_plane, only_one
from rendezview.sensors.ring.circle_pose import CirclePose, pose_covariance, shape_of_circle
from rendezview.sensors.ring.concentric import joint_poses
from rendezview.sensors.ring.detector import Detection, RingDetector, RingEdge, RingOptions
from rendezview.sensors.ring.ellipse import Ellipse
from rendezview.sensors.ring.observation import RingObservation
from rendezview.sensors.ring.which_circle import (
    Which,
    by_range,
    ring_of_circle,
    without_range,
)

Array = npt.NDArray[np.float64]

_MOST_COMPANIONS = 5  # Source: by construction, a bound of time
# Of the first edge's radius: other edges of a lip. Larger circles are a foot or a cone behind it,
# smaller ones a nozzle or a shield: near head-on they fit as well, and move the place by 1 %.
_COMPANIONS = (0.8, 1.02)  # Source: ring-vehicle (0.1), seed 22
_COMPANIONS_BY_SCORE = (0.8, 1.25)  # where the first may be an inner edge. Source: ring-accuracy
# σ of an ellipse's numbers over that of its edge's systematic part: the ellipse takes in a part.
_SYSTEMATIC = 1.0  # Source: ring-vehicle (0.1), seed 22
_LEAST_SYSTEMATIC_PX = 1e-3  # Source: by construction, far below any error
# Frames without a pose, after which the last one is forgotten. Source: a chosen limit
_FORGET_FRAMES = 5
_RANGE_SHARE = 0.05  # of a range without a σ. Source: half the relief of a vehicle
# Of the semi-axis: how far a ring may have moved since it was known. Source: by hand; see
# ring-accuracy
_PLACE_TOLERANCE = 0.35


@dataclass(frozen=True, slots=True, eq=False)
class RingPrior:
    """Knowledge of other sensors before a frame; any of it may be None."""

    centre_m: Array | None = None  # (3,) of the ring, camera frame
    axis: Array | None = None  # (3,) camera frame
    range_m: float | None = None  # to the ring's centre; None: that of ``centre_m``
    # One σ of the range. None: 5 %, and ``range_m`` counts only while the place is not known from
    # frames before.
    range_sigma_m: float | None = None


class RingSensor:
    """Follows one ring through the frames of a camera.

    Threads may share an instance: their calls run one after the other.

    Args:
        camera: of the frames.
        radius_m: of the ring's edge; None: ellipses only.
        options: of the detector.
        circles: of the target about the ring's axis: height over the ring's plane (m, outwards
            positive) and radius (m); see ``DockingRing.circles``.
    """

    def __init__(
        self,
        camera: Camera,
        radius_m: float | None = None,
        options: RingOptions | None = None,
        circles: Sequence[tuple[float, float]] = (),
    ) -> None:
        if radius_m is not None and not (math.isfinite(radius_m) and radius_m > 0.0):
            raise ValueError(f"radius_m must be positive, not {radius_m}")
        self.camera, self.radius_m, self.circles = camera, radius_m, tuple(circles)
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
        which = self._select(detection, prior)
        edge = which.edge
        if edge is None:
            return self._nothing(time_s, detection, which.reason)
        circles, misfits = self._poses(detection, edge, which.by_score)
        if not circles:
            return self._nothing(time_s, detection, "the ellipse is no circle's picture")
        doubtful = which.alone and self._last is None
        if which.rivals or which.others or doubtful:
            return RingObservation(
                Status.AMBIGUOUS, which.reason, time_s=time_s, edges=detection.edges, edge=edge,
                circles=circles, choice=Choice(None, which.reason),
                rivals=(
                    *((k, self._poses(detection, k, which.by_score)[0]) for k in which.rivals),
                    *((k, self._through(detection, k, j)) for k, j in which.others),
                ),
                doubtful=doubtful,
                stage_ms=detection.stage_ms,
            )  # fmt: skip
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

    def _poses(
        self, detection: Detection, edge: int, by_score: bool
    ) -> tuple[tuple[CirclePose, ...], tuple[float, ...]]:
        assert self.radius_m is not None
        poses, misfits = joint_poses(
            self.camera, _companions(detection.edges, edge, by_score), self.radius_m
        )
        sigma_px = _SYSTEMATIC * detection.edges[edge].systematic_px
        return tuple(self._widened(pose, sigma_px) for pose in poses), misfits

    def _through(self, detection: Detection, edge: int, circle: int) -> tuple[CirclePose, ...]:
        """The ring's poses if an ellipse is another of the target's circles."""
        assert self.radius_m is not None
        height_m, radius_m = self.circles[circle]
        found = detection.edges[edge]
        poses, _ = joint_poses(self.camera, [found.ellipse], radius_m)
        sigma_px = _SYSTEMATIC * found.systematic_px
        return tuple(
            ring_of_circle(self._widened(pose, sigma_px), height_m, self.radius_m) for pose in poses
        )

    def _widened(self, pose: CirclePose, sigma_px: float) -> CirclePose:
        """A pose whose covariance has the systematic error of its edge as well."""
        if pose.covariance is None or sigma_px < _LEAST_SYSTEMATIC_PX:
            return pose
        more = pose_covariance(self.camera, pose, sigma_px**2 * np.eye(5))
        return replace(pose, covariance=pose.covariance + more)

    def _nothing(self, time_s: float, detection: Detection, reason: str) -> RingObservation:
        self._missed += 1
        if self._missed >= _FORGET_FRAMES:
            self._forget()
        return RingObservation(
            Status.NOT_FOUND, reason, time_s=time_s,
            edges=detection.edges, stage_ms=detection.stage_ms,
        )  # fmt: skip

    def _select(self, detection: Detection, prior: RingPrior) -> Which:
        """Which ellipse is the ring's edge of the known radius."""
        edges = detection.edges
        if not edges:
            return Which(None, (), detection.reason or "no ellipse")
        assert self.radius_m is not None
        centre, axis = prior.centre_m, prior.axis
        memory = None
        if self._last is not None:
            memory = self._last
        elif self._pair:
            memory = self._pair[0]
        if centre is None and memory is not None:
            centre, axis = memory.centre_m, memory.axis
        expected = None
        if centre is not None:
            if axis is None:
                axis = -np.asarray(centre) / np.linalg.norm(centre)
            expected = shape_of_circle(self.camera, centre, axis, self.radius_m)
        aside = np.zeros(len(edges))
        if expected is not None:
            half = 0.5 * (expected[2] + expected[4])
            long = half + math.hypot(0.5 * (expected[2] - expected[4]), expected[3])
            aside = np.array(
                [math.hypot(*(edge.ellipse.centre_px - expected[:2])) / long for edge in edges]
            )
        if aside.min() > _PLACE_TOLERANCE:
            return Which(None, (), "no ellipse where the ring should be")
        given = self._range(prior, known=expected is not None)
        if given is not None:
            return by_range(
                self.camera, edges, self.radius_m, *given, self.circles, aside < _PLACE_TOLERANCE
            )
        if expected is None:
            return without_range(self.camera, edges, self.radius_m, self.circles)
        sizes = np.array([edge.ellipse.semi_axes_px[0] for edge in edges])
        cost = aside + 2.0 * np.abs(np.log(sizes / long))
        best = int(np.argmin(cost))
        if cost[best] > _PLACE_TOLERANCE:
            return Which(None, (), "no ellipse where and as large as the ring should be")
        return Which(best, (), "")

    def _range(self, prior: RingPrior, *, known: bool) -> tuple[float, float] | None:
        """Given range of the ring and its σ; None where the memory of the last frame decides."""
        range_m = prior.range_m
        if range_m is None and prior.centre_m is not None:
            range_m = float(np.linalg.norm(prior.centre_m))
        elif prior.range_sigma_m is None and known and prior.centre_m is None:
            return None  # a range without an error is that of the first frames
        if range_m is None:
            return None
        sigma_m = prior.range_sigma_m
        return range_m, _RANGE_SHARE * range_m if sigma_m is None else sigma_m

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


def _companions(edges: tuple[RingEdge, ...], first: int, by_score: bool) -> list[Ellipse]:
    """An edge's ellipse, then those that may be other edges of the same ring.

    Edges of the same group come first, then edges at about the same place, because a short arc
    gives a poor place. Of a lip fitted as a pair one edge is enough. The joint fit leaves
    out an edge that does not belong there.
    """
    low, high = _COMPANIONS_BY_SCORE if by_score else _COMPANIONS
    main, pairs = edges[first].ellipse, {edges[first].pair}
    near: list[tuple[bool, float, Ellipse]] = []
    for k, edge in enumerate(edges):
        if k == first or (edge.pair >= 0 and edge.pair in pairs):
            continue
        ratio = edge.ellipse.semi_axes_px[0] / main.semi_axes_px[0]
        aside = float(np.linalg.norm(edge.ellipse.centre_px - main.centre_px))
        if not low < ratio < high:
            continue
        same = edge.group == edges[first].group
        if same or aside < 0.3 * main.semi_axes_px[0]:
            near.append((not same, -edge.arc_rad, edge.ellipse))
            pairs.add(edge.pair)
    near.sort(key=lambda item: item[:2])
    return [main, *(ellipse for *_, ellipse in near[:_MOST_COMPANIONS])]
