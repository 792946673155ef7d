"""Several edges of one ring: one pose for all, and often the sign of its tilt.

The edges of an end frame are circles about one axis, in or near one plane. Their radii besides the
known one are free. Each ellipse with its covariance is a measurement of five numbers; the pose is
the least-squares one. It is better than a single edge's on short arcs, and the wrong one of the two
poses misfits, because circles of one plane have centres that only the true tilt explains.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.estimation.least_squares import damped_step
from rendezview.estimation.linear_algebra import copy_into, invert
from rendezview.geometry.camera import Camera
from rendezview.geometry.lens import lens_vector
from rendezview.sensors.ring.circle_pose import (
    RADIUS_SHARE,
    CirclePose,
    circle_poses,
    picture_of_circle,
    pose_covariance,
    tangent_basis,
)
from rendezview.sensors.ring.ellipse import Ellipse

Array = npt.NDArray[np.float64]

# σ of an edge's height over the ring's plane, as a share of the radius. Source: by hand; see
# ring-accuracy
PLANE_SHARE = 0.004
_STEPS = 15  # Gauss–Newton iterations at most. Source: by construction, a bound only
_LEAST_GAIN = 1e-4  # χ², a hundredth of a standard deviation: the end. Source: by construction
# Of a parameter, for numerical slopes.
_SLOPE_STEP = 1e-5  # Source: by construction, between rounding and curvature
_MOST = 5  # edges. Source: by construction, a bound of time
# χ² over its degrees of freedom, of edges that are not of one plane. Source: by hand; see
# ring-accuracy
_MISFIT = 4.0


def fit_joint(
    camera: Camera, ellipses: list[Ellipse], start: CirclePose
) -> tuple[CirclePose, float] | None:
    """The pose that explains all edges, and the misfit χ²; None where it does not converge.

    Args:
        camera: only its matrix is used.
        ellipses: with their ``shape_covariance``; the first is the edge of ``start.radius_m``.
        start: a pose of the first.
    """
    used = ellipses[:_MOST]
    shapes = np.array([ellipse.shape for ellipse in used])
    covariances = np.array([ellipse.shape_covariance for ellipse in used], dtype=np.float64)
    information = np.asarray(np.linalg.inv(covariances), dtype=np.float64)
    size = np.sqrt(shapes[:, 2] * shapes[:, 4] - shapes[:, 3] ** 2)
    centre, axis = start.centre_m.copy(), start.axis.copy()
    covariance = np.empty((5, 5))
    ratios = np.asarray(size / size[0], dtype=np.float64)
    chi2 = _fit(
        lens_vector(camera), shapes, information, start.radius_m, PLANE_SHARE, centre, axis,
        tangent_basis(axis), ratios, covariance,
    )  # fmt: skip
    if not chi2 >= 0.0:
        return None
    if float(axis @ centre) > 0.0:
        axis = -axis
    # Near head-on the bend of the first edge's picture bounds the axis; a slope does not.
    bound = pose_covariance(camera, CirclePose(centre, axis, start.radius_m), covariances[0])
    turn = tangent_basis(start.axis).T @ tangent_basis(axis)
    whole = np.eye(5)
    whole[3:, 3:] = turn.T
    covariance = whole @ covariance @ whole.T
    for k in (3, 4):
        overshoot = covariance[k, k] / bound[k, k]
        if overshoot > 1.0:
            covariance[k, :] /= np.sqrt(overshoot)
            covariance[:, k] /= np.sqrt(overshoot)
    covariance[:3, :3] += RADIUS_SHARE**2 * np.outer(centre, centre)
    pose = CirclePose(centre, axis, start.radius_m, 0.5 * (covariance + covariance.T))
    return pose, float(chi2)


@njit(cache=True, nogil=True, error_model="numpy")
def _predict(
    camera: Array, centre: Array, axis: Array, basis: Array, radius: float, parameters: Array,
    count: int, out: Array,
) -> bool:  # fmt: skip
    """Shapes (count, 5) of all edges; parameters are steps of the pose, then ratio and height."""
    c, n, at = np.empty(3), np.empty(3), np.empty(3)
    for i in range(3):
        c[i] = centre[i] + parameters[i] * radius
    _turned(axis, basis, parameters, n)
    for k in range(count):
        ratio, height = 1.0, 0.0
        if k > 0:
            ratio, height = parameters[3 + 2 * k], parameters[4 + 2 * k]
        for i in range(3):
            at[i] = c[i] + n[i] * (height * radius)
        if not picture_of_circle(camera, at, n, radius * ratio, out[k]):
            return False
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _turned(axis: Array, basis: Array, parameters: Array, out: Array) -> None:
    """Fill ``out`` (3,), the axis after the steps that parameters 3 and 4 are."""
    square = 0.0
    for i in range(3):
        out[i] = axis[i] + basis[i, 0] * parameters[3] + basis[i, 1] * parameters[4]
        square += out[i] * out[i]
    for i in range(3):
        out[i] /= np.sqrt(square)


@njit(cache=True, nogil=True, error_model="numpy")
def _fit(
    camera: Array, shapes: Array, information: Array, radius: float, plane_share: float,
    centre: Array, axis: Array, basis: Array, ratios: Array, covariance: Array,
) -> float:  # fmt: skip
    """Gauss–Newton from ``centre``, ``axis`` (3,), in place; χ², negative where it fails."""
    count = shapes.shape[0]
    size = 5 + 2 * (count - 1)
    p = np.zeros(size)
    for k in range(1, count):
        p[3 + 2 * k] = ratios[k]
    here, step, right = np.empty((count, 5)), np.empty(size), np.empty(size)
    normal, lower = np.empty((size, size)), np.empty((size, size))
    chi2, damping, previous = 1e300, 1e-6, p.copy()
    for _ in range(_STEPS):
        now = np.inf
        if _predict(camera, centre, axis, basis, radius, p, count, here):
            now = _misfit(shapes, here, information, p, plane_share)
        if not now <= chi2 * (1.0 + 1e-9):
            damping *= 20.0
            if damping > 1e8 or chi2 > 1e299:
                return -1.0
            for i in range(size):
                p[i] = 0.5 * (p[i] + previous[i])
            continue
        converged = chi2 - now < _LEAST_GAIN
        chi2 = now
        copy_into(p, previous)
        damping = max(damping * 0.1, 1e-12)
        if not _equations(
            camera, shapes, here, information, radius, plane_share, centre, axis, basis, p,
            normal, right,
        ):  # fmt: skip
            return -1.0
        if converged:
            break
        if not damped_step(normal, right, damping, lower, step):
            return -1.0
        for i in range(size):
            p[i] += step[i]
    inverse = np.empty((size, size))
    if not invert(normal, lower, inverse):
        return -1.0
    for i in range(5):
        for j in range(5):
            scale = (radius if i < 3 else 1.0) * (radius if j < 3 else 1.0)
            covariance[i, j] = inverse[i, j] * scale
    for i in range(3):
        centre[i] += previous[i] * radius
    _turned(axis, basis, previous, axis)
    return chi2


@njit(cache=True, nogil=True, error_model="numpy")
def _misfit(
    shapes: Array, predicted: Array, information: Array, p: Array, plane_share: float
) -> float:
    """χ² of the shapes and of the edges' heights over the plane."""
    total = 0.0
    for k in range(shapes.shape[0]):
        for i in range(5):
            for j in range(5):
                off = shapes[k, i] - predicted[k, i]
                total += off * information[k, i, j] * (shapes[k, j] - predicted[k, j])
        if k > 0:
            total += (p[4 + 2 * k] / plane_share) ** 2
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def _equations(
    camera: Array, shapes: Array, here: Array, information: Array, radius: float,
    plane_share: float, centre: Array, axis: Array, basis: Array, p: Array, normal: Array,
    right: Array,
) -> bool:  # fmt: skip
    """Normal equations at the parameters ``p``; False where a slope cannot be formed."""
    count, size = shapes.shape[0], p.shape[0]
    there, slopes = np.empty((count, 5)), np.empty((size, count, 5))
    moved, weighted = p.copy(), np.empty(5)
    for i in range(size):
        moved[i] = p[i] + _SLOPE_STEP
        if not _predict(camera, centre, axis, basis, radius, moved, count, there):
            return False
        moved[i] = p[i]
        for k in range(count):
            for e in range(5):
                slopes[i, k, e] = (there[k, e] - here[k, e]) / _SLOPE_STEP
    normal[:] = 0.0
    normal[3, 3] = normal[4, 4] = 1.0  # a turn of the axis by one radian is the prior's σ
    right[:] = 0.0
    for k in range(count):
        for i in range(size):
            for e in range(5):
                weighted[e] = 0.0
                for o in range(5):
                    weighted[e] += information[k, e, o] * slopes[i, k, o]
                right[i] += weighted[e] * (shapes[k, e] - here[k, e])
            for j in range(size):
                for e in range(5):
                    normal[i, j] += slopes[j, k, e] * weighted[e]
        if k > 0:
            normal[4 + 2 * k, 4 + 2 * k] += 1.0 / plane_share**2
            right[4 + 2 * k] -= p[4 + 2 * k] / plane_share**2
    return True


