"""The two poses of a circle of known radius, and their covariance.

An ellipse is the picture of two circles of a given radius: the cone over it has two families of
circular sections. Head-on the two coincide, and the error of the tilt is the square root of the
error of the ellipse's roundness.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.estimation.linear_algebra import copy_into
from rendezview.geometry.camera import Camera
from rendezview.geometry.lens import lens_vector
from rendezview.sensors.ring.conic import root_into
from rendezview.sensors.ring.ellipse import Ellipse

Array = npt.NDArray[np.float64]

# σ of a known radius: facets of a CAD ring, warmth, tolerances. Source: by construction, 72 facets,
# (π / 72)² / 6
RADIUS_SHARE = 3e-4
_FIXED_POINT_STEPS = 12  # Source: by construction, a bound only
# Of an axis' standard deviation: beyond it nothing is known. Source: by construction, a bound only
_LARGEST_ANGLE_RAD = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class CirclePose:
    """Where a ring is: its centre and axis in the camera frame.

    The covariance is 5 × 5: the centre (m, camera axes), then the axis (rad) along
    `tangent_basis`: the axis is ``n + d₁ e₁ + d₂ e₂``.
    """

    centre_m: Array  # (3,)
    axis: Array  # (3,) unit, normal of the ring's plane on the camera's side
    radius_m: float
    covariance: Array | None = None  # (5, 5)

    @property
    def tilt_rad(self) -> float:
        """Angle between the axis and the line of sight; 0 is head-on."""
        cosine = -float(self.axis @ self.centre_m) / float(np.linalg.norm(self.centre_m))
        return math.acos(min(max(cosine, -1.0), 1.0))

    @property
    def axis_sigma_rad(self) -> float:
        """Largest σ of the axis; 0 without a covariance."""
        if self.covariance is None:
            return 0.0
        return math.sqrt(max(float(np.linalg.eigvalsh(self.covariance[3:, 3:])[-1]), 0.0))


def tangent_basis(axis: npt.ArrayLike) -> Array:
    """(3, 2) unit vectors e₁, e₂ across an axis n (3,): e₁ is camera x less its part along n,
    normalised (camera y where n is along x to 1e-3), e₂ = n × e₁."""
    n = np.asarray(axis, dtype=np.float64)
    reference = np.array([1.0, 0.0, 0.0])
    if abs(n[0]) > 1.0 - 1e-6:
        reference = np.array([0.0, 1.0, 0.0])
    first = reference - n * (n @ reference)
    first /= np.linalg.norm(first)
    return np.column_stack([first, np.cross(n, first)])


def shape_of_circle(
    camera: Camera, centre_m: npt.ArrayLike, axis: npt.ArrayLike, radius_m: float
) -> Array | None:
    """Shape vector (5,) of a circle's picture (see `ellipse`), px without distortion.

    The dual conic of ``c + R (cos t e₁ + sin t e₂)`` is ``K (R²(I - n nᵀ) - c cᵀ) Kᵀ``. None where
    the circle reaches the plane of the camera, so that its picture is no ellipse.
    """
    shape = np.empty(5)
    if not picture_of_circle(
        lens_vector(camera), np.asarray(centre_m, dtype=np.float64),
        np.asarray(axis, dtype=np.float64), radius_m, shape,
    ):  # fmt: skip
        return None
    return shape


def shapes_of_circles(camera: Camera, centres_m: Array, axes: Array, radius_m: float) -> Array:
    """`shape_of_circle` of N circles, centres and axes (N, 3): (N, 5), NaN where there is none."""
    shapes = np.full((len(axes), 5), np.nan)
    _pictures_of_circles(lens_vector(camera), centres_m, axes, radius_m, shapes)
    return shapes


@njit(cache=True, nogil=True, error_model="numpy")
def _pictures_of_circles(
    camera: Array, centres: Array, axes: Array, radius: float, shapes: Array
) -> None:
    for k in range(len(axes)):
        if not picture_of_circle(camera, centres[k], axes[k], radius, shapes[k]):
            shapes[k] = np.nan


@njit(cache=True, nogil=True, error_model="numpy")
def picture_of_circle(camera: Array, c: Array, n: Array, radius: float, shape: Array) -> bool:
    """`shape_of_circle` for compiled loops; False where there is no ellipse."""
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    r2 = radius * radius
    d = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            d[i, j] = -r2 * n[i] * n[j] - c[i] * c[j]
        d[i, i] += r2
    if d[2, 2] >= 0.0 or c[2] <= 0.0:
        return False
    scale = -1.0 / d[2, 2]
    # K D Kᵀ, scaled to -1 at its end; the mean of the points is its last column.
    u, v = -d[0, 2] * scale, -d[1, 2] * scale
    s00, s01, s11 = d[0, 0] * scale + u * u, d[0, 1] * scale + u * v, d[1, 1] * scale + v * v
    s00, s01, s11 = fx * fx * s00, fx * fy * s01, fy * fy * s11
    shape[0], shape[1] = fx * u + cx, fy * v + cy
    return root_into(s00, s01, s11, shape)


@njit(cache=True, nogil=True, error_model="numpy")
def circles_of_picture(
    camera: Array, shape: Array, radius: float, centres: Array, axes: Array
) -> int:
    """Centres (2, 3) and axes (2, 3) of both circles; 2, 1 where they are one, 0 for no ellipse."""
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    # The cone over the ellipse in ray coordinates: |A⁻¹ (p - c)|² = 1.
    a, b, c = shape[2], shape[3], shape[4]
    determinant = a * c - b * b
    i00, i01, i11 = c / determinant, -b / determinant, a / determinant
    m00, m01, m11 = i00 * i00 + i01 * i01, i01 * (i00 + i11), i01 * i01 + i11 * i11
    m00, m01, m11 = m00 * fx * fx, m01 * fx * fy, m11 * fy * fy
    x, y = (shape[0] - cx) / fx, (shape[1] - cy) / fy
    cone = np.empty((3, 3))
    cone[0, 0], cone[0, 1], cone[1, 1] = m00, m01, m11
    cone[0, 2], cone[1, 2] = -(m00 * x + m01 * y), -(m01 * x + m11 * y)
    cone[2, 2] = m00 * x * x + 2.0 * m01 * x * y + m11 * y * y - 1.0
    cone[1, 0], cone[2, 0], cone[2, 1] = cone[0, 1], cone[0, 2], cone[1, 2]
    for i in range(3):
        for j in range(3):
            cone[i, j] /= m00 + m11
            if not math.isfinite(cone[i, j]):
                return 0
    values, vectors = np.linalg.eigh(cone)
    low, middle, high = values[0], values[1], values[2]
    if not (low < 0.0 < middle):
        return 0
    first = np.sqrt(max(high - middle, 0.0) / (high - low))
    last = np.sqrt((middle - low) / (high - low))
    distance = middle * radius / np.sqrt(-low * high)
    for k in range(2):
        sign, centre, normal = 1.0 - 2.0 * k, centres[k], axes[k]
        for i in range(3):
            normal[i] = sign * first * vectors[i, 2] + last * vectors[i, 0]
            centre[i] = 0.0
        # The centre is the pole of the plane's vanishing line: cone⁻¹ n.
        for e in range(3):
            dot = normal[0] * vectors[0, e] + normal[1] * vectors[1, e] + normal[2] * vectors[2, e]
            for i in range(3):
                centre[i] += vectors[i, e] * dot / values[e]
        ahead = -1.0 if centre[2] < 0.0 else 1.0
        along = normal[0] * centre[0] + normal[1] * centre[1] + normal[2] * centre[2]
        for i in range(3):
            centre[i] *= ahead * distance / abs(along)
            normal[i] *= -1.0 if ahead * along > 0.0 else 1.0
    return 1 if first < 1e-9 else 2


def circle_poses(
    camera: Camera, ellipse: Ellipse, radius_m: float, radius_share: float = RADIUS_SHARE
) -> tuple[CirclePose, ...]:
    """Both poses of a ring of known radius; one where the ring is exactly head-on.

    Args:
        camera: only its matrix is used: the ellipse is without lens distortion.
        ellipse: with ``shape_covariance`` the poses have theirs.
        radius_m: of the ring's edge that the ellipse is.
        radius_share: error of that radius (one σ), as a share of it; in the covariance.

    Returns:
        The poses, that with the axis nearer to the camera's own (-z) first.
    """
    if not (math.isfinite(radius_m) and radius_m > 0.0):
        raise ValueError(f"radius_m must be positive, not {radius_m}")
    centres, axes = np.empty((2, 3)), np.empty((2, 3))
    count = circles_of_picture(lens_vector(camera), ellipse.shape, radius_m, centres, axes)
    poses: list[CirclePose] = []
    for centre, axis in zip(centres[:count], axes[:count], strict=True):
        pose = CirclePose(centre, axis, radius_m)
        if ellipse.shape_covariance is not None:
            covariance = pose_covariance(camera, pose, ellipse.shape_covariance)
            covariance[:3, :3] += radius_share**2 * np.outer(centre, centre)
            pose = CirclePose(centre, axis, radius_m, covariance)
        poses.append(pose)
    return tuple(sorted(poses, key=lambda pose: float(pose.axis[2])))


def widened(camera: Camera, pose: CirclePose, sigma_px: float) -> CirclePose:
    """A pose whose covariance has a systematic error of its ellipse's numbers, px, as well."""
    if pose.covariance is None or sigma_px == 0.0:
        return pose
    more = pose_covariance(camera, pose, sigma_px**2 * np.eye(5))
    return replace(pose, covariance=pose.covariance + more)


