"""The protection of a pose: levels that its errors exceed with a known risk, and alarms."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rendezview.geometry.pose import Array

ESTIMATORS_DISAGREE = "witnesses"  # the alarm of two that disagree


@dataclass(frozen=True, slots=True, eq=False)
class Protection:
    """How far off a pose may be, at a risk that the user has set. Infinite: no level."""

    risk: float  # probability that an error exceeds its level
    attitude_rad: float  # π: any attitude is possible
    position_m: float  # of the translation
    axes: Array  # (6,) of each axis: rotation vector rad, translation m; camera frame
    wrong: float  # probability that another answer than the pose is the truth
    drift: float  # largest cumulative sum of the innovations, standard deviations
    # Why the pose must not be used: a level above its limit (attitude, position), two estimators
    # that disagree (witnesses), a drift (drift). Empty: it may be used.
    alarms: tuple[str, ...] = ()

    @property
    def alarm(self) -> bool:
        """Whether the pose must not be used."""
        return bool(self.alarms)

    def record(self) -> dict[str, Any]:
        """As a JSON object; infinite levels become null."""
        return {
            "risk": self.risk,
            "attitude_rad": self.attitude_rad,
            "position_m": self.position_m,
            "axes": self.axes,
            "wrong": self.wrong,
            "drift": self.drift,
            "alarm": self.alarm,
            "alarms": list(self.alarms),
        }


@dataclass(slots=True)
class Levels:
    """The levels and alarms of a run, for its summary."""

    _attitude_rad: list[float] = field(default_factory=list)
    _position_m: list[float] = field(default_factory=list)
    _alarms: Counter[str] = field(default_factory=Counter)
    _frames: int = 0

    def add(self, protection: Protection | None) -> None:
        """Count one pose; ``None``: the frame has no pose."""
        if protection is None:
            return
        self._frames += 1
        self._alarms.update(protection.alarms)
        if not protection.alarm:
            self._attitude_rad.append(protection.attitude_rad)
            self._position_m.append(protection.position_m)

    def __str__(self) -> str:
        """One line for a terminal."""
        free = len(self._attitude_rad)
        if not self._frames:
            return "protection levels: no pose has one"
        words = f"protection levels: {free} of {self._frames} poses without an alarm"
        if free:
            degrees = math.degrees(float(np.median(self._attitude_rad)))
            words += f", {degrees:.2g}° and {float(np.median(self._position_m)):.2g} m median"
        kinds = ", ".join(f"{name} {count}" for name, count in sorted(self._alarms.items()))
        return words + (f"; alarms: {kinds}" if kinds else "")
