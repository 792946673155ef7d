"""What the sensor says of one pair of pictures."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from rendezview.geometry.pose import Array, Pose
from rendezview.sensors.observation import Status
from rendezview.sensors.reflectors.pattern import SixNumbers
from rendezview.sensors.reflectors.rates import Rates
from rendezview.sensors.reflectors.spots import COLUMNS, Spots


@dataclass(frozen=True, slots=True, eq=False)
class ReflectorObservation:
    """What the sensor says of one pair of pictures; no pose without ``Status.OK``."""

    status: Status
    reason: str | None
    pose: Pose | None = None  # camera_from_target
    covariance: Array | None = None  # (6, 6)
    six: SixNumbers | None = None
    rates: Rates | None = None
    spots: Spots = field(default_factory=lambda: Spots(np.empty((0, COLUMNS))))
    reflectors: tuple[str | None, ...] = ()  # name of the reflector of each spot
    group: str | None = None  # whose face the six numbers are of
    roll_ambiguous: bool = False  # turned by a symmetry of the reflectors it would look the same
    tracked: bool = False  # by windows, not by a search of the whole picture
    stage_ms: dict[str, float] = field(default_factory=dict)

    @property
    def triplet(self) -> list[int] | None:
        """Numbers of the spots that are reflectors, in the order of the reflectors."""
        named = [k for k, name in enumerate(self.reflectors) if name is not None]
        return named or None
