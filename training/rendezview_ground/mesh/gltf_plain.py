"""Rewrites what the reader of glTF files does not know in terms of what it knows.

Each function replaces one feature of the standard. A file without any of them is not rewritten.
"""

from __future__ import annotations

import base64
import json
import math
import re
from typing import Any

import numpy as np

from rendezview_ground.mesh.gltf_buffers import DRACO, KINDS, MESHOPT, Buffers, Numbers
from rendezview_ground.mesh.notes import counted

INSTANCES = "EXT_mesh_gpu_instancing"
_TRANSFORM = "KHR_texture_transform"
_GLOSS = "KHR_materials_pbrSpecularGlossiness"
# Required extensions that are honoured here, or change nothing that is read.
_HONOURED = (
    *MESHOPT, DRACO, INSTANCES, _TRANSFORM, _GLOSS, "KHR_mesh_quantization", "EXT_texture_webp",
    "KHR_lights_punctual", "KHR_xmp_json_ld",
)  # fmt: skip
_TRIANGLES, _FAN = 4, 6  # Source: glTF 2.0, 3.7.2.1, modes of a primitive
_READ = ("POSITION", "TEXCOORD_0", "COLOR_0")
_CODES = {np.dtype(kind): code for code, kind in KINDS.items()}
_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}


def not_honoured(header: dict[str, Any]) -> list[str]:
    """Extensions without which the file is not what it says, and which are not read."""
    required = header.get("extensionsRequired")
    names = required if isinstance(required, list) else []
    return [n for n in map(str, names) if n not in _HONOURED and not n.startswith("KHR_materials_")]


def is_plain(header: dict[str, Any], primitives: list[dict[str, Any]]) -> bool:
    """Whether the reader of glTF files knows all of it."""
    text = json.dumps(header)
    unknown = (*MESHOPT, DRACO, INSTANCES, _TRANSFORM, _GLOSS, '"normalized": true', '"sparse"')
    return (
        not any(word in text for word in unknown)
        and not re.search('"texCoord": [1-9]', text)
        and all(p.get("mode") != _FAN and "POSITION" in _attributes(p) for p in primitives)
    )


def plain_file(header: dict[str, Any], buffers: Buffers) -> tuple[bytes, list[str]]:
    """The file as one glTF text, without the features above, and notes on what was left out."""
    notes = _drop_empty(header)
    copies = _repeat(header, buffers)
    if copies:
        notes.append(f"{counted(copies, 'instance')} of its nodes drawn.")
    for material in header.get("materials", []):
        _take_gloss(material)
    out = _Content()
    for mesh in header.get("meshes", []):
        for primitive in mesh["primitives"]:
            _take_primitive(header, buffers, primitive, out)
    for image in header.get("images", []):
        if "bufferView" in image:
            image["bufferView"] = out.add_view(buffers.view(image["bufferView"]))
    return out.written(header), notes


class _Content:
    """The content of a file that is put together."""

    def __init__(self) -> None:
        self.accessors: list[dict[str, Any]] = []
        self.views: list[dict[str, int]] = []
        self.content = bytearray()
        self.known: dict[int, int] = {}  # new numbers of accessors that are taken as they are

    def add_view(self, content: bytes) -> int:
        """The number of a new view."""
        view = {"buffer": 0, "byteOffset": len(self.content), "byteLength": len(content)}
        self.views.append(view)
        self.content += content + bytes(-len(content) % 4)
        return len(self.views) - 1

    def add(self, values: Numbers) -> int:
        """The number of a new accessor with these values, (count,) or (count, width)."""
        table = np.ascontiguousarray(values).reshape(len(values), -1)
        if table.dtype not in _CODES:
            table = table.astype("<f4" if table.dtype.kind == "f" else "<u4")
        self.accessors.append(
            {
                "bufferView": self.add_view(table.tobytes()),
                "componentType": _CODES[table.dtype],
                "count": len(table),
                "type": _TYPES[table.shape[1]],
            }
        )
        return len(self.accessors) - 1

    def written(self, header: dict[str, Any]) -> bytes:
        """The file, with what the header has beside numbers and extensions."""
        left_out = ("animations", "skins", "extensionsRequired", "extensionsUsed")
        plain = {key: value for key, value in header.items() if key not in left_out}
        plain |= {"accessors": self.accessors, "bufferViews": self.views}
        inside = "data:application/octet-stream;base64," + base64.b64encode(self.content).decode()
        plain["buffers"] = [{"byteLength": len(self.content), "uri": inside}]
        return json.dumps(plain).encode()


