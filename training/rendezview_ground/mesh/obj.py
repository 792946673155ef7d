"""Wavefront OBJ files and their materials.

Own code, because trimesh counts relative indices from the end of the file instead of from their
line, which gives a wrong shape without a message. It also stops at comments after values, tabs and
indented lines.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rendezview.errors import RendezviewError
from rendezview_ground.mesh.colours import Rgb, grey, linear_from_srgb
from rendezview_ground.mesh.materials import read_materials
from rendezview_ground.mesh.mesh_file import MeshFile
from rendezview_ground.mesh.notes import counted
from rendezview_ground.mesh.polygon import cut_note, cut_polygons
from rendezview_ground.mesh.text import COMMA_NOTE, decoded, is_text, with_points

_LINES_AND_POINTS = frozenset({"l", "p"})
_FREE_FORM = frozenset({"curv", "curv2", "surf"})


@dataclass(slots=True)
class _Content:
    """The content of the file's lines, in their order."""

    positions: list[list[float]] = field(default_factory=list)
    colours: dict[int, list[float]] = field(default_factory=dict)  # by vertex
    texture_uv: list[list[float]] = field(default_factory=list)
    corners: list[int] = field(default_factory=list)  # vertices, one polygon after the other
    corner_uv: list[int] = field(default_factory=list)  # −1: none
    polygon_size: list[int] = field(default_factory=list)
    polygon_line: list[int] = field(default_factory=list)
    polygon_material: list[str] = field(default_factory=list)
    libraries: list[str] = field(default_factory=list)
    short_faces: int = 0
    lines_and_points: int = 0
    free_form: int = 0


def read_obj(path: Path, node: str | None) -> MeshFile:
    """The triangles of a file.

    Raises:
        RendezviewError: a node is named, or a line that cannot be read, with its number.
    """
    if node is not None:
        raise RendezviewError(
            f"{path}#{node}: OBJ files have no nodes here: export the part alone, or as GLB"
        )
    data = path.read_bytes()
    if not is_text(data):
        raise RendezviewError(
            f"{path} is not an OBJ file: it holds binary data. "
            "If it is a mesh in another format, give it that format's suffix."
        )
    text, commas = with_points(decoded(data), "v")
    content = _parse(path, text)
    notes = [COMMA_NOTE] if commas else []
    vertices = np.array(content.positions, dtype=np.float64).reshape(-1, 3)
    sizes, corners, corner_uv = (
        np.array(some, dtype=np.int64)
        for some in (content.polygon_size, content.corners, content.corner_uv)
    )
    lost = np.flatnonzero((corners < 0) | (corners >= len(vertices)))
    if len(lost):
        line = np.repeat(content.polygon_line, sizes)[lost[0]]
        raise RendezviewError(
            f"{path}, line {line}: the face uses a vertex that is not there "
            f"(the file has {len(vertices)}). The file is damaged or cut short: export it again."
        )
    cuts, owner, concave = cut_polygons(vertices, sizes, corners)
    if many := int(np.count_nonzero(sizes > 3)):
        notes.append(cut_note(many, concave))
    faces, names = corners[cuts], [content.polygon_material[p] for p in owner]
    notes += _ignored(content)
    rgb = _material_rgb(path, content, names, corner_uv[cuts], notes)
    rgb = _vertex_rgb(content, faces, rgb, notes)
    return MeshFile(vertices, faces, rgb, None, tuple(notes))


def _parse(path: Path, text: str) -> _Content:
    content = _Content()
    material = ""
    joined = text.replace("\\\r\n", " ").replace("\\\n", " ")
    for number, line in enumerate(joined.splitlines(), start=1):
        key, *values = line.split("#", 1)[0].split() or [""]
        try:
            if key == "v":
                _take_vertex(content, values)
            elif key == "vt":
                content.texture_uv.append([float(x) for x in [*values, "0"][:2]])
            elif key == "f":
                if len(values) < 3:
                    content.short_faces += 1
                    continue
                _take_polygon(content, values)
                content.polygon_line.append(number)
                content.polygon_material.append(material)
            elif key == "usemtl":
                material = line.strip()[len("usemtl") :].strip()
            elif key == "mtllib":
                content.libraries.append(line.strip()[len("mtllib") :].strip())
            elif key in _LINES_AND_POINTS:
                content.lines_and_points += 1
            elif key in _FREE_FORM:
                content.free_form += 1
        except (ValueError, IndexError) as error:
            raise RendezviewError(
                f"{path}, line {number}: cannot read {line.strip()[:60]!r} ({error}). "
                "Correct the line or export the mesh again."
            ) from error
    return content


