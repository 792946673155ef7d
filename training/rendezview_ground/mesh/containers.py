"""Data of container formats that trimesh ignores: units, 3MF colours, texture references."""

from __future__ import annotations

import mmap
import re
import zipfile
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from rendezview.errors import RendezviewError
from rendezview_ground.mesh.colours import GREY, Rgb, linear_from_srgb

_MOST_UNPACKED = 2_000_000_000  # bytes, all parts of a 3MF file. Source: a chosen limit
# Source: 3MF core specification, ST_Unit.
_METRES_PER_3MF_UNIT = {
    "micron": 1e-6,
    "millimeter": 1e-3,
    "centimeter": 1e-2,
    "inch": 0.0254,
    "foot": 0.3048,
    "meter": 1.0,
}
_TEXTURE_MARKS = {
    ".glb": b'"baseColorTexture"',
    ".gltf": b'"baseColorTexture"',
    ".dae": b"<texture",
    ".ply": b"TextureFile",
}


def file_unit(path: Path) -> tuple[float, str] | None:
    """Metres per unit of a file that states its unit, and the unit's name for a note."""
    suffix = path.suffix.lower()
    if suffix in (".glb", ".gltf"):
        return 1.0, "metres (glTF)"
    if suffix == ".dae":
        metre = _dae_metre(path)
        return None if metre is None else (metre, f"units of {metre:g} m (DAE)")
    if suffix == ".3mf":
        name = _model_of_3mf(path).get("unit", "millimeter")
        if name not in _METRES_PER_3MF_UNIT:
            raise ValueError(f"unknown 3MF unit {name!r}")
        return _METRES_PER_3MF_UNIT[name], f"{name}s (3MF)".replace("inchs", "inches").replace(
            "foots", "feet"
        )
    return None


def refers_to_texture(path: Path) -> bool:
    """Whether the file names a colour texture, loadable or not."""
    mark = _TEXTURE_MARKS.get(path.suffix.lower())
    if mark is None:
        return False
    with path.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
        return data.find(mark) >= 0


def colours_of_3mf(path: Path) -> list[Rgb]:
    """Face colours of every object with a mesh, in the order of the file.

    Base materials and colour groups are read (sRGB, three corners averaged); textures
    and composites stay grey.
    """
    model = _model_of_3mf(path)
    palettes: dict[str, list[list[float]]] = {}
    for group in model.iter():
        if _tag(group) in ("basematerials", "colorgroup"):
            palettes[group.get("id", "")] = [
                _hex_rgb(entry.get("displaycolor") or entry.get("color") or "") for entry in group
            ]
    return [_object_rgb(item, palettes) for item in _objects_with_mesh(model)]


def _object_rgb(item: ElementTree.Element, palettes: dict[str, list[list[float]]]) -> Rgb:
    rows: list[list[float]] = []
    default = item.get("pindex")
    for triangle in (element for element in item.iter() if _tag(element) == "triangle"):
        palette = palettes.get(triangle.get("pid", item.get("pid", "")), [])
        first = triangle.get("p1", default)
        picks = [first, triangle.get("p2", first), triangle.get("p3", first)]
        known = [palette[int(p)] for p in picks if p is not None and int(p) < len(palette)]
        rows.append(np.mean(known, axis=0).tolist() if known else [GREY] * 3)
    return np.array(rows, dtype=np.float32).reshape(-1, 3)


def _objects_with_mesh(model: ElementTree.Element) -> Iterator[ElementTree.Element]:
    for item in model.iter():
        if _tag(item) == "object" and any(_tag(child) == "mesh" for child in item):
            yield item


def _hex_rgb(text: str) -> list[float]:
    """``#RRGGBB`` or ``#RRGGBBAA`` (sRGB) as linear values."""
    digits = text.strip().lstrip("#")
    if len(digits) not in (6, 8):
        return [GREY] * 3
    values: list[float] = linear_from_srgb(
        [int(digits[k : k + 2], 16) / 255.0 for k in (0, 2, 4)]
    ).tolist()
    return values


def has_decimal_commas(collada: bytes) -> bool:
    """Whether the unit of a Collada file has a comma, as all its numbers then."""
    return re.search(rb"<unit\b[^>]*\bmeter=[\"']\d+,\d", collada) is not None


def check_3mf(path: Path) -> None:
    """Refuse an archive that unpacks to much more than a mesh needs, or keeps its bodies elsewhere.

    Raises:
        ValueError: its parts are too large together.
        RendezviewError: the items of its build are in other parts.
    """
    with zipfile.ZipFile(path) as archive:
        total = sum(part.file_size for part in archive.infolist())
    if total > _MOST_UNPACKED:
        raise ValueError(f"it unpacks to {total / 1e9:.1f} GB, more than {_MOST_UNPACKED / 1e9:g}")
    if re.search(rb"<(?:\w+:)?item\b[^>]*\w:path=", _content_of_3mf(path)):
        raise RendezviewError(
            f"{path}: its bodies are in other parts of the archive (production extension), which "
            "are not read: export it as one 3MF part, STL or GLB"
        )


def _model_of_3mf(path: Path) -> ElementTree.Element:
    return ElementTree.fromstring(_content_of_3mf(path))


def _content_of_3mf(path: Path) -> bytes:
    with zipfile.ZipFile(path) as archive:
        for name in archive.namelist():
            if "3d/3dmodel.model" in name.lower():
                return archive.read(name)
    raise ValueError("no 3D/3dmodel.model inside")


def _dae_metre(path: Path) -> float | None:
    """``<asset><unit meter=…>`` of the document, or None."""
    for _, element in ElementTree.iterparse(path, events=("end",)):
        if _tag(element) == "unit":
            metre = float(element.get("meter", "1").replace(",", "."))
            if not (np.isfinite(metre) and metre > 0):
                raise ValueError(f"<unit meter={metre:g}> is not a length")
            return metre
        if _tag(element) == "asset":
            return None
    return None


def _tag(element: ElementTree.Element) -> str:
    return element.tag.rpartition("}")[2] if isinstance(element.tag, str) else ""
