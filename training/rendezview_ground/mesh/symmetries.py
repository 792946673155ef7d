"""Symmetries of a mesh, found from its surface."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from rendezview.geometry.pose import Array
from rendezview.geometry.symmetry import Symmetry
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.mesh.surface_sample import surface_sample

_POINTS = 4000  # on the surface
_SAME = 0.01  # of the radius; a rotated point this close to the surface lies on it
_SHARE = 0.997  # least share of such points: an antenna of 0.3 % of the surface breaks a symmetry
_ORDERS = (2, 3, 4, 5, 6, 8)  # of discrete rotations that are tested
_CONTINUOUS_RAD = np.deg2rad([7.0, 31.0, 53.0, 97.0])  # rad; no regular prism has all of them


def find_symmetries(mesh: Mesh, seed: int = 0) -> tuple[Symmetry, ...]:
    """Discrete and continuous symmetries about axes through the origin of the target frame.

    The coordinate axes and the surface's principal axes are tested. Target files cannot express a
    symmetry whose axis misses the origin, so these are not tested.
    """
    points = surface_sample(mesh, _POINTS, np.random.default_rng(seed))
    centre_m, radius_m = mesh.bounding_sphere
    tree = cKDTree(surface_sample(mesh, 20 * _POINTS, np.random.default_rng(seed + 1)))
    found: list[Symmetry] = []
    for axis in _axes(points):
        # The bounding sphere's centre must lie on the axis.
        if np.linalg.norm(np.cross(axis, centre_m)) > _SAME * radius_m:
            continue
        if all(_alike(points, tree, axis, angle, radius_m) for angle in _CONTINUOUS_RAD):
            found.append(Symmetry("continuous", axis, None))
            continue
        for order in reversed(_ORDERS):
            angle = 2.0 * np.pi / order
            if _alike(points, tree, axis, angle, radius_m):
                found.append(Symmetry("discrete", axis, angle))
                break
    return tuple(found)


def _axes(points: Array) -> list[Array]:
    principal = np.linalg.eigh(np.cov(points.T))[1].T
    axes: list[Array] = []
    for axis in [*np.eye(3), *principal]:
        if all(abs(axis @ other) < np.cos(np.deg2rad(5.0)) for other in axes):
            axes.append(axis)
    return axes


def _alike(points: Array, tree: cKDTree, axis: Array, angle_rad: float, radius_m: float) -> bool:
    turned = Rotation.from_rotvec(angle_rad * axis).apply(points)
    distance, _ = tree.query(turned, distance_upper_bound=2.0 * _SAME * radius_m)
    return bool(np.mean(np.isfinite(distance)) >= _SHARE)