def _take_vertex(content: _Content, values: list[str]) -> None:
    if len(values) < 3:
        raise ValueError("a vertex needs three coordinates")
    content.positions.append([float(x) for x in values[:3]])
    if len(values) >= 6:  # x y z r g b; a single fourth value is a weight
        content.colours[len(content.positions) - 1] = [float(x) for x in values[3:6]]


def _take_polygon(content: _Content, corners: list[str]) -> None:
    """``v``, ``v/vt``, ``v//vn`` or ``v/vt/vn``; negative indices count back from this line."""
    for corner in corners:
        parts = corner.split("/")
        content.corners.append(_from_zero(int(parts[0]), len(content.positions)))
        has_uv = len(parts) > 1 and parts[1] != ""
        uv = _from_zero(int(parts[1]), len(content.texture_uv)) if has_uv else -1
        content.corner_uv.append(uv)
    content.polygon_size.append(len(corners))


def _from_zero(index: int, so_far: int) -> int:
    return index - 1 if index >= 0 else max(so_far + index, -1)


def _ignored(content: _Content) -> list[str]:
    found = (
        (content.lines_and_points, "line or point element", "ignored"),
        (content.short_faces, "face", "with fewer than three corners ignored"),
        (content.free_form, "free-form element", "ignored: export it as triangles"),
    )
    return [f"{counted(count, noun)} {text}." for count, noun, text in found if count]


def _material_rgb(
    path: Path, content: _Content, names: list[str], uv: NDArray[np.int64], notes: list[str]
) -> Rgb:
    """Colours by ``usemtl``."""
    rgb = grey(len(names))
    materials, library_notes = read_materials(path.parent, content.libraries)
    notes += library_notes
    coordinates = np.array(content.texture_uv, dtype=np.float64).reshape(-1, 2)
    name_of_face = np.array(names, dtype=object)
    unknown: list[str] = []
    for name in dict.fromkeys(names):
        mine = name_of_face == name
        if name in materials:
            corner = uv[mine]
            mapped = (corner >= 0).all() and corner.max(initial=-1) < len(coordinates)
            rgb[mine] = materials[name].face_rgb(
                coordinates[corner] if mapped else None, mine.sum()
            )
        elif name:
            unknown.append(name)
    if unknown and not library_notes:
        some = ", ".join(unknown[:4]) + (" …" if len(unknown) > 4 else "")
        notes.append(f"{counted(len(unknown), 'material')} not defined ({some}): grey there.")
    return rgb


def _vertex_rgb(content: _Content, faces: NDArray[np.int64], rgb: Rgb, notes: list[str]) -> Rgb:
    """Vertex colours override materials, on faces whose three corners have one."""
    if not content.colours:
        return rgb
    colours = np.full((len(content.positions), 3), np.nan)
    colours[list(content.colours)] = list(content.colours.values())
    largest = float(np.nanmax(np.abs(colours), initial=0.0))
    if not np.isfinite(largest) or largest > 255.0 or np.nanmin(colours, initial=0.0) < 0.0:
        notes.append(f"Vertex colours ignored: values up to {largest:g} are neither 0–1 nor 0–255.")
        return rgb
    corner = colours[faces] / (255.0 if largest > 1.0 else 1.0)
    whole = np.isfinite(corner).all(axis=(1, 2))
    rgb[whole] = linear_from_srgb(corner[whole]).mean(axis=1)
    if not whole.all():
        notes.append(f"{counted(int((~whole).sum()), 'face')} with a vertex without a colour.")
    return rgb
