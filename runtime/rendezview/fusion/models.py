"""Measurement models: what each kind of reading should be at a state, and its Jacobian.

A reading may mean several things: either circle of a ring's ellipse, or another edge than the
ring's. Each is a `Forecast`; the likeliest counts. Slopes are of the error state (`state`):
R_true = exp([θ]×) R, p_true = p + δp (docs/conventions.md).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rendezview.fusion.options import FusionOptions, SensorOptions
from rendezview.fusion.state import (
    RING_GEOMETRY,
    FilterState,
    Slot,
    pose_covariance,
    sensor_options,
)
from rendezview.fusion.update import root_of
from rendezview.geometry import so3
from rendezview.geometry.pose import Array
from rendezview.sensors.beam import BeamMesh, Met
from rendezview.sensors.measurement import (
    Measurement,
    PoseMeasurement,
    RangeMeasurement,
    RingMeasurement,
    tangents,
)

# Of another edge than the ring's, beside the ring's own errors: σ of its bearing (rad), range
# (relative) and axis (rad). Source: ring's edge at docking-ring radii of 0.8 to 1.2
_OTHER_BEARING, _OTHER_RANGE, _OTHER_RAD = 0.01, 0.3, 0.03
# Of a ring's covariance, which takes its edges for independent. Source: fusion-approach, seeds 0–5,
# and the Mitsuba approach: with 1 the place is 1.3 times as bad below 7.5 m, with 4 1.1 times
_RING_INFLATION = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class Forecast:
    """A reading beside one of its meanings, linearised at a state."""

    residual: Array  # (k,) measured − expected, the bias left out
    design: Array  # (k, n) slope by every state, the bias's included
    noise: Array  # (k, k) covariance of the white noise
    root: Array  # (k, k) of the whole covariance that the sensor reports
    shares: Array  # (k,) white share of it
    sigmas: Array  # (k,) of the reading
    teaches: bool = True  # the shares are learnt from it
    log_prior: float = 0.0
    other_edge: bool = False


def forecasts(
    state: FilterState, measurement: Measurement, options: FusionOptions
) -> list[Forecast] | str:
    """Each meaning of a reading beside the state; words where the two cannot be compared."""
    sensor = sensor_options(measurement, options)
    if isinstance(measurement, PoseMeasurement):
        return [_pose(state, measurement, sensor)]
    if isinstance(measurement, RingMeasurement):
        return _ring(state, measurement, sensor, options)
    assert isinstance(measurement, RangeMeasurement)  # the others are inputs
    return _range(state, measurement, sensor)


def _forecast(
    state: FilterState, measurement: Measurement, residual: Array, motion: Array, whole: Array,
    shares: Array, late_s: float, *, bias: int = 0, teaches: bool = True, log_prior: float = 0.0,
) -> Forecast | None:  # fmt: skip
    """With the bias's columns; None where the covariance cannot be used."""
    slot = state.slots[measurement.sensor]
    root = root_of(whole)
    if root is None:
        return None
    start, size = slot.start + bias, len(whole)
    design = np.zeros((size, state.deviations.shape[1]))
    design[:, : motion.shape[1]] = motion
    design[:, start : start + size] = root * np.sqrt(np.maximum(1.0 - shares, 0.0))
    noise: Array = (root * shares) @ root.T
    sigmas: Array = np.sqrt(whole.diagonal())
    if slot.lateness >= 0:  # what it shows is of a moment before
        moving = state.velocity - np.cross(state.rate, state.place_m)
        speed = motion[:, :3] @ (state.rotation @ state.rate) + motion[:, 3:6] @ moving
        design[:, slot.lateness] = -late_s * speed
    return Forecast(residual, design, noise, root, shares, sigmas, teaches, log_prior, bias > 0)


def _pose(state: FilterState, measurement: PoseMeasurement, sensor: SensorOptions) -> Forecast:
    away = -state.rotation @ state.place_m
    turn = so3.between(np.array(measurement.pose.rotation), state.rotation)
    residual = np.concatenate([turn, measurement.pose.translation_m - away])
    motion = np.zeros((6, 6))
    motion[:3, :3] = np.eye(3)
    motion[3:, :3], motion[3:, 3:] = -so3.hat(away), -state.rotation  # θ × away
    whole = pose_covariance(measurement, sensor)
    shares = state.white[measurement.sensor]
    forecast = _forecast(state, measurement, residual, motion, whole, shares, sensor.late_s)
    assert forecast is not None  # the measurement checks its covariance
    return forecast


def _ring(
    state: FilterState, measurement: RingMeasurement, sensor: SensorOptions, options: FusionOptions
) -> list[Forecast] | str:
    ring, geometry, means = measurement.ring, state.slots.get(RING_GEOMETRY), np.zeros(2)
    sigmas = np.array([options.ring_radius_sigma, options.ring_depth_sigma_m])
    if geometry is not None:
        means = np.array([state.mean(geometry.start), state.mean(geometry.start + 1)])
    radius, depth_m = 1.0 + sigmas[0] * means[0], sigmas[1] * means[1]
    if radius <= 0.1:
        return "the ring's radius is lost"
    centre, axis, basis, motion = ring_parts(
        ring.centre_m, ring.axis, state.rotation, state.place_m, radius, depth_m
    )
    if centre[2] <= 0.0:
        return "the ring would be behind the camera"
    motion[:, 6:] *= sigmas
    known, motion = motion[:, 6:] @ means, _spread_out(motion, geometry)
    other, shares = options.ring_other_edge, state.white[measurement.sensor]
    found = []
    for place, normal, covariance in zip(
        measurement.centres_m, measurement.axes, measurement.covariances, strict=True
    ):
        residual, whole = circle_parts(
            place, normal, covariance, centre, axis, basis, _RING_INFLATION * sensor.inflation
        )
        residual += known  # the columns of radius and depth have it
        edge = _forecast(
            state, measurement, residual, motion, whole, shares, sensor.late_s,
            log_prior=math.log1p(-other),
        )  # fmt: skip
        if edge is not None:
            found.append(edge)
        if other > 0.0:
            wide = of_other_edge(whole, place)
            beside = _forecast(
                state, measurement, residual, motion, wide, np.full(5, 1.0 - sensor.bias_share),
                sensor.late_s, bias=5, teaches=False, log_prior=math.log(other),
            )  # fmt: skip
            if beside is not None:
                found.append(beside)
    return found or "its covariance cannot be used"


