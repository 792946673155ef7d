"""A blanket of insulation around a part of a mesh: a bumpy layer that no CAD model has."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rendezview.geometry.pose import Array
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.mesh.triangles import crosses

MOST_INSULATION = 0.1  # of the radius; thicker layers are another craft
_EDGE_RADII = 0.08  # longest edge under the blanket: half of a bump
_BUMP_RADII = 0.15  # correlation length of the bumps
_BUMPINESS = 0.5  # standard deviation of the thickness over its mean
_HEM_RADII = 0.1  # over which the blanket ends
_WAVES = 96  # of the random field
_SAME_PLACE = 1e-6  # radii; vertices nearer to each other are one


def insulated(mesh: Mesh, share: float, rng: np.random.Generator, covered: float = 0.5) -> Mesh:
    """The mesh with a blanket over a part of it, on a side that the random numbers choose.

    Surfaces move outwards along their normals by a Gaussian random field, never inwards. Faces
    under the blanket are subdivided.

    Args:
        mesh: the CAD model.
        share: mean thickness, as a share of the radius of the bounding sphere.
        rng: of side and bumps.
        covered: share of the surface under the blanket, 0 to 1.

    Raises:
        ValueError: ``share`` is not 0 to ``MOST_INSULATION``, or ``covered`` not 0 to 1.
    """
    if not 0.0 <= share <= MOST_INSULATION:
        raise ValueError(f"share must be 0 to {MOST_INSULATION} of the radius, not {share}")
    if not 0.0 <= covered <= 1.0:
        raise ValueError(f"covered must be 0 to 1, not {covered}")
    if share == 0.0 or covered == 0.0:
        return mesh
    centre_m, radius_m = mesh.bounding_sphere
    fine, _ = _subdivided(mesh, radius_m)
    places = (fine.vertices_m - centre_m) / radius_m
    normals, areas = outwards(fine)
    thickness = np.maximum(1.0 + _BUMPINESS * _bumps(places, rng), 0.0)
    moved = share * radius_m * thickness * _cover(places, areas, covered, rng)
    vertices_m = fine.vertices_m + moved[:, None] * normals
    return replace(fine, vertices_m=vertices_m, notes=(*mesh.notes, _note(share, covered)))


def blanketed(
    mesh: Mesh,
    blankets: Sequence[tuple[NDArray[np.bool_], float]],
    rng: np.random.Generator | None = None,
) -> Mesh:
    """The mesh with blankets over some of its faces.

    Args:
        mesh: the CAD model, its trust and parts already assigned.
        blankets: (F,) the faces under each, and its mean thickness, m.
        rng: of the bumps; None: each is as thick as its mean everywhere.

    Raises:
        ValueError: a blanket is thicker than ``MOST_INSULATION`` of the radius.
    """
    centre_m, radius_m = mesh.bounding_sphere
    fine, source = _subdivided(mesh, radius_m)
    moved = np.zeros(len(fine.vertices_m))
    for faces, thickness_m in blankets:
        if not 0.0 <= thickness_m <= MOST_INSULATION * radius_m:
            raise ValueError(
                f"a blanket must be 0 to {MOST_INSULATION * radius_m:.3g} m thick, "
                f"not {thickness_m:g}"
            )
        under = np.unique(fine.faces[faces[source]])
        moved[under] = np.maximum(moved[under], thickness_m)
    if rng is not None:
        places = (fine.vertices_m - centre_m) / radius_m
        moved *= np.maximum(1.0 + _BUMPINESS * _bumps(places, rng), 0.0)
    vertices_m = fine.vertices_m + moved[:, None] * outwards(fine)[0]
    return replace(fine, vertices_m=vertices_m)


def _note(share: float, covered: float) -> str:
    return (
        f"a blanket of {100 * share:g} % of the radius covers {100 * covered:.0f} % of the surface"
    )


def _subdivided(mesh: Mesh, radius_m: float) -> tuple[Mesh, NDArray[np.intp]]:
    """Consistent winding, short edges, and one vertex at each place; and each face's own before."""
    import trimesh  # slow to import, and most meshes have no blanket

    body = trimesh.Trimesh(mesh.vertices_m, mesh.faces, process=False)
    trimesh.repair.fix_normals(body, multibody=True)  # type: ignore[no-untyped-call]
    vertices_m, faces, source = trimesh.remesh.subdivide_to_size(  # type: ignore[no-untyped-call]
        body.vertices, body.faces, _EDGE_RADII * radius_m, max_iter=12, return_index=True
    )
    keys = np.round(vertices_m / (_SAME_PLACE * radius_m)).astype(np.int64)
    _, first, same = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    joined = same.reshape(-1)[faces]
    whole = (np.diff(np.sort(joined, axis=1), axis=1) > 0).all(axis=1)
    source = source[whole]
    return mesh.with_faces(vertices_m[first], joined[whole], source), source


def outwards(mesh: Mesh) -> tuple[Array, Array]:
    """(V, 3) unit normals of the vertices, means of their faces', and (V,) shares of the area."""
    crossed = crosses(mesh.vertices_m[mesh.faces])
    normals = np.zeros_like(mesh.vertices_m)
    for k in range(3):
        np.add.at(normals, mesh.faces[:, k], crossed)
    each = np.repeat(np.linalg.norm(crossed, axis=1), 3)
    areas = np.bincount(mesh.faces.ravel(), each, len(normals))
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return normals / np.where(lengths > 0.0, lengths, 1.0), areas / areas.sum()


def _bumps(places: Array, rng: np.random.Generator) -> Array:
    """(V,) a Gaussian field of variance 1."""
    waves = random_waves(places, _BUMP_RADII, _WAVES, rng)
    return np.asarray(waves @ (rng.standard_normal(_WAVES) * np.sqrt(2.0 / _WAVES)))


def random_waves(places: Array, length: float, count: int, rng: np.random.Generator) -> Array:
    """(V, count) random Fourier features at places (V, 3), by Rahimi & Recht 2007.

    Their sum with Gaussian weights is a Gaussian field with a Gaussian correlation of this length.
    """
    waves = rng.standard_normal((count, 3)) / length
    phases = rng.uniform(0.0, 2.0 * np.pi, count)
    return np.asarray(np.cos(places @ waves.T + phases))


def _cover(places: Array, areas: Array, covered: float, rng: np.random.Generator) -> Array:
    """(V,) 1 under the blanket, 0 beside it, over a hem between both."""
    axis = rng.standard_normal(3)
    along = places @ (axis / np.linalg.norm(axis))
    order = np.argsort(-along)
    last = int(np.searchsorted(np.cumsum(areas[order]), covered))
    border = along[order[min(last, len(order) - 1)]]
    return np.asarray(np.clip(0.5 + (along - border) / _HEM_RADII, 0.0, 1.0))
