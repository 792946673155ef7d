"""Options of the filter: motion of the craft, belief in each sensor, and when the state is lost."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Annotated, Any

from pydantic import (
    AliasChoices,
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    model_serializer,
)

_FORBID = ConfigDict(extra="forbid")  # in files: an unknown key is an error


# Keys in files of the fields that have another name
_KEYS = {"bias_share": "lasting", "bias_s": "lasting_s", "bias_range": "lasting_range"}


def _key(field_name: str) -> Any:
    """In files, the documented key or the name of the field."""
    return Field(validation_alias=AliasChoices(_KEYS[field_name], field_name))


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionOptions:
    """White accelerations, as spectral densities, and the uncertainty at the start."""

    __pydantic_config__ = _FORBID

    # rad/s² √s, of the target. Source: by construction, 1.7 × the wander of fusion-approach
    angular: float = 3e-4
    # m/s² √s, of one craft against the other. Source: by construction, as angular
    linear: float = 1e-3
    # m/s² √s, further along the line of sight: a chaser brakes there.
    along: float = 0.0  # Source: by construction, off
    # rad/s² √s, of the camera: rotates the target and swings its place. Source: by construction,
    # 1.7 × the wander of fusion-approach
    pointing: float = 1e-4
    # rad/s, σ of the unknown first rates. Source: by construction, a turn in ten minutes
    first_rate: float = 0.01
    first_velocity: float = 0.5  # m/s, σ of the unknown first velocity. Source: a chosen limit

    def __post_init__(self) -> None:
        for name in (f.name for f in fields(self)):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} must not be negative: {getattr(self, name)}")


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorOptions:
    """How a sensor's error splits into noise and bias, and when the sensor is trusted.

    The errors of a camera on neighbouring frames are nearly the same. A share of the variance is
    therefore a bias: a first-order Gauss–Markov process in the sensor's own σ, and part of the
    state. In files its keys are ``lasting``, ``lasting_s`` and ``lasting_range``.
    """

    __pydantic_config__ = _FORBID

    # Of the variance that the sensor reports.
    inflation: float = 1.0  # Source: by construction, neutral
    floor_rad: float = 0.0  # rad, σ added to its attitude or axis. Source: by construction, off
    floor_range: float = 0.0  # σ added to its place, over the range. Source: by construction, off
    # Of the variance, that is a bias. Source: by hand; halved, the 95 % error doubles
    bias_share: Annotated[float, _key("bias_share")] = 0.8
    # s, correlation time of the bias. Source: by hand; uncritical halved or doubled
    bias_s: Annotated[float, _key("bias_s")] = 30.0
    # Change of ln(range) over which the bias decorrelates. Source: by hand; uncritical halved or
    # doubled
    bias_range: Annotated[float, _key("bias_range")] = 0.5
    # Probability that a good measurement is rejected.
    gate: float = 1e-4  # Source: by construction, a rate of false alarms
    # Rejected in a row: locked out. Source: by construction, 10⁻¹² by chance with this gate
    lock_after: int = 3
    # Edges beside the ring in a row: locked out. Source: by construction, 10⁻⁸ by chance with
    # ring_other_edge
    loose_after: int = 8
    unlock_after: int = 3  # in agreement in a row: unlocked. Source: by construction, as lock_after
    # Measurements over which NIS is averaged. Source: χ² distribution, their mean scatters by 0.3
    window: int = 20
    # Mean NIS per degree of freedom above which a sensor is locked out. Source: χ² distribution:
    # good measurements of one degree exceed it in 7 of 10⁶ windows
    nis_limit: float = 3.0

    def __post_init__(self) -> None:
        if not (0.0 < self.inflation < math.inf and 0.0 <= self.bias_share < 1.0):
            raise ValueError(
                f"inflation must be positive and lasting from 0 to below 1: "
                f"{self.inflation}, {self.bias_share}"
            )
        if not (0.0 <= self.floor_rad < math.inf and 0.0 <= self.floor_range < math.inf):
            raise ValueError("floor_rad and floor_range must not be negative")
        if not (self.bias_s > 0.0 and self.bias_range > 0.0 and self.nis_limit > 0.0):
            raise ValueError("lasting_s, lasting_range and nis_limit must be positive")
        if not 0.0 < self.gate < 1.0:
            raise ValueError(f"gate must be a probability, not {self.gate}")
        if min(self.lock_after, self.loose_after, self.unlock_after, self.window) < 1:
            raise ValueError("lock_after, loose_after, unlock_after and window must be at least 1")

    @model_serializer(mode="wrap")
    def _by_key(self, write: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return {_KEYS.get(name, name): value for name, value in write(self).items()}


@dataclass(frozen=True, slots=True, kw_only=True)
class FusionOptions:
    """All options of the filter."""

    __pydantic_config__ = _FORBID

    motion: MotionOptions = field(default_factory=MotionOptions)
    pose: SensorOptions = field(default_factory=SensorOptions)  # of any sensor that gives poses
    ring: SensorOptions = field(default_factory=SensorOptions)
    range: SensorOptions = field(default_factory=SensorOptions)
    sensors: Mapping[str, SensorOptions] = field(default_factory=dict)  # by name; wins
    # Relative, of the ring's radius; 0: it is known.
    ring_radius_sigma: float = 0.0  # Source: by construction, off
    # m, of the ring's place along its axis; 0: it is known.
    ring_depth_sigma_m: float = 0.0  # Source: by construction, off
    # Probability that another edge was taken for the ring's; then only its bearing counts. Source:
    # by hand; uncritical halved or doubled
    ring_other_edge: float = 0.1
    # Poses that must agree before the state is believed. Source: with 2 the mean NEES is 5194, with
    # 3 it is 9
    start_with: int = 3
    history_s: float = 10.0  # s, how late a measurement may be. Source: a chosen limit
    # Measurements kept for late ones.
    history_most: int = 1000  # Source: by construction, a bound of memory
    coasting_after_s: float = 5.0  # s without an accepted measurement. Source: a chosen limit
    # σ of the place over the range at which the state is lost. Source: a chosen limit
    lost_range_fraction: float = 0.05
    # rad, σ of the attitude at which the state is lost. Source: a chosen limit
    lost_rad: float = math.radians(10.0)
    # s; an older measurement is no vote on a restart. Source: by construction, as coasting_after_s
    recent_s: float = 5.0
