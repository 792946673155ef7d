"""Measurement models: the predicted value of each kind, and its Jacobian by the state.

Slopes are of the error state: R_true = exp([w]×) R, t_true = t + v (docs/conventions.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.special import chdtri

from rendezview.fusion.model_kernels import pose_model, ring_expected
from rendezview.fusion.options import SensorOptions
from rendezview.fusion.state import FilterState
from rendezview.geometry.pose import Array
from rendezview.sensors.measurement import (
    Measurement,
    PoseMeasurement,
    RangeMeasurement,
    RingMeasurement,
)

_COLUMNS = 14  # twelve of motion, ring radius and depth. Source: by construction
# σ of the place by which a spot must lie within its surface. Source: normal distribution, 95 %
_INSIDE = 2.0
# Cosine of beam and surface normal below which a range is not used. Source: by construction, 3°: 1
# mm of relief is 2 cm of range
_GRAZING = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class Expected:
    """A measurement linearised at a state."""

    residual: Array  # (m,) measured − expected, the bias left out
    slope: Array  # (m, 14) slope by motion, ring radius and depth
    white: Array  # (m, m) covariance of the white noise
    bias_root: Array  # (m, b) slope by the bias, which has unit variance
    loose: bool = False  # little information: another edge than the ring's was taken


@cache
def gate_of(size: int, chance: float) -> float:
    """Squared distance that a good measurement exceeds by chance."""
    return float(chdtri(size, chance))


def expected(
    state: FilterState,
    measurement: Measurement,
    sensor: SensorOptions,
    chance_of_other: float = 0.0,
    start: int = _COLUMNS,
) -> Expected | str:
    """The measurement beside the state; words where the two cannot be compared.

    ``start`` is the index of the sensor's bias in the state. The bias gives the likelihood
    of each candidate.
    """
    if isinstance(measurement, PoseMeasurement):
        return _pose(state, measurement, sensor)
    if isinstance(measurement, RingMeasurement):
        return _ring(state, measurement, sensor, chance_of_other, start)
    return _range(state, measurement)


def _pose(state: FilterState, measurement: PoseMeasurement, sensor: SensorOptions) -> Expected:
    pose = measurement.pose
    residual, white, root = pose_model(
        pose.rotation, pose.translation_m, measurement.covariance, state.rotation,
        state.translation_m, sensor.inflation, sensor.floor_rad, sensor.floor_range,
        sensor.bias_share,
    )  # fmt: skip
    return Expected(residual, _POSE_SLOPE, white, root)


def _ring(
    state: FilterState,
    measurement: RingMeasurement,
    sensor: SensorOptions,
    chance_of_other: float,
    start: int,
) -> Expected | str:
    if state.extras[0] <= -0.9:
        return "the ring's radius is lost"
    ring = measurement.ring
    # Copies: for read-only arrays numba would compile the loop a second time.
    centre_m, axis = np.array(ring.centre_m), np.array(ring.axis)
    before, loose, residual, slope, white, root = ring_expected(
        measurement.centres_m, measurement.axes, measurement.covariances, centre_m, axis,
        state.rotation, state.translation_m, state.extras, state.covariance, start,
        sensor.inflation, sensor.floor_rad, sensor.floor_range, sensor.bias_share, chance_of_other,
    )  # fmt: skip
    if not before:
        return "the ring would be behind the camera"
    return Expected(residual, slope, white, root, loose)


def _range(state: FilterState, measurement: RangeMeasurement) -> Expected | str:
    beam = measurement.direction
    from_origin = state.translation_m - measurement.origin_m
    reason = "no surface"
    for surface in measurement.surfaces:
        normal = state.rotation @ surface.normal
        arm = state.rotation @ surface.point_m
        slant = float(normal @ beam)
        if abs(slant) < _GRAZING:
            reason = "the beam grazes the surface"
            continue
        distance = float(normal @ (arm + from_origin)) / slant
        if not distance > 0.0:
            reason = "the surface would be behind the ranger"
            continue
        if surface.inner_m > 0.0 or surface.outer_m < np.inf:
            spot = distance * beam - from_origin - arm
            from_point = float(np.sqrt(spot @ spot))
            # Only where the spot is on it with confidence.
            margin_m = _INSIDE * float(np.sqrt(max(state.covariance[3, 3], state.covariance[4, 4])))
            if not surface.inner_m + margin_m <= from_point <= surface.outer_m - margin_m:
                reason = f"the beam may miss the surface: {from_point:.2g} m from its middle"
                continue
        slope = np.zeros((1, _COLUMNS))
        # d(n·(p − o)/(n·d)), with n and p − t turned by w: n × (t − o − distance d) over n·d.
        away = from_origin - distance * beam
        slope[0, 0] = (normal[1] * away[2] - normal[2] * away[1]) / slant
        slope[0, 1] = (normal[2] * away[0] - normal[0] * away[2]) / slant
        slope[0, 2] = (normal[0] * away[1] - normal[1] * away[0]) / slant
        slope[0, 3:6] = normal / slant
        return Expected(
            np.array([measurement.range_m - distance]),
            slope,
            np.array([[measurement.sigma_m**2]]),
            np.array([[surface.relief_m]]),
        )
    return reason


# Source: by construction, the pose stands first
_POSE_SLOPE = np.hstack([np.eye(6), np.zeros((6, _COLUMNS - 6))])
