"""Damaged and hostile pictures for the decoders themselves, without a service around them.

Of test_fuzz.py, and by the hundred thousand of experiment service-faults.
"""

from __future__ import annotations

import faulthandler
import os
import struct
import tempfile
import time
import zlib
from collections import Counter
from collections.abc import Callable
from io import BytesIO
from pathlib import Path

import cv2
import numpy as np
from tests.service.fuzz import MOST_MB, PEAK_EVERY, forget_peak, peak_mb
from tests.service.fuzz_cases import CAMERA, Cases
from tests.service.hostile_pictures import chunk, png, rows_of

from rendezview.errors import RendezviewError
from rendezview.io.sequences.decoding import PNG, decode_grey
from rendezview.io.sequences.stacks import first_levels
from rendezview_service.messages.frames import read_frame
from rendezview_service.worker.worker import decoding_s

_HANGS_S = 300.0  # s without a look at the peak of memory: the process shows where, and ends
_HOSTILE = 0.1  # share of hostile pictures, which are damaged, too, half of the time
_STACKS = 0.04  # share of files that may hold several pictures, FITS and TIFF: they cost most


def sealed(content: bytes) -> bytes:
    """A damaged PNG whose chunks have right checksums, so that a decoder reads them."""
    parts, place = [content[: len(PNG)]], len(PNG)
    while place + 12 <= len(content):
        (length,) = struct.unpack(">I", content[place : place + 4])
        length = min(length, len(content) - place - 12)
        start = place + 8
        parts.append(chunk(content[place + 4 : start], content[start : start + length]))
        place = start + length + 4
    return b"".join([*parts, chunk(b"IEND", b"")])


class Pictures(Cases):
    """Files of all kinds that are read, each damaged by chance."""

    def __init__(self, seed: int) -> None:
        super().__init__(seed)
        grey = self.rng.integers(0, 255, (120, 160), dtype=np.uint8) // 16
        self.grey = grey
        colours, deep = np.dstack([grey] * 3), grey.astype(np.uint16) * 257
        alpha = np.dstack([colours, grey])
        progressive = [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]
        made = [
            *((".png", one, []) for one in (grey, colours, alpha, deep)),
            *((".jpg", one, more) for one in (grey, colours) for more in ([], progressive)),
            (".jpg", grey, [cv2.IMWRITE_JPEG_RST_INTERVAL, 3]),
            *((".tiff", one, []) for one in (grey, colours, deep)),
            *((".tiff", deep, [cv2.IMWRITE_TIFF_COMPRESSION, how]) for how in (5, 8, 32773)),
            *((".webp", one, [cv2.IMWRITE_WEBP_QUALITY, how]) for one in (grey, alpha)
              for how in (50, 101)),
            (".bmp", grey, []), (".pgm", grey, []),
        ]  # fmt: skip
        self.files = [cv2.imencode(*one)[1].tobytes() for one in made]
        self.files.append(png(grey, zlib.compress(rows_of(grey)), interlaced=1))
        tiffs = [one for one in self.files if one[:2] in (b"II", b"MM")]
        self.stacks = [("tiff", one) for one in tiffs] + [("fits", one) for one in self._fits(grey)]

    @staticmethod
    def _fits(grey: np.ndarray) -> list[bytes]:
        """Plain and packed FITS files; none without astropy."""
        try:
            from astropy.io import fits
        except ImportError:
            return []
        found = []
        for unit in (fits.PrimaryHDU(grey), fits.CompImageHDU(grey.astype(np.int16))):
            unit.writeto(file := BytesIO())
            found.append(file.getvalue())
        return found

    def touched(self, content: bytes) -> bytes:
        """With one to four other bytes."""
        changed = bytearray(content)
        for place in self.rng.integers(0, len(changed), self.rng.integers(1, 5)):
            changed[place] = self.rng.integers(256)
        return bytes(changed)

    def picture(self) -> tuple[str, bytes]:
        """Its kind and a file."""
        rng = self.rng
        if rng.random() < _STACKS:
            kind, content = self.stacks[rng.integers(len(self.stacks))]
            return kind, self.damaged(content)
        if rng.random() < _HOSTILE:
            content = self.hostile[rng.integers(len(self.hostile))]
            if rng.random() < 0.5:
                return "hostile", content
        else:
            content = self.files[rng.integers(len(self.files))]
        if rng.random() < 0.1:
            return "png, rows", png(self.grey, zlib.compress(self.touched(rows_of(self.grey))))
        content = self.damaged(content) if rng.random() < 0.5 else self.touched(content)
        if content[:8] == PNG and rng.random() < 0.8:
            return "png, sealed", sealed(content)
        return "damaged", content


def campaign(seed: int, count: int) -> list[str]:
    """So many pictures as frames of a session and as files; what must not be.

    That is: an error other than `RendezviewError`, an image of another shape or type, more
    processor time than ends a process, or 200 MB for a frame. A decoder that crashes or hangs
    ends this process.
    """
    pictures, failures, outcomes = Pictures(seed), list[str](), Counter[str]()
    worst_s, worst_mb, before_mb, start_s = 0.0, 0.0, 0.0, time.monotonic()
    own = [os.getpid()]

    def give(kind: str, read: Callable[..., np.ndarray | None], *given: object) -> None:
        nonlocal worst_s
        before_s = time.process_time()
        try:
            image = read(*given)
            outcomes[f"{kind}: {'refused' if image is None else 'read'}"] += 1
            grey = read is first_levels or image is None or image.dtype == np.uint8
            if image is not None and not (grey and image.ndim == 2):
                failures.append(f"picture {k}, {kind}: {image.dtype} {image.shape}")
        except RendezviewError:
            outcomes[f"{kind}: refused"] += 1
        except Exception as error:  # the fault that is looked for
            failures.append(f"picture {k}, {kind}: {error!r}")
        spent_s = time.process_time() - before_s
        worst_s = max(worst_s, spent_s)
        if spent_s > decoding_s(CAMERA):
            failures.append(f"picture {k}, {kind}: {spent_s:.2f} s of processor time")

    with tempfile.TemporaryDirectory() as work:
        for k in range(count):
            if k % PEAK_EVERY == 0:
                faulthandler.dump_traceback_later(_HANGS_S, exit=True)
                forget_peak(own)
                before_mb = peak_mb(own)
            kind, content = pictures.picture()
            if kind in ("fits", "tiff"):
                file = Path(work) / f"picture.{kind}"
                file.write_bytes(content)
                give(f"stack, {kind}", first_levels, file)
                continue
            give(f"frame, {kind}", read_frame, content, CAMERA)
            grown_mb = peak_mb(own) - before_mb if k % PEAK_EVERY == PEAK_EVERY - 1 else 0.0
            worst_mb = max(worst_mb, grown_mb)
            if grown_mb > MOST_MB:
                failures.append(f"pictures to {k}: {grown_mb:.0f} MB more")
            give(f"file, {kind}", decode_grey, content)
    faulthandler.cancel_dump_traceback_later()
    spent_s = time.monotonic() - start_s
    print(f"seed {seed}: {count} pictures in {spent_s:.0f} s, {len(failures)} failures")
    print(", ".join(f"{name} {number}" for name, number in sorted(outcomes.items())))
    print(f"most for one {worst_s:.2f} s of processor time; for {PEAK_EVERY}, {worst_mb:.0f} MB")
    print(*failures[:20], sep="\n")
    return failures
