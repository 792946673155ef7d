"""The state of the filter: relative motion under several models, and the sensors' biases.

The camera's place in the target's axes does not turn when the camera swings, its attitude does:
so the state is camera_from_target's rotation R, the camera's place p = −Rᵀ t, the target's rate and
the camera's velocity, both against inertial space, all in the target's axes. The error state has
18 entries of motion: attitude (rad, on the left, camera frame: R_true = exp(θ) R), place (m), rate
(rad/s), velocity (m/s), jitter of the camera's attitude (rad, camera frame), acceleration (m/s²).
Then one block for each sensor, its bias in its own σ (Gauss–Markov of unit variance).
The joint covariance remembers what of the pose came from which sensor, so that a hundred frames
with one common error do not count as a hundred.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from rendezview.fusion.options import FusionOptions, SensorOptions
from rendezview.geometry import so3
from rendezview.geometry.pose import Array
from rendezview.sensors.measurement import Measurement, PoseMeasurement

MOTION = 18  # attitude, place, rate, velocity, jitter, acceleration. Source: by construction

# (6, 6) that every pose has at least: below it rounding counts. Source: no sensor is that good
_LEAST_COVARIANCE = np.diag([1e-7**2] * 3 + [1e-6**2] * 3)
RING_GEOMETRY = "ring's radius and depth"  # a block of the state, of no sensor


class Slot(NamedTuple):
    """The place of a sensor's bias in the state, and of its lateness after it."""

    start: int
    size: int
    lateness: int = -1  # index; -1: its times are right


class FilterState(NamedTuple):
    """Relative motion at a time by M models, with the sensors' biases; n states in all."""

    time_s: float
    rotation: Array  # (3, 3) camera from target
    place_m: Array  # (3,) of the camera, target's axes
    rate: Array  # (3,) of the target, rad/s, target's axes
    velocity: Array  # (3,) of the camera, m/s, target's axes
    deviations: Array  # (M, n) of each model from these; jitter, acceleration and biases
    covariances: Array  # (M, n, n)
    weights: Array  # (M,) probability of each model
    slots: Mapping[str, Slot]
    fading: Array  # (n - 18, 2) how fast each bias is forgotten: 1/s, and per ln of the range
    white: Mapping[str, Array]  # white share of each sensor's variance, by component
    readings: Mapping[str, int]  # number of readings that taught it
    sigmas: Mapping[str, Array]  # σ of each sensor's last reading, by component
    jitter: float  # σ of the first jitter, rad
    pose_s: float = -math.inf  # time of the last pose
    confirmed: bool = False
    turning: Array | None = None  # (3,) rad/s, of the camera, its own frame; None: not measured
    turning_sigma: float = 0.0  # rad/√s
    turning_s: float = -math.inf  # when that was measured

    @property
    def nominal(self) -> tuple[Array, Array, Array, Array]:
        """Rotation, place, rate, velocity."""
        return self.rotation, self.place_m, self.rate, self.velocity

    def mean(self, entry: int) -> float:
        """Mean deviation of one entry over all models."""
        return float(self.weights @ self.deviations[:, entry])


def sensor_options(measurement: Measurement, options: FusionOptions) -> SensorOptions:
    """Those of the sensor's name, else of its kind."""
    named = options.sensors.get(measurement.sensor)
    if named is not None:
        return named
    if isinstance(measurement, PoseMeasurement):
        return options.pose
    return options.range if measurement.size == 1 else options.ring


def pose_covariance(measurement: PoseMeasurement, options: SensorOptions) -> Array:
    """(6, 6) covariance that the filter uses for a pose."""
    return options.inflation * measurement.covariance + _LEAST_COVARIANCE


