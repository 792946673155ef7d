"""Whether pictures fit their camera: size, and bits of 16-bit levels."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import BIT_DEPTHS, Camera
from rendezview.io.camera_files import load_camera
from rendezview.io.files import read_bytes
from rendezview.io.plausible import comb_doubts
from rendezview.io.sequences.decoding import Levels, decode_levels
from rendezview.io.sequences.misfit import misfit
from rendezview.io.sequences.picture_marks import Marks, mark_notes, marks_of

_SAMPLES = 5  # pictures of a sequence that are looked at before it runs. Source: a chosen limit
_MOST_CAMERA_FILES = 30  # that are read to name one that fits. Source: a chosen limit
_CAMERA_SUFFIXES = (".yaml", ".yml", ".json", ".xml")


def sampled(count: int) -> npt.NDArray[np.intp]:
    """Places, evenly spread, of the few of so many pictures that are looked at before a run."""
    return np.unique(np.linspace(0, count - 1, _SAMPLES).round().astype(np.intp))


def decoded(contents: Iterable[bytes]) -> tuple[list[Levels], list[Marks]]:
    """Levels and marks of the files that are pictures."""
    pictures: list[Levels] = []
    marks: list[Marks] = []
    for content in contents:
        picture = decode_levels(content)
        if picture is not None:
            pictures.append(picture)
            marks.append(marks_of(content))
    return pictures, marks


def fitted(
    paths: Sequence[Path], camera: Camera, folder: Path
) -> tuple[int | None, tuple[str, ...]]:
    """Bits of 16-bit levels (None: the levels have 8), and notes on the pictures.

    Some pictures from first to last are read, unreadable ones left out. The bits are those of the
    camera, else the fewest that hold all their levels. The sequence is read with this number, and a
    frame with a higher level is an error, not a guess.

    Raises:
        RendezviewError: the camera fits none of the pictures.
    """

    def readable() -> Iterator[bytes]:
        for place in sampled(len(paths)):
            with contextlib.suppress(RendezviewError):
                yield read_bytes(paths[place], "an image")

    pictures, marks = decoded(readable())
    return fitted_levels(pictures, marks, camera, folder)


def fitted_levels(
    pictures: Sequence[Levels], marks: Sequence[Marks], camera: Camera, folder: Path
) -> tuple[int | None, tuple[str, ...]]:
    """As `fitted`, of pictures that were read, and their marks."""
    check_sizes(pictures, camera, folder)
    bits, notes = _bits_of(pictures, camera)
    return bits, (*notes, *mark_notes(marks), *comb_doubts(pictures))


def _bits_of(pictures: Sequence[Levels], camera: Camera) -> tuple[int | None, tuple[str, ...]]:
    """Bits in use, and what a command says of a number that no file gives."""
    peaks = [int(picture.max()) for picture in pictures if picture.dtype == np.uint16]
    if not peaks or camera.bit_depth is not None:
        return camera.bit_depth if peaks else None, ()
    bits = next(bits for bits in BIT_DEPTHS if max(peaks) < 1 << bits)
    return bits, (
        f"the pictures have 16-bit levels, of which {bits} bits are used: put bit_depth into the "
        "camera file if that is wrong",
    )


def check_sizes(pictures: Iterable[Levels], camera: Camera, folder: Path) -> None:
    """Refuse a camera that fits none of the pictures.

    Raises:
        RendezviewError: with what would fit.
    """
    shapes = {picture.shape for picture in pictures}
    if not shapes or (camera.height, camera.width) in shapes:
        return
    height, width = sorted(shapes)[0]
    fitting = _files_that_fit(width, height, folder)
    beside = f"; {' and '.join(fitting)} would fit" if fitting else ""
    raise RendezviewError(f"{folder}: {misfit(width, height, camera)}{beside}")


def _files_that_fit(width: int, height: int, folder: Path) -> list[str]:
    """Camera files in the folder or beside it whose pictures have this size."""
    found = []
    candidates = (
        path
        for place in (folder, folder.resolve().parent)
        for path in sorted(place.glob("*"))
        if path.suffix.lower() in _CAMERA_SUFFIXES and path.is_file()
    )
    for path in itertools.islice(candidates, _MOST_CAMERA_FILES):
        try:
            camera = load_camera(path)
        except RendezviewError:
            continue
        if (camera.width, camera.height) == (width, height):
            found.append(str(path))
    return found
