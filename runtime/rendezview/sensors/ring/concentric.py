"""Several edges of one ring: one pose for all, and often the sign of its tilt.

The edges of an end frame are circles about one axis, in or near one plane. Their radii besides the
known one are free. Each ellipse with its covariance is a measurement of five numbers; the pose is
the least-squares one. It is better than a single edge's on short arcs, and the wrong one of the two
poses misfits, because circles of one plane have centres that only the true tilt explains.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from rendezview.estimation.least_squares import Equations, minimise
from rendezview.geometry.camera import Camera
from rendezview.sensors.ring.circle_pose import (
    RADIUS_SHARE,
    CirclePose,
    circle_poses,
    pose_covariance,
    shapes_of_circles,
    tangent_basis,
)
from rendezview.sensors.ring.ellipse import Ellipse

Array = npt.NDArray[np.float64]

# σ of an edge's height over the ring's plane, as a share of the radius. Source: by hand; see
# ring-accuracy
PLANE_SHARE = 0.004
# Of a parameter, for numerical slopes.
_SLOPE_STEP = 1e-5  # Source: by construction, between rounding and curvature
# χ² over its degrees of freedom, of edges that are not of one plane. Source: by hand; see
# ring-accuracy
_MISFIT = 4.0


def fit_joint(
    camera: Camera, ellipses: list[Ellipse], start: CirclePose, systematic_px: float = 0.0
) -> tuple[CirclePose, float] | None:
    """The pose that explains all edges, and the misfit χ²; None where it does not converge.

    Args:
        camera: only its matrix is used.
        ellipses: with their ``shape_covariance``; the first is the edge of ``start.radius_m``.
        start: a pose of the first.
        systematic_px: σ of an error of the first's numbers that its covariance is without.
    """
    shapes = np.array([ellipse.shape for ellipse in ellipses])
    covariances = np.array([ellipse.shape_covariance for ellipse in ellipses], dtype=np.float64)
    try:
        roots = np.linalg.cholesky(np.linalg.inv(covariances)).transpose(0, 2, 1)
    except np.linalg.LinAlgError:  # an edge that is hardly determined
        return None
    count, basis = len(ellipses), tangent_basis(start.axis)
    size = np.sqrt(shapes[:, 2] * shapes[:, 4] - shapes[:, 3] ** 2)
    first = np.zeros(3 + 2 * count)
    first[5::2] = size[1:] / size[0]
    steps = np.vstack([np.zeros_like(first), _SLOPE_STEP * np.eye(len(first))])

    def left(p: Array) -> Array | None:
        """(M, …) misfits of shapes and heights for M vectors of parameters, in σ."""
        axes = start.axis + p[:, 3:5] @ basis.T
        axes /= np.linalg.norm(axes, axis=1)[:, None]
        ratios, heights = np.ones((len(p), count, 1)), np.zeros((len(p), count, 1))
        ratios[:, 1:, 0], heights[:, 1:, 0] = p[:, 5::2], p[:, 6::2]
        axes = np.repeat(axes[:, None], count, axis=1)
        places = start.centre_m + start.radius_m * (p[:, None, :3] + heights * axes)
        seen = shapes_of_circles(
            camera, places.reshape(-1, 3), axes.reshape(-1, 3), start.radius_m * ratios.ravel()
        ).reshape(len(p), count, 5)
        if not np.isfinite(seen).all():
            return None
        off = np.einsum("kij,mkj->mki", roots, shapes - seen).reshape(len(p), -1)
        return np.hstack([off, -p[:, 6::2] / PLANE_SHARE])

    def cost(p: Array) -> float:
        off = left(p[None])
        return np.inf if off is None else float(np.sum(off**2))

    def equations(p: Array) -> Equations:
        off = left(p + steps)
        if off is None:
            return np.inf, np.eye(len(p)), np.zeros(len(p))
        here, slopes = off[0], (off[0] - off[1:]) / _SLOPE_STEP
        normal = slopes @ slopes.T
        normal[range(3, 5), range(3, 5)] += 1.0  # a turn of the axis by one radian: the prior's σ
        return float(here @ here), normal, slopes @ here

    found = minimise(equations, np.add, first, cost=cost)
    if found is None:
        return None
    chi2, normal, _ = equations(found.at)
    if not np.isfinite(chi2):
        return None
    scale = np.repeat([start.radius_m, 1.0], (3, 2))
    try:
        covariance = np.linalg.inv(normal)[:5, :5] * np.outer(scale, scale)
    except np.linalg.LinAlgError:
        return None
    centre = start.centre_m + found.at[:3] * start.radius_m
    axis = start.axis + basis @ found.at[3:5]
    axis /= np.linalg.norm(axis)
    if float(axis @ centre) > 0.0:
        axis = -axis
    pose = CirclePose(centre, axis, start.radius_m)
    covariance[:3, :3] += RADIUS_SHARE**2 * np.outer(centre, centre)
    if systematic_px > 0.0:
        covariance += pose_covariance(camera, pose, systematic_px**2 * np.eye(5))
    return replace(pose, covariance=0.5 * (covariance + covariance.T)), chi2


def joint_poses(
    camera: Camera, ellipses: list[Ellipse], radius_m: float, systematic_px: float = 0.0
) -> tuple[tuple[CirclePose, ...], tuple[float, ...]]:
    """Both poses of a ring from all its edges, and the misfit χ² of each.

    An edge that misfits both poses (a cone behind the ring, a shadow) is left out. With a single
    edge the poses are `circle_poses` and their misfit is 0.

    Args:
        camera: only its matrix is used.
        ellipses: with covariances; the first is the edge of ``radius_m``.
        radius_m: of that edge.
        systematic_px: σ of an error of its numbers that its covariance is without.
    """
    poses = circle_poses(camera, ellipses[0], radius_m, systematic_px=systematic_px)
    misfits = tuple(0.0 for _ in poses)
    used = [ellipses[0]]
    for ellipse in ellipses[1:]:
        fits = [fit_joint(camera, [*used, ellipse], pose, systematic_px) for pose in poses]
        best = min((fit[1] for fit in fits if fit is not None), default=np.inf)
        if best > _MISFIT * 4 * len(used):
            continue
        used.append(ellipse)
        # Where only one pose can be fitted, the other is as wrong as can be said.
        poses = tuple(p if f is None else f[0] for p, f in zip(poses, fits, strict=True))
        misfits = tuple(best + 1e6 if fit is None else fit[1] for fit in fits)
    return poses, misfits
