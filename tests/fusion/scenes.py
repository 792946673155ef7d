"""Drawn measurements of a synthetic target; truth and noise from one seed."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from rendezview.fusion import (
    BeamSurface,
    Fusion,
    FusionOptions,
    Measurement,
    MotionOptions,
    PoseMeasurement,
    RangeMeasurement,
    RingCandidate,
    RingMeasurement,
    SensorOptions,
    Verdict,
)
from rendezview.fusion.choice import Snapshot, step
from rendezview.fusion.hypothesis import Hypothesis
from rendezview.fusion.state import FilterState
from rendezview.geometry.pose import Array, Pose
from rendezview.io.target import DockingRing

RING = DockingRing(np.array([-1.68, 0.1, -0.2]), np.array([-1.0, 0.0, 0.0]), 0.6)
PLANE = BeamSurface(RING.centre_m, RING.axis)
SIGMA = np.array([4e-3, 5e-3, 2e-3, 0.01, 0.01, 0.05])
START = Pose(Rotation.from_rotvec([0.1, -1.5, 0.15]).as_matrix(), np.array([0.3, -0.5, 30.0]))
MOVE = np.array([0.01, -0.02, -0.2])  # m/s
TURN = np.array([1e-3, -2e-3, 1.5e-3])  # rad/s

WHITE = SensorOptions(bias_share=0.0)
# Nothing moves unasked: one model without noise.
STILL = MotionOptions(
    angular=0.0, accelerations=(0.0,), lasting_accelerations=(0.0,), stays_s=(60.0,),
    jitters=(0.0,), jitters_s=(0.4,),
)  # fmt: skip
QUIET = FusionOptions(motion=STILL, pose=WHITE, ring=WHITE, range=WHITE, ring_other_edge=0.0)

Path = Callable[[float], Pose]


def drift(time_s: float) -> Pose:
    """A slow approach and a slow turn, both steady, from 30 m."""
    return Pose(
        Rotation.from_rotvec(TURN * time_s).as_matrix() @ START.rotation,
        START.translation_m + MOVE * time_s,
    )


def along_axis(range_m: Callable[[float], float], turn: Array = TURN) -> Path:
    """The ring's centre on the boresight at a distance of the time."""

    def path(time_s: float) -> Pose:
        rotation = Rotation.from_rotvec(turn * time_s).as_matrix() @ START.rotation
        ahead = np.array([0.0, 0.0, range_m(time_s)])
        return Pose(rotation, ahead - rotation @ RING.centre_m)

    return path


def with_jitter(path: Path, sigma_rad: float, hertz: float, seed: int) -> Path:
    """The camera swings about each axis, by five sines about one frequency."""
    rng = np.random.default_rng(seed)
    pulses = 2.0 * math.pi * hertz * rng.uniform(0.5, 1.5, (3, 5))
    phases = rng.uniform(0.0, 2.0 * math.pi, (3, 5))

    def swung(time_s: float) -> Pose:
        vector = sigma_rad * math.sqrt(2.0 / 5.0) * np.sin(pulses * time_s + phases).sum(axis=1)
        still, swing = path(time_s), Rotation.from_rotvec(vector).as_matrix()
        return Pose(swing @ still.rotation, swing @ still.translation_m)

    return swung


