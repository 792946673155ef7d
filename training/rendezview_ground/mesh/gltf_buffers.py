"""The numbers in a glTF file: buffers, packed views, sparse and quantised accessors."""

from __future__ import annotations

import base64
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from rendezview.errors import optional

# Source: glTF 2.0, 3.6.2.2, component types
KINDS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
MESHOPT = ("EXT_meshopt_compression", "KHR_meshopt_compression")
DRACO = "KHR_draco_mesh_compression"
_MOST_BYTES = 2**31  # of an accessor. Source: a chosen limit
Numbers = NDArray[Any]


class Buffers:
    """The accessors of a file as arrays.

    Args:
        path: of the file, beside which other buffers are.
        header: its JSON.
        place: where the binary part of a GLB file starts, bytes.
    """

    def __init__(self, path: Path, header: dict[str, Any], place: int) -> None:
        self._path, self._header = path, header
        self._blobs: list[bytes] = []
        self._views: dict[int, bytes] = {}
        for buffer in header.get("buffers", []):
            uri = buffer.get("uri")
            if uri is None:
                self._blobs.append(b"" if self._blobs else path.read_bytes()[place:])
            elif uri.startswith("data:"):
                self._blobs.append(base64.b64decode(uri.split(",", 1)[1]))
            else:
                self._blobs.append((path.parent / unquote(uri)).read_bytes())

    def read(self, index: int) -> Numbers:
        """(count, width) numbers of an accessor; whole numbers that mean fractions are these."""
        accessor = self._header["accessors"][index]
        count, width = accessor["count"], _WIDTHS[accessor["type"]]
        kind = np.dtype(KINDS[accessor["componentType"]])
        if count * width * kind.itemsize > _MOST_BYTES:
            raise ValueError(f"an accessor of {count} entries is too large")
        if "bufferView" in accessor:
            view = self._header["bufferViews"][accessor["bufferView"]]
            start, stride = accessor.get("byteOffset", 0), view.get("byteStride", 0)
            values = _table(self.view(accessor["bufferView"]), kind, count, width, start, stride)
        else:
            values = np.zeros((count, width), kind)
        sparse = accessor.get("sparse")
        if sparse is not None:
            where, what = sparse["indices"], sparse["values"]
            rows = _table(
                self.view(where["bufferView"]), np.dtype(KINDS[where["componentType"]]),
                sparse["count"], 1, where.get("byteOffset", 0),
            )  # fmt: skip
            values[rows[:, 0]] = _table(
                self.view(what["bufferView"]), kind, sparse["count"], width,
                what.get("byteOffset", 0),
            )  # fmt: skip
        return _fractions(values, accessor)

    def view(self, index: int) -> bytes:
        """The bytes of a buffer view, unpacked."""
        if index not in self._views:
            view = self._header["bufferViews"][index]
            packed = next((view.get("extensions", {}).get(n) for n in MESHOPT
                           if n in view.get("extensions", {})), None)  # fmt: skip
            part = view if packed is None else packed
            start = part.get("byteOffset", 0)
            found = self._blobs[part["buffer"]][start : start + part["byteLength"]]
            self._views[index] = found if packed is None else self._meshopt(packed, found)
        return self._views[index]

    def draco(self, primitive: dict[str, Any]) -> dict[str, Numbers]:
        """The attributes of a Draco primitive by name, and its ``indices``."""
        with self._package(DRACO):
            import DracoPy
        packed = primitive["extensions"][DRACO]
        found = DracoPy.decode(self.view(packed["bufferView"]))
        names = {number: name for name, number in packed["attributes"].items()}
        arrays = {"indices": np.asarray(found.faces).reshape(-1).astype("<u4")}
        for attribute in found.attributes:
            name = names.get(attribute["unique_id"])
            if name is not None:
                accessor = self._header["accessors"][primitive["attributes"][name]]
                arrays[name] = _fractions(np.asarray(attribute["data"]), accessor)
        return arrays

    def _meshopt(self, packed: dict[str, Any], content: bytes) -> bytes:
        with self._package(MESHOPT[0]):
            import meshoptimizer
        count, stride = packed["count"], packed["byteStride"]
        if packed["mode"] == "ATTRIBUTES":
            kind = np.dtype((np.void, stride))
            table = meshoptimizer.decode_vertex_buffer(count, stride, content, dtype=kind)
            if packed.get("filter", "NONE") == "EXPONENTIAL":  # the others are not of positions
                words = table.view("<i4")
                exponents = words >> 24
                numbers = np.ldexp(((words << 8) >> 8).astype(np.float64), exponents)
                return bytes(numbers.astype("<f4").tobytes())
            return bytes(table.tobytes())
        decode = {
            "TRIANGLES": meshoptimizer.decode_index_buffer,
            "INDICES": meshoptimizer.decode_index_sequence,
        }[packed["mode"]]
        return bytes(np.asarray(decode(count, 4, content)).astype(f"<u{stride}").tobytes())

    def _package(self, extension: str) -> AbstractContextManager[None]:
        """Of the package that unpacks an extension."""
        who = f"{self._path}: its geometry is compressed ({extension}): it needs"
        return optional(who, "gltf", instead=", or export it without compression")


def _fractions(values: Numbers, accessor: dict[str, Any]) -> Numbers:
    """Whole numbers that mean fractions as these. Source: glTF 2.0, 3.11."""
    if not accessor.get("normalized") or values.dtype.kind not in "iu":
        return values
    return np.maximum(values / np.iinfo(values.dtype).max, -1.0).astype("<f4")


def _table(
    content: bytes, kind: np.dtype[Any], count: int, width: int, start: int, stride: int = 0
) -> Numbers:
    """(count, width) numbers, ``stride`` bytes from row to row (0: none between)."""
    row = width * kind.itemsize
    step = stride or row
    length = step * (count - 1) + row if count else 0
    if start + length > len(content):
        raise ValueError(f"{count} entries of {row} bytes are not in a view of {len(content)}")
    data = np.frombuffer(content, np.uint8, length, start)
    rows = np.lib.stride_tricks.as_strided(data, (count, row), (step, 1))
    return np.array(np.ascontiguousarray(rows).view(kind))
