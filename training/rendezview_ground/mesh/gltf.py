"""What trimesh would read wrongly in a glTF file, or refuse in riddles."""

from __future__ import annotations

import codecs
import json
import struct
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from rendezview.errors import RendezviewError
from rendezview_ground.mesh.gltf_buffers import Buffers
from rendezview_ground.mesh.gltf_plain import is_plain, not_honoured, plain_file

GLTF_SUFFIXES = (".glb", ".gltf")
# Source: glTF 2.0, 4.4 "GLB file format": magic, version, length; then length and type of a chunk
_GLB_HEADER = struct.Struct("<4sIIII")
_JSON_CHUNK = 0x4E4F534A  # its type. Source: glTF 2.0, 4.4.3
_CHUNK_BYTES = 8  # before a chunk's content. Source: glTF 2.0, 4.4.3


def plain_gltf(path: Path) -> tuple[bytes | None, list[str]]:
    """A file that the reader does not fully know, as glTF that it knows, and notes on it.

    None for a file that is read as it is. What is damaged in other ways is left to the reader.

    Raises:
        RendezviewError: glTF 1, a required extension that is not honoured, packed geometry without
            the package that unpacks it, or a file of its geometry is missing or lies outside its
            folder.
    """
    header, place = _header(path)
    version = str(_entry(header, "asset").get("version", "2.0"))
    if version.split(".")[0] == "1":
        raise RendezviewError(f"{path} is a file of glTF {version}: export it as glTF 2.0")
    unknown = not_honoured(header)
    if unknown:
        raise RendezviewError(
            f"{path}: it requires {' and '.join(unknown)}, which is not honoured here: export it "
            "without"
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
    with path.open("rb") as stream:
        marked = stream.read(3) == codecs.BOM_UTF8
    if not _entries(header, "meshes") or (is_plain(header, _primitives(header)) and not marked):
        return None, []
    return plain_file(header, Buffers(path, header, place))


def _header(path: Path) -> tuple[dict[str, Any], int]:
    """The JSON of a file, empty where there is none to read, and where its binary part starts."""
    with path.open("rb") as stream:
        if path.suffix.lower() == ".gltf":
            text = stream.read()
        else:
            start = stream.read(_GLB_HEADER.size)
            if len(start) < _GLB_HEADER.size:
                return {}, 0
            magic, version, _, length, kind = _GLB_HEADER.unpack(start)
            if magic == b"glTF" and version == 1:
                return {"asset": {"version": "1.0"}}, 0
            if magic != b"glTF" or kind != _JSON_CHUNK:
                return {}, 0
            text = stream.read(length)
        place = stream.tell() + _CHUNK_BYTES
    try:
        header = json.loads(text)
    except ValueError:
        return {}, 0
    return (header, place) if isinstance(header, dict) else ({}, 0)


def _entry(header: dict[str, Any], name: str) -> dict[str, Any]:
    value = header.get(name)
    return value if isinstance(value, dict) else {}


def _entries(header: dict[str, Any], name: str) -> list[dict[str, Any]]:
    values = header.get(name)
    return [v for v in values if isinstance(v, dict)] if isinstance(values, list) else []


def _primitives(header: dict[str, Any]) -> list[dict[str, Any]]:
    return [p for mesh in _entries(header, "meshes") for p in _entries(mesh, "primitives")]
