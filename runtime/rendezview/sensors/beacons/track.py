"""The sensor's memory from one reading to the next, and how long it lasts."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum, StrEnum

import numpy as np
import numpy.typing as npt

from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Array, Pose
from rendezview.sensors.beacons.detect.cover import middle
from rendezview.sensors.beacons.detect.spot_columns import AMPLITUDE, RIVALS, SIGMA, X
from rendezview.sensors.beacons.detect.spots import SpotTable
from rendezview.sensors.beacons.match.acquisition_options import Acquisition
from rendezview.sensors.beacons.match.choice import FEW
from rendezview.sensors.beacons.pose.refinement import Refined
from rendezview.sensors.observation import Status

_LIKE = 9.0  # χ² of a spot's light that tells its reflector's. Source: by construction, 3 σ
_VAGUE = 3.0  # × the σ of the others. Source: experiment reflector-hidden --scene glint
_NEVER = 10**6  # readings. Source: by construction


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackingOptions:
    """Windows, and when to give up."""

    # Half width over a spot's σ … Source: by hand; uncritical halved or doubled
    window_sizes: float = 4.0
    # … and the margin for motion. Source: by hand; uncritical halved or doubled
    window_px: float = 6.0
    # … and each reading without that spot. Source: by hand; uncritical halved or doubled
    coasting_px: float = 4.0
    # Of the distance to the next reflector, at most. Source: by construction, less than half
    window_share: float = 0.45
    # Readings without a pose before the whole picture is searched again. Source: a chosen limit
    coast: int = 5
    memory: int = 50  # … and before the last range is no longer used. Source: a chosen limit
    confirm: bool = True  # a first find counts when the next reading agrees
    # Of a redundant fit: a spot further off is no reflector. Source: normal distribution, 2·10⁻⁹
    gate_sigma: float = 6.0
    # χ² of a pose of few spots against the motion, beyond which it is not given. Source: experiment
    # reflector-hidden --scene glint; steady, swinging and jittering motion stays below
    jump_limit: float = 20.0
    gap_limit: float = 8.0  # … after a reading without a pose. Source: likewise
    # … whose σ is at least so many rad, and share of the range: a smaller jump misleads nobody.
    # Source: by construction, 5° and 3 % over the root of jump_limit; at half of it an
    # approach that slows down is lost
    jump_floor: tuple[float, float] = (0.0195, 0.0067)
    # Readings in which a pose with a doubtful spot must keep to the motion before: one whose σ is
    # so many times that of the others, or beside which another was in so many readings before.
    # Source: experiment reflector-hidden --scene glint
    doubt: int = 12
    # error of a centroid beside the noise: pixels, lens, reflector edge. A first find is without:
    # its σ is of the noise. Source: by hand; simulated spots have none, so NEES is 3 instead of 5
    floor_px: float = 0.01
    # s, from the first row to the last of a rolling shutter; times are those of the middle row
    readout_s: float = 0.0  # Source: a global shutter

    def __post_init__(self) -> None:
        if not 0.0 <= self.readout_s < 1.0:
            raise RendezviewError(f"readout_s must be from 0 to below 1 s, not {self.readout_s}")


class Doubt(IntEnum):
    """Whether one of few visible spots may not be its reflector, or not all of it."""

    NONE = 0
    SOME = 1  # another spot is beside it, or its place is uncertain
    OTHER = 2  # … and another spot was beside it shortly before: it may be that one


class Branch(StrEnum):
    """How the pose is distinguished from the mirrored one that shows nearly the same spots."""

    SURE = "sure"  # by its spots, which no other pose shows, or by its motion, since they did
    MERGED = "merged"  # both are within the error: the covariance holds both
    OPEN = "open"  # not at all: there is no pose


@dataclass(slots=True, eq=False)
class Track:
    """The memory between readings."""

    time_s: float
    pose: Pose
    places: Array  # (N, 2) of the last reading, NaN where not visible
    before: Array  # (N, 2) of the reading before that
    before_s: float
    brightness: Array  # (N,) of each reflector when it was last visible, grey
    noise: float
    roll_ambiguous: bool
    misses: int = 0
    branch: Branch = Branch.SURE
    aged: npt.NDArray[np.int64] = field(init=False)  # (N,) readings since its brightness was sure
    alone: npt.NDArray[np.int64] = field(init=False)  # (N,) readings since another was beside it

    def __post_init__(self) -> None:
        self.alone = np.full(len(self.places), _NEVER)
        self.aged = np.zeros(len(self.places), np.int64)

    @classmethod
    def begun(cls, time_s: float, pose: Pose, reflectors: int, *, roll_known: bool) -> Track:
        """The memory of a pose that another sensor has found: no spot was seen yet."""
        nowhere, dim = np.full((reflectors, 2), np.nan), np.full(reflectors, np.nan)
        return cls(time_s, pose, nowhere, nowhere.copy(), time_s, dim, 2.0, not roll_known)

    @classmethod
    def after(
        cls, last: Track | None, time_s: float, table: Array, refined: Refined, noise: float,
        ambiguous: bool, branch: Branch, coast: int, light: Array | None = None,
    ) -> Track:  # fmt: skip
        """The memory after a reading; ``table`` (N, COLUMNS): its spots, NaN where not visible."""
        dim, before, before_s = (
            np.full(len(table), np.nan),
            np.full((len(table), 2), np.nan),
            time_s,
        )
        if last is not None:
            dim = last.brightness
            if last.misses <= coast:
                before, before_s = last.places, last.time_s
        sure = np.isfinite(table[:, X])
        if light is not None:
            sure = sure & (light < _LIKE) & ~vague(table[:, SIGMA].copy())
        after = cls(
            time_s, refined.camera_from_target, table[:, :2].copy(), before, before_s,
            np.where(sure, table[:, AMPLITUDE], dim), noise, ambiguous, branch=branch,
        )  # fmt: skip
        if last is not None:
            after.aged = np.where(sure, 0, last.aged + 1)
            after.alone = np.where(table[:, RIVALS] > 0.0, 0, last.alone + 1)
        return after

    def doubts(self, table: Array, seen: npt.NDArray[np.int64], options: TrackingOptions) -> Doubt:
        """The largest doubt about a visible spot."""
        if not 3 <= len(seen) <= FEW:
            return Doubt.NONE
        sigma, rivals = table[seen, SIGMA], table[seen, RIVALS]
        beside, recent = rivals > 0.0, self.alone[seen] < options.doubt
        wide = vague(sigma)
        if (recent & (wide | ~beside)).any():
            return Doubt.OTHER
        return Doubt.SOME if (wide | beside).any() else Doubt.NONE

    def follow(self, time_s: float, seen: npt.NDArray[np.int64], table: Array) -> None:
        """Keep the places of visible reflectors, too few for a pose: they move the windows."""
        places = np.full_like(self.places, np.nan)
        places[seen] = table[seen, :2]
        self.before, self.before_s = self.places, self.time_s
        self.places, self.time_s = places, time_s
        self.aged += 1


@dataclass(slots=True)
class Lights:
    """How many lights there were when three or more spots showed no target.

    Of few spots that pass for it later, while there are fewer, one may be another light: the
    reflector may be the one that has vanished.
    """

    readings: int  # for which it is remembered
    count: int = 0
    since: int = _NEVER  # readings

    def take(self, found: Acquisition | None, spots: SpotTable) -> None:
        """Remember a search without a pose; where no three spots fit, two lights may be one."""
        if found is None or found.refined is not None or len(spots) < 3:
            return
        lights = len(spots) + (found.status is not Status.AMBIGUOUS)
        self.count = max(lights, self.count if self.since < self.readings else 0)
        self.since = 0

    def vanished(self, found: Acquisition, spots: SpotTable) -> bool:
        """Whether there are fewer lights than shortly before; an uncertain spot may be two."""
        sigma = spots.sigma_px[found.spot_indices].ravel()
        few = len(sigma) <= FEW and self.since < self.readings
        return few and len(spots) + int(vague(sigma).sum()) < self.count


def vague(sigma_px: Array) -> npt.NDArray[np.bool_]:
    """(K,) which of the spots of a reading are less certain than the others, by their σ (K,)."""
    return np.asarray(sigma_px > _VAGUE * middle(sigma_px))


def checked_acceleration(acceleration: npt.ArrayLike) -> Array:
    """(6,) angular rad/s², linear m/s² of the target, camera frame.

    Raises:
        ValueError: another shape, or not finite.
    """
    checked = np.asarray(acceleration, dtype=np.float64)
    if checked.shape != (6,) or not np.isfinite(checked).all():
        raise ValueError(f"acceleration must be (6,) and finite, not {checked.tolist()}")
    return checked
