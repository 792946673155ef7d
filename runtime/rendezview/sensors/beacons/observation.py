"""The observation of the reflector sensor: spots, the pose, the six numbers and their rates."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rendezview.geometry.pose import Pose
from rendezview.io.target import DockingRing
from rendezview.sensors.beacons.budget import Budget
from rendezview.sensors.beacons.constellation import SixNumbers
from rendezview.sensors.beacons.detect.spot_columns import COLUMNS
from rendezview.sensors.beacons.detect.spots import SpotTable
from rendezview.sensors.beacons.match.acquisition_options import STRANGE, Acquisition
from rendezview.sensors.beacons.rates import Rates
from rendezview.sensors.measurement import Measurement
from rendezview.sensors.observation import Observation, Status


@dataclass(frozen=True, slots=True, eq=False, kw_only=True, repr=False)
class ReflectorObservation(Observation):
    """The outcome of one pair of pictures; there is a pose only with ``Status.OK``."""

    six: SixNumbers | None = None
    rates: Rates | None = None
    spots: SpotTable = field(default_factory=lambda: SpotTable(np.empty((0, COLUMNS))))
    reflectors: tuple[str | None, ...] = ()  # name of the reflector of each spot
    group: str | None = None  # the six numbers are of this group's face
    roll_ambiguous: bool = False  # rotated by a symmetry of the reflectors it looks the same
    tracked: bool = False  # by windows, not by a search of the whole picture
    note: str | None = None  # what differs from the target file, such as the diameter of the dots
    budget: Budget | None = None  # the covariance by cause

    @property
    def triplet(self) -> list[int] | None:
        """Numbers of the spots that are reflectors, in the order of the reflectors."""
        named = [k for k, name in enumerate(self.reflectors) if name is not None]
        return named or None

    def measurement(
        self, sensor: str, *, ring: DockingRing | None = None, mount: Pose | None = None
    ) -> Measurement | None:
        """The pose for the filter; ``None`` while the roll may be wrong by half a turn."""
        if self.roll_ambiguous:
            return None
        return Observation.measurement(self, sensor, ring=ring, mount=mount)

    def record(self) -> dict[str, Any]:
        """The observation as its line of JSON."""
        has_pose = self.pose is not None
        return {
            "time_s": self.time_s,
            "status": str(self.status),
            "reason": self.reason,
            "spots": [
                {**spot, "reflector": name}
                for spot, name in zip(self.spots.records(), self.reflectors, strict=True)
            ],
            "triplet": self.triplet if has_pose else None,
            "group": self.group if has_pose else None,
            "pose": self.pose,
            "six": self.six,
            "roll_ambiguous": self.roll_ambiguous if has_pose else None,
            "covariance": self.covariance,
            "common_covariance": self.common,
            "budget": self.budget,
            "rates": rates_record(self.rates),
            "tracked": self.tracked,
            "note": self.note,
            "stage_ms": self.stage_ms,
        }


def refused(
    found: Acquisition, time_s: float, spots: SpotTable, stage_ms: dict[str, float]
) -> ReflectorObservation:
    """The reading of a picture in which no pose was found, or one that is not given."""
    return ReflectorObservation(
        found.status, found.reason, time_s=time_s, spots=spots, reflectors=(None,) * len(spots),
        stage_ms=stage_ms,
    )  # fmt: skip


def undecided(
    reason: str, time_s: float, spots: SpotTable, names: tuple[str | None, ...],
    stage_ms: dict[str, float], *, tracked: bool,
) -> ReflectorObservation:  # fmt: skip
    """A reading whose spots several poses may show."""
    return ReflectorObservation(
        Status.AMBIGUOUS, reason, time_s=time_s, spots=spots, reflectors=names, tracked=tracked,
        stage_ms=stage_ms,
    )  # fmt: skip


def missed(
    time_s: float, spots: SpotTable, names: tuple[str, ...], lost: list[str],
    stage_ms: dict[str, float], *, search: bool, strange: bool,
) -> ReflectorObservation:  # fmt: skip
    """A reading while tracking whose visible reflectors ``names`` fix no pose, or that has none.

    ``lost`` are those expected but not visible. ``search``: the whole picture is searched next.
    ``strange``: spots are where reflectors were expected, but no pose shows enough of them.
    """
    status, reason = Status.LOST, "no reflector where it was expected"
    if strange:
        status, reason = Status.AMBIGUOUS, STRANGE
    elif names:
        status = Status.PARTIAL
        reason = f"{len(names)} of the reflectors visible ({', '.join(names)}), which fixes no pose"
        reason += f"; not visible: {', '.join(lost)}"
    elif search:
        reason += ": the whole picture is searched next"
    return ReflectorObservation(
        status, reason, time_s=time_s, spots=spots, reflectors=names, tracked=True,
        stage_ms=stage_ms,
    )  # fmt: skip


def rates_record(rates: Rates | None) -> dict[str, Any] | None:
    """Rates as a log has them."""
    if rates is None:
        return None
    return {
        "velocity_m_s": rates.velocity_m_s,
        "turn_rad_s": rates.turn_rad_s,
        "six_per_s": rates.six_per_s,
        "covariance": rates.covariance,
        "span_s": rates.span_s,
    }
