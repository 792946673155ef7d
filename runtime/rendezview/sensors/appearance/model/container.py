"""The bytes of a model file: named arrays and a JSON header, nothing that can execute.

Why no other format: files in this one must stay readable, so a second one would only add code.

Layout, little-endian: ``RVM\\n``, u32 format version, u64 header length, header (JSON,
UTF-8, keys sorted), the arrays at multiples of 64 bytes, SHA-256 of everything before
it. The same content always gives the same bytes.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import struct
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rendezview.errors import RendezviewError, explained
from rendezview.io.files import atomic_write, check_regular

MAGIC = b"RVM\n"
VERSION = 1  # of the format. Source: by construction
_PREFIX = struct.Struct("<4sIQ")
_ALIGN = 64  # bytes; each array starts at a multiple. Source: by construction
_DIGEST_BYTES = hashlib.sha256().digest_size
_READ_AT_ONCE = 1 << 20  # bytes. Source: by construction, a buffer of 1 MiB
_DTYPES = ("|u1", "|i1", "<u2", "<i2", "<i4", "<i8", "<f4", "<f8")


def write_container(
    path: Path, header: Mapping[str, Any], arrays: Mapping[str, npt.NDArray[Any]]
) -> None:
    """Write header and arrays, atomically.

    Raises:
        RendezviewError: the file cannot be written (the reason is said).
        ValueError: an array has a type that the format has not.
    """
    digest = hashlib.sha256()
    with atomic_write(path) as file:
        for chunk in _chunks(header, arrays):
            digest.update(chunk)
            file.write(chunk)
        file.write(digest.digest())


def _chunks(header: Mapping[str, Any], arrays: Mapping[str, npt.NDArray[Any]]) -> list[bytes]:
    table, blobs, offset = [], [], 0
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        if array.dtype.str not in _DTYPES:
            raise ValueError(f"a model file cannot hold {name} of type {array.dtype}")
        blob = array.tobytes()
        table.append(
            {"name": name, "dtype": array.dtype.str, "shape": list(array.shape), "offset": offset}
        )
        padded = blob + bytes(-len(blob) % _ALIGN)
        blobs.append(padded)
        offset += len(padded)
    text = json.dumps(
        {"arrays": table, "bytes": offset, "header": header},
        sort_keys=True,
        allow_nan=False,
        separators=(",", ":"),
    ).encode()
    text += b" " * (-(_PREFIX.size + len(text)) % _ALIGN)
    return [_PREFIX.pack(MAGIC, VERSION, len(text)), text, *blobs]


def read_container(path: Path) -> tuple[dict[str, Any], dict[str, npt.NDArray[Any]]]:
    """Read header and arrays (read-only) and check every byte against the checksum.

    Raises:
        RendezviewError: no such file, another kind of file, a newer version, cut off,
            or damaged.
    """
    try:
        data, digest = _read(path)
    except FileNotFoundError:
        raise RendezviewError(f"{path}: no such model file") from None
    except OSError as error:
        raise RendezviewError(f"{path}: {error.strerror or error}") from None
    if len(data) < _PREFIX.size:
        raise RendezviewError(f"{path}: the model file is cut off; train or copy it again")
    _, version, length = _PREFIX.unpack_from(data)
    if version > VERSION:
        raise RendezviewError(
            f"{path}: the model has format {version}, this program reads up to {VERSION}: "
            "update rendezview or train again"
        )
    body = _PREFIX.size + length
    try:
        description = json.loads(bytes(data[_PREFIX.size : body]))
        total = body + int(description["bytes"])
        table, header = list(description["arrays"]), dict(description["header"])
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError):
        raise RendezviewError(
            f"{path}: the model file is cut off or damaged in its header; train or copy it again"
        ) from None
    if len(data) != total + _DIGEST_BYTES:
        raise RendezviewError(
            f"{path}: the model file has {len(data)} bytes instead of {total + _DIGEST_BYTES}: "
            "it is cut off; train or copy it again"
        )
    if digest != data[total:]:
        raise RendezviewError(f"{path}: the model file is damaged (checksum); copy it again")
    faults = (ValueError, KeyError, TypeError, OverflowError)
    with explained(f"{path}: the model file's table is wrong: ", faults=faults):
        arrays = {str(entry["name"]): _array(data, body, total, entry) for entry in table}
    return header, arrays


def _read(path: Path) -> tuple[memoryview, bytes]:
    """The file, read-only, and the SHA-256 of all its bytes but the stored checksum.

    A second thread computes the checksum of one block while the next is read.
    """
    check_regular(path, "a model")
    with path.open("rb", buffering=0) as file, ThreadPoolExecutor(1) as pool:
        if file.read(len(MAGIC)) != MAGIC:  # before a large file of another kind is read
            said = "not a rendezview model; make one with `rendezview train`"
            raise RendezviewError(f"{path}: {said}")
        file.seek(0)
        size = os.fstat(file.fileno()).st_size
        buffer: npt.NDArray[np.uint8] = np.empty(size, dtype=np.uint8)
        data = buffer.data
        checksum = hashlib.sha256()
        end = max(0, size - _DIGEST_BYTES)
        done, sums = 0, []
        while done < size:
            count = file.readinto(data[done : done + _READ_AT_ONCE])
            if not count:
                break
            sums.append(pool.submit(checksum.update, data[min(done, end) : min(done + count, end)]))
            done += count
        for each in sums:
            each.result()
    buffer.flags.writeable = False
    return buffer.data[:done], checksum.digest()


def check_shapes(part: str, owner: object, /, **wanted: tuple[int, ...]) -> None:
    """Arrays of a part of a model have the shapes that belong together.

    Raises:
        ValueError: one has not; which one is said.
    """
    for name, shape in wanted.items():
        found = getattr(owner, name).shape
        if found != shape:
            raise ValueError(f"{part}.{name} has shape {found} instead of {shape}")


def _array(data: memoryview, body: int, end: int, entry: dict[str, Any]) -> npt.NDArray[Any]:
    if entry["dtype"] not in _DTYPES:
        raise ValueError(entry["dtype"])
    dtype = np.dtype(entry["dtype"])
    shape, start = tuple(int(n) for n in entry["shape"]), body + int(entry["offset"])
    count = math.prod(shape)
    if min(shape, default=0) < 0 or start < body or start + count * dtype.itemsize > end:
        raise ValueError(f"{entry['name']} lies outside the file")
    return np.frombuffer(data, dtype=dtype, count=count, offset=start).reshape(shape)
