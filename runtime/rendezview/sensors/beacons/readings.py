"""Readings of a rig: JSON lines of currents or spots, or pictures of all cameras."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rendezview.errors import RendezviewError, explained
from rendezview.io.files import StrPath
from rendezview.io.results import read_json_lines
from rendezview.io.sequences.images import IMAGE_SUFFIXES, read_grey
from rendezview.sensors.beacons.detect.detectors import UNKNOWN, Spots
from rendezview.sensors.beacons.detect.led_spots import SpotOptions, find_spots
from rendezview.sensors.beacons.rig import Rig, RigCamera

_SIGMA_PX = 0.05  # of a spot in a file that gives none. Source: stereo-accuracy (0.1)


@dataclass(frozen=True, slots=True)
class Reading:
    """One moment: the spots of each camera, fetched when asked for."""

    im_id: int
    time_s: float
    fetch: Callable[[], tuple[Spots, ...]]


def open_readings(
    path: StrPath,
    rig: Rig,
    names: tuple[str, ...],
    *,
    rate_hz: float = 1.0,
    options: SpotOptions | None = None,
) -> list[Reading]:
    """Readings in order.

    Args:
        path: a JSON-lines file, each line ``time_s`` and either ``currents`` (camera, light,
            4) or ``spots`` (camera, spot, 2) with optional ``leds`` (camera, spot) and
            ``sigma_px``; or a folder of numbered pictures of each camera.
        rig: the cameras; pictures are theirs in the order of the cameras' names.
        names: of the target's lights, in order, for ``leds``.
        rate_hz: of pictures, which carry no time.
        options: how lights are detected in a picture.

    Raises:
        RendezviewError: missing, neither of these, or a line (named) that does not fit.
    """
    if Path(path).is_dir():
        return list(_pictures(path, rig, rate_hz, options))
    return list(_lines(path, rig, names))


def _lines(path: StrPath, rig: Rig, names: tuple[str, ...]) -> Iterator[Reading]:
    last_s = -np.inf
    for number, record in enumerate(read_json_lines(path), start=1):
        where = f"{path}: reading {number}"
        time_s = record.get("time_s")
        if isinstance(time_s, bool) or not isinstance(time_s, int | float) or not time_s > last_s:
            raise RendezviewError(f"{where}: time_s must be a number later than the one before")
        last_s = float(time_s)
        with explained(f"{where}: ", ": correct or remove the line", (ValueError, TypeError)):
            spots = _spots(record, rig, names)
        yield Reading(number - 1, last_s, lambda spots=spots: spots)  # type: ignore[misc]


def _spots(record: dict[str, Any], rig: Rig, names: tuple[str, ...]) -> tuple[Spots, ...]:
    key = "currents" if "currents" in record else "spots"
    given = record.get(key)
    if not isinstance(given, list) or len(given) != len(rig):
        raise ValueError(f"needs currents or spots, a list for each of the {len(rig)} cameras")
    named = record.get("leds") or [None] * len(rig)
    if len(named) != len(rig):
        raise ValueError(f"leds needs a list for each of the {len(rig)} cameras")
    sigma = float(record.get("sigma_px", _SIGMA_PX))
    found = []
    for camera, rows, leds in zip(rig.cameras, given, named, strict=True):
        if key == "currents":
            if camera.photodiode is None:
                raise ValueError(f"currents, but camera {camera.name!r} takes pictures")
            if len(rows) != len(names):
                raise ValueError(f"currents of {len(rows)} lights, the target has {len(names)}")
            currents = np.array([row or [np.nan] * 4 for row in rows], dtype=np.float64)
            found.append(camera.photodiode.read(currents))
            continue
        places = np.array(rows, dtype=np.float64).reshape(-1, 2)
        if leds is None:
            numbers = np.full(len(places), UNKNOWN)
        else:
            unknown = [name for name in leds if name is not None and name not in names]
            if unknown or len(leds) != len(places):
                raise ValueError(f"leds must name a light of the target (or null) for each spot, "
                                 f"not {leds}")  # fmt: skip
            numbers = np.array([UNKNOWN if n is None else names.index(n) for n in leds], np.int64)
        found.append(Spots(places, np.full(places.shape, sigma), numbers))
    return tuple(found)


def _pictures(
    folder: StrPath, rig: Rig, rate_hz: float, options: SpotOptions | None
) -> Iterator[Reading]:
    if not (np.isfinite(rate_hz) and rate_hz > 0.0):
        raise RendezviewError(f"the rate of pictures must be positive, not {rate_hz}")
    by_name = dict(picture_pairs(folder))
    missing = [camera.name for camera in rig.cameras if camera.name not in by_name]
    if missing:
        raise RendezviewError(
            f"{folder}: no pictures of camera {', '.join(missing)} (there are "
            f"{', '.join(by_name)}): name them as the rig names its cameras"
        )
    for number, paths in enumerate(
        zip(*(by_name[camera.name] for camera in rig.cameras), strict=True)
    ):
        yield Reading(
            number,
            number / rate_hz,
            lambda paths=paths: tuple(  # type: ignore[misc]
                _picture(camera, path, options)
                for camera, path in zip(rig.cameras, paths, strict=True)
            ),
        )


def _picture(camera: RigCamera, path: Path, options: SpotOptions | None) -> Spots:
    grey = read_grey(path)
    if grey.shape[::-1] != camera.size:
        raise RendezviewError(
            f"{path}: is {grey.shape[1]} × {grey.shape[0]} pixels, camera {camera.name!r} is "
            f"{camera.size}: use the rig file of these pictures"
        )
    return find_spots(grey, options)


def picture_pairs(folder: StrPath) -> list[tuple[str, list[Path]]]:
    """The pictures of a folder by camera: ``left01.jpg right01.jpg …`` or ``left/ right/``.

    Raises:
        RendezviewError: no two kinds of pictures with the same numbers.
    """
    base = Path(folder)
    by_camera: dict[str, dict[str, Path]] = {}
    for path in sorted([*base.glob("*"), *base.glob("*/*")]):
        if path.suffix.lower() not in IMAGE_SUFFIXES:
            continue
        parted = re.fullmatch(r"(.*?)[_-]?(\d+)", path.stem)
        if parted is None:
            continue
        name = parted[1] if path.parent == base else path.parent.name
        by_camera.setdefault(name, {})[parted[2]] = path
    if not by_camera:
        raise RendezviewError(
            f"{folder}: no numbered pictures: name them left01.jpg right01.jpg, or left/01.jpg …"
        )
    common = sorted(set.intersection(*(set(numbers) for numbers in by_camera.values())), key=int)
    if not common:
        raise RendezviewError(f"{folder}: the cameras {sorted(by_camera)} share no picture number")
    return [(name, [paths[k] for k in common]) for name, paths in sorted(by_camera.items())]
