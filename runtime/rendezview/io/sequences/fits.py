"""FITS files of space cameras and star trackers, read by astropy: pictures, cubes, times."""

from __future__ import annotations

import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rendezview.errors import RendezviewError
from rendezview.io.sequences.picture import Picture

FITS_ENDINGS = (
    ".fits", ".fit", ".fts", ".fits.gz", ".fit.gz", ".fts.gz", ".fits.fz", ".fit.fz",
)  # fmt: skip
_PLANES = 1_000_000  # the place of a picture is its unit × this + its plane. Source: chosen
_EXPOSURES = ("XPOSURE", "EXPTIME", "EXPOSURE")  # s. Source: FITS 4.0, section 9; others' use
_UNIX = datetime(1970, 1, 1, tzinfo=UTC)  # Source: POSIX
_KEYS = (
    "ROWORDER", "BAYERPAT", "CTYPE3", "CDELT3", "CUNIT3", "TIMESYS", "DATE-AVG", "DATE-BEG",
    "DATE-END", "DATE-OBS", "TIME-OBS", "UT", *_EXPOSURES,
)  # fmt: skip
_quiet = threading.Lock()  # filters of warnings are global


def fits_pictures(path: Path) -> tuple[list[Picture], list[str]]:
    """The pictures of a file, with the times of the middle of their exposures, and notes.

    Of several image units, those named as the first are read: others are errors, masks, weights.

    Raises:
        RendezviewError: astropy is not installed, the file is damaged or has no picture.
    """
    found: list[Picture] = []
    notes: list[str] = []
    with _opened(path) as units:
        images = [k for k, unit in enumerate(units) if unit.is_image and _planes(unit, path)]
        if not images:
            raise RendezviewError(f"{path}: no picture in it, only tables: give files of pictures")
        named = [k for k in images if units[k].name == units[images[0]].name]
        if not units[images[0]].name or units[images[0]].name == "PRIMARY":
            named = [k for k in images if units[k].name in ("", "PRIMARY")]
        if len(named) < len(images):
            left = ", ".join(sorted({units[k].name for k in images if k not in named}))
            notes.append(f"further units of the FITS files are left out: {left}")
        several = len(named) > 1 or _planes(units[named[0]], path) > 1
        for k in named:
            header = _header(units, k)
            planes = _planes(units[k], path)
            notes += _notes(header, planes)
            for plane, time_s in enumerate(_times_s(header, planes, path)):
                name = f"{path.name}, picture {len(found)}" if several else path.name
                found.append(Picture(path, name, k * _PLANES + plane, time_s))
    return found, notes


def read_fits(path: Path, place: int) -> npt.NDArray[Any]:
    """A picture (height, width), its levels by BSCALE and BZERO, the first row on top.

    Rows are as stored, which is from the top in camera files; ``ROWORDER = 'BOTTOM-UP'`` turns
    them.

    Raises:
        RendezviewError: astropy is not installed, or the file is damaged.
    """
    index, plane = divmod(place, _PLANES)
    with _opened(path) as units:
        unit = units[index]
        if len(unit.shape) == 2:
            levels = np.asarray(unit.data)
        else:
            lead = (0,) * (len(unit.shape) - 3)
            levels = np.asarray(unit.section[(*lead, plane)])
        order = str(_header(units, index).get("ROWORDER", ""))
    return levels[::-1] if order.upper().startswith("BOTTOM") else levels


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    try:
        from astropy.io import fits
    except ImportError:
        raise RendezviewError(
            f"{path}: FITS files need another package: pip install 'rendezview[fits]', or convert "
            "them to TIFF or PNG of 16 bits"
        ) from None
    try:
        with _quiet, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of headers that are not of the standard
            with fits.open(path, memmap=False) as units:
                yield units
    except RendezviewError:
        raise
    except Exception as error:  # astropy's, over any bytes
        raise RendezviewError(
            f"{path}: not a FITS file that can be read ({type(error).__name__}: {error}): it is "
            "damaged or cut short; replace it"
        ) from error


def _planes(unit: Any, path: Path) -> int:
    """Pictures of a unit; 0 without any."""
    shape = unit.shape
    if len(shape) < 2 or min(shape) == 0:
        return 0
    while len(shape) > 3 and shape[0] == 1:
        shape = shape[1:]
    if len(shape) > 3:
        sizes = " × ".join(str(n) for n in reversed(shape))
        raise RendezviewError(f"{path}: a picture of {sizes}: store one of width × height × time")
    return int(shape[0]) if len(shape) == 3 else 1


def _header(units: Any, index: int) -> dict[str, Any]:
    """The keywords that are used, of a unit, else of the first."""
    first, own = units[0].header, units[index].header
    return {key: own.get(key, first.get(key)) for key in _KEYS if key in own or key in first}


def _notes(header: dict[str, Any], planes: int) -> list[str]:
    notes = []
    if "ROWORDER" not in header:
        notes.append(
            "FITS files do not say which row is on top: the first is taken. Where that mirrors the "
            "pictures, write ROWORDER = 'BOTTOM-UP' into them"
        )
    if header.get("BAYERPAT"):
        notes.append(
            f"the FITS files are colour mosaics ({header['BAYERPAT']}): store them as grey or bin "
            "them 2 × 2, and the camera file with them"
        )
    if planes in (3, 4) and "TIME" not in str(header.get("CTYPE3", "")).upper():
        notes.append(
            f"the FITS files hold {planes} planes, which are taken as pictures: store colours as "
            "grey"
        )
    scale = str(header.get("TIMESYS", "UTC")).strip().upper()
    if scale != "UTC" and _stamp(header) is not None:
        notes.append(f"the times of the FITS files are of {scale}, not UTC")
    return notes


def _times_s(header: dict[str, Any], planes: int, path: Path) -> list[float | None]:
    """Of each plane: the middle of its exposure, s since 1970, or since the first without dates."""
    start = _stamp(header)
    if planes == 1:
        return [start]
    on_time = any(word in str(header.get("CTYPE3", "")).upper() for word in ("TIME", "UTC"))
    step = header.get("CDELT3")
    unit = {"s": 1.0, "ms": 1e-3, "": 1.0}.get(str(header.get("CUNIT3", "s")).strip().lower())
    if not on_time or not isinstance(step, int | float) or step <= 0.0 or unit is None:
        return [None] * planes
    return [(start or 0.0) + k * step * unit for k in range(planes)]


def _stamp(header: dict[str, Any]) -> float | None:
    """The middle of the exposure, s since 1970, by what the header has."""
    middle = _date(header, "DATE-AVG")
    if middle is not None:
        return middle
    start, end = _date(header, "DATE-BEG"), _date(header, "DATE-END")
    start = _date(header, "DATE-OBS") if start is None else start
    if start is None:
        return None
    if end is not None and end >= start:
        return 0.5 * (start + end)
    lengths = (header.get(key) for key in _EXPOSURES)
    length = next((value for value in lengths if isinstance(value, int | float)), 0.0)
    return start + 0.5 * max(float(length), 0.0)


def _date(header: dict[str, Any], key: str) -> float | None:
    """A date with its time of day, s since 1970."""
    text = str(header.get(key, "")).strip()
    if "T" not in text:
        clock = str(header.get("TIME-OBS", header.get("UT", ""))).strip()
        text = f"{text}T{clock}" if text and ":" in clock else ""
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        return None
    return (moment.replace(tzinfo=moment.tzinfo or UTC) - _UNIX) / timedelta(seconds=1)
