"""How freely the craft move, how far each sensor is believed, and when to let go."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields

from pydantic import ConfigDict

_FORBID = ConfigDict(extra="forbid")  # in files: an unknown key is an error


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionOptions:
    """White accelerations, as spectral densities, and what is not known at the start."""

    __pydantic_config__ = _FORBID

    angular: float = 3e-4  # rad/s² √s, of the target
    linear: float = 1e-3  # m/s² √s, of one craft against the other
    along: float = 0.0  # m/s² √s, more along the line of sight: a chaser brakes there
    pointing: float = 1e-4  # rad/s² √s, of the camera: turns the target and swings it round
    first_rate: float = 0.01  # rad/s, σ of the unknown first rates
    first_velocity: float = 0.5  # m/s

    def __post_init__(self) -> None:
        for name in (f.name for f in fields(self)):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} must not be negative: {getattr(self, name)}")


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorOptions:
    """What a sensor's covariance means over time, and when the sensor is believed.

    A camera's error on one frame is nearly that on the next: most of it lasts. So a share of
    the variance is a bias, first-order Gauss–Markov in the sensor's own σ, and a part of the state.
    """

    __pydantic_config__ = _FORBID

    inflation: float = 1.0  # of the variance that the sensor gives
    floor_rad: float = 0.0  # σ that its attitude or axis has besides, whatever it says
    floor_range: float = 0.0  # … and its place, over the range
    lasting: float = 0.8  # share of the variance that lasts
    lasting_s: float = 30.0  # for so long (1/e)
    lasting_range: float = 0.5  # … and over so much change of the logarithm of the range
    gate: float = 1e-4  # chance that a good measurement is turned away
    lock_after: int = 3  # turned away in a row: locked out
    loose_after: int = 8  # edges beside the ring in a row: locked out
    unlock_after: int = 3  # in agreement in a row: let in again
    window: int = 20  # measurements over which NIS is averaged
    nis_limit: float = 3.0  # mean NIS over its degrees of freedom at which a sensor is locked out

    def __post_init__(self) -> None:
        if not (0.0 < self.inflation < math.inf and 0.0 <= self.lasting < 1.0):
            raise ValueError(
                f"inflation must be positive and lasting from 0 to below 1: "
                f"{self.inflation}, {self.lasting}"
            )
        if not (0.0 <= self.floor_rad < math.inf and 0.0 <= self.floor_range < math.inf):
            raise ValueError("floor_rad and floor_range must not be negative")
        if not (self.lasting_s > 0.0 and self.lasting_range > 0.0 and self.nis_limit > 0.0):
            raise ValueError("lasting_s, lasting_range and nis_limit must be positive")
        if not 0.0 < self.gate < 1.0:
            raise ValueError(f"gate must be a probability, not {self.gate}")
        if min(self.lock_after, self.loose_after, self.unlock_after, self.window) < 1:
            raise ValueError("lock_after, loose_after, unlock_after and window must be at least 1")


@dataclass(frozen=True, slots=True, kw_only=True)
class FusionOptions:
    """Everything that can be chosen."""

    __pydantic_config__ = _FORBID

    motion: MotionOptions = field(default_factory=MotionOptions)
    pose: SensorOptions = field(default_factory=SensorOptions)  # of any sensor that gives poses
    ring: SensorOptions = field(default_factory=SensorOptions)
    range: SensorOptions = field(default_factory=SensorOptions)
    sensors: Mapping[str, SensorOptions] = field(default_factory=dict)  # by name; wins
    ring_radius_sigma: float = 0.0  # relative, of the ring's radius; 0: it is known
    ring_depth_sigma_m: float = 0.0  # of the ring's place along its axis; 0: it is known
    ring_other_edge: float = 0.1  # chance that an edge near the ring's was taken for it; then
    # only its bearing says something
    start_with: int = 3  # poses that must agree before the state is believed
    history_s: float = 10.0  # late measurements are still taken in for so long
    history_most: int = 1000  # measurements
    coasting_after_s: float = 5.0  # without a measurement that was believed
    lost_range_fraction: float = 0.05  # σ of the place over the range at which the state is lost
    lost_rad: float = math.radians(10.0)  # σ of the attitude
    recent_s: float = 5.0  # what sensors said longer ago is no vote on a new start
