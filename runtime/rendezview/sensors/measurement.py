"""Measurements, as the filter takes them: a pose, a ring or a range, with time and covariance.

Where a sensor is not mounted at the filter's camera, `in_camera` transforms its measurement by
``sensor_from_camera`` when it is made. The filter then works in one frame only.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from numbers import Real

import numpy as np
import numpy.typing as npt

from rendezview.geometry.pose import Array, Pose
from rendezview.io.target import DockingRing
from rendezview.sensors.beam import BeamMesh, BeamSurface

# Source: by construction
_ROUNDING = 1e-9  # of the largest variance: the rounding of a covariance written to a file
# Of σ σ: the largest difference of a covariance from its transpose, the rounding to three digits.
_ASYMMETRY = 1e-3  # Source: by construction


@dataclass(frozen=True, slots=True, eq=False)
class PoseMeasurement:
    """All six degrees of freedom: from the recognizer, reflectors, a stereo tracker.

    Raises:
        ValueError: a number is not finite, or the covariance not one (symmetric, positive).
    """

    time_s: float  # when the light fell on the sensor
    sensor: str
    pose: Pose  # camera_from_target
    covariance: Array  # (6, 6) rotation vector, translation; on the left, camera frame
    # (6, 6) of it that all readings of a run have in common, as a calibration's; None: not known
    common: Array | None = None

    size = bias_size = 6

    def __post_init__(self) -> None:
        object.__setattr__(self, "time_s", _checked_time(self.time_s, self.sensor))
        object.__setattr__(self, "covariance", _checked_covariance(self.covariance, self.sensor))
        if self.common is not None:
            common = _semidefinite(self.common, 6, f"{self.sensor}: the common covariance")
            object.__setattr__(self, "common", common)

    def in_camera(self, sensor_from_camera: Pose) -> PoseMeasurement:
        """The measurement in the camera frame, from that of its sensor."""
        camera_from_sensor = sensor_from_camera.inverse()
        pose, turn = camera_from_sensor @ self.pose, camera_from_sensor.rotation
        common = None if self.common is None else turned(self.common, turn)
        covariance = turned(self.covariance, turn)
        return PoseMeasurement(self.time_s, self.sensor, pose, covariance, common)


@dataclass(frozen=True, slots=True, eq=False)
class RingCandidate:
    """One of the two circles in space that project to the same ellipse."""

    centre_m: Array  # (3,) camera frame
    axis: Array  # (3,) unit, normal of the ring's plane, of either sign
    covariance: Array  # (6, 6) centre, axis; that of the axis has rank two: none along it

    def __post_init__(self) -> None:
        centre, axis = (np.array(v, dtype=np.float64) for v in (self.centre_m, self.axis))
        if centre.shape != (3,) or not np.isfinite(centre).all():
            raise ValueError(f"centre_m must be three finite numbers, not {self.centre_m}")
        if axis.shape != (3,) or not abs(float(np.linalg.norm(axis)) - 1.0) < 1e-3:
            raise ValueError(f"axis must be a unit vector (3,), not {self.axis}")
        covariance = _semidefinite(self.covariance, 6, "the covariance of a ring")
        object.__setattr__(self, "centre_m", centre)
        object.__setattr__(self, "axis", axis / np.linalg.norm(axis))
        object.__setattr__(self, "covariance", covariance)

    @classmethod
    def of_tangent(
        cls, centre_m: npt.ArrayLike, axis: npt.ArrayLike, covariance: npt.ArrayLike, basis: Array
    ) -> RingCandidate:
        """From a (5, 5) covariance of centre and the two tangents (3, 2) of the axis."""
        spread = np.zeros((6, 5))
        spread[:3, :3], spread[3:, 3:] = np.eye(3), basis
        whole = spread @ np.asarray(covariance, dtype=np.float64) @ spread.T
        return cls(np.asarray(centre_m), np.asarray(axis), whole)


def ring_candidates(
    circles: Iterable[tuple[npt.ArrayLike, npt.ArrayLike, npt.ArrayLike | None]],
) -> tuple[RingCandidate, ...]:
    """At most two candidates from the centre (3,), axis (3,) and covariance (5, 5) of circles.

    The covariance is of the centre and of the axis along `tangents`. A circle whose covariance is
    missing or not finite is left out.

    Raises:
        ValueError: a covariance is not (5, 5), or has a negative variance.
    """
    found = []
    for centre, axis, covariance in circles:
        matrix = np.array(covariance, dtype=np.float64)  # None becomes NaN
        if not np.isfinite(matrix).all():
            continue
        matrix = _semidefinite(matrix, 5, "covariance")
        normal = np.array(axis, dtype=np.float64)
        found.append(RingCandidate.of_tangent(centre, normal, matrix, tangents(normal)))
    return tuple(found[:2])


@dataclass(frozen=True, slots=True, eq=False)
class RingMeasurement:
    """A circular ring of known radius: three degrees of freedom of the centre, two of the axis.

    An ellipse is the image of two circles. Both may be given; the filter weighs them by its state.

    Raises:
        ValueError: no candidate, or a number is not finite.
    """

    time_s: float
    sensor: str
    candidates: tuple[RingCandidate, ...]  # one or two
    ring: DockingRing  # where it is on the target, target frame
    centres_m: Array = field(init=False)  # (K, 3) of the candidates
    axes: Array = field(init=False)  # (K, 3)
    covariances: Array = field(init=False)  # (K, 6, 6)

    size = 5
    bias_size = 10  # of the ring's edge, and of another edge taken for it

    def __post_init__(self) -> None:
        object.__setattr__(self, "time_s", _checked_time(self.time_s, self.sensor))
        if not self.candidates:
            raise ValueError(f"{self.sensor}: a ring needs at least one candidate")
        both = self.candidates[:2]
        object.__setattr__(self, "centres_m", np.array([c.centre_m for c in both]))
        object.__setattr__(self, "axes", np.array([c.axis for c in both]))
        object.__setattr__(self, "covariances", np.array([c.covariance for c in both]))

    def in_camera(self, sensor_from_camera: Pose) -> RingMeasurement:
        """The measurement in the camera frame, from that of its sensor."""
        camera_from_sensor = sensor_from_camera.inverse()
        moved = tuple(
            RingCandidate(
                camera_from_sensor.apply(c.centre_m),
                camera_from_sensor.rotation @ c.axis,
                turned(c.covariance, camera_from_sensor.rotation),
            )
            for c in self.candidates
        )
        return RingMeasurement(self.time_s, self.sensor, moved, self.ring)


@dataclass(frozen=True, slots=True, eq=False)
class RangeMeasurement:
    """A distance along a beam to the target.

    Of several planes the filter uses the first that the spot hits with certainty. Where there is
    none, the range cannot be used: end the list with an unbounded plane of large relief.

    Raises:
        ValueError: a number is not finite, the range or σ not positive, no direction, no surface.
    """

    time_s: float
    sensor: str
    range_m: float
    sigma_m: float
    surfaces: tuple[BeamSurface, ...] | BeamMesh  # what the beam may meet
    origin_m: Array = field(default_factory=lambda: np.zeros(3))  # (3,) camera frame
    direction: Array = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))  # (3,) unit

    size = bias_size = 1

    def __post_init__(self) -> None:
        object.__setattr__(self, "time_s", _checked_time(self.time_s, self.sensor))
        if not (0.0 < self.range_m < math.inf and 0.0 < self.sigma_m < math.inf):
            raise ValueError(
                f"{self.sensor}: range and σ must be positive: {self.range_m}, {self.sigma_m}"
            )
        if not self.surfaces:
            raise ValueError(f"{self.sensor}: a range needs a surface that the beam may meet")
        origin = np.array(self.origin_m, dtype=np.float64)
        direction = np.array(self.direction, dtype=np.float64)
        if origin.shape != (3,) or not np.isfinite(origin).all():
            raise ValueError(f"{self.sensor}: origin_m must be three finite numbers, not {origin}")
        if direction.shape != (3,) or not 0.0 < float(np.linalg.norm(direction)) < math.inf:
            raise ValueError(f"{self.sensor}: direction must be a vector (3,), not {direction}")
        object.__setattr__(self, "origin_m", origin)
        object.__setattr__(self, "direction", direction / np.linalg.norm(direction))

    def in_camera(self, sensor_from_camera: Pose) -> RangeMeasurement:
        """The measurement in the camera frame, from that of its sensor."""
        camera_from_sensor = sensor_from_camera.inverse()
        return RangeMeasurement(
            self.time_s, self.sensor, self.range_m, self.sigma_m, self.surfaces,
            camera_from_sensor.apply(self.origin_m), camera_from_sensor.rotation @ self.direction,
        )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class RateMeasurement:
    """The camera's own rotation: a gyroscope's, or between two attitudes of a star tracker.

    It is the mean since the sensor's reading before; of the first, since the filter's last.

    Raises:
        ValueError: a number is not finite, or σ not positive.
    """

    time_s: float
    sensor: str
    rate_rad_s: Array  # (3,) against inertial space, camera frame
    sigma_rad_s: float  # of each axis

    size = bias_size = 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "time_s", _checked_time(self.time_s, self.sensor))
        rate = _checked_vector(self.rate_rad_s, "rate_rad_s", self.sensor)
        object.__setattr__(self, "rate_rad_s", rate)
        _check_sigma(self.sigma_rad_s, "sigma_rad_s", self.sensor)

    def in_camera(self, sensor_from_camera: Pose) -> RateMeasurement:
        """The measurement in the camera frame, from that of its sensor."""
        rate = sensor_from_camera.rotation.T @ self.rate_rad_s
        return RateMeasurement(self.time_s, self.sensor, rate, self.sigma_rad_s)


@dataclass(frozen=True, slots=True, eq=False)
class ThrustMeasurement:
    """A change of the camera's velocity that is known: thrusters that fired.

    Raises:
        ValueError: a number is not finite, or σ not positive.
    """

    time_s: float
    sensor: str
    velocity_change_m_s: Array  # (3,) of the chaser against inertial space, camera frame
    sigma_m_s: float  # of each axis

    size = bias_size = 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "time_s", _checked_time(self.time_s, self.sensor))
        change = _checked_vector(self.velocity_change_m_s, "velocity_change_m_s", self.sensor)
        object.__setattr__(self, "velocity_change_m_s", change)
        _check_sigma(self.sigma_m_s, "sigma_m_s", self.sensor)

    def in_camera(self, sensor_from_camera: Pose) -> ThrustMeasurement:
        """The measurement in the camera frame, from that of its sensor."""
        change = sensor_from_camera.rotation.T @ self.velocity_change_m_s
        return ThrustMeasurement(self.time_s, self.sensor, change, self.sigma_m_s)


Measurement = (
    PoseMeasurement | RingMeasurement | RangeMeasurement | RateMeasurement | ThrustMeasurement
)


def _checked_vector(vector: npt.ArrayLike, name: str, sensor: str) -> Array:
    found = np.array(vector, dtype=np.float64)
    if found.shape != (3,) or not np.isfinite(found).all():
        raise ValueError(f"{sensor}: {name} must be three finite numbers, not {vector!r}")
    return found


def _check_sigma(sigma: float, name: str, sensor: str) -> None:
    if not 0.0 < sigma < math.inf:
        raise ValueError(f"{sensor}: {name} must be positive, not {sigma}")


def _checked_time(time_s: float, sensor: str) -> float:
    if isinstance(time_s, bool) or not isinstance(time_s, Real):
        raise ValueError("time_s is not known; sensors can only be joined by their times")
    if not math.isfinite(time_s):
        raise ValueError(f"{sensor}: the time of a measurement must be finite, not {time_s}")
    return float(time_s)


def _checked_covariance(covariance: npt.ArrayLike, sensor: str) -> Array:
    """A covariance as an array, made exactly symmetric.

    Raises:
        ValueError: another shape, not finite, not symmetric, or not positive definite.
    """
    matrix = _symmetric(covariance, 6, f"{sensor}: the covariance")
    try:
        np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        raise ValueError(f"{sensor}: the covariance is not positive definite") from None
    return matrix


def _semidefinite(covariance: npt.ArrayLike, size: int, what: str) -> Array:
    """A covariance that may leave directions out; ValueError: as below, or a negative variance."""
    matrix = _symmetric(covariance, size, what)
    spread = np.linalg.eigvalsh(matrix)
    if not spread[0] >= -_ROUNDING * spread[-1]:
        raise ValueError(f"{what} has a negative variance")
    return matrix


def _symmetric(covariance: npt.ArrayLike, size: int, what: str) -> Array:
    """A covariance made exactly symmetric.

    Raises:
        ValueError: another shape, not finite, or not symmetric.
    """
    matrix = np.array(covariance, dtype=np.float64)
    if matrix.shape != (size, size) or not np.isfinite(matrix).all():
        raise ValueError(f"{what} must be ({size}, {size}) and finite")
    sigmas = np.sqrt(np.maximum(np.diagonal(matrix), 0.0))
    if (np.abs(matrix - matrix.T) > _ASYMMETRY * np.outer(sigmas, sigmas)).any():
        raise ValueError(f"{what} is not symmetric: a half of it, or another matrix")
    return np.asarray(0.5 * (matrix + matrix.T))


def turned(covariance: Array, rotation: Array) -> Array:
    """A covariance (6, 6) of two vectors in a frame turned by ``rotation``."""
    both = np.zeros((6, 6))
    both[:3, :3] = both[3:, 3:] = rotation
    return np.asarray(both @ covariance @ both.T)


def tangents(axis: Array) -> Array:
    """(3, 2) unit vectors e₁, e₂ across an axis n, as in logs of rings (docs/files-logs.md).

    e₁ is camera x less its part along n, normalised (camera y where n is along x); e₂ = n × e₁.
    """
    along_x = abs(axis[0]) > 1.0 - 1e-6
    first = np.array([0.0, 1.0, 0.0]) if along_x else np.array([1.0, 0.0, 0.0])
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
