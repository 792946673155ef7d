"""Fewer triangles of the same shape: training draws a mesh thousands of times.

Edges are collapsed while the sum of the squared distances of the new vertex from the planes of all
faces that it stands for stays below the square of the tolerance (M. Garland and P. Heckbert,
Surface simplification using quadric error metrics, SIGGRAPH 1997; by pyfqmr). So no vertex lies
farther than the tolerance from a plane that it replaces.
"""

from __future__ import annotations

import numpy as np
import pyfqmr
from numpy.typing import NDArray

from rendezview.geometry.pose import Array
from rendezview_ground.mesh.mesh import Mesh

# Faces; a smaller mesh is drawn as it is. Source: training with 72,000 takes 1.5 times as long as
# with 17,600; of 482,988 faces 697 s, simplified 134 s (version 0.1)
MANY_FACES = 40_000
# Tolerance, of the target's radius. Source: 0.014 px of a view of 560 px, 0.05 px where the target
# is 2000 px large
TOLERANCE_RADII = 5e-5
_COLOUR_STEP = 0.02  # albedo; closer colours are one. Source: a sixth of a visible crease
_LEAST_FACES = 1000  # of one colour; fewer stay as they are. Source: by construction
_ROUNDS = 100  # over all edges. Source: the default of pyfqmr


def simplified(mesh: Mesh, tolerance_m: float, many: int | None = None) -> Mesh:
    """The mesh with fewer triangles, if it has more than ``many``, or than `MANY_FACES`.

    Borders stay where they are: open edges, and the edges between parts that differ in colour,
    joint or trust.

    Args:
        mesh: cleaned, equal positions merged.
        tolerance_m: see the module.
        many: faces; a mesh with no more stays as it is.
    """
    if len(mesh.faces) <= (MANY_FACES if many is None else many):
        return mesh
    group = _groups(mesh)
    order = np.argsort(group, kind="stable")
    vertices: list[Array] = []
    faces: list[NDArray[np.int32]] = []
    source: list[NDArray[np.intp]] = []  # a face of the group, for each new one
    first = 0
    for members in np.split(order, np.flatnonzero(np.diff(group[order])) + 1):
        used, own = np.unique(mesh.faces[members], return_inverse=True)
        points, corners = mesh.vertices_m[used], own.reshape(-1, 3).astype(np.int32)
        alike = members
        if len(members) >= _LEAST_FACES:
            points, corners = _collapsed(points, corners, tolerance_m)
            alike = np.full(len(corners), members[0])
        vertices.append(points)
        faces.append(corners + np.int32(first))
        source.append(alike)
        first += len(points)
    of_face = np.concatenate(source)
    # Vertices of two groups at one place are one again: a crease between them is found as before.
    places, number = np.unique(np.concatenate(vertices), axis=0, return_inverse=True)
    joined = number.reshape(-1)[np.concatenate(faces)]
    return mesh.with_faces(places, joined, of_face)


def _groups(mesh: Mesh) -> NDArray[np.intp]:
    """(F,) a number for the faces that agree in colour, joint and trust."""
    columns = [np.rint(np.asarray(mesh.face_rgb, dtype=np.float64).T / _COLOUR_STEP)]
    columns += [np.asarray(c, float)[None] for c in (mesh.face_part, mesh.face_trust)
                if c is not None]  # fmt: skip
    _, group = np.unique(np.concatenate(columns), axis=1, return_inverse=True)
    return np.asarray(group.reshape(-1), dtype=np.intp)


def _collapsed(
    vertices: Array, faces: NDArray[np.int32], tolerance_m: float
) -> tuple[Array, NDArray[np.int32]]:
    """Vertices and faces after all collapses within the tolerance."""
    work = pyfqmr.Simplify()
    work.setMesh(vertices, faces)
    # The threshold of round k is alpha (k + K) ** aggressiveness: here the same in all.
    work.simplify_mesh(
        target_count=1, aggressiveness=0.0, alpha=tolerance_m**2, K=1, max_iterations=_ROUNDS,
        preserve_border=True, verbose=False,
    )  # fmt: skip
    points, corners, _ = work.getMesh()
    return np.asarray(points, dtype=np.float64), np.asarray(corners, dtype=np.int32)
