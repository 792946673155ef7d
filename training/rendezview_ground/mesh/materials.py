"""Material libraries (``.mtl``) of OBJ files: diffuse colour and texture."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import unquote

import numpy as np

from rendezview.geometry.pose import Array
from rendezview_ground.mesh.colours import Rgb, grey, linear_from_srgb, texture_face_rgb
from rendezview_ground.mesh.text import decoded


@dataclass(frozen=True, slots=True, eq=False)
class Material:
    """Diffuse part of a material."""

    diffuse: Array | None  # (3,) linear, ``Kd``
    image: Any | None  # Pillow image, ``map_Kd``

    def face_rgb(self, corner_uv: Array | None, count: int) -> Rgb:
        """Colours of ``count`` faces; ``corner_uv`` (count, 3, 2) with texture coordinates."""
        if self.image is not None and corner_uv is not None:
            # Kd is ignored: beside a texture, exporters write 0 or 1 arbitrarily.
            return texture_face_rgb(self.image, corner_uv).astype(np.float32)
        if self.diffuse is None:
            return grey(count)
        return np.tile(self.diffuse, (count, 1)).astype(np.float32)


def read_materials(folder: Path, libraries: list[str]) -> tuple[dict[str, Material], list[str]]:
    """Materials by name, and one sentence for each file that is missing or unreadable."""
    materials: dict[str, Material] = {}
    notes: list[str] = []
    for entry in dict.fromkeys(libraries):
        whole = _find(folder, entry)
        names = [entry] if whole is not None else entry.split()
        for name in names:
            path = _find(folder, name)
            if path is None:
                notes.append(f"Material library {name} not found beside the mesh: faces are grey.")
                continue
            try:
                text = decoded(path.read_bytes())
            except OSError as error:
                notes.append(f"Material library {name} not readable ({error}): faces are grey.")
                continue
            _parse(folder, text, materials, notes)
    return materials, notes


def _parse(folder: Path, text: str, materials: dict[str, Material], notes: list[str]) -> None:
    name = ""
    for line in text.splitlines():
        key, _, rest = line.strip().partition(" ")
        if "\t" in key:
            key, _, rest = line.strip().partition("\t")
        rest = rest.strip()
        if key.lower() == "newmtl":
            name = rest
            materials[name] = Material(None, None)
        elif key.lower() == "kd":
            diffuse = _colour(rest)
            if diffuse is not None:
                materials[name] = Material(diffuse, _known(materials, name).image)
        elif key.lower() == "map_kd":
            image = _open_image(folder, rest, notes)
            known = _known(materials, name)
            white = known.diffuse is not None and np.all(known.diffuse >= 1.0)
            lost = image is None and white  # white beside a lost texture has no meaning
            materials[name] = Material(None if lost else known.diffuse, image)


def _known(materials: dict[str, Material], name: str) -> Material:
    return materials.get(name, Material(None, None))


def _colour(text: str) -> Array | None:
    """``r g b`` or one grey value; None for spectral and CIE colours."""
    try:
        values = [float(value) for value in text.split()[:3]]
    except ValueError:
        return None
    if len(values) == 1:
        values = values * 3
    return linear_from_srgb(values) if len(values) == 3 and np.isfinite(values).all() else None


def _open_image(folder: Path, entry: str, notes: list[str]) -> Any | None:
    """The texture as a Pillow image in memory, or None and a note."""
    path = _find(folder, entry) or _find(folder, (entry.split() or [""])[-1])  # behind options
    if path is None:
        note = f"Texture {entry} not found beside the mesh: its faces keep their plain colour."
    else:
        try:
            from PIL import Image

            with Image.open(path) as image:
                return image.convert("RGB")
        except ImportError:
            note = "Textures ignored: install Pillow (pip install pillow) to use their colours."
        except Exception as error:  # Pillow raises many kinds for damaged files
            note = f"Texture {path.name} not readable ({error}): its faces keep their plain colour."
    if note not in notes:
        notes.append(note)
    return None


def _find(folder: Path, entry: str) -> Path | None:
    """The file as written, or its name in the mesh's folder (paths of another machine).

    Files elsewhere are not opened: a mesh may come from somebody else.
    """
    plain = entry.strip().strip('"')
    # As it is, with escaped spaces, and as an address.
    names = dict.fromkeys([plain, plain.replace("\\ ", " "), unquote(plain)])
    places = [PurePosixPath(name.replace("\\", "/")) for name in names]
    for candidate in (folder / p for place in places if place.name for p in (place, place.name)):
        inside = os.path.realpath(candidate).startswith(os.path.realpath(folder) + os.sep)
        if inside and os.path.isfile(candidate):  # never raises, for any name
            return candidate
    return None
