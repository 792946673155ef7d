"""TIFF files: their directories, one a picture, and stacks of pictures. EXIF has the same form."""

from __future__ import annotations

import mmap
import re
import struct
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from rendezview.errors import RendezviewError
from rendezview.io.sequences.picture import AS_STORED, Picture
from rendezview.io.sequences.quiet import quiet_opencv

ORIENTATION = 274  # tags. Source: TIFF 6.0
_SUBFILE, _DESCRIPTION, _DATE = 254, 270, 306
_MOST_PAGES = 1_000_000  # Source: a chosen limit
_MOST_TAGS = 4096  # of a page that are read. Source: a chosen limit
_FIELDS = {3: "H", 4: "I"}  # of types that are read, beside text. Source: TIFF 6.0


class Tiff:
    """Where the tags of a file are; classic and BigTIFF, in both byte orders.

    Every method raises struct.error where the file is cut short.
    """

    def __init__(self, content: Any) -> None:
        self._content = content
        order = "<" if content[:2] == b"II" else ">"
        self.big = struct.unpack_from(f"{order}H", content, 2)[0] == 43
        self._start = 8 if self.big else 4  # place of the first directory's offset
        self._offset, self._count = (order + "Q", order + "Q") if self.big else (
            order + "I", order + "H",
        )  # fmt: skip
        self._entry = order + ("HHQ" if self.big else "HHI")
        self._order = order

    def pages(self) -> Iterator[int]:
        """Places of the directories, each once."""
        seen: set[int] = set()
        (place,) = self._unpack(self._offset, self._start)
        while place and place not in seen and len(seen) < _MOST_PAGES:
            seen.add(place)
            yield place
            (place,) = self._unpack(self._offset, self._next(place))

    def whole_pages(self) -> list[int]:
        """Pages that are no smaller copies of others, as thumbnails are; else all."""
        pages = list(self.pages())
        return [page for page in pages if not (self.number(page, _SUBFILE) or 0) & 1] or pages

    def number(self, page: int, tag: int) -> int | None:
        """The value of a whole number."""
        found = self.place(page, tag)
        if found is None or found[1] not in _FIELDS:
            return None
        return int(self._unpack(self._order + _FIELDS[found[1]], found[0])[0])

    def text(self, page: int, tag: int) -> str:
        """The value of a text; empty without one."""
        found = self.place(page, tag)
        if found is None or found[1] != 2:
            return ""
        place, _, count = found
        if count > struct.calcsize(self._offset):
            (place,) = self._unpack(self._offset, place)
        return bytes(self._content[place : place + count]).rstrip(b"\0").decode("utf-8", "replace")

    def place(self, page: int, tag: int) -> tuple[int, int, int] | None:
        """Place of a tag's value, its type and its count."""
        (count,) = self._unpack(self._count, page)
        step = struct.calcsize(self._entry) + struct.calcsize(self._offset)
        first = page + struct.calcsize(self._count)
        for place in range(first, first + step * min(count, _MOST_TAGS), step):
            name, kind, length = self._unpack(self._entry, place)
            if name == tag:
                return place + struct.calcsize(self._entry), kind, length
        return None

    def show(self, page: int) -> None:
        """Make a page the first one, and leave its orientation as stored; changes the content."""
        struct.pack_into(self._offset, self._content, self._start, page)
        turned = self.place(page, ORIENTATION)
        if turned is not None:
            struct.pack_into(self._order + "H", self._content, turned[0], 1)

    def _unpack(self, form: str, place: int) -> tuple[int, ...]:
        if place > len(self._content):
            raise struct.error("a directory is beyond its end")
        return struct.unpack_from(form, self._content, place)

    def _next(self, page: int) -> int:
        (count,) = self._unpack(self._count, page)
        step = struct.calcsize(self._entry) + struct.calcsize(self._offset)
        return int(page + struct.calcsize(self._count) + step * count)


def tiff_pictures(path: Path) -> tuple[list[Picture], list[str]]:
    """The pages of a file, with times where the file has them, and notes.

    Raises:
        RendezviewError: it cannot be read, or is a stack of ImageJ without directories.
    """
    with _mapped(path) as content:
        tiff = Tiff(content)
        pages = tiff.whole_pages()
        about = tiff.text(pages[0], _DESCRIPTION) if pages else ""
        turns = [tiff.number(page, ORIENTATION) or 1 for page in pages]
        dates = [tiff.text(page, _DATE) for page in pages]
    notes = []
    announced = re.search(r"^images=(\d+)\s*$", about, re.MULTILINE)
    if announced and len(pages) == 1 and int(announced[1]) > 1:
        raise RendezviewError(
            f"{path}: ImageJ keeps its {announced[1]} pictures without directories: save the stack "
            "in parts of less than 4 GB, or as an image sequence"
        )
    channels = re.search(r"^channels=(\d+)\s*$", about, re.MULTILINE)
    if channels and int(channels[1]) > 1:
        notes.append(f"{path.name} has {channels[1]} channels, which are taken as pictures in time")
    times_s = _times_s(about, dates)
    several = len(pages) > 1
    return [
        Picture(path, f"{path.name}, page {k}" if several else path.name, page, time_s, turned)
        for k, (page, time_s, turned) in enumerate(zip(pages, times_s, turns, strict=True))
    ], notes


def read_tiff(path: Path, page: int) -> npt.NDArray[Any] | None:
    """One page as grey (height, width) levels, of its own type; None if it is damaged."""
    with _mapped(path) as content:
        Tiff(content).show(page)
        data = np.frombuffer(content, dtype=np.uint8)
        try:
            with quiet_opencv():
                return cv2.imdecode(data, AS_STORED)
        except cv2.error:
            return None
        finally:
            del data  # or the file cannot be closed


def _mapped(path: Path) -> mmap.mmap:
    """The file, to be changed in memory only."""
    with path.open("rb") as stream:
        return mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_COPY)


def _times_s(about: str, dates: list[str]) -> list[float | None]:
    """Times of the pages: OME's, ImageJ's interval, or the date of each; None without."""
    deltas = re.findall(r'<Plane\b[^>]*?\bDeltaT="([^"]+)"', about)
    if len(deltas) == len(dates) and 'DeltaTUnit="ms"' not in about:
        return [float(delta) for delta in deltas]
    interval = re.search(r"^finterval=([\d.eE+-]+)\s*$", about, re.MULTILINE)
    if interval and float(interval[1]) > 0.0:
        return [k * float(interval[1]) for k in range(len(dates))]
    try:
        stamps = [datetime.strptime(date, "%Y:%m:%d %H:%M:%S") for date in dates]
    except ValueError:
        return [None] * len(dates)
    if len(set(stamps)) < len(stamps):  # whole seconds: too coarse for these frames
        return [None] * len(dates)
    return [stamp.replace(tzinfo=UTC).timestamp() for stamp in stamps]
