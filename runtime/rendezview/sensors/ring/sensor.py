"""The ring sensor: frames in, the ring's pose out, with memory from frame to frame."""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import numpy.typing as npt

from rendezview.geometry.camera import Camera
from rendezview.sensors.arguments import check_time
from rendezview.sensors.observation import Status
from rendezview.sensors.ring.choice import Choice, by_attitude, by_plane, only_one
from rendezview.sensors.ring.circle_pose import CirclePose, shape_of_circle
from rendezview.sensors.ring.concentric import joint_poses
from rendezview.sensors.ring.detector import Detection, RingDetector, RingEdge, RingOptions
from rendezview.sensors.ring.ellipse import Ellipse
from rendezview.sensors.ring.memory import Memory
from rendezview.sensors.ring.observation import RingObservation
from rendezview.sensors.ring.which_circle import (
    RING,
    RIVAL_COST,
    Knowledge,
    Which,
    ring_of_circle,
    which_circle,
)

Array = npt.NDArray[np.float64]

_MOST_COMPANIONS = 5  # Source: by construction, a bound of time
# Of the first edge's radius: other edges of a lip. Larger circles are a foot or a cone behind it,
# smaller ones a nozzle or a shield: near head-on they fit as well, and move the place by 1 %.
_COMPANIONS = (0.8, 1.02)  # Source: ring-vehicle (0.1), seed 22
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
        self._memory: Memory | None = None
        self._remembered_s = 0.0

    def update(
        self, time_s: float, image: npt.ArrayLike, prior: RingPrior | None = None
    ) -> RingObservation:
        """Look at the next frame.

        Args:
            time_s: of the frame, later than that of the frame before.
            image: (H, W) grey levels, or (H, W, 3) blue, green, red; see `check_frame`.
            prior: what other sensors know; it wins over the memory of the last frame.

        Raises:
            ValueError: the time is not finite, or not later than that of the frame before.
            RendezviewError: the image is not one of this camera's.
        """
        with self._lock:
            check_time(time_s, self._last_s)
            detection = self._detector.detect(image)
            self._last_s = time_s
            return self._read(time_s, detection, prior or RingPrior())

    def _read(self, time_s: float, detection: Detection, prior: RingPrior) -> RingObservation:
        seen = partial(
            RingObservation, time_s=time_s, edges=detection.edges, stage_ms=detection.stage_ms
        )
        if self.radius_m is None:
            if not detection.edges:
                return seen(Status.NOT_FOUND, detection.reason or "no ellipse")
            return seen(Status.OK, "no radius is given, so no pose", edge=0)
        which = self._select(time_s, detection, prior)
        edge = which.edge
        if edge is None:
            return seen(Status.NOT_FOUND, which.reason)
        circles, misfits = self._poses(detection, edge, which.circle)
        if not circles:
            return seen(Status.NOT_FOUND, "the ellipse is no circle's picture")
        if which.rivals or which.doubtful:
            rivals = tuple((k, self._poses(detection, k, j)[0]) for k, j in which.rivals)
            return seen(
                Status.AMBIGUOUS, which.reason, edge=edge, circles=circles, rivals=rivals,
                choice=Choice(None, which.reason), doubtful=which.doubtful,
            )  # fmt: skip
        choice = self._choose(circles, misfits, prior, which)
        chosen = choice.index is not None
        self._memory = Memory(circles if choice.index is None else (circles[choice.index],))
        self._remembered_s = time_s
        return seen(
            Status.OK if chosen else Status.AMBIGUOUS, None if chosen else choice.reason,
            edge=edge, circles=circles, choice=choice,
        )  # fmt: skip

    def _poses(
        self, detection: Detection, edge: int, circle: int
    ) -> tuple[tuple[CirclePose, ...], tuple[float, ...]]:
        """The ring's poses if an ellipse is one of the target's circles, with their misfits."""
        assert self.radius_m is not None
        height_m, radius_m = (0.0, self.radius_m) if circle == RING else self.circles[circle]
        found = detection.edges[edge]
        ellipses = _companions(detection.edges, edge) if circle == RING else [found.ellipse]
        poses, misfits = joint_poses(self.camera, ellipses, radius_m, found.systematic_px)
        return tuple(ring_of_circle(pose, height_m, self.radius_m) for pose in poses), misfits

    def _select(self, time_s: float, detection: Detection, prior: RingPrior) -> Which:
        """Which ellipse is the ring's edge of the known radius."""
        edges = detection.edges
        if self._memory is not None:
            self._memory = replace(self._memory, age_s=time_s - self._remembered_s)
            if self._memory.is_spent:
                self._forget()
        if not edges:
            return Which(None, (), detection.reason or "no ellipse")
        assert self.radius_m is not None
        possible = None
        range_m, sigma_m, memory = prior.range_m, prior.range_sigma_m, self._memory
        if prior.centre_m is not None:
            memory = None
            possible = self._in_place(edges, prior.centre_m, prior.axis)
            if not possible.any():
                return Which(None, (), "no ellipse where the ring should be")
            if range_m is None:
                range_m = float(np.linalg.norm(prior.centre_m))
        elif memory is not None and sigma_m is None:
            range_m = None  # a range without an error is that of the first frames
        if range_m is not None and sigma_m is None:
            sigma_m = _RANGE_SHARE * range_m
        known = Knowledge(self.radius_m, self.circles, range_m, sigma_m or 0.0, memory)
        return which_circle(self.camera, edges, known, possible)

    def _in_place(
        self, edges: Sequence[RingEdge], centre_m: Array, axis: Array | None
    ) -> npt.NDArray[np.bool_]:
        """(K,) ellipses that lie where a ring at ``centre_m`` is seen."""
        assert self.radius_m is not None
        if axis is None:
            axis = -np.asarray(centre_m) / np.linalg.norm(centre_m)
        expected = shape_of_circle(self.camera, centre_m, axis, self.radius_m)
        if expected is None:
            return np.ones(len(edges), dtype=bool)
        long = Ellipse.from_shape(expected).semi_axes_px[0]
        places = np.array([edge.ellipse.centre_px for edge in edges])
        aside = np.hypot(*(places - expected[:2]).T)
        return np.asarray(aside < _PLACE_TOLERANCE * long)

    def _choose(
        self, poses: tuple[CirclePose, ...], misfits: tuple[float, ...], prior: RingPrior,
        which: Which,
    ) -> Choice:  # fmt: skip
        single = only_one(poses)
        if prior.axis is not None:
            return by_attitude(poses, prior.axis)
        if single is not None:
            return single
        if which.axis is not None and which.other_cost > RIVAL_COST:
            nearest = int(np.argmax([pose.axis @ which.axis for pose in poses]))
            return Choice(nearest, "the target's circles and the last frames fit this axis only")
        return by_plane(misfits)


def _companions(edges: tuple[RingEdge, ...], first: int) -> list[Ellipse]:
    """An edge's ellipse, then those of its group that may be other edges of the same ring.

    Of a lip fitted as a pair one edge is enough. The joint fit leaves out an edge that does not
    belong there.
    """
    main, pairs = edges[first], {edges[first].pair}
    near: list[RingEdge] = []
    for edge in edges:
        ratio = edge.ellipse.semi_axes_px[0] / main.ellipse.semi_axes_px[0]
        if edge is main or edge.group != main.group or not _COMPANIONS[0] < ratio < _COMPANIONS[1]:
            continue
        if edge.pair < 0 or edge.pair not in pairs:
            near.append(edge)
            pairs.add(edge.pair)
    near.sort(key=lambda edge: -edge.arc_rad)
    return [edge.ellipse for edge in (main, *near[:_MOST_COMPANIONS])]
