"""The two poses of a circle of known radius, and their covariance.

An ellipse is the picture of two circles of a given radius: the cone over it has two families of
circular sections. Head-on the two coincide, and the error of the tilt is the square root of the
error of the ellipse's roundness.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

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
# For slopes: of the range, and rad. Source: by construction, between rounding and curvature
_PLACE_STEP, _TILT_STEP = 1e-5, 1e-3
_ONE = 1e-9  # between two axes that are one. Source: by construction, rounding


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
    """`shapes_of_circles` of one circle (5,); None where there is none."""
    shape = shapes_of_circles(camera, np.atleast_2d(centre_m), np.atleast_2d(axis), radius_m)[0]
    return shape if np.isfinite(shape).all() else None


def shapes_of_circles(
    camera: Camera, centres_m: npt.ArrayLike, axes: npt.ArrayLike, radii_m: npt.ArrayLike
) -> Array:
    """Shape vectors (N, 5) of the pictures of circles (see `ellipse`), px without distortion.

    Centres and axes are (N, 3), radii (N,) or one of all. NaN where a circle reaches the plane of
    the camera, so that its picture is no ellipse.
    """
    places, ways = (np.array(x, dtype=np.float64, order="C") for x in (centres_m, axes))
    shapes = np.full((len(ways), 5), np.nan)
    radii = np.full(len(ways), radii_m, dtype=np.float64)
    _pictures_of_circles(lens_vector(camera), places, ways, radii, shapes)
    return shapes


@njit(cache=True, nogil=True, error_model="numpy")
def _pictures_of_circles(
    camera: Array, centres: Array, axes: Array, radii: Array, shapes: Array
) -> None:
    """Fill in `shapes_of_circles`.

    The dual conic of ``c + R (cos t e₁ + sin t e₂)`` is ``K (R²(I - n nᵀ) - c cᵀ) Kᵀ``.
    """
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    d = np.empty((3, 3))
    for k in range(len(axes)):
        c, n, r2, shape = centres[k], axes[k], radii[k] * radii[k], shapes[k]
        for i in range(3):
            for j in range(3):
                d[i, j] = -r2 * n[i] * n[j] - c[i] * c[j]
            d[i, i] += r2
        if d[2, 2] >= 0.0 or c[2] <= 0.0:
            continue
        scale = -1.0 / d[2, 2]
        # K D Kᵀ, scaled to -1 at its end; the mean of the points is its last column.
        u, v = -d[0, 2] * scale, -d[1, 2] * scale
        s00, s01, s11 = d[0, 0] * scale + u * u, d[0, 1] * scale + u * v, d[1, 1] * scale + v * v
        if root_into(fx * fx * s00, fx * fy * s01, fy * fy * s11, shape):
            shape[0], shape[1] = fx * u + cx, fy * v + cy


def cones_of_shapes(camera: Camera, shapes: Array) -> Array:
    """(N, 3, 3) C of the cones q' C q = 0 of the rays q through ellipses (N, 5); negative within.

    A ray's pixel is the point A⁻¹ (p - c) of the unit circle.
    """
    pixels = np.zeros((len(shapes), 2, 3))
    pixels[:, 0, 0], pixels[:, 1, 1] = camera.fx, camera.fy
    pixels[:, :, 2] = (camera.cx, camera.cy) - shapes[:, :2]
    round_it = np.linalg.solve(shapes[:, [2, 3, 3, 4]].reshape(-1, 2, 2), pixels)
    return np.asarray(round_it.transpose(0, 2, 1) @ round_it - np.diag([0.0, 0.0, 1.0]))


def circles_of_shapes(camera: Camera, shapes: Array) -> tuple[Array, Array]:
    """Centres (N, 2, 3) and axes (N, 2, 3) of both circles of radius 1 m that ellipses (N, 5) are.

    NaN where an ellipse is no circle's picture.
    """
    cones = cones_of_shapes(camera, shapes)
    values, vectors = np.linalg.eigh(cones)
    low, middle, high = values.T[:, :, None, None]
    low, middle = np.where(low < 0.0, low, np.nan), np.where(middle > 0.0, middle, np.nan)
    first = np.sqrt(np.maximum(high - middle, 0.0) / (high - low))
    last = np.sqrt((middle - low) / (high - low))
    along, across = vectors[:, None, :, 0], vectors[:, None, :, 2]
    axes = np.array([[1.0], [-1.0]]) * first * across + last * along
    # The centre is the pole of the plane's vanishing line: cone⁻¹ n.
    centres = (axes @ vectors / values[:, None, :]) @ vectors.transpose(0, 2, 1)
    centres *= np.where(centres[..., 2:] < 0.0, -1.0, 1.0)
    far = np.sum(axes * centres, axis=2, keepdims=True)
    centres *= middle / np.sqrt(-low * high) / np.abs(far)
    return centres, np.where(far > 0.0, -axes, axes)


def circle_poses(
    camera: Camera, ellipse: Ellipse, radius_m: float, radius_share: float = RADIUS_SHARE,
    systematic_px: float = 0.0,
) -> tuple[CirclePose, ...]:  # fmt: skip
    """Both poses of a ring of known radius; one where the ring is exactly head-on.

    Args:
        camera: only its matrix is used: the ellipse is without lens distortion.
        ellipse: with ``shape_covariance`` the poses have theirs.
        radius_m: of the ring's edge that the ellipse is.
        radius_share: error of that radius (one σ), as a share of it; in the covariance.
        systematic_px: σ of an error of the ellipse's numbers that its covariance is without.

    Returns:
        The poses, that with the axis nearer to the camera's own (-z) first.
    """
    if not (math.isfinite(radius_m) and radius_m > 0.0):
        raise ValueError(f"radius_m must be positive, not {radius_m}")
    centres, axes = circles_of_shapes(camera, ellipse.shape[None])
    count = 1 if np.abs(axes[0, 0] - axes[0, 1]).max() < _ONE else 2
    poses: list[CirclePose] = []
    for unit, axis in zip(centres[0, :count], axes[0, :count], strict=True):
        if not np.isfinite(unit).all():
            return ()
        centre = radius_m * unit
        pose = CirclePose(centre, axis, radius_m)
        if ellipse.shape_covariance is not None:
            spread = ellipse.shape_covariance + systematic_px**2 * np.eye(5)
            covariance = pose_covariance(camera, pose, spread)
            covariance[:3, :3] += radius_share**2 * np.outer(centre, centre)
            pose = CirclePose(centre, axis, radius_m, covariance)
        poses.append(pose)
    return tuple(sorted(poses, key=lambda pose: float(pose.axis[2])))


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
    slopes, bends = _differences(camera, pose, axis)
    if not np.isfinite(slopes).all():
        return np.full((5, 5), np.inf)
    information = np.linalg.inv(shape_covariance)
    total = slopes.T @ information @ slopes
    # The centre absorbs part of a bend, and of a tilt: only the remainder determines the tilt.
    absorbed = np.linalg.solve(total[:3, :3], slopes[:, :3].T @ information)
    left = bends - slopes[:, :3] @ absorbed @ bends
    curve = (0.25 * np.sum(left * (information @ left), axis=0)).tolist()
    alone = total[3:, 3:] - total[3:, :3] @ absorbed @ slopes[:, 3:]
    first, second, both = float(alone[0, 0]), float(alone[1, 1]), float(alone[0, 1])
    most = _LARGEST_ANGLE_RAD**-2
    one = other = 0.01  # variances of the tilt about both axes
    for _ in range(_FIXED_POINT_STEPS):
        more = curve[0] * one + most, curve[1] * other + most
        area = (first + more[0]) * (second + more[1]) - both * both
        one = 0.5 * (one + (second + more[1]) / area)
        other = 0.5 * (other + (first + more[0]) / area)
    total[[3, 4], [3, 4]] += more
    covariance = np.asarray(np.linalg.inv(total), dtype=np.float64)
    return 0.5 * (covariance + covariance.T)


def _differences(camera: Camera, pose: CirclePose, axis: Array) -> tuple[Array, Array]:
    """Slopes (5, 5) and bends (5, 2) of the picture's shape by centre (m) and tilt (rad)."""
    steps = np.full(5, _TILT_STEP)
    steps[:3] = _PLACE_STEP * np.linalg.norm(pose.centre_m)
    moves = np.vstack([np.diag(steps), -np.diag(steps), np.zeros(5)])
    axes = axis + moves[:, 3:] @ tangent_basis(axis).T
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    shapes = shapes_of_circles(camera, pose.centre_m + moves[:, :3], axes, pose.radius_m)
    ahead, behind, here = shapes[:5], shapes[5:10], shapes[10]
    bends = (ahead + behind - 2.0 * here)[3:] / _TILT_STEP**2
    return ((ahead - behind) / (2.0 * steps[:, None])).T, bends.T
