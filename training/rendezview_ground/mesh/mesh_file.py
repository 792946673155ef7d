"""What a reader of a mesh format gives: the triangles as the file has them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rendezview.geometry.pose import Array
from rendezview_ground.mesh.colours import Rgb, grey

Part = tuple[Array, NDArray[np.int64], Rgb]  # vertices (V, 3), faces (F, 3), colours (F, 3)


@dataclass(frozen=True, slots=True, eq=False)
class MeshFile:
    """The triangles of a file: nothing merged, dropped or scaled."""

    vertices: Array  # (V, 3), unit of the file
    faces: NDArray[np.int64]  # (F, 3)
    face_rgb: Rgb  # (F, 3) linear
    unit: tuple[float, str] | None  # metres per unit and its name, if the file states it
    notes: tuple[str, ...]


def joined(parts: list[Part], unit: tuple[float, str] | None, notes: list[str]) -> MeshFile:
    """One mesh of parts."""
    if not parts:
        empty = np.zeros((0, 3))
        return MeshFile(empty, empty.astype(np.int64), grey(0), unit, tuple(notes))
    starts = np.cumsum([0, *(len(vertices) for vertices, _, _ in parts[:-1])])
    return MeshFile(
        vertices=np.vstack([vertices for vertices, _, _ in parts]),
        faces=np.vstack([f + start for (_, f, _), start in zip(parts, starts, strict=True)]),
        face_rgb=np.vstack([rgb for _, _, rgb in parts]),
        unit=unit,
        notes=tuple(notes),
    )
