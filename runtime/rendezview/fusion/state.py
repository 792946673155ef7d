"""The state of the filter and its two functions: `predict` and `update`.

Error state, perturbation on the left in the camera frame as in every covariance here:
attitude (rad), place of the target's origin (m), angular rate (rad/s), velocity (m/s); then the
ring's radius (relative) and depth (m) where they are not known; then one block for each sensor,
its bias in its own σ (Gauss–Markov of unit variance; Schmidt's bias, but estimated).
The joint covariance remembers what of the pose came from which sensor, so that a hundred frames
with one common error do not count as a hundred.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rendezview.estimation.linear_algebra import square_root
from rendezview.fusion.kernels import predicted
from rendezview.fusion.model_kernels import pose_covariance
from rendezview.fusion.options import FusionOptions, SensorOptions
from rendezview.geometry.pose import Array, Pose
from rendezview.sensors.measurement import Measurement, PoseMeasurement

MOTION = 12  # attitude, place, angular rate, velocity. Source: by construction
RADIUS, DEPTH = 12, 13  # of the ring
RING = slice(RADIUS, DEPTH + 1)  # Source: by construction
FIRST_BIAS = 14  # Source: by construction


@dataclass(frozen=True, slots=True)
class Slot:
    """The place of a sensor's bias in the state."""

    sensor: str
    start: int
    size: int
    bias_s: float
    bias_range: float


@dataclass(frozen=True, slots=True, eq=False)
class FilterState:
    """Relative pose and rates at a time, with the estimates of the sensors' biases."""

    time_s: float
    rotation: Array  # (3, 3) camera from target
    translation_m: Array  # (3,)
    rates: Array  # (6,) rotation vector rad/s, velocity of the target's origin m/s; camera frame
    extras: Array  # (n - 12,) ring radius (relative error), ring depth (m), biases (σ)
    covariance: Array  # (n, n)
    fading: Array  # (n - 12, 2) how fast the extras are forgotten: 1/s, and per ln of the range
    slots: tuple[Slot, ...] = ()

    @property
    def pose(self) -> Pose:
        """camera_from_target."""
        return Pose(self.rotation, self.translation_m)

    @property
    def motion_covariance(self) -> Array:
        """(12, 12) of (rotation vector, translation, angular rate, velocity)."""
        return self.covariance[:MOTION, :MOTION]

    def slot(self, sensor: str) -> Slot | None:
        """The place of a sensor's bias; ``None`` before its first measurement."""
        for slot in self.slots:
            if slot.sensor == sensor:
                return slot
        return None


def sensor_options(measurement: Measurement, options: FusionOptions) -> SensorOptions:
    """Those of the sensor's name, else of its kind."""
    named = options.sensors.get(measurement.sensor)
    if named is not None:
        return named
    if isinstance(measurement, PoseMeasurement):
        return options.pose
    return options.range if measurement.size == 1 else options.ring


def begin(
    measurement: PoseMeasurement, options: FusionOptions, rates: Array | None = None
) -> FilterState:
    """The state at a first pose, whose bias is known to be in it.

    Args:
        rates: (6,) where they are known better than zero.
    """
    sensor = sensor_options(measurement, options)
    motion = options.motion
    covariance = np.zeros((FIRST_BIAS + 6, FIRST_BIAS + 6))
    first = pose_covariance(
        measurement.pose.translation_m, measurement.covariance, sensor.inflation,
        sensor.floor_rad, sensor.floor_range,
    )  # fmt: skip
    covariance[:6, :6] = first
    for i in range(3):
        covariance[6 + i, 6 + i] = motion.first_rate**2
        covariance[9 + i, 9 + i] = motion.first_velocity**2
    covariance[RADIUS, RADIUS] = options.ring_radius_sigma**2
    covariance[DEPTH, DEPTH] = options.ring_depth_sigma_m**2
    # The error of the estimate is −(A b + white), where b is the bias.
    root = square_root(sensor.bias_share * first)
    bias = slice(FIRST_BIAS, FIRST_BIAS + 6)
    covariance[bias, bias] = np.eye(6)
    covariance[:6, bias], covariance[bias, :6] = -root, -root.T
    slot = Slot(measurement.sensor, FIRST_BIAS, 6, sensor.bias_s, sensor.bias_range)
    return FilterState(
        measurement.time_s,
        np.array(measurement.pose.rotation),
        np.array(measurement.pose.translation_m),
        np.zeros(6) if rates is None else rates.copy(),
        np.zeros(FIRST_BIAS - MOTION + 6),
        covariance,
        np.vstack([np.zeros((2, 2)), fading_of(slot)]),  # radius and depth are constants
        (slot,),
    )


def predict(state: FilterState, dt_s: float, options: FusionOptions) -> FilterState:
    """The state ``dt_s`` later: rates go on, white accelerations widen it.

    Raises:
        ValueError: the step is negative or not finite.
    """
    if not 0.0 <= dt_s < math.inf:
        raise ValueError(f"the filter goes forward only, not by {dt_s} s")
    if dt_s == 0.0:
        return state
    motion = options.motion
    rotation, translation, extras, covariance = predicted(
        state.rotation, state.translation_m, state.rates, state.extras, state.covariance,
        state.fading, dt_s, motion.angular**2, motion.linear**2, motion.along**2,
        motion.pointing**2,
    )  # fmt: skip
    return FilterState(
        state.time_s + dt_s, rotation, translation, state.rates, extras, covariance, state.fading,
        state.slots,
    )  # fmt: skip


def fading_of(slot: Slot) -> Array:
    """(size, 2) how fast a bias is forgotten: 1/s, and per ln of the range."""
    return np.tile([1.0 / slot.bias_s, 1.0 / slot.bias_range], (slot.size, 1))
