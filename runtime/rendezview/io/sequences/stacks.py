"""Files that may hold several pictures or levels beyond 16 bits: FITS, TIFF stacks.

A new format is a file with two functions, and its line in `FORMATS`.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy.typing as npt

from rendezview.errors import RendezviewError, explained
from rendezview.geometry.camera import Camera
from rendezview.io.grey_frame import eight_bits
from rendezview.io.sequences.fits import FITS_ENDINGS, fits_pictures, read_fits
from rendezview.io.sequences.fitting import fitted_levels, sampled
from rendezview.io.sequences.frame import GreyImage, Sequence
from rendezview.io.sequences.picture import Picture, counts, unit_of
from rendezview.io.sequences.picture_marks import Marks
from rendezview.io.sequences.tiff import read_tiff, tiff_pictures

TIFF_ENDINGS = (".tif", ".tiff")
_DAMAGED = -1  # place of a picture that is not found in its file. Source: by construction
_FAULTS = (OSError, ValueError, struct.error)  # of readers, over any bytes
_WRONG = "not a picture that can be read, damaged, cut short or of another kind"


@dataclass(frozen=True, slots=True)
class Format:
    """How the pictures of a file are found, with notes, and one of them is read by its place."""

    pictures: Callable[[Path], tuple[list[Picture], list[str]]]
    read: Callable[[Path, int], npt.NDArray[Any] | None]  # (height, width), None: damaged


FORMATS: dict[str, Format] = {
    **dict.fromkeys(FITS_ENDINGS, Format(fits_pictures, read_fits)),
    **dict.fromkeys(TIFF_ENDINGS, Format(tiff_pictures, read_tiff)),
}


def has_format(path: Path) -> bool:
    """Whether a file is of one of `FORMATS`, by its name."""
    return path.name.lower().endswith(tuple(FORMATS))


def open_stacks(paths: list[Path], camera: Camera, source: Path) -> Sequence:
    """The pictures of files as one sequence, numbered from 0 in the order of the files.

    Args:
        paths: all of formats of `FORMATS`.
        camera: of all pictures.
        source: for the sequence.

    Raises:
        RendezviewError: a file cannot be read, or the camera fits none of the pictures.
    """
    pictures: list[Picture] = []
    notes: dict[str, None] = {}
    for path in paths:
        try:
            found, said = _listed(path)
        except RendezviewError:
            if len(paths) == 1:
                raise
            found, said = [Picture(path, path.name, _DAMAGED)], []
        pictures += found
        notes.update(dict.fromkeys(said))
    samples: list[npt.NDArray[Any]] = []
    marks: list[Marks] = []
    for place in sampled(len(pictures)):
        try:
            samples.append(_levels(pictures[place]))
        except RendezviewError:
            if not samples and place == len(pictures) - 1:
                raise
            continue
        marks.append(Marks(pictures[place].orientation))
    unit = unit_of(samples)
    bits, more = fitted_levels(
        [counts(sample, unit) for sample in samples], marks, camera, paths[0].parent
    )
    if unit != 1.0 and unit != 65_535.0:
        notes[f"levels beyond 16 bits: {1.0 / unit:g} of them are one"] = None
    read = ((p.name, p.time_s, partial(_read, p, unit, bits or 16)) for p in pictures)
    return Sequence.of_pictures(source, camera, read, (*notes, *more))


def first_levels(path: Path) -> npt.NDArray[Any]:
    """The levels of a file's first picture (height, width), of their own type.

    Raises:
        RendezviewError: it cannot be read.
    """
    return _levels(_listed(path)[0][0])


def _format(path: Path) -> Format:
    name = path.name.lower()
    return next(found for ending, found in FORMATS.items() if name.endswith(ending))


def _listed(path: Path) -> tuple[list[Picture], list[str]]:
    with explained(f"{path}: {_WRONG} (", "): replace the file", _FAULTS):
        pictures, notes = _format(path).pictures(path)
    if not pictures:
        raise RendezviewError(f"{path}: {_WRONG}: replace the file")
    return pictures, notes


def _levels(picture: Picture) -> npt.NDArray[Any]:
    if picture.place == _DAMAGED:
        _listed(picture.path)  # says what is wrong
    with explained(f"{picture.path}: {_WRONG} (", "): replace the file", _FAULTS):
        levels = _format(picture.path).read(picture.path, picture.place)
    if levels is None or levels.ndim != 2:
        raise RendezviewError(
            f"{picture.path}: {picture.name} cannot be read: it is damaged, or of a packing or "
            "depth that is not read: store it as PNG or TIFF of 8 or 16 bits"
        )
    return levels


def _read(picture: Picture, unit: float, bits: int) -> GreyImage:
    with explained(f"{picture.name}: ", faults=RendezviewError):
        return eight_bits(counts(_levels(picture), unit), bits)
