"""The filter's update: a measurement beside the forecast, and the state after it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rendezview.fusion.kernels import corrected
from rendezview.fusion.models import expected, gate_of
from rendezview.fusion.options import FusionOptions, SensorOptions
from rendezview.fusion.state import FilterState, Slot, fading_of, sensor_options
from rendezview.geometry.pose import Array
from rendezview.sensors.measurement import Measurement


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

    residual: Array  # (m,) measured − expected, less the bias as it is known
    raw: Array  # (m,) with it
    nis: float  # its squared distance in σ
    log_volume: float  # ln|S|
    white: Array  # (m, m) the part of its covariance that is new each time
    bias_root: Array  # (m, b) root of the part that lasts
    updated: FilterState  # the state if it is believed
    loose: bool = False  # a ring with another of its edges taken: only its bearing counts

    @property
    def size(self) -> int:
        """Degrees of freedom."""
        return len(self.residual)

    @property
    def bias(self) -> Array:
        """(m, m) the part of its covariance that lasts."""
        return self.bias_root @ self.bias_root.T


def innovation(
    state: FilterState, measurement: Measurement, options: FusionOptions
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
    known = _with_slot(state, measurement, sensor)
    slot = known.slot(measurement.sensor)
    assert slot is not None
    forecast = expected(known, measurement, sensor, options.ring_other_edge, slot.start)
    if isinstance(forecast, str):
        return Rejected(measurement.sensor, math.inf, measurement.size, forecast)
    fits, nis, log_volume, residual, rotation, place, rates, extras, covariance = corrected(
        known.rotation, known.translation_m, known.rates, known.extras, known.covariance,
        forecast.slope, forecast.bias_root, slot.start, forecast.white, forecast.residual,
    )  # fmt: skip
    if not fits:
        return Rejected(
            measurement.sensor, math.inf, measurement.size, "its covariance cannot be used"
        )
    updated = FilterState(
        known.time_s, rotation, place, rates, extras, covariance, known.fading, known.slots
    )
    return Innovation(
        residual, forecast.residual, nis, log_volume, forecast.white, forecast.bias_root, updated,
        forecast.loose,
    )  # fmt: skip


def update(
    state: FilterState, measurement: Measurement, options: FusionOptions
) -> FilterState | Rejected:
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


def _with_slot(state: FilterState, measurement: Measurement, sensor: SensorOptions) -> FilterState:
    """The state with room for the bias of a sensor that the state has not met before."""
    if state.slot(measurement.sensor) is not None:
        return state
    n, size = len(state.covariance), measurement.bias_size
    covariance = np.zeros((n + size, n + size))
    covariance[:n, :n] = state.covariance
    covariance[n:, n:] = np.eye(size)
    slot = Slot(measurement.sensor, n, size, sensor.bias_s, sensor.bias_range)
    return FilterState(
        state.time_s, state.rotation, state.translation_m, state.rates,
        np.concatenate([state.extras, np.zeros(size)]), covariance,
        np.vstack([state.fading, fading_of(slot)]), (*state.slots, slot),
    )  # fmt: skip
