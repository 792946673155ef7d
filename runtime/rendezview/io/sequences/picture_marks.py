"""What the file of a picture says beside its levels: orientation, further pages, transparency."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from rendezview.io.sequences.tiff import ORIENTATION, Tiff

_TURNS = {
    2: "mirrored", 3: "by 180°", 4: "mirrored", 5: "mirrored, by 90°", 6: "by 90°",
    7: "mirrored, by 90°", 8: "by 270°",
}  # fmt: skip
_PNG = b"\x89PNG\r\n\x1a\n"
_ALPHA_TYPES = (4, 6)  # Source: PNG, table 11.1
_TIFF = (b"II", b"MM")
_SEGMENTS = range(0xE0, 0xF0)  # Source: JPEG, APP0 to APP15
_WEBP_ALPHA = 0x10  # Source: WebP container, VP8X flags; the lossless header, its last byte


@dataclass(frozen=True, slots=True)
class Marks:
    """Of one file; what its kind does not have is the default."""

    orientation: int = 1  # of EXIF
    pages: int = 1
    transparent: bool = False  # has a channel for it


def marks_of(content: bytes) -> Marks:
    """The marks of a PNG, JPEG, TIFF or WebP; those of a damaged file may be wrong."""
    try:
        if content.startswith(_PNG):
            return _png(content)
        if content.startswith(b"\xff\xd8"):
            return _jpeg(content)
        if content[:2] in _TIFF:
            return Marks(_orientation(content), max(len(Tiff(content).whole_pages()), 1))
        if content.startswith(b"RIFF") and content[8:12] == b"WEBP":
            return _webp(content)
    except (struct.error, IndexError):
        pass
    return Marks()


def tiff_as_stored(content: bytes) -> bytes:
    """A TIFF that does not ask to be turned: its decoder would do it."""
    changed = bytearray(content)
    try:
        if _orientation(content) == 1:
            return content
        tiff = Tiff(changed)
        tiff.show(next(tiff.pages()))
    except struct.error:
        return content
    return bytes(changed)


def mark_notes(marks: Iterable[Marks]) -> tuple[str, ...]:
    """What a user should know of some pictures of a sequence."""
    found = list(marks)
    turned = Counter(mark.orientation for mark in found if mark.orientation in _TURNS)
    notes = [
        f"the pictures ask to be shown turned ({_TURNS[kind]}, EXIF orientation {kind}), which is "
        "not done: the camera must be calibrated with pictures as they are stored"
        for kind in turned
    ]
    pages = max((mark.pages for mark in found), default=1)
    if pages > 1:
        notes.append(f"files hold {pages} pictures each: the first is read; split them into files")
    return tuple(notes)


def _png(content: bytes) -> Marks:
    chunks = list(_chunks(content))
    kinds = [kind for kind, _ in chunks]
    exif = next((data for kind, data in chunks if kind == b"eXIf"), b"")
    transparent = content[25] in _ALPHA_TYPES or b"tRNS" in kinds
    return Marks(_orientation(exif) if exif else 1, 1, transparent)


def _chunks(content: bytes) -> Iterator[tuple[bytes, bytes]]:
    place = len(_PNG)
    while place + 12 <= len(content):
        length, kind = struct.unpack_from(">I4s", content, place)
        yield kind, content[place + 8 : place + 8 + min(length, 65_536)]
        place += 12 + length


def _jpeg(content: bytes) -> Marks:
    place = 2
    while content[place] == 0xFF and content[place + 1] in _SEGMENTS:
        (length,) = struct.unpack_from(">H", content, place + 2)
        if content[place + 4 : place + 10] == b"Exif\0\0":
            return Marks(_orientation(content[place + 10 : place + 2 + length]))
        place += 2 + length
    return Marks()


def _webp(content: bytes) -> Marks:
    place, pages, orientation, transparent = 12, 0, 1, False
    while place + 8 <= len(content):
        kind, length = struct.unpack_from("<4sI", content, place)
        if kind == b"ANMF":
            pages += 1
        elif kind == b"VP8X":
            transparent = bool(content[place + 8] & _WEBP_ALPHA)
        elif kind == b"VP8L":
            transparent |= bool(content[place + 12] & _WEBP_ALPHA)
        elif kind == b"EXIF":
            data = content[place + 8 : place + 8 + length]
            orientation = _orientation(data.removeprefix(b"Exif\0\0"))
        place += 8 + length + length % 2
    return Marks(orientation, max(pages, 1), transparent)


def _orientation(content: bytes) -> int:
    """Of the first directory of a TIFF, or of EXIF; 1 without."""
    tiff = Tiff(content)
    first = next(tiff.pages(), None)
    return 1 if first is None else tiff.number(first, ORIENTATION) or 1
