"""What each kind of measurement is expected to say, and its slope by the state.

Slopes are of the error state: R_true = exp([w]×) R, t_true = t + v (docs/conventions.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import chdtri

from rendezview.fusion.kernels import rotation_vector, square_root
from rendezview.fusion.measurements import (
    Measurement,
    PoseMeasurement,
    RangeMeasurement,
    RingCandidate,
    RingMeasurement,
)
from rendezview.fusion.options import SensorOptions
from rendezview.pose import Array

if TYPE_CHECKING:
    from rendezview.fusion.state import State

_COLUMNS = 14  # twelve of motion, ring radius and depth
_RADIUS, _DEPTH = 12, 13
_GRAZING = 0.05  # cosine of beam and surface normal below which a range says nothing


@dataclass(frozen=True, slots=True, eq=False)
class Expected:
    """A measurement linearised at a state."""

    residual: Array  # (m,) measured − expected, the lasting error left out
    design: Array  # (m, 14) slope by motion, ring radius and depth
    white: Array  # (m, m) covariance of what is new each time
    lasting_root: Array  # (m, m) slope by the lasting error, which has unit variance
    mixed: Expected | None = None  # the other candidate


@cache
def gate_of(size: int, chance: float) -> float:
    """Squared distance that a good measurement exceeds by chance."""
    return float(chdtri(size, chance))


def root_of_lasting(covariance: Array, sensor: SensorOptions) -> Array:
    """Lower triangular root of the share of a covariance that lasts."""
    return np.asarray(square_root(sensor.lasting * covariance))


def expected(state: State, measurement: Measurement, sensor: SensorOptions) -> Expected | str:
    """The measurement beside the state; words where the two cannot be compared."""
    if isinstance(measurement, PoseMeasurement):
        return _pose(state, measurement, sensor)
    if isinstance(measurement, RingMeasurement):
        return _ring(state, measurement, sensor)
    return _range(state, measurement)


def _pose(state: State, measurement: PoseMeasurement, sensor: SensorOptions) -> Expected:
    pose = measurement.pose
    residual = np.empty(6)
    residual[:3] = rotation_vector(pose.rotation, state.rotation)
    residual[3:] = pose.translation_m - state.translation_m
    covariance = sensor.inflation * measurement.covariance
    return Expected(
        residual, _POSE_DESIGN, (1.0 - sensor.lasting) * covariance,
        root_of_lasting(covariance, sensor),
    )  # fmt: skip


def _ring(state: State, measurement: RingMeasurement, sensor: SensorOptions) -> Expected | str:
    ring = measurement.ring
    axis = state.rotation @ ring.axis
    # The radius that the sensor takes is too small by (1 + radius): so is its centre's distance.
    size = 1.0 + float(state.extras[_RADIUS - 12])
    depth = float(state.extras[_DEPTH - 12])
    if size <= 0.1:
        return "the ring's radius is lost"
    arm = state.rotation @ (ring.centre_m + depth * ring.axis)
    centre = (arm + state.translation_m) / size
    if not centre[2] > 0.0:
        return "the ring would be behind the camera"
    basis = tangents(axis)
    design = np.zeros((5, _COLUMNS))
    design[:3, :3] = -_cross(arm) / size
    design[:3, 3:6] = np.eye(3) / size
    design[:3, _RADIUS] = -centre / size
    design[:3, _DEPTH] = axis / size
    design[3:, :3] = -basis.T @ _cross(axis)
    looks = [_look(c, centre, axis, basis, design, sensor) for c in measurement.candidates[:2]]
    if len(looks) == 1:
        return looks[0]
    first, second = looks
    return Expected(first.residual, design, first.white, first.lasting_root, second)


def _look(
    candidate: RingCandidate,
    centre: Array,
    axis: Array,
    basis: Array,
    design: Array,
    sensor: SensorOptions,
) -> Expected:
    sign = 1.0 if candidate.axis @ axis >= 0.0 else -1.0  # a circle has no front
    residual = np.empty(5)
    residual[:3] = candidate.centre_m - centre
    residual[3:] = basis.T @ (sign * candidate.axis)
    flat = np.zeros((5, 6))
    flat[:3, :3], flat[3:, 3:] = np.eye(3), sign * basis.T
    covariance = sensor.inflation * (flat @ candidate.covariance @ flat.T)
    return Expected(
        residual, design, (1.0 - sensor.lasting) * covariance, root_of_lasting(covariance, sensor)
    )


def _range(state: State, measurement: RangeMeasurement) -> Expected | str:
    surface, beam = measurement.surface, measurement.direction
    normal = state.rotation @ surface.normal
    slant = float(normal @ beam)
    if abs(slant) < _GRAZING:
        return "the beam grazes the surface"
    from_origin = state.translation_m - measurement.origin_m
    distance = float(normal @ (state.rotation @ surface.point_m + from_origin)) / slant
    if not distance > 0.0:
        return "the surface would be behind the ranger"
    design = np.zeros((1, _COLUMNS))
    # d(n·(p − o)/(n·d)), with n and p − t turned by w: n × (t − o − distance d) over n·d.
    away = from_origin - distance * beam
    design[0, 0] = (normal[1] * away[2] - normal[2] * away[1]) / slant
    design[0, 1] = (normal[2] * away[0] - normal[0] * away[2]) / slant
    design[0, 2] = (normal[0] * away[1] - normal[1] * away[0]) / slant
    design[0, 3:6] = normal / slant
    return Expected(
        np.array([measurement.range_m - distance]),
        design,
        np.array([[measurement.sigma_m**2]]),
        np.array([[surface.relief_m]]),
    )


def tangents(axis: Array) -> Array:
    """(3, 2) unit vectors across an axis, right-handed with it, the first from the x axis."""
    first = np.array([1.0, 0.0, 0.0]) if abs(axis[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    first = first - (first @ axis) * axis
    first /= np.sqrt(first @ first)
    second = np.array(
        [
            axis[1] * first[2] - axis[2] * first[1],
            axis[2] * first[0] - axis[0] * first[2],
            axis[0] * first[1] - axis[1] * first[0],
        ]
    )
    return np.column_stack([first, second])


def _cross(vector: Array) -> Array:
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _pose_design() -> Array:
    design = np.zeros((6, _COLUMNS))
    design[:, :6] = np.eye(6)
    return design


_POSE_DESIGN = _pose_design()
