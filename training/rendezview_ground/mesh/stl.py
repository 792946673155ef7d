"""STL files, text and binary."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from rendezview.errors import RendezviewError
from rendezview_ground.mesh.colours import grey, stl_face_rgb
from rendezview_ground.mesh.mesh_file import MeshFile
from rendezview_ground.mesh.notes import counted
from rendezview_ground.mesh.text import COMMA_NOTE, decoded, is_text, with_points

_HEADER_BYTES = 84  # a name and the number of triangles
_RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("word", "<u2")])
_VERTEX = re.compile(r"\bvertex\s+(\S+)\s+(\S+)\s+(\S+)", re.IGNORECASE)
_LOOP = re.compile(r"\bouter\s+loop\b", re.IGNORECASE)
_END = re.compile(r"\bend\s*solid\b", re.IGNORECASE)
_TAIL = 1024  # characters in which the end is searched


def read_stl(path: Path, node: str | None) -> MeshFile:
    """The triangles of a file; each has corners of its own.

    Raises:
        RendezviewError: a node is named.
        ValueError: cut short, or no STL file.
    """
    if node is not None:
        raise RendezviewError(f"{path}#{node}: STL files have no nodes: export the part alone")
    data = path.read_bytes()
    start = data[:_TAIL]
    if is_text(start) and "facet" in decoded(start).lower():
        return _text(decoded(data))
    return _binary(data)


def _text(text: str) -> MeshFile:
    if not _END.search(text, max(len(text) - _TAIL, 0)):
        raise ValueError("the text ends without `endsolid`: it is cut short")
    text, commas = with_points(text, "vertex")
    numbers = np.array(_VERTEX.findall(text)).reshape(-1, 3).astype(np.float64)
    loops = len(_LOOP.findall(text))
    if len(numbers) != 3 * loops:
        raise ValueError(f"{len(numbers)} vertices in {loops} facets: not all are triangles")
    return _mesh(numbers, (COMMA_NOTE,) if commas else ())


def _binary(data: bytes) -> MeshFile:
    if len(data) < _HEADER_BYTES:
        raise ValueError(f"{len(data)} bytes are too few for an STL file")
    count = int.from_bytes(data[80:84], "little")
    length = _HEADER_BYTES + _RECORD.itemsize * count
    if len(data) < length or (count == 0 and len(data) > length):
        raise ValueError(
            f"the header announces {count} triangles ({length} bytes) but the file has "
            f"{len(data)} bytes"
        )
    records = np.frombuffer(data, _RECORD, count, _HEADER_BYTES)
    notes: tuple[str, ...] = ()
    if len(data) > length:
        notes = (f"{counted(len(data) - length, 'byte')} behind the last triangle ignored.",)
    found = _mesh(records["corners"].reshape(-1, 3).astype(np.float64), notes)
    coloured = stl_face_rgb(records["word"], data[:80])
    if coloured is None:
        return found
    rgb, total = coloured
    notes = (*notes, f"{counted(total, 'face')} with an STL colour.")
    return MeshFile(found.vertices, found.faces, rgb, None, notes)


def _mesh(corners: np.ndarray, notes: tuple[str, ...]) -> MeshFile:
    faces = np.arange(len(corners), dtype=np.int64).reshape(-1, 3)
    return MeshFile(corners, faces, grey(len(faces)), None, notes)