def pose_covariance(camera: Camera, pose: CirclePose, shape_covariance: Array) -> Array:
    """(5, 5) of centre (m) and axis (rad along `tangent_basis`) from that of the shape vector.

    Near head-on the shape changes with the square of the tilt only. So the bend of the picture over
    one standard deviation of the axis is added to its slope, that standard deviation being the one
    that comes out of it (a fixed point); and the slope is taken at the least tilt that the ellipse
    still allows (one σ), because a ring seen head-on is as a rule measured a little tilted.
    """
    first = _covariance_at(camera, pose, pose.axis, shape_covariance)
    if not np.isfinite(first).all():
        return first
    sight = -pose.centre_m / np.linalg.norm(pose.centre_m)
    tilt = pose.tilt_rad
    spread = math.sqrt(float(np.linalg.eigvalsh(first[3:, 3:])[-1]))
    least = math.sqrt(max(tilt * tilt - 2.0 * tilt * spread, 0.0))
    if tilt < 1e-12 or least > 0.98 * tilt:
        return first
    across = pose.axis - sight * float(sight @ pose.axis)
    across /= np.linalg.norm(across)
    return _covariance_at(
        camera, pose, math.cos(least) * sight + math.sin(least) * across, shape_covariance
    )


def _covariance_at(camera: Camera, pose: CirclePose, axis: Array, shape_covariance: Array) -> Array:
    """Covariance of the pose from that of the shape, slopes and bends taken at ``axis``."""
    jacobian, bends = np.empty((5, 5)), np.zeros((5, 2))
    if not _differences(
        lens_vector(camera), pose.centre_m, axis, tangent_basis(axis), pose.radius_m, jacobian,
        bends,
    ):  # fmt: skip
        return np.full((5, 5), np.inf)
    information = np.linalg.inv(shape_covariance)
    plain = jacobian.T @ information @ jacobian
    # The centre absorbs part of a bend: only the remainder determines the tilt.
    place = jacobian[:, :3]
    left = bends - place @ np.linalg.solve(
        place.T @ information @ place, place.T @ information @ bends
    )
    curve = np.sum(left * (information @ left), axis=0)
    spread = np.full(2, 0.1)
    covariance = plain
    for _ in range(_FIXED_POINT_STEPS):
        total = plain.copy()
        for k in range(2):
            total[3 + k, 3 + k] += 0.25 * curve[k] * spread[k] ** 2 + 1.0 / _LARGEST_ANGLE_RAD**2
        covariance = np.asarray(np.linalg.inv(total), dtype=np.float64)
        spread = np.sqrt(0.5 * (spread**2 + np.diag(covariance)[3:]))
    return 0.5 * (covariance + covariance.T)