def _take_primitive(
    header: dict[str, Any], buffers: Buffers, primitive: dict[str, Any], out: _Content
) -> None:
    """Give a primitive new accessors, with the values as they are meant."""
    attributes = primitive["attributes"]
    arrays: dict[str, Numbers] = {}
    if DRACO in primitive.get("extensions", {}):
        arrays = buffers.draco(primitive)
        primitive["mode"] = _TRIANGLES  # also of strips
        attributes["indices"] = -1
    elif "indices" in primitive:
        attributes["indices"] = primitive["indices"]

    def values(name: str) -> Numbers:
        return arrays[name] if name in arrays else buffers.read(attributes[name])

    chosen, turn, offset = _texture_change(header, primitive)
    if chosen in attributes and (chosen != "TEXCOORD_0" or turn is not None):
        coordinates = values(chosen).astype(np.float64)
        if turn is not None:
            coordinates = coordinates @ turn.T + offset
        arrays["TEXCOORD_0"], attributes["TEXCOORD_0"] = coordinates.astype("<f4"), -1
    if primitive.get("mode") == _FAN:
        order = (
            values("indices").reshape(-1).astype(np.int64)
            if "indices" in attributes
            else np.arange(len(values("POSITION")))
        )
        middle = np.full(max(len(order) - 2, 0), order[0])
        arrays["indices"] = np.column_stack([middle, order[1:-1], order[2:]]).reshape(-1)
        attributes["indices"], primitive["mode"] = -1, _TRIANGLES
    taken = {}
    for name in (*_READ, "indices"):
        if name in arrays:
            taken[name] = out.add(arrays[name])
        elif name in attributes:
            if attributes[name] not in out.known:
                out.known[attributes[name]] = out.add(values(name))
            taken[name] = out.known[attributes[name]]
    if "indices" in taken:
        primitive["indices"] = taken.pop("indices")
    primitive["attributes"] = taken
    primitive.pop("extensions", None)
    primitive.pop("targets", None)


def _attributes(primitive: dict[str, Any]) -> dict[str, int]:
    value = primitive.get("attributes")
    return value if isinstance(value, dict) else {}


def _drop_empty(header: dict[str, Any]) -> list[str]:
    """Primitives without positions, and meshes without primitives."""
    lost, empty = 0, set()
    for number, mesh in enumerate(header.get("meshes", [])):
        kept = [p for p in mesh["primitives"] if "POSITION" in _attributes(p)]
        lost += len(mesh["primitives"]) - len(kept)
        mesh["primitives"] = kept
        if not kept:
            empty.add(number)
    for node in header.get("nodes", []):
        if node.get("mesh") in empty:
            del node["mesh"]
    return [f"{counted(lost, 'primitive')} without positions left out."] if lost else []


def _take_gloss(material: dict[str, Any]) -> None:
    """The diffuse colour of a specular–glossiness material as base colour."""
    gloss = material.get("extensions", {}).pop(_GLOSS, None)
    if gloss is None:
        return
    plain = {"baseColorFactor": gloss.get("diffuseFactor", [1.0, 1.0, 1.0, 1.0])}
    if "diffuseTexture" in gloss:
        plain["baseColorTexture"] = gloss["diffuseTexture"]
    material["pbrMetallicRoughness"] = plain


def _texture_change(
    header: dict[str, Any], primitive: dict[str, Any]
) -> tuple[str, Numbers | None, Numbers]:
    """The coordinates that the base colour uses, and how it turns and shifts them."""
    material = header["materials"][primitive["material"]] if "material" in primitive else {}
    texture = material.get("pbrMetallicRoughness", {}).get("baseColorTexture", {})
    change = texture.get("extensions", {}).get(_TRANSFORM)
    chosen = (change or {}).get("texCoord", texture.get("texCoord", 0))
    if change is None:
        return f"TEXCOORD_{chosen}", None, np.zeros(2)
    angle, scale = change.get("rotation", 0.0), change.get("scale", (1.0, 1.0))
    cosine, sine = math.cos(angle), math.sin(angle)
    # Source: KHR_texture_transform: translation · rotation · scale; its example shows the sign
    turn = np.array([[cosine, sine], [-sine, cosine]]) * scale
    return f"TEXCOORD_{chosen}", turn, np.array(change.get("offset", (0.0, 0.0)))


def _repeat(header: dict[str, Any], buffers: Buffers) -> int:
    """Nodes with instances get a child for each."""
    total, nodes = 0, header.get("nodes", [])
    for node in list(nodes):
        given = node.get("extensions", {}).pop(INSTANCES, None)
        if given is None or "mesh" not in node:
            continue
        parts = {
            key: buffers.read(given["attributes"][name])
            for name, key in (("TRANSLATION", "translation"), ("ROTATION", "rotation"),
                              ("SCALE", "scale"))
            if name in given["attributes"]
        }  # fmt: skip
        mesh = node.pop("mesh")
        for k in range(min(map(len, parts.values()), default=1)):
            placed = {key: [float(x) for x in rows[k]] for key, rows in parts.items()}
            node.setdefault("children", []).append(len(nodes))
            nodes.append({"mesh": mesh, **placed})
            total += 1
    return total
