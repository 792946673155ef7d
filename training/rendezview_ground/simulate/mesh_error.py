"""A target that differs from its CAD model: a smoothly deformed mesh."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rendezview.geometry.pose import Array
from rendezview_ground.mesh.insulation import outwards, random_waves
from rendezview_ground.mesh.mesh import Mesh

_LENGTH_RADII = 0.5  # correlation length in target radii: parts move, small shapes stay
_WAVES = 64  # of the random field
MOST_MESH_ERROR = 0.2  # of the radius; beyond, the shape is another one


def deformed(mesh: Mesh, share: float, rng: np.random.Generator) -> Mesh:
    """The mesh with its vertices moved by a smooth random field.

    The field is Gaussian with a Gaussian correlation. The rigid motion that fits it best is taken
    out, so that a true pose of the CAD model stays the best pose of the deformed mesh.

    Args:
        mesh: the CAD model.
        share: RMS displacement of the surface, as a share of the radius of the bounding sphere.
        rng: of the field.

    Raises:
        ValueError: ``share`` is not 0 to ``MOST_MESH_ERROR``.
    """
    if not 0.0 <= share <= MOST_MESH_ERROR:
        raise ValueError(f"share must be 0 to {MOST_MESH_ERROR} of the radius, not {share}")
    centre_m, radius_m = mesh.bounding_sphere
    places = (mesh.vertices_m - centre_m) / radius_m
    waves = random_waves(places, _LENGTH_RADII, _WAVES, rng)
    moves = waves @ rng.standard_normal((_WAVES, 3))
    _, weights = outwards(mesh)
    moves -= _rigid_part(places, moves, weights)
    rms = np.sqrt(weights @ (moves**2).sum(axis=1))
    return replace(mesh, vertices_m=mesh.vertices_m + share * radius_m / rms * moves)


def _rigid_part(places: Array, moves: Array, weights: Array) -> Array:
    """(V, 3) of the small rotation and the translation that fit best, weighted least squares."""
    axes = np.eye(3)
    basis = np.array([np.cross(axis, places) for axis in axes]
                     + [np.broadcast_to(axis, places.shape) for axis in axes])  # fmt: skip
    matrix = np.einsum("v,jvi,kvi->jk", weights, basis, basis)
    right = np.einsum("v,jvi,vi->j", weights, basis, moves)
    motion = np.linalg.lstsq(matrix, right, rcond=None)[0]
    return np.einsum("j,jvi->vi", motion, basis)  # type: ignore[no-any-return]
