"""The state of the filter and its two functions: `predict` and `update`.

Error state, perturbation on the left in the camera frame as in every covariance here:
attitude (rad), place of the target's origin (m), angular rate (rad/s), velocity (m/s); then the
ring's radius (relative) and depth (m) where they are not known; then one block for each sensor,
its lasting error in its own σ (Gauss–Markov of unit variance; Schmidt's bias, but estimated).
The joint covariance remembers what of the pose came from which sensor, so that a hundred frames
with one common error do not count as a hundred.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rendezview.fusion.kernels import corrected, predicted
from rendezview.fusion.model_kernels import pose_covariance
from rendezview.fusion.models import expected, gate_of, root_of_lasting
from rendezview.fusion.options import FusionOptions, SensorOptions
from rendezview.geometry import so3
from rendezview.geometry.pose import Array, Pose
from rendezview.sensors.measurement import Measurement, PoseMeasurement

MOTION = 12  # attitude, place, angular rate, velocity
RADIUS, DEPTH = 12, 13  # of the ring
FIRST_BIAS = 14


@dataclass(frozen=True, slots=True)
class Slot:
    """Where a sensor's lasting error stands in the state."""

    sensor: str
    start: int
    size: int
    lasting_s: float
    lasting_range: float


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """Relative pose and rates at a time, with what is known of the sensors' lasting errors."""

    time_s: float
    rotation: Array  # (3, 3) camera from target
    translation_m: Array  # (3,)
    rates: Array  # (6,) rotation vector rad/s, velocity of the target's origin m/s; camera frame
    extras: Array  # (n - 12,) ring radius (relative error), ring depth (m), lasting errors (σ)
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
        """Where a sensor's lasting error stands; ``None`` before it was first heard."""
        for slot in self.slots:
            if slot.sensor == sensor:
                return slot
        return None


@dataclass(frozen=True, slots=True)
class Rejected:
    """A measurement that was not taken, and why."""

    sensor: str
    nis: float  # squared distance in σ
    size: int  # degrees of freedom
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class Innovation:
    """A measurement beside what was expected of it."""

    residual: Array  # (m,) measured − expected, less the lasting error as it is known
    raw: Array  # (m,) with it
    nis: float  # its squared distance in σ
    log_volume: float  # ln|S|
    white: Array  # (m, m) the part of its covariance that is new each time
    lasting_root: Array  # (m, b) root of the part that lasts
    updated: State  # the state if it is believed
    loose: bool = False  # a ring, of which another edge was taken: only its bearing counts

    @property
    def size(self) -> int:
        """Degrees of freedom."""
        return len(self.residual)

    @property
    def lasting(self) -> Array:
        """(m, m) the part of its covariance that lasts."""
        return self.lasting_root @ self.lasting_root.T


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
) -> State:
    """The state at a first pose, whose lasting error is known to be in it.

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
    # The estimate is wrong by −(A b + white): what is in it of the lasting error b.
    root = root_of_lasting(first, sensor)
    bias = slice(FIRST_BIAS, FIRST_BIAS + 6)
    covariance[bias, bias] = np.eye(6)
    covariance[:6, bias], covariance[bias, :6] = -root, -root.T
    slot = Slot(measurement.sensor, FIRST_BIAS, 6, sensor.lasting_s, sensor.lasting_range)
    return State(
        measurement.time_s,
        np.array(measurement.pose.rotation),
        np.array(measurement.pose.translation_m),
        np.zeros(6) if rates is None else rates.copy(),
        np.zeros(FIRST_BIAS - MOTION + 6),
        covariance,
        np.vstack([np.zeros((2, 2)), _fading(slot)]),  # radius and depth are constants
        (slot,),
    )


def predict(state: State, dt_s: float, options: FusionOptions) -> State:
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
    return State(
        state.time_s + dt_s, rotation, translation, state.rates, extras, covariance, state.fading,
        state.slots,
    )  # fmt: skip


def innovation(
    state: State, measurement: Measurement, options: FusionOptions
) -> Innovation | Rejected:
    """A measurement beside the state at its time; rejected only where it cannot be compared.

    Raises:
        ValueError: the state is not at the time of the measurement.
    """
    if abs(state.time_s - measurement.time_s) > 1e-9:
        raise ValueError(
            f"{measurement.sensor}: predict the state from {state.time_s} s to "
            f"{measurement.time_s} s first"
        )
    sensor = sensor_options(measurement, options)
    heard = _with_slot(state, measurement, sensor)
    slot = heard.slot(measurement.sensor)
    assert slot is not None
    seen = expected(heard, measurement, sensor, options.ring_other_edge, slot.start)
    if isinstance(seen, str):
        return Rejected(measurement.sensor, math.inf, measurement.size, seen)
    fits, nis, log_volume, residual, rotation, place, rates, extras, covariance = corrected(
        heard.rotation, heard.translation_m, heard.rates, heard.extras, heard.covariance,
        seen.slope, seen.lasting_root, slot.start, seen.white, seen.residual,
    )  # fmt: skip
    if not fits:
        return Rejected(
            measurement.sensor, math.inf, measurement.size, "its covariance cannot be used"
        )
    updated = State(
        heard.time_s, rotation, place, rates, extras, covariance, heard.fading, heard.slots
    )
    return Innovation(
        residual, seen.residual, nis, log_volume, seen.white, seen.lasting_root, updated,
        seen.loose,
    )  # fmt: skip


def update(state: State, measurement: Measurement, options: FusionOptions) -> State | Rejected:
    """The state after a measurement at its time, if it passes the gate.

    Raises:
        ValueError: the state is not at the time of the measurement.
    """
    found = innovation(state, measurement, options)
    if isinstance(found, Rejected):
        return found
    gate = gate_of(found.size, sensor_options(measurement, options).gate)
    if found.nis > gate:
        return Rejected(
            measurement.sensor, found.nis, found.size,
            f"{math.sqrt(found.nis):.1f} σ away, the gate is at {math.sqrt(gate):.1f}",
        )  # fmt: skip
    return found.updated


def difference(one: State, other: State) -> Array:
    """(6,) perturbation of the pose that leads from the other state to this one."""
    turn = so3.between(one.rotation, other.rotation)
    return np.concatenate([turn, one.translation_m - other.translation_m])


def _with_slot(state: State, measurement: Measurement, sensor: SensorOptions) -> State:
    """With room for the lasting error of a sensor that is heard for the first time."""
    if state.slot(measurement.sensor) is not None:
        return state
    n, size = len(state.covariance), measurement.bias_size
    covariance = np.zeros((n + size, n + size))
    covariance[:n, :n] = state.covariance
    covariance[n:, n:] = np.eye(size)
    slot = Slot(measurement.sensor, n, size, sensor.lasting_s, sensor.lasting_range)
    return State(
        state.time_s, state.rotation, state.translation_m, state.rates,
        np.concatenate([state.extras, np.zeros(size)]), covariance,
        np.vstack([state.fading, _fading(slot)]), (*state.slots, slot),
    )  # fmt: skip


def _fading(slot: Slot) -> Array:
    return np.tile([1.0 / slot.lasting_s, 1.0 / slot.lasting_range], (slot.size, 1))
