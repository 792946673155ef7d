"""What a self-calibration takes: named spots of readings, and lengths that were measured."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from rendezview.geometry.pose import Array, Pose
from rendezview.io.files import StrPath
from rendezview.io.pose_log import read_poses
from rendezview.sensors.beacons.constellation import ReflectorPattern
from rendezview.sensors.beacons.observation import ReflectorObservation

# Of the base: σ with which a run is read, so that a reflector that is off does not hide the target.
# Source: by construction, 1 mm of 368
_LOOSE = 0.003
# px. A spot's error depends on where in its pixel it is: only readings that differ by as much add
# to each other. Source: by construction, a pixel's period
_APART_PX = 1.0
_MOST = 300  # readings, evenly spaced. Source: by construction, a bound of time
FEWEST_SPOTS = 4  # three spots and six numbers leave nothing over. Source: by construction


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """The named spots of one reading."""

    pose: Pose  # camera_from_target, near the truth
    reflectors: npt.NDArray[np.int64]  # (K,) numbers in the pattern
    spots_px: Array  # (K, 2)
    sigma_px: Array  # (K,) one σ an axis
    roll_ambiguous: bool = False  # whether the names may be those of half a turn


@dataclass(frozen=True, slots=True)
class KnownLength:
    """A distance between the middles of two reflectors that was measured."""

    first: str
    second: str
    length_m: float
    sigma_m: float


def loosened(patterns: list[ReflectorPattern]) -> list[ReflectorPattern]:
    """Patterns to read a run with: they allow reflectors off by a few times 0.3 % of a base."""
    return [
        replace(p, sigmas_m=np.maximum(p.sigmas_m, _LOOSE * p.base_m), sigmas_known=True)
        for p in patterns
    ]


def sightings_of_readings(
    readings: Iterable[ReflectorObservation], pattern: ReflectorPattern
) -> list[Sighting]:
    """The readings that tell something of the places: poses of four or more spots."""
    return _told(
        _sighting(r.pose, r.roll_ambiguous, r.reflectors, r.spots.records(), pattern)
        for r in readings
        if r.pose is not None
    )


def sightings_of_log(path: StrPath, pattern: ReflectorPattern) -> list[Sighting]:
    """The same of a log of ``rendezview reflectors``.

    Raises:
        RendezviewError: missing, or a line (named) is none of such a log.
    """

    def of_line(line: dict[str, Any]) -> Sighting | None:
        if line["pose"] is None:
            return None
        pose = Pose.from_quat_wxyz(line["pose"]["quat_wxyz"], line["pose"]["translation_m"])
        names = [spot["reflector"] for spot in line["spots"]]
        return _sighting(pose, bool(line["roll_ambiguous"]), names, line["spots"], pattern)

    return _told(read_poses(path, of_line, "`rendezview reflectors`"))


def _sighting(
    pose: Pose, roll_ambiguous: bool, names: Iterable[str | None],
    spots: list[dict[str, float]], pattern: ReflectorPattern,
) -> Sighting:  # fmt: skip
    numbers = {name: k for k, name in enumerate(pattern.names)}
    rows = [
        (numbers[name], spot["x_px"], spot["y_px"], spot["sigma_px"])
        for name, spot in zip(names, spots, strict=True)
        # The middle of a saturated spot is that of its rim.
        if name in numbers and spot["saturated_px"] < 1 and spot["sigma_px"] > 0.0
    ]
    table = np.array(rows, dtype=np.float64).reshape(-1, 4)
    return Sighting(
        pose, table[:, 0].astype(np.int64), table[:, 1:3].copy(), table[:, 3].copy(), roll_ambiguous
    )


def _told(sightings: Iterable[Sighting | None]) -> list[Sighting]:
    """Those of four or more spots, each unlike all before, at most 300."""
    kept: list[Sighting] = []
    seen: dict[tuple[int, ...], list[Array]] = {}
    for one in sightings:
        if one is None or len(one.reflectors) < FEWEST_SPOTS:
            continue
        order = np.argsort(one.reflectors)
        before = seen.setdefault(tuple(one.reflectors[order].tolist()), [])
        spots = one.spots_px[order]
        if before and np.abs(np.array(before) - spots).max(axis=(1, 2)).min() < _APART_PX:
            continue
        before.append(spots)
        kept.append(one)
    chosen = np.unique(np.linspace(0, len(kept) - 1, min(len(kept), _MOST)).round().astype(int))
    return [kept[k] for k in chosen]
