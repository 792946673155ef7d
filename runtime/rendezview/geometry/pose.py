"""Rigid transforms between named frames.

A transform is named ``to_from_from``: ``camera_from_target`` maps target
coordinates to camera coordinates, and ``a_from_b @ b_from_c`` is ``a_from_c``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import overload

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy.spatial.transform import Rotation

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """Rigid transform ``p_to = rotation @ p_from + translation_m``.

    Raises:
        ValueError: a part has the wrong shape or is not finite, or ``rotation``
            is not orthonormal with determinant +1 (to 1e-6).
    """

    rotation: Array  # (3, 3) orthonormal, det +1
    translation_m: Array  # (3,)

    def __post_init__(self) -> None:
        rotation = np.array(self.rotation, dtype=np.float64, order="C")
        translation_m = np.array(self.translation_m, dtype=np.float64)
        if rotation.shape != (3, 3) or translation_m.shape != (3,):
            raise ValueError(
                f"a pose needs a (3, 3) rotation and a (3,) translation, "
                f"not {rotation.shape} and {translation_m.shape}"
            )
        if not _all_finite(rotation, translation_m):
            raise ValueError("a pose must be finite")
        if not _is_rotation(rotation, 1e-6):
            raise ValueError(
                f"rotation is not orthonormal with determinant +1: {rotation.tolist()}"
            )
        rotation.setflags(write=False)
        translation_m.setflags(write=False)
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "translation_m", translation_m)

    @classmethod
    def unchecked(cls, rotation: Array, translation_m: Array) -> Pose:
        """A pose of arrays that a compiled loop made, without a check and without a copy.

        For loops of microseconds only: the arrays must be float64, finite and a rotation.
        """
        pose = object.__new__(cls)
        rotation.setflags(write=False)
        translation_m.setflags(write=False)
        object.__setattr__(pose, "rotation", rotation)
        object.__setattr__(pose, "translation_m", translation_m)
        return pose

    @classmethod
    def identity(cls) -> Pose:
        """The transform that changes nothing."""
        return cls(np.eye(3), np.zeros(3))

    @classmethod
    def from_quat_wxyz(cls, quat_wxyz: npt.ArrayLike, translation_m: npt.ArrayLike) -> Pose:
        """Pose from a scalar-first quaternion (any norm but zero) and a translation in metres."""
        quat = np.asarray(quat_wxyz, dtype=np.float64)
        if quat.shape != (4,) or not np.isfinite(quat).all() or not np.any(quat):
            raise ValueError(f"quat_wxyz must be four finite numbers, not all zero: {quat_wxyz!r}")
        rotation = Rotation.from_quat(quat[[1, 2, 3, 0]]).as_matrix()
        return cls(rotation, np.asarray(translation_m, dtype=np.float64))

    @classmethod
    def from_matrix(cls, matrix: npt.ArrayLike) -> Pose:
        """Pose of a (4, 4) or (3, 4) matrix [R t], which is exact or rounded to a few digits.

        Raises:
            ValueError: another shape or last row, or R is no rotation; a scaled or transposed
                matrix is named.
        """
        given = np.asarray(matrix, dtype=np.float64)
        if given.shape not in ((4, 4), (3, 4)):
            raise ValueError(f"a pose's matrix must be (4, 4) or (3, 4), not {given.shape}")
        if len(given) == 4 and given[3].tolist() != [0.0, 0.0, 0.0, 1.0]:
            turned = "; it is transposed" if given[:, 3].tolist() == [0.0, 0.0, 0.0, 1.0] else ""
            raise ValueError(f"the last row must be 0 0 0 1, not {given[3].tolist()}{turned}")
        return cls(nearest_rotation(given[:3, :3]), given[:3, 3])

    def as_matrix(self) -> Array:
        """(4, 4) matrix [R t; 0 1]."""
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = self.rotation, self.translation_m
        return matrix

    @property
    def quat_wxyz(self) -> Array:
        """(4,) unit quaternion of the rotation, scalar first, w ≥ 0.

        Shepperd, J. Guidance and Control 1(3), 1978: from the largest of the four components.
        """
        rotation = self.rotation
        if not _is_rotation(rotation, 1e-12):
            rotation = nearest_rotation(rotation)
        quat = np.empty(4)
        _quaternion(rotation, quat)
        return quat

    def as_dict(self) -> dict[str, list[float]]:
        """As JSON has it: ``quat_wxyz`` and ``translation_m``."""
        return {"quat_wxyz": self.quat_wxyz.tolist(), "translation_m": self.translation_m.tolist()}

    @overload
    def __matmul__(self, other: Pose) -> Pose: ...
    @overload
    def __matmul__(self, other: npt.ArrayLike) -> Array: ...
    def __matmul__(self, other: Pose | npt.ArrayLike) -> Pose | Array:
        """Chain: ``a_from_b @ b_from_c`` is ``a_from_c``; with points (..., 3), `apply`."""
        if not isinstance(other, Pose):
            return self.apply(other)
        return Pose(
            self.rotation @ other.rotation, self.rotation @ other.translation_m + self.translation_m
        )

    def inverse(self) -> Pose:
        """``b_from_a`` of ``a_from_b``."""
        return Pose(self.rotation.T, -self.rotation.T @ self.translation_m)

    def apply(self, points_m: npt.ArrayLike) -> Array:
        """Points (..., 3) in the *from* frame → the same points in the *to* frame."""
        points = np.asarray(points_m)
        if points.ndim == 0 or points.shape[-1] != 3:
            raise ValueError(f"points_m must be (..., 3), not {points.shape}")
        return points @ self.rotation.T + self.translation_m

    def __eq__(self, other: object) -> bool:
        """Whether all numbers are equal; use `angle_to` and distances for nearness."""
        if not isinstance(other, Pose):
            return NotImplemented
        return np.array_equal(self.rotation, other.rotation) and np.array_equal(
            self.translation_m, other.translation_m
        )

    def __hash__(self) -> int:
        return hash((*self.rotation.ravel().tolist(), *self.translation_m.tolist()))

    def angle_to(self, other: Pose) -> float:
        """Angle of the rotation between the two, radians in [0, π]."""
        return rotation_angle(self.rotation @ other.rotation.T)

    def perturbed(self, delta: npt.ArrayLike) -> Pose:
        """This pose with a left perturbation (rotation vector rad, translation m), (6,).

        ``p' = exp(delta[:3]) (R p + t) + delta[3:]`` is not meant: rotation and
        translation are perturbed apart, ``R' = exp(w) R``, ``t' = t + v``, which
        is the convention of every covariance in this package.
        """
        step = np.asarray(delta, dtype=np.float64)
        if step.shape != (6,):
            raise ValueError(f"delta must be (6,), not {step.shape}")
        return Pose(
            Rotation.from_rotvec(step[:3]).as_matrix() @ self.rotation,
            self.translation_m + step[3:],
        )

    def delta_from(self, other: Pose) -> Array:
        """(6,) the left perturbation of another pose that gives this one, see ``perturbed``."""
        turn = Rotation.from_matrix(self.rotation @ other.rotation.T).as_rotvec()
        return np.concatenate([turn, self.translation_m - other.translation_m])


@njit(cache=True, nogil=True, error_model="numpy")
def _all_finite(rotation: Array, translation_m: Array) -> bool:
    for i in range(3):
        if not math.isfinite(translation_m[i]):
            return False
        for j in range(3):
            if not math.isfinite(rotation[i, j]):
                return False
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _is_rotation(r: Array, tolerance: float) -> bool:
    """Whether (3, 3) is orthonormal to a tolerance and right-handed."""
    for i in range(3):
        for j in range(i + 1):
            dot = r[i, 0] * r[j, 0] + r[i, 1] * r[j, 1] + r[i, 2] * r[j, 2]
            if not abs(dot - (1.0 if i == j else 0.0)) <= tolerance:
                return False
    x = r[1, 1] * r[2, 2] - r[1, 2] * r[2, 1]
    y = r[1, 2] * r[2, 0] - r[1, 0] * r[2, 2]
    z = r[1, 0] * r[2, 1] - r[1, 1] * r[2, 0]
    return bool(r[0, 0] * x + r[0, 1] * y + r[0, 2] * z >= 0.0)


@njit(cache=True, nogil=True, error_model="numpy")
def _quaternion(r: Array, quat: Array) -> None:
    trace = r[0, 0] + r[1, 1] + r[2, 2]
    a = 0  # the largest of the diagonal
    for k in range(1, 3):
        if r[k, k] > r[a, a]:
            a = k
    b, c = (a + 1) % 3, (a + 2) % 3
    if trace > r[a, a]:
        quat[0] = 1.0 + trace
        quat[1], quat[2], quat[3] = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    else:
        quat[0] = r[c, b] - r[b, c]
        quat[1 + a] = 1.0 + 2.0 * r[a, a] - trace
        quat[1 + b], quat[1 + c] = r[b, a] + r[a, b], r[c, a] + r[a, c]
    size = math.sqrt(quat[0] ** 2 + quat[1] ** 2 + quat[2] ** 2 + quat[3] ** 2)
    quat /= -size if quat[0] < 0.0 else size


def rotation_angle(rotation: npt.ArrayLike) -> float:
    """Angle of a (3, 3) rotation matrix, radians in [0, π]; exact near 0 and near π."""
    (a, b, c), (d, e, f), (g, h, i) = np.asarray(rotation, dtype=np.float64).tolist()
    # 2 sin and 2 cos of the angle.
    return math.atan2(math.hypot(h - f, c - g, d - b), a + e + i - 1.0)


def minimal_rotation(from_direction: npt.ArrayLike, to_direction: npt.ArrayLike) -> Array:
    """The (3, 3) rotation of least angle that turns one direction (3,) into another.

    Opposite directions have no single answer: any axis across them is taken.

    Raises:
        ValueError: a direction is zero or not finite.
    """
    a = np.array(from_direction, dtype=np.float64)
    b = np.array(to_direction, dtype=np.float64)
    for direction in (a, b):
        if direction.shape != (3,):
            raise ValueError(f"a direction must be (3,), not {direction.shape}")
    one, other = _unit(a.tolist()), _unit(b.tolist())
    if one is None or other is None:
        raise ValueError(f"directions must be finite and not zero: {a}, {b}")
    return _turn_between(one, other)


_Direction = tuple[float, float, float]


def _unit(v: list[float]) -> _Direction | None:
    """A vector (3,) divided by its length, without overflow; None if it has none."""
    largest = max(map(abs, v))
    if not (largest > 0.0 and all(map(math.isfinite, v))):
        return None
    x, y, z = v[0] / largest, v[1] / largest, v[2] / largest
    length = math.sqrt(x * x + y * y + z * z)
    return x / length, y / length, z / length


def _turn_between(a: _Direction, b: _Direction) -> Array:
    """(3, 3) the rotation of least angle between two unit vectors."""
    p, q, r = a
    x, y, z = q * b[2] - r * b[1], r * b[0] - p * b[2], p * b[1] - q * b[0]
    cosine = p * b[0] + q * b[1] + r * b[2]
    sine = math.sqrt(x * x + y * y + z * z)
    if sine < 1e-14:
        if cosine > 0.0:
            return np.eye(3)
        least = min(abs(p), abs(q), abs(r))  # any axis across: towards the least component of a
        x = 1.0 if abs(p) == least else 0.0
        y = 1.0 if x == 0.0 and abs(q) == least else 0.0
        z = 1.0 - x - y
    else:
        x, y, z = x / sine, y / sine, z / sine
    # Near ±1 rounding tilts the cross product; across `a` the turn still ends exactly at `b`.
    along = x * p + y * q + z * r
    x, y, z = x - p * along, y - q * along, z - r * along
    length = math.sqrt(x * x + y * y + z * z)
    x, y, z = x / length, y / length, z / length
    size = math.sqrt(sine * sine + cosine * cosine)
    sine, cosine = sine / size, cosine / size
    # 1 - cos without cancellation for small angles
    rest = sine * sine / (1.0 + cosine) if cosine > 0.0 else 1.0 - cosine
    return np.array(
        [
            [1.0 - rest * (y * y + z * z), rest * x * y - sine * z, rest * x * z + sine * y],
            [rest * x * y + sine * z, 1.0 - rest * (x * x + z * z), rest * y * z - sine * x],
            [rest * x * z - sine * y, rest * y * z + sine * x, 1.0 - rest * (x * x + y * y)],
        ]
    )


def nearest_rotation(matrix: npt.ArrayLike) -> Array:
    """The rotation (3, 3) nearest to a matrix rounded in a file, in the Frobenius norm.

    A matrix orthonormal to 1e-12 is returned as it is, so that what we wrote is read unchanged.

    Raises:
        ValueError: not (3, 3), not finite, or further than 1e-3 (largest element of
            ``R Rᵀ - I``) from a rotation: no rounding, but another thing.
    """
    given = np.asarray(matrix, dtype=np.float64)
    if given.shape != (3, 3) or not np.isfinite(given).all():
        raise ValueError(f"a rotation must be (3, 3) and finite, not {given.tolist()}")
    large = np.abs(given).max() > 2.0  # no rotation, and products may overflow
    error = np.inf if large else np.abs(given @ given.T - np.eye(3)).max()
    if error > 1e-3 or np.linalg.det(given) < 0.0:
        raise ValueError(f"not a rotation (orthonormal, determinant +1): {given.tolist()}")
    if error <= 1e-12:
        return given
    u, _, vt = np.linalg.svd(given)
    return np.asarray(u @ vt)
