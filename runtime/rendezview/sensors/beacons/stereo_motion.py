"""A filter over the readings, which costs no rate: every reading gives an estimate.

The paper averages several scans for one reading. Here each scan is weighed against the
motion so far: pose and rates with a covariance, rates disturbed by white accelerations. The
reading enters as its equations, not as a pose, so that even one light helps.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from rendezview.estimation import linear_algebra
from rendezview.estimation.motion import predict_covariance
from rendezview.geometry import so3
from rendezview.geometry.pose import Array
from rendezview.sensors.beacons.pose.collinearity import solve
from rendezview.sensors.beacons.rig import Rig

_ITERATIONS = 15  # Source: by construction, a bound only
_TOLERANCE = 0.1  # of a standard deviation, of the last step. Source: by construction
# Squared distance of reading and forecast, in σ, at which the forecast is wrong. Source: χ²
# distribution, six degrees, 10⁻¹⁴
_BREAK = 80.0


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionOptions:
    """How freely the target moves; white accelerations, as spectral densities."""

    # rad/s² √s: rate error 1.1°/s after 1 s. Source: by hand; see experiment stereo-accuracy
    angular_acceleration: float = 0.02
    # m/s² √s. Source: by hand; see experiment stereo-accuracy
    linear_acceleration: float = 0.02
    first_rate: float = 0.2  # rad/s, σ of the unknown first rates. Source: a chosen limit
    first_velocity: float = 0.2  # m/s. Source: a chosen limit

    def __post_init__(self) -> None:
        for name in self.__slots__:
            if not 0.0 <= getattr(self, name) < np.inf:
                raise ValueError(f"{name} must not be negative: {getattr(self, name)}")


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """State of the filter, rig frame: pose, rates (rotation vector rad/s, velocity m/s)."""

    time_s: float
    rotation: Array  # (3, 3) rig from target
    translation: Array  # (3,)
    rates: Array  # (6,)
    covariance: Array  # (12, 12) of (pose perturbation, rates)


def begin(
    time_s: float, rotation: Array, translation: Array, covariance: Array, options: MotionOptions
) -> Motion:
    """The filter at a first reading's pose with its (6, 6) covariance."""
    whole = np.zeros((12, 12))
    whole[:6, :6] = covariance
    sigma = [options.first_rate] * 3 + [options.first_velocity] * 3
    whole[6:, 6:] = np.diag(np.square(sigma))
    return Motion(time_s, rotation.copy(), translation.copy(), np.zeros(6), whole)


def predict(state: Motion, time_s: float, options: MotionOptions) -> Motion:
    """The state at a later time.

    Raises:
        ValueError: the time is earlier than the state's.
    """
    dt = time_s - state.time_s
    if not dt >= 0.0:
        raise ValueError(f"the filter cannot go back, from {state.time_s} s to {time_s} s")
    rotation, translation, covariance = _predict(
        state.rotation, state.translation, state.rates, state.covariance, dt,
        options.angular_acceleration**2, options.linear_acceleration**2,
    )  # fmt: skip
    return Motion(time_s, rotation, translation, state.rates, covariance)


def update(
    state: Motion,
    rig: Rig,
    leds: Array,
    xy: Array,
    weight: Array,
    start: tuple[Array, Array] | None = None,
) -> Motion | None:
    """The state after a reading at its time; ``None`` where the equations do not converge.

    Args:
        state: predicted to the time of the reading.
        rig: the cameras.
        leds: (L, 3) target frame.
        xy: (C, L, 2) ideal places.
        weight: (C, L, 2) 1/σ, 0 for lights that are not visible or rejected.
        start: rotation and translation to begin at, such as the reading's own pose.
    """
    given = (state.rotation, state.translation) if start is None else start
    rotation, translation = given[0].copy(), given[1].copy()
    rates = state.rates.copy()
    covariance = np.empty((12, 12))
    if not _update(
        state.rotation, state.translation, state.covariance, leds, rig.rotations,
        rig.translations, xy, weight, rotation, translation, rates, covariance,
    ):  # fmt: skip
        return None
    return Motion(state.time_s, rotation, translation, rates, covariance)


def breaks(state: Motion, rotation: Array, translation: Array, information: Array) -> bool:
    """Whether a reading's own pose is so far from the forecast that the forecast is wrong."""
    return bool(
        _breaks(
            state.rotation, state.translation, state.covariance, rotation, translation, information
        )
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _predict(
    rotation: Array,
    translation: Array,
    rates: Array,
    covariance: Array,
    dt: float,
    angular: float,
    linear: float,
) -> tuple[Array, Array, Array]:
    """Rotation, translation and covariance ``dt`` later; densities of the white accelerations."""
    turn, later, density = so3.exp(dt * rates[:3]), np.empty((3, 3)), np.zeros((6, 6))
    for i in range(3):
        density[i, i], density[3 + i, 3 + i] = angular, linear
        for j in range(3):
            later[i, j] = (
                turn[i, 0] * rotation[0, j]
                + turn[i, 1] * rotation[1, j]
                + turn[i, 2] * rotation[2, j]
            )
    predicted = predict_covariance(covariance, turn, dt, density, np.ones(0))
    return later, translation + dt * rates[3:], predicted


@njit(cache=True, nogil=True, error_model="numpy")
def difference(
    rotation: Array, translation: Array, other_rotation: Array, other_translation: Array
) -> Array:
    """(6,) perturbation that leads from the other pose to this one."""
    out = np.empty(6)
    out[:3] = so3.between(rotation, other_rotation)
    for i in range(3):
        out[3 + i] = translation[i] - other_translation[i]
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _update(
    prior_rotation: Array,
    prior_translation: Array,
    prior: Array,
    leds: Array,
    cr: Array,
    ct: Array,
    xy: Array,
    weight: Array,
    rotation: Array,
    translation: Array,
    rates: Array,
    covariance: Array,
) -> bool:
    lower, inverse, information = np.zeros((6, 6)), np.empty((6, 6)), np.empty((6, 6))
    if not linear_algebra.invert(prior[:6, :6], lower, inverse):
        return False
    _, _, done = solve(
        rotation, translation, leds, cr, ct, xy, weight, inverse, prior_rotation,
        prior_translation, _ITERATIONS, _TOLERANCE, information,
    )  # fmt: skip
    if not done:
        return False
    posterior = np.empty((6, 6))
    if not linear_algebra.invert(information, lower, posterior):
        return False
    moved = difference(rotation, translation, prior_rotation, prior_translation)
    gain = np.ascontiguousarray(prior[6:, :6]) @ inverse  # gain of the rates by a pose's correction
    rates += gain @ moved
    covariance[:6, :6] = posterior
    covariance[6:, :6] = gain @ posterior
    covariance[:6, 6:] = covariance[6:, :6].T
    lost = np.ascontiguousarray(prior[:6, :6]) - posterior
    covariance[6:, 6:] = prior[6:, 6:] - gain @ lost @ gain.T
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _breaks(
    rotation: Array,
    translation: Array,
    covariance: Array,
    measured_rotation: Array,
    measured_translation: Array,
    information: Array,
) -> bool:
    lower, both, solution = np.zeros((6, 6)), np.empty((6, 6)), np.empty(6)
    if not linear_algebra.invert(information, lower, both):
        return False
    both += covariance[:6, :6]
    away = difference(measured_rotation, measured_translation, rotation, translation)
    if not linear_algebra.solve(both, away, lower, solution):
        return False
    return bool(away @ solution > _BREAK)