class World:
    """Truth and noisy sensors."""

    def __init__(self, seed: int, truth: Path = drift) -> None:
        self.rng = np.random.default_rng(seed)
        self.truth = truth

    @staticmethod
    def error(estimate: Pose, truth: Pose) -> Array:
        """(6,) perturbation from truth to estimate."""
        turn = Rotation.from_matrix(estimate.rotation @ truth.rotation.T).as_rotvec()
        return np.concatenate([turn, estimate.translation_m - truth.translation_m])

    def kinds(self, time_s: float) -> list[Measurement]:
        """One of each."""
        return [self.pose(time_s), self.ring(time_s), self.range(time_s)]

    def pose(
        self, time_s: float, offset: Array | None = None, sensor: str = "camera",
        sigma: Array = SIGMA,
    ) -> PoseMeasurement:  # fmt: skip
        noise = sigma * self.rng.standard_normal(6)
        lie = np.zeros(6) if offset is None else offset
        truth = self.truth(time_s).perturbed(noise + lie)
        return PoseMeasurement(time_s, sensor, truth, np.diag(sigma**2))

    def ring(
        self, time_s: float, sigma_m: float = 0.01, sigma_rad: float = 5e-3, scale: float = 1.0
    ) -> RingMeasurement:
        """``scale`` of its distance: an edge of another size is taken for the ring's."""
        truth = self.truth(time_s)
        centre = scale * truth.apply(RING.centre_m) + sigma_m * self.rng.standard_normal(3)
        axis = truth.rotation @ RING.axis
        seen = axis + sigma_rad * self.rng.standard_normal(3)
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = sigma_m**2 * np.eye(3)
        covariance[3:, 3:] = sigma_rad**2 * (np.eye(3) - np.outer(axis, axis))
        candidate = RingCandidate(centre, seen / np.linalg.norm(seen), covariance)
        return RingMeasurement(time_s, "ring", (candidate,), RING)

    def range(self, time_s: float, sigma_m: float = 0.02) -> RangeMeasurement:
        truth = self.truth(time_s)
        normal = truth.rotation @ RING.axis
        distance = float(normal @ truth.apply(RING.centre_m)) / float(normal[2])
        noisy = distance + sigma_m * self.rng.standard_normal()
        return RangeMeasurement(time_s, "laser", noisy, sigma_m, (PLANE,))

    def run(
        self, fusion: Fusion, start_s: float, end_s: float,
        sensors: Iterable[str] = ("camera", "ring", "laser"), offset: Array | None = None,
    ) -> dict[str, list[Verdict]]:  # fmt: skip
        """Half a second between measurements; verdicts by sensor. The camera may lie."""
        told: dict[str, list[Verdict]] = {name: [] for name in sensors}
        for k in range(round(2 * start_s), round(2 * end_s)):
            for one in (self.pose(0.5 * k, offset), self.ring(0.5 * k), self.range(0.5 * k)):
                if one.sensor in told:
                    told[one.sensor].append(fusion.add(one))
        return told

    def squared(self, fusion: Fusion, time_s: float) -> float:
        """Squared error of the pose in σ; 30 is its 99.996 % quantile."""
        estimate = fusion.state_at(time_s)
        assert estimate.pose is not None
        assert estimate.covariance is not None
        off = self.error(estimate.pose, self.truth(time_s))
        return float(off @ np.linalg.solve(estimate.covariance[:6, :6], off))


@dataclass
class Course:
    """Errors of a run, at each pose of a sensor."""

    fused: Array  # (N, 6)
    sensed: Array  # (N, 6)
    squared: Array  # (N,) normalised
    levels: Array  # (N, 2) protection: attitude rad, place m
    alarms: Array  # (N,) bool
    fusion: Fusion

    @staticmethod
    def rms(errors: Array) -> float:
        return float(np.sqrt((errors**2).sum(axis=1).mean()))

    def place_ratio(self, skip: int = 10) -> float:
        """RMS error of the place over the sensor's own."""
        return self.rms(self.fused[skip:, 3:]) / self.rms(self.sensed[skip:, 3:])

    def attitude_ratio(self, skip: int = 10) -> float:
        return self.rms(self.fused[skip:, :3]) / self.rms(self.sensed[skip:, :3])


def course(
    world: World, readings: Iterable[Measurement], options: FusionOptions | None = None,
    sensor: str = "camera",
) -> Course:  # fmt: skip
    """A filter through a series, looked at after each pose of one sensor."""
    fusion = Fusion(options)
    fused, sensed, squared, levels, alarms = [], [], [], [], []
    for one in readings:
        fusion.add(one)
        if one.sensor != sensor or not isinstance(one, PoseMeasurement):
            continue
        estimate, truth = fusion.state_at(one.time_s), world.truth(one.time_s)
        assert estimate.pose is not None
        assert estimate.covariance is not None
        assert estimate.protection is not None
        off = world.error(estimate.pose, truth)
        fused.append(off)
        sensed.append(world.error(one.pose, truth))
        squared.append(off @ np.linalg.solve(estimate.covariance[:6, :6], off))
        levels.append([estimate.protection.attitude_rad, estimate.protection.position_m])
        alarms.append(estimate.protection.alarm)
    arrays = (np.array(one) for one in (fused, sensed, squared, levels, alarms))
    return Course(*arrays, fusion)


def taken(
    state: FilterState, measurement: Measurement, options: FusionOptions
) -> tuple[FilterState, Verdict]:
    """The state after one measurement, without a history."""
    before = Hypothesis(state, {}, 1, state.time_s, state.time_s)
    after, verdict = step(Snapshot(before), measurement, options)
    assert after.main is not None
    return after.main.state, verdict


def still_at(state: FilterState, measurement: Measurement) -> Measurement:
    """The measurement at the state's time."""
    return replace(measurement, time_s=state.time_s)