def joint_poses(
    camera: Camera, ellipses: list[Ellipse], radius_m: float
) -> tuple[tuple[CirclePose, ...], tuple[float, ...]]:
    """Both poses of a ring from all its edges, and the misfit χ² of each.

    An edge that misfits both poses (a cone behind the ring, a shadow) is left out. With a single
    edge the poses are `circle_poses` and their misfit is 0.

    Args:
        camera: only its matrix is used.
        ellipses: with covariances; the first is the edge of ``radius_m``.
        radius_m: of that edge.
    """
    poses = circle_poses(camera, ellipses[0], radius_m)
    misfits = tuple(0.0 for _ in poses)
    used = [ellipses[0]]
    for ellipse in ellipses[1:]:
        if len(used) == _MOST:
            break
        fits = [fit_joint(camera, [*used, ellipse], pose) for pose in poses]
        best = min((fit[1] for fit in fits if fit is not None), default=np.inf)
        if best > _MISFIT * 4 * len(used):
            continue
        used.append(ellipse)
        # Where only one pose can be fitted, the other is as wrong as can be said.
        poses = tuple(p if f is None else f[0] for p, f in zip(poses, fits, strict=True))
        misfits = tuple(best + 1e6 if fit is None else fit[1] for fit in fits)
    return poses, misfits