@njit(cache=True, nogil=True, error_model="numpy")
def _differences(
    camera: Array, centre: Array, axis: Array, basis: Array, radius: float, jacobian: Array,
    bends: Array,
) -> bool:  # fmt: skip
    """Fill slopes (5, 5) and bends (5, 2) of the picture's shape by centre and tilt.

    The linear algebra is numpy's own: small matrix products compile for seconds.
    """
    base, ahead, behind = np.empty(5), np.empty(5), np.empty(5)
    if not picture_of_circle(camera, centre, axis, radius, base):
        return False
    reach_m = 1e-5 * np.sqrt(centre[0] ** 2 + centre[1] ** 2 + centre[2] ** 2)
    c, n = np.empty(3), np.empty(3)
    for k in range(5):
        size = reach_m if k < 3 else 1e-3
        for side in range(2):
            move = size if side == 0 else -size
            copy_into(centre, c)
            copy_into(axis, n)
            if k < 3:
                c[k] += move
            else:
                for i in range(3):
                    n[i] += move * basis[i, k - 3]
                length = np.sqrt(n[0] ** 2 + n[1] ** 2 + n[2] ** 2)
                for i in range(3):
                    n[i] /= length
            if not picture_of_circle(camera, c, n, radius, ahead if side == 0 else behind):
                return False
        for i in range(5):
            jacobian[i, k] = (ahead[i] - behind[i]) / (2.0 * size)
            if k >= 3:
                bends[i, k - 3] = (ahead[i] - 2.0 * base[i] + behind[i]) / (size * size)
    return True
