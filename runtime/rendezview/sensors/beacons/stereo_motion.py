"""A filter over the readings, which costs no rate: every reading gives an estimate.

The paper averages several scans for one reading. Here each scan is weighed against the
motion so far: pose and rates with a covariance, rates disturbed by white accelerations. The
reading enters as its equations, not as a pose, so that even one light helps.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rendezview.estimation.motion import predict_covariance
from rendezview.geometry import so3
from rendezview.geometry.pose import Array
from rendezview.sensors.beacons.match.agreement import ITERATIONS, difference
from rendezview.sensors.beacons.pose.collinearity import solve
from rendezview.sensors.beacons.rig import Rig

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
    turn = so3.exp(dt * state.rates[:3])
    density = np.square([options.angular_acceleration] * 3 + [options.linear_acceleration] * 3)
    covariance = predict_covariance(state.covariance, turn, dt, density)
    place = state.translation + dt * state.rates[3:]
    return Motion(time_s, turn @ state.rotation, place, state.rates, covariance)


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
    rotation, translation = (state.rotation, state.translation) if start is None else start
    rotation, translation = rotation.copy(), translation.copy()
    prior, information = state.covariance, np.empty((6, 6))
    inverse = np.asarray(np.linalg.inv(prior[:6, :6]), np.float64)
    _, _, done = solve(
        rotation, translation, leds, rig.rotations, rig.translations, xy, weight, inverse,
        state.rotation, state.translation, ITERATIONS, _TOLERANCE, information,
    )  # fmt: skip
    if not done:
        return None
    gain = prior[6:, :6] @ inverse  # of the rates by a pose's correction
    both = np.vstack([np.eye(6), gain])
    whole = both @ np.linalg.inv(information) @ both.T
    whole[6:, 6:] += prior[6:, 6:] - gain @ prior[:6, 6:]
    moved = difference(rotation, translation, state.rotation, state.translation)
    return Motion(state.time_s, rotation, translation, state.rates + gain @ moved, whole)


def breaks(state: Motion, rotation: Array, translation: Array, information: Array) -> bool:
    """Whether a reading's own pose is so far from the forecast that the forecast is wrong."""
    both = np.linalg.inv(information) + state.covariance[:6, :6]
    away = difference(rotation, translation, state.rotation, state.translation)
    return bool(away @ np.linalg.solve(both, away) > _BREAK)
