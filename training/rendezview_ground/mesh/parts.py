"""Parts of a mesh by name or place, how far each is trusted, and what covers it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from rendezview.errors import RendezviewError, explained
from rendezview.geometry.pose import Array
from rendezview.io.parts import TrustedPart
from rendezview.io.target import Target
from rendezview_ground.mesh.insulation import blanketed
from rendezview_ground.mesh.mesh import Mesh, load_mesh

_SAME_RADII = 1e-5  # of the target's radius: a face's middle in two readings of a file


def faces_of(
    mesh: Mesh, target: Target, nodes: Sequence[str], boxes_m: Sequence[Array], unit: str | None
) -> NDArray[np.bool_]:
    """(F,) whether a face is of one of the nodes or lies wholly in one of the boxes.

    Args:
        mesh: of the target's file, target frame.
        target: gives the file.
        nodes: names in the file's scene.
        boxes_m: (2, 3) each, target frame, lowest and highest corner.
        unit: of a bare mesh.
    """
    corners = mesh.vertices_m[mesh.faces]
    chosen = np.zeros(len(mesh.faces), dtype=np.bool_)
    for low, high in boxes_m:
        chosen |= np.all((corners >= low) & (corners <= high), axis=(1, 2))
    radius_m = mesh.bounding_sphere[1]
    middles = cKDTree(corners.mean(axis=1))
    for node in nodes:
        path = target.mesh_path
        part = load_mesh(path.with_name(f"{path.name}#{node}"), unit or target.unit)
        own = part.vertices_m[part.faces].mean(axis=1)
        distance, nearest = middles.query(own)
        chosen[nearest[distance < _SAME_RADII * radius_m]] = True
    return chosen


def with_trust(mesh: Mesh, target: Target, unit: str | None = None) -> Mesh:
    """The target's mesh with the trust of each face; the mesh itself where all is trusted.

    Of several parts that share a face the least trusted counts.

    Raises:
        RendezviewError: a part has no faces, or nothing of the mesh is trusted.
    """
    if not target.parts:
        return mesh
    trust = np.ones(len(mesh.faces), dtype=np.float32)
    for part in target.parts:
        chosen = _own(mesh, target, part, unit)
        trust[chosen] = np.minimum(trust[chosen], np.float32(part.trust))
    if not trust.any():
        raise RendezviewError("no part of the mesh is trusted: raise trust of one in [[parts]]")
    return replace(mesh, face_trust=trust)


def with_blankets(
    mesh: Mesh, target: Target, unit: str | None = None, rng: np.random.Generator | None = None
) -> Mesh:
    """The target's mesh with the blankets of its parts; the mesh itself where there are none.

    Faces under them are subdivided: parts are separated by the faces of the file, so joints
    and trust come first. ``rng``: of bumps; None: each blanket is as thick as its mean everywhere.

    Raises:
        RendezviewError: a part has no faces, or its blanket is too thick.
    """
    covered = [part for part in target.parts if part.insulation_m > 0.0]
    if not covered:
        return mesh
    blankets = [(_own(mesh, target, part, unit), part.insulation_m) for part in covered]
    with explained(f"{target.name}: insulation_m of [[parts]]: "):
        return blanketed(mesh, blankets, rng)


def _own(mesh: Mesh, target: Target, part: TrustedPart, unit: str | None) -> NDArray[np.bool_]:
    """(F,) the faces of a part."""
    chosen = faces_of(mesh, target, part.nodes, part.boxes_m, unit)
    if not chosen.any():
        raise RendezviewError(f"part {part.name!r}: no face of the mesh is in it")
    return chosen
