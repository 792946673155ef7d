"""From observation to correction, frame by frame: cloud, segment, prediction, spin."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from rendezview.geometry.pose import Array, Pose
from rendezview.trajectory.cloud import PointCloud, camera_place, centre_place
from rendezview.trajectory.guidance import Correction, correct
from rendezview.trajectory.no_fit import NoFit
from rendezview.trajectory.plan import Plan
from rendezview.trajectory.relative_orbit import transition
from rendezview.trajectory.segment import Carrier, Segment, fit_segment
from rendezview.trajectory.shapes import Shape
from rendezview.trajectory.spin import Spin, fit_spin, fit_spin_of_directions, in_line_of_sight

_DEFAULT_SEGMENT_S = 100.0  # s, where neither a turn nor a time is given. Source: a chosen limit


@dataclass(frozen=True, kw_only=True)
class FollowerOptions:
    """The plan or shape to follow, and how far back observations count."""

    # Of a segment: the paper's one radian ….
    turn_rad: float | None = 1.0  # Source: Cleghorn & Sternberg 1991
    segment_s: float | None = None  # … or its time, where that is given
    poses: bool = True  # refined poses where there are; False: active nodes only
    spin: bool = True
    # spin is fitted so many times a segment. Source: by construction, a bound of time
    spins: int = 10

    def __post_init__(self) -> None:
        if self.turn_rad is not None and not 0.0 < self.turn_rad < np.pi:
            raise ValueError(f"turn_rad must be between 0 and π, not {self.turn_rad}")
        if self.segment_s is not None and not self.segment_s > 0.0:
            raise ValueError(f"segment_s must be positive, not {self.segment_s}")


@dataclass(frozen=True, slots=True, eq=False)
class Report:
    """The results after a frame; false values hold their reason."""

    time_s: float
    number: int  # of the segment, from 0
    ended: bool  # this frame ends it
    segment: Segment | NoFit
    correction: Correction | NoFit | None  # None without a plan
    spin: Spin | NoFit | None  # None where it is not asked for
    path_from_target: Array  # (3, 3); the identity where it is not known


class PathFollower:
    """At every frame, fits the segment that the camera flies and compares it with a plan.

    Threads may share an instance: calls run one after the other.
    """

    def __init__(
        self,
        centre_m: npt.ArrayLike,
        shape: Shape | None = None,
        plan: Plan | None = None,
        options: FollowerOptions | None = None,
    ) -> None:
        """A follower of one target.

        Args:
            centre_m: (3,) of the path, target frame, where the plan does not give one.
            shape: the shape to fit; None: that of the plan.

        Raises:
            ValueError: neither shape nor plan, or no such shape.
        """
        if shape is None and plan is None:
            raise ValueError("a follower needs a shape or a plan")
        self.plan = plan
        self.options = options or FollowerOptions()
        given = centre_m if plan is None or plan.centre_m is None else plan.centre_m
        self.centre_m = np.asarray(given, dtype=np.float64)
        asked = shape if shape is not None or plan is None else plan.shape
        self.shape = None if asked is None else Shape(asked)
        self.cloud = PointCloud.empty()  # of the window
        self._turns: list[tuple[float, Array, Array]] = []  # time, attitude, covariance
        self._burns: list[tuple[float, Array]] = []
        self._since_s = -np.inf  # of the window
        self._began_s: float | None = None  # of the segment
        self._number = 0
        self._segment: Segment | NoFit = NoFit("no points yet")
        self._spin: Spin | NoFit | None = None
        self._spun_s = -np.inf
        self._last_s = -np.inf
        self._lock = threading.Lock()  # of all of the above

    def burn(self, time_s: float, delta_v_m_s: npt.ArrayLike) -> None:
        """A correction was flown: a change of velocity (3,), plan's axes.

        A deviation from the plan takes it into account; any other shape restarts.
        """
        with self._lock:
            self._burns.append((float(time_s), np.asarray(delta_v_m_s, np.float64)))
            if not self._deviates:
                self._since_s = float(time_s)
                self.cloud = self.cloud.since(self._since_s)
                self._segment = NoFit("a correction was flown: no points yet")

    def update(
        self,
        time_s: float,
        pose: Pose | None = None,
        covariance: npt.ArrayLike | None = None,
        points_m: npt.ArrayLike | None = None,
        weights: npt.ArrayLike | None = None,
        path_from_camera: npt.ArrayLike | None = None,
    ) -> Report:
        """Process the next frame.

        Args:
            pose: refined camera_from_target, if there is one.
            covariance: (6, 6) of it.
            points_m: (K, 3) where active nodes put the camera, target frame.
            weights: (K,) trust in each.
            path_from_camera: (3, 3) the chaser's own attitude in the plan's axes, where it is
                known. Without it the target is taken to keep its attitude in them, and the spin
                is that about the line of sight's frame.
        """
        with self._lock:
            attitude = (
                None if path_from_camera is None else np.asarray(path_from_camera, np.float64)
            )
            path = self._path_from_target(time_s, pose, attitude)
            known = np.eye(3) if path is None else path
            trouble = self._trouble(time_s, pose, covariance, points_m)
            if trouble is not None:
                return Report(time_s, self._number, False, trouble, None, None, known)
            self._last_s = time_s
            self._began_s = time_s if self._began_s is None else self._began_s
            self._take(time_s, pose, covariance, points_m, weights, attitude, path)
            self._refit(time_s)
            ended = self._advance(time_s)
            correction: Correction | NoFit | None = None
            if self.plan is not None:
                correction = self._correction(time_s)
            if self.options.spin:
                self._turn_rates(time_s, ended)
            report = Report(
                time_s, self._number, ended, self._segment, correction, self._spin, known
            )
            if ended:
                self._number += 1
                self._began_s = time_s
            return report

    @property
    def _deviates(self) -> bool:
        dynamic = self.shape in (Shape.ORBIT, Shape.DRIFT)
        return self.plan is not None and self.plan.deviation and dynamic

    def _trouble(
        self,
        time_s: float,
        pose: Pose | None,
        covariance: npt.ArrayLike | None,
        points_m: npt.ArrayLike | None,
    ) -> NoFit | None:
        if not np.isfinite(time_s):
            return NoFit(f"a time is not finite: {time_s}")
        if time_s <= self._last_s:
            return NoFit(f"the times do not rise: {time_s:g} s after {self._last_s:g} s")
        for values, words in ((covariance, "the covariance"), (points_m, "a point")):
            if values is not None and not np.isfinite(np.asarray(values, np.float64)).all():
                return NoFit(f"{words} is not finite")
        if pose is not None and not pose.apply(self.centre_m).any():
            return NoFit("the camera is at the centre of the path: there is no line of sight")
        return None

    def _path_from_target(
        self, time_s: float, pose: Pose | None, attitude: Array | None
    ) -> Array | None:
        """(3, 3); None without a pose where the chaser's own attitude is known."""
        if attitude is not None:
            return None if pose is None else attitude @ pose.rotation
        if self.plan is None or not np.isfinite(time_s):
            return np.eye(3)
        return self.plan.path_from_target(time_s)

    def _take(
        self,
        time_s: float,
        pose: Pose | None,
        covariance: npt.ArrayLike | None,
        points_m: npt.ArrayLike | None,
        weights: npt.ArrayLike | None,
        attitude: Array | None,
        path_from_target: Array | None,
    ) -> None:
        """Points and attitude of one frame, in the plan's axes."""
        if self.options.poses and pose is not None and covariance is not None:
            if attitude is None:
                place, spread = camera_place(pose, covariance, self.centre_m)
                turn = path_from_target
                sight = in_line_of_sight(pose, self.centre_m)
                reference = sight @ pose.rotation.T
            else:
                place, spread = centre_place(pose, covariance, self.centre_m)
                turn = reference = attitude
                sight = attitude @ pose.rotation
            assert turn is not None
            one = PointCloud.of_places(time_s, turn @ place, turn @ spread @ turn.T)
            self.cloud = self.cloud.joined(one)
            wide = np.asarray(covariance, np.float64)[:3, :3]
            self._turns.append((time_s, sight, reference @ wide @ reference.T))
        if points_m is not None and path_from_target is not None and len(np.asarray(points_m)):
            about = (np.asarray(points_m, np.float64) - self.centre_m) @ path_from_target.T
            self.cloud = self.cloud.joined(PointCloud.of_nodes(time_s, about, weights))

    def _refit(self, time_s: float) -> None:
        assert self.shape is not None
        shape, flown_s = self.shape, time_s - max(self._since_s, self._first_s())
        if shape is Shape.DRIFT and flown_s < 0.5 * self._span_s(time_s):
            shape = Shape.ORBIT  # too short to distinguish a push from a velocity
        n = 0.0 if self.plan is None else self.plan.mean_motion_rad_s
        self._segment = fit_segment(
            self.cloud,
            shape,
            mean_motion_rad_s=n,
            carrier=self._carrier() if self._deviates else None,
        )

    def _first_s(self) -> float:
        return float(self.cloud.times_s[0]) if len(self.cloud) else np.inf

    def _carrier(self) -> Carrier:
        """The plan plus the effect of the corrections flown."""
        plan, burns = self.plan, list(self._burns)
        assert plan is not None

        def ridden(times_s: Array) -> Array:
            places = plan.places(times_s)
            for at_s, delta_v in burns:
                for k in np.flatnonzero(times_s > at_s):
                    moved = transition(plan.mean_motion_rad_s, float(times_s[k] - at_s))[:3, 3:]
                    places[k] += moved @ delta_v
            return places

        return ridden

    def _span_s(self, time_s: float) -> float:
        """How long a segment lasts, estimated from the fit."""
        if self.options.segment_s is not None:
            return self.options.segment_s
        if self.options.turn_rad is None or not isinstance(self._segment, Segment):
            return _DEFAULT_SEGMENT_S
        since_s = self._segment.start_s
        swept = _angle(*self._segment.places([since_s, time_s]))
        if swept < 1e-6 or time_s <= since_s:
            return _DEFAULT_SEGMENT_S
        return self.options.turn_rad * (time_s - since_s) / swept

    def _advance(self, time_s: float) -> bool:
        """Drop data older than a segment; True when a segment has been flown since the last one."""
        if not isinstance(self._segment, Segment):
            return False
        span_s = self._span_s(time_s)
        self._since_s = max(self._since_s, time_s - span_s)
        self.cloud = self.cloud.since(self._since_s)
        self._turns = [turn for turn in self._turns if turn[0] >= self._since_s - 1e-9]
        return self._began_s is not None and time_s - self._began_s >= span_s * (1.0 - 1e-9)

    def _correction(self, time_s: float) -> Correction | NoFit:
        assert self.plan is not None
        if not isinstance(self._segment, Segment):
            return self._segment
        reach_s = time_s + self._span_s(time_s)  # the fit predicts the next segment
        if time_s < self.plan.end_s < reach_s:
            reach_s = self.plan.end_s
        return correct(self._segment, self.plan, time_s, reach_s)

    def _turn_rates(self, time_s: float, ended: bool) -> None:
        due = time_s - self._spun_s >= self._span_s(time_s) / self.options.spins
        if not (due or ended):
            return
        self._spun_s = time_s
        # Whether it tumbles is asked once a segment.
        tumbling = None if ended else isinstance(self._spin, Spin) and self._spin.tumbling
        if self._turns:
            times, attitudes, covariances = (
                np.array(column) for column in zip(*self._turns, strict=True)
            )
            self._spin = fit_spin(times, attitudes, covariances, tumbling=tumbling)
        else:
            nodes = self.cloud
            self._spin = fit_spin_of_directions(
                nodes.times_s, nodes.places_m, nodes.weights, tumbling=tumbling
            )


