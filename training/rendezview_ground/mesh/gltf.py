"""Checks of a glTF file's header: what trimesh would read wrongly, or refuse in riddles."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from rendezview.errors import RendezviewError

GLTF_SUFFIXES = (".glb", ".gltf")
# Source: glTF 2.0, 4.4 "GLB file format": magic, version, length; then length and type of a chunk
_GLB_HEADER = struct.Struct("<4sIIII")
_JSON_CHUNK = 0x4E4F534A  # Source: glTF 2.0, 4.4.3.2, "JSON"
_TRIANGLE_FAN = 6  # Source: glTF 2.0, 3.7.2.1, mode of a primitive
_COMPRESSED = ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression")


def check_gltf(path: Path) -> None:
    """Refuse a glTF file whose triangles cannot be read, in words that say why.

    What is damaged in other ways is left to the reader of the file.

    Raises:
        RendezviewError: glTF 1, compressed geometry, triangle fans, or a file of its geometry is
            missing or lies outside its folder.
    """
    header = _header(path)
    version = str(_entry(header, "asset").get("version", "2.0"))
    if version.split(".")[0] == "1":
        raise RendezviewError(f"{path} is a file of glTF {version}: export it as glTF 2.0")
    required = header.get("extensionsRequired")
    for name in _COMPRESSED:
        if isinstance(required, list) and name in required:
            raise RendezviewError(
                f"{path}: its geometry is compressed ({name}), which is not read here: export it "
                "without compression"
            )
    if any(primitive.get("mode") == _TRIANGLE_FAN for primitive in _primitives(header)):
        raise RendezviewError(
            f"{path}: it holds triangle fans, which are not read here: export plain triangles"
        )
    for buffer in _entries(header, "buffers"):
        uri = buffer.get("uri")
        if isinstance(uri, str) and not uri.startswith("data:"):
            beside = path.parent / unquote(uri)
            if not beside.resolve().is_relative_to(path.parent.resolve()):
                raise RendezviewError(
                    f"{path}: its geometry is in {uri}, outside the folder of the mesh, where "
                    "nothing is read: put that file beside it, or export one GLB file"
                )
            if not beside.is_file():
                raise RendezviewError(
                    f"{path}: its geometry is in {beside}, which is not there: put that file "
                    "beside it, or export one GLB file"
                )


def _header(path: Path) -> dict[str, Any]:
    """The JSON of a file; empty where there is none to read."""
    with path.open("rb") as stream:
        if path.suffix.lower() == ".gltf":
            text = stream.read()
        else:
            start = stream.read(_GLB_HEADER.size)
            if len(start) < _GLB_HEADER.size:
                return {}
            magic, version, _, length, kind = _GLB_HEADER.unpack(start)
            if magic == b"glTF" and version == 1:
                return {"asset": {"version": "1.0"}}
            if magic != b"glTF" or kind != _JSON_CHUNK:
                return {}
            text = stream.read(length)
    try:
        header = json.loads(text)
    except ValueError:
        return {}
    return header if isinstance(header, dict) else {}


def _entry(header: dict[str, Any], name: str) -> dict[str, Any]:
    value = header.get(name)
    return value if isinstance(value, dict) else {}


def _entries(header: dict[str, Any], name: str) -> list[dict[str, Any]]:
    values = header.get(name)
    return [v for v in values if isinstance(v, dict)] if isinstance(values, list) else []


def _primitives(header: dict[str, Any]) -> list[dict[str, Any]]:
    return [p for mesh in _entries(header, "meshes") for p in _entries(mesh, "primitives")]
