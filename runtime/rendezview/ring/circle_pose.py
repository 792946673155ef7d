"""The two poses of a circle of known radius, and their covariance.

An ellipse is the picture of two circles of a given radius: the cone over it has two families of
circular sections. Seen head-on the two are one, and the tilt is known to the square root only of
how round the ellipse is known to be.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rendezview.camera import Camera
from rendezview.ring.ellipse import Ellipse

Array = npt.NDArray[np.float64]

_FIXED_POINT_STEPS = 12
_LARGEST_ANGLE_RAD = 1.0  # of an axis' standard deviation: beyond it nothing is known


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
    c, n = np.asarray(centre_m, dtype=np.float64), np.asarray(axis, dtype=np.float64)
    k = camera.matrix
    dual = k @ (radius_m**2 * (np.eye(3) - np.outer(n, n)) - np.outer(c, c)) @ k.T
    if dual[2, 2] >= 0.0 or c[2] <= 0.0:
        return None
    dual /= -dual[2, 2]
    x, y = -dual[0, 2], -dual[1, 2]
    square = dual[:2, :2] + np.outer([x, y], [x, y])
    determinant = square[0, 0] * square[1, 1] - square[0, 1] ** 2
    if determinant <= 0.0:
        return None
    # Square root of a symmetric 2 × 2 matrix.
    root = math.sqrt(determinant)
    size = math.sqrt(square[0, 0] + square[1, 1] + 2.0 * root)
    return np.array(
        [x, y, (square[0, 0] + root) / size, square[0, 1] / size, (square[1, 1] + root) / size]
    )


def circle_poses(camera: Camera, ellipse: Ellipse, radius_m: float) -> tuple[CirclePose, ...]:
    """Both poses of a ring of known radius; one where the ellipse is seen exactly head-on.

    Args:
        camera: only its matrix is used: the ellipse is without lens distortion.
        ellipse: with ``shape_covariance`` the poses have theirs.
        radius_m: of the ring's edge that the ellipse is.

    Returns:
        The poses, that with the axis nearer to the camera's own (-z) first.
    """
    if not (math.isfinite(radius_m) and radius_m > 0.0):
        raise ValueError(f"radius_m must be positive, not {radius_m}")
    x, y, a, b, c = ellipse.shape
    matrix = np.array([[a, b], [b, c]])
    square = matrix @ matrix - np.outer([x, y], [x, y])
    dual = np.array([[square[0, 0], square[0, 1], -x], [square[1, 0], square[1, 1], -y],
                     [-x, -y, -1.0]])  # fmt: skip
    to_rays = np.linalg.inv(camera.matrix)
    cone = np.linalg.inv(to_rays @ dual @ to_rays.T)
    values, vectors = np.linalg.eigh(cone / np.linalg.norm(cone))
    if values[1] < 0.0:  # one negative, two positive
        values, vectors = -values[::-1], vectors[:, ::-1]
    low, middle, high = values  # low < 0 < middle ≤ high
    if not (low < 0.0 < middle):
        return ()
    first = math.sqrt(max(high - middle, 0.0) / (high - low))
    last = math.sqrt((middle - low) / (high - low))
    distance = middle * radius_m / math.sqrt(-low * high)
    poses: list[CirclePose] = []
    for sign in (1.0, -1.0):
        normal = sign * first * vectors[:, 2] + last * vectors[:, 0]
        centre = np.linalg.solve(cone, normal)
        if centre[2] < 0.0:
            centre = -centre
        centre *= distance / abs(float(normal @ centre))
        if float(normal @ centre) > 0.0:
            normal = -normal
        pose = CirclePose(centre, normal, radius_m)
        if ellipse.shape_covariance is not None:
            covariance = pose_covariance(camera, pose, ellipse.shape_covariance)
            pose = CirclePose(centre, normal, radius_m, covariance)
        poses.append(pose)
    if first < 1e-9:
        return (poses[0],)
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


def _covariance_at(
    camera: Camera, pose: CirclePose, axis: Array, shape_covariance: Array
) -> Array:
    basis = tangent_basis(axis)
    base = shape_of_circle(camera, pose.centre_m, axis, pose.radius_m)
    if base is None:
        return np.full((5, 5), np.inf)
    information = np.linalg.inv(shape_covariance)
    jacobian, bends = np.empty((5, 5)), np.zeros((5, 2))
    reach_m = 1e-5 * float(np.linalg.norm(pose.centre_m))

    def shape(step: Array) -> Array:
        turned = axis + basis @ step[3:]
        found = shape_of_circle(
            camera, pose.centre_m + step[:3], turned / np.linalg.norm(turned), pose.radius_m
        )
        return base if found is None else found

    for k in range(5):
        size = reach_m if k < 3 else 1e-3
        step = np.zeros(5)
        step[k] = size
        ahead, behind = shape(step), shape(-step)
        jacobian[:, k] = (ahead - behind) / (2.0 * size)
        if k >= 3:
            bends[:, k - 3] = (ahead - 2.0 * base + behind) / size**2
    plain = jacobian.T @ information @ jacobian
    # The centre takes up what of a bend it can: only what is left tells the tilt.
    centre = jacobian[:, :3]
    taken = np.linalg.solve(centre.T @ information @ centre, centre.T @ information)
    left = bends - centre @ (taken @ bends)
    curve = np.diag(left.T @ information @ left)
    spread = np.full(2, 0.1)
    covariance = np.eye(5)
    for _ in range(_FIXED_POINT_STEPS):
        total = plain.copy()
        total[[3, 4], [3, 4]] += 0.25 * curve * spread**2 + _LARGEST_ANGLE_RAD**-2
        covariance = np.linalg.inv(total)
        spread = np.sqrt(0.5 * (spread**2 + np.diag(covariance)[3:]))
    return 0.5 * (covariance + covariance.T)