def record(report: Report) -> dict[str, Any]:
    """A report as a log of JSON lines stores it, docs/files-logs.md."""
    line: dict[str, Any] = {"number": report.number, "ended": report.ended}
    segment = report.segment
    if isinstance(segment, Segment):
        times = np.linspace(segment.start_s, report.time_s, 13)
        ahead = np.linspace(report.time_s, 2.0 * report.time_s - segment.start_s, 13)
        line["segment"] = {
            "shape": str(segment.shape),
            **segment.described(),  # first: a V-bar's own place_m is that of another time
            "start_s": segment.start_s,
            "place_m": segment.places(report.time_s)[0],
            "velocity_m_s": segment.velocity(report.time_s),
            "place_covariance_m2": segment.place_covariance(report.time_s),
            "frames": segment.frames,
            "points": segment.points,
            "gap_sigma": segment.gap_sigma,
            "path_m": segment.places(times),
            "predicted_m": segment.places(ahead),
        }
    else:
        line["segment"], line["segment_reason"] = None, segment.reason
    correction = report.correction
    if isinstance(correction, Correction):
        line["correction"] = _fields(
            correction, "reach_s error_m predicted_error_m predicted_sigma_m delta_v_m_s direction "
            "arrival_delta_v_m_s",
        )  # fmt: skip
    elif correction is not None:
        line["correction"], line["correction_reason"] = None, correction.reason
    spin = report.spin
    if isinstance(spin, Spin):
        line["spin"] = _fields(spin, "time_s") | {
            "quat_wxyz": Pose(spin.rotation, np.zeros(3)).quat_wxyz,
            **_fields(
                spin, "rate_rad_s speed_rad_s speed_sigma_rad_s axis axis_reference axis_sigma_rad "
                "covariance tumbling moments moments_sigma roll_known",
            ),
        }  # fmt: skip
    elif spin is not None:
        line["spin"], line["spin_reason"] = None, spin.reason
    return line


def _fields(of: object, names: str) -> dict[str, Any]:
    return {name: getattr(of, name) for name in names.split()}


def _angle(a: Array, b: Array) -> float:
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))