def ring_parts(
    ring_centre: Array, ring_axis: Array, rotation: Array, place: Array, radius: float,
    depth_m: float,
) -> tuple[Array, Array, Array, Array]:  # fmt: skip
    """Expected centre (3,) and axis (3,) of a ring; tangents (3, 2); slope (5, 8).

    Args:
        radius: true one over the given one. The radius that the sensor takes is too small by this
            factor: so is its centre's distance.
        depth_m: offset along the axis.

    Returns:
        The slope is by attitude, place, radius and depth.
    """
    axis = rotation @ ring_axis
    centre = rotation @ (ring_centre + depth_m * ring_axis - place) / radius
    basis = tangents(axis)
    motion = np.zeros((5, 8))
    motion[:3, :3], motion[:3, 3:6] = -so3.hat(centre), -rotation / radius  # θ × centre
    motion[:3, 6], motion[:3, 7] = -centre / radius, axis / radius
    motion[3:, :3] = -basis.T @ so3.hat(axis)
    return centre, axis, basis, motion


def circle_parts(
    measured_centre: Array, measured_axis: Array, covariance: Array, centre: Array, axis: Array,
    basis: Array, inflation: float,
) -> tuple[Array, Array]:  # fmt: skip
    """(5,) residual and (5, 5) covariance of a circle beside the expected one.

    Args:
        covariance: (6, 6) of centre and axis.
        inflation: of the covariance.
    """
    sign = 1.0 if measured_axis @ axis >= 0.0 else -1.0  # a circle has no front
    flat = np.zeros((5, 6))
    flat[:3, :3], flat[3:, 3:] = np.eye(3), sign * basis.T
    residual = np.concatenate([measured_centre - centre, flat[3:, 3:] @ measured_axis])
    return residual, inflation * flat @ covariance @ flat.T


def of_other_edge(whole: Array, place: Array) -> Array:
    """(5, 5) covariance of a circle that is another edge than the ring's, seen at (3,) place.

    A concentric edge, or one of a shadow: the line of sight is nearly right, the size not.
    """
    wide = whole.copy()
    wide[:3, :3] += _OTHER_BEARING**2 * (place @ place) * np.eye(3)
    wide[:3, :3] += _OTHER_RANGE**2 * np.outer(place, place)
    wide[3:, 3:] += _OTHER_RAD**2 * np.eye(2)
    return wide


def _spread_out(motion: Array, geometry: Slot | None) -> Array:
    """The slope of a ring by the states in their order: radius and depth where they stand."""
    if geometry is None:
        return motion[:, :6].copy()
    wide = np.zeros((5, geometry.start + 2))
    wide[:, :6], wide[:, geometry.start :] = motion[:, :6], motion[:, 6:]
    return wide


def _range(
    state: FilterState, measurement: RangeMeasurement, sensor: SensorOptions
) -> list[Forecast] | str:
    beam, rotation = measurement.direction, state.rotation
    start_m = state.place_m + rotation.T @ measurement.origin_m  # target frame
    met = _met(state, measurement, start_m)
    if isinstance(met, str):
        return met
    normal = rotation @ met.normal
    slant = float(normal @ beam)
    # d(n·(q − o)/(n·d)), with n and q = R (point − p) turned by θ: n × (q − o − distance d)
    # and q × n over n·d, together −n × (o + distance d).
    away = measurement.origin_m + met.distance_m * beam
    motion = np.zeros((1, 6))
    motion[0, :3] = -so3.hat(normal) @ away / slant
    motion[0, 3:] = -met.normal / slant
    whole = np.array([[measurement.sigma_m**2 + met.relief_m**2]])
    white = measurement.sigma_m**2 / whole[0]
    residual = np.array([measurement.range_m - met.distance_m])
    found = _forecast(
        state, measurement, residual, motion, whole, white, sensor.late_s, teaches=False
    )
    return "its covariance cannot be used" if found is None else [found]


def _met(state: FilterState, measurement: RangeMeasurement, start_m: Array) -> Met | str:
    """What the beam meets: the first of the planes that it certainly hits, or the mesh."""
    surfaces, reason = measurement.surfaces, "no surface"
    # Where depth is hardly known yet, no innovation shows that the beam met a thin part.
    if isinstance(surfaces, BeamMesh) and not state.confirmed:
        return "a range on the mesh waits until poses agree"
    beam = state.rotation.T @ measurement.direction
    pose = (state.weights[:, None, None] * state.covariances[:, :6, :6]).sum(axis=0)
    # Of the spot, by attitude and place: R⁻¹ turns by −R⁻¹ θ.
    arm = measurement.origin_m + measurement.range_m * measurement.direction
    slope = np.hstack([state.rotation.T @ so3.hat(arm), np.eye(3)])
    spread = slope @ pose @ slope.T
    for surface in (surfaces,) if isinstance(surfaces, BeamMesh) else surfaces:
        met = surface.met(start_m, beam, spread)
        if not isinstance(met, str):
            return met
        reason = met
    return reason