def begin(
    measurement: PoseMeasurement,
    options: FusionOptions,
    rates: tuple[Array, Array] | None = None,
    sigmas: tuple[float, float] | None = None,
) -> FilterState:
    """The state at a first pose, whose bias is known to be in it.

    Args:
        rates: (3,) of the target and (3,) velocity, where they are known better than zero.
        sigmas: of them, rad/s and m/s.
    """
    motion, sensor = options.motion, sensor_options(measurement, options)
    count = len(motion.accelerations) * len(motion.jitters)
    rotation = np.array(measurement.pose.rotation)
    away = np.array(measurement.pose.translation_m)
    slots: dict[str, Slot] = {}
    geometry = 2 if options.ring_radius_sigma > 0.0 or options.ring_depth_sigma_m > 0.0 else 0
    if geometry:
        slots[RING_GEOMETRY] = Slot(MOTION, geometry)
    start = MOTION + geometry
    slots[measurement.sensor] = _slot(start, 6, sensor)
    fading = np.vstack([np.zeros((geometry, 2)), _fading(6, sensor)])  # the ring's is constant
    n = MOTION + len(fading)
    # From (rotation, translation) to (attitude, place): p = −Rᵀ t.
    into = np.zeros((6, 6))
    into[:3, :3] = np.eye(3)
    into[3:, :3] = -rotation.T @ so3.hat(away)
    into[3:, 3:] = -rotation.T
    covariance = np.zeros((n, n))
    whole = pose_covariance(measurement, sensor)
    covariance[:6, :6] = into @ whole @ into.T
    rate_sigma, velocity_sigma = sigmas or (motion.first_rate, motion.first_velocity)
    entries = np.arange(n)
    covariance[entries[6:9], entries[6:9]] = rate_sigma**2
    covariance[entries[9:12], entries[9:12]] = velocity_sigma**2
    covariance[entries[MOTION:], entries[MOTION:]] = 1.0
    # The error of the estimate is −(A b + white), where b is the bias.
    white = np.full(6, 1.0 - sensor.bias_share)
    root = into @ np.linalg.cholesky(whole) * np.sqrt(1.0 - white)
    bias = slice(start, start + 6)
    covariance[:6, bias], covariance[bias, :6] = -root, -root.T
    covariances = np.repeat(covariance[None], count, axis=0)
    for model in range(count):
        acceleration, jitter = divmod(model, len(motion.jitters))
        for i in range(3):
            covariances[model, 12 + i, 12 + i] = motion.jitters[jitter] ** 2
            lasting = motion.lasting_accelerations[acceleration]
            covariances[model, 15 + i, 15 + i] = lasting**2
    turning, moving = rates if rates is not None else (np.zeros(3), np.zeros(3))
    return FilterState(
        measurement.time_s, rotation, -rotation.T @ away, turning, moving, np.zeros((count, n)),
        covariances, np.full(count, 1.0 / count), slots, fading, {measurement.sensor: white}, {},
        {measurement.sensor: np.sqrt(whole.diagonal())}, motion.jitters[0], measurement.time_s,
    )  # fmt: skip


def with_slot(state: FilterState, measurement: Measurement, sensor: SensorOptions) -> FilterState:
    """The state with room for the bias of a sensor that it has not met before."""
    name = measurement.sensor
    if name in state.slots:
        return state
    count, n = state.deviations.shape
    fading = _fading(measurement.bias_size, sensor)
    size = len(fading)
    covariances = np.zeros((count, n + size, n + size))
    covariances[:, :n, :n] = state.covariances
    covariances[:, np.arange(n, n + size), np.arange(n, n + size)] = 1.0
    return state._replace(
        deviations=np.hstack([state.deviations, np.zeros((count, size))]),
        covariances=covariances,
        slots={**state.slots, name: _slot(n, measurement.bias_size, sensor)},
        fading=np.vstack([state.fading, fading]),
        white={**state.white, name: np.full(measurement.size, 1.0 - sensor.bias_share)},
    )


def _slot(start: int, size: int, sensor: SensorOptions) -> Slot:
    return Slot(start, size, start + size if sensor.late_s > 0.0 else -1)


def _fading(size: int, sensor: SensorOptions) -> Array:
    """(S, 2) of a sensor's bias, and of its lateness, which is constant."""
    bias = np.tile([1.0 / sensor.bias_s, 1.0 / sensor.bias_range], (size, 1))
    return np.vstack([bias, np.zeros((1, 2))]) if sensor.late_s > 0.0 else bias
