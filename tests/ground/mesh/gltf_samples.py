"""Small GLB files, put together accessor by accessor."""

from __future__ import annotations

import io
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

CODES = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
# A wedge of 2 × 4 × 1.
CORNERS = np.array(
    [[-1, -2, 0], [1, -2, 0], [1, 2, 0], [-1, 2, 0], [-1, -2, 1], [1, -2, 1]], np.float32
)
FACES = np.array(
    [[0, 2, 1], [0, 3, 2], [0, 1, 5], [0, 5, 4], [4, 5, 2], [4, 2, 3], [1, 2, 5], [0, 4, 3]],
    np.uint16,
)


class Glb:
    """A file with one node and one mesh, whose primitives and extensions a test adds."""

    def __init__(self) -> None:
        self.content = bytearray()
        self.header: dict[str, Any] = {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "meshes": [{"primitives": []}],
            "accessors": [],
            "bufferViews": [],
        }

    def view(self, content: bytes, **more: Any) -> int:
        place = len(self.content)
        self.content += content + bytes(-len(content) % 4)
        entry = {"buffer": 0, "byteOffset": place, "byteLength": len(content)}
        self.header["bufferViews"].append(entry | more)
        return len(self.header["bufferViews"]) - 1

    def accessor(self, values: np.ndarray, view: int | None = -1, **more: Any) -> int:
        """The number of an accessor; its view is made, or given, or None."""
        table = np.ascontiguousarray(values).reshape(len(values), -1)
        entry = {"componentType": CODES[table.dtype.str[1:]], "count": len(table),
                 "type": TYPES[table.shape[1]]}  # fmt: skip
        if view is not None:
            entry["bufferView"] = self.view(table.tobytes()) if view == -1 else view
        self.header["accessors"].append(entry | more)
        return len(self.header["accessors"]) - 1

    def primitive(self, positions: int | None, **more: Any) -> dict[str, Any]:
        entry: dict[str, Any] = {"attributes": {}, "indices": self.accessor(FACES.reshape(-1))}
        if positions is not None:
            entry["attributes"]["POSITION"] = positions
        self.header["meshes"][0]["primitives"].append(entry | more)
        return entry | more

    def texture(self, **more: Any) -> dict[str, Any]:
        """A texture whose left half is red, its right half green, its lower rows blue."""
        pixels = np.zeros((8, 8, 3), np.uint8)
        pixels[:, :4, 0] = pixels[:, 4:, 1] = 255
        pixels[4:] = [0, 0, 255]
        packed = io.BytesIO()
        Image.fromarray(pixels).save(packed, "png")
        image = {"bufferView": self.view(packed.getvalue()), "mimeType": "image/png"}
        self.header |= {"images": [image], "textures": [{"source": 0}]}
        return {"index": 0} | more

    def write(self, path: Path) -> Path:
        self.header["buffers"] = [{"byteLength": len(self.content)}]
        text = json.dumps(self.header).encode()
        text += b" " * (-len(text) % 4)
        total = 28 + len(text) + len(self.content)
        path.write_bytes(
            struct.pack("<4sIIII", b"glTF", 2, total, len(text), 0x4E4F534A)
            + text
            + struct.pack("<II", len(self.content), 0x004E4942)
            + self.content
        )
        return path
