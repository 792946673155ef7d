"""Options of the filter: motion of the craft, belief in each sensor, and when the state is lost.

The motion and the noise are learnt from the innovations while the filter runs: the defaults are
where it starts, and serve every approach.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Annotated, Any

from pydantic import (
    AliasChoices,
    BeforeValidator,
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    model_serializer,
    model_validator,
)

from rendezview.estimation.protection import LEAST_RISK, MOST_RISK


def _as_tuple(given: Any) -> Any:
    """A list as a tuple: after a validator of the whole content, strict mode takes no list."""
    return tuple(given) if isinstance(given, list) else given


_Numbers = Annotated[tuple[float, ...], BeforeValidator(_as_tuple)]
_FORBID = ConfigDict(extra="forbid")  # in files: an unknown key is an error


# Keys in files of the fields that have another name
_KEYS = {"bias_share": "lasting", "bias_s": "lasting_s", "bias_range": "lasting_range"}


def _key(field_name: str) -> Any:
    """In files, the documented key or the name of the field."""
    return Field(validation_alias=AliasChoices(_KEYS[field_name], field_name))


def _without(content: Any, keys: tuple[str, ...]) -> Any:
    """The content of a file without keys of earlier versions, which nothing needs now."""
    found = [key for key in keys if isinstance(content, dict) and key in content]
    if not found:
        return content
    warnings.warn(
        f"fusion options: {', '.join(found)} of earlier versions are ignored: they are not needed",
        DeprecationWarning,
        stacklevel=2,
    )
    return {key: value for key, value in content.items() if key not in found}


def _check_sizes(options: Any) -> None:
    """Refuse numbers whose squares the filter cannot use; the rest is checked by name."""
    for name in (f.name for f in fields(options)):
        value = getattr(options, name)
        for one in value if isinstance(value, tuple | list) else (value,):
            if isinstance(one, float) and not (
                one in (0.0, math.inf) or math.isnan(one) or _LEAST <= abs(one) <= _MOST
            ):
                key = _KEYS.get(name, name)
                raise ValueError(f"{key} must be 0 or {_LEAST:g} … {_MOST:g}, not {one:g}")


_LEAST, _MOST = 1e-12, 1e9  # Source: a chosen limit


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionOptions:
    """How the craft may move: several models of each, weighed by their likelihood.

    A model is one of the accelerations with one of the jitters. The acceleration of one craft
    against the other is white noise and a lasting part (Singer's, of exponential correlation); the
    jitter turns the camera, and returns to zero (Ornstein and Uhlenbeck's process).
    """

    __pydantic_config__ = _FORBID

    # rad/s² √s, of the target's rotation. Source: Mitsuba approach: a quarter of it makes the
    # attitude twice as bad there, and 30 % better in plain simulation
    angular: float = 2e-4
    # m/s² √s of each model: coasting, braking, a jerk. Source: plain simulation: one of them
    # alone is 5 to 20 % worse
    accelerations: _Numbers = (5e-4, 2e-3, 3e-2)
    # m/s², σ of the lasting acceleration of each. Source: chaser's braking, 1–20 mm/s²
    lasting_accelerations: _Numbers = (1e-3, 1e-2, 1e-2)
    acceleration_s: float = 30.0  # s, its correlation. Source: plain simulation, uncritical
    # s, mean stay in each. Source: plain simulation, uncritical
    stays_s: _Numbers = (60.0, 40.0, 5.0)
    # rad, σ of each jitter; the first is only the first guess, it is learnt. Source: `simulate`
    # has 5 mrad; without the second a swing of 0.3° at 0.15 Hz restarts the filter
    jitters: _Numbers = (6e-3, 7e-3)
    jitters_s: _Numbers = (0.4, 2.0)  # s, their correlation. Source: as the jitters
    # s, mean stay in each. Source: plain situations; without an end, spins are 1.4 times as often
    # beyond their level
    jitter_stay_s: float = 300.0
    # σ of the unknown first rates: of a slow target, and of a tumbling one that is passed fast. The
    # first few readings choose between them.
    first_rate: float = 0.03  # rad/s. Source: chosen, 1.7°/s
    first_velocity: float = 0.5  # m/s. Source: a chosen limit
    fast_rate: float = 0.5  # rad/s. Source: chosen, 30°/s
    fast_velocity: float = 10.0  # m/s. Source: a chosen limit

    @model_validator(mode="before")
    @classmethod
    def _old_keys(cls, content: Any) -> Any:
        return _without(content, ("linear", "along", "pointing", "slews"))

    def __post_init__(self) -> None:
        _check_sizes(self)
        for name in (f.name for f in fields(self)):
            value = getattr(self, name)
            for one in value if isinstance(value, tuple | list) else (value,):
                if not 0.0 <= one < math.inf:
                    raise ValueError(f"{name} must not be negative: {value}")
        for name in (f.name for f in fields(self)):
            if isinstance(getattr(self, name), list):
                object.__setattr__(self, name, tuple(getattr(self, name)))
        kinds = len(self.accelerations), len(self.jitters)
        if not 1 <= min(kinds) <= max(kinds) <= _MOST_MODELS:
            raise ValueError(f"accelerations and jitters: 1 to {_MOST_MODELS} of each")
        for name, others in _BESIDE.items():
            for other in others:
                if len(getattr(self, other)) != len(getattr(self, name)):
                    raise ValueError(f"{other} must have one entry for each of {name}")
        if min(self.acceleration_s, self.jitter_stay_s, *self.stays_s, *self.jitters_s) <= 0.0:
            raise ValueError("acceleration_s, stays_s, jitters_s, jitter_stay_s must be positive")


# Of one kind: the work grows with the square of their product. Source: a chosen limit
_MOST_MODELS = 4
_BESIDE = {"accelerations": ("lasting_accelerations", "stays_s"), "jitters": ("jitters_s",)}


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorOptions:
    """How a sensor's error splits into noise and bias, and how often it is an outlier.

    The errors of a camera on neighbouring frames are nearly the same. A share of the variance is
    therefore a bias: a first-order Gauss–Markov process in the sensor's own σ, and part of the
    state. The share is learnt from the innovations; `bias_share` is where it starts. In files its
    keys are ``lasting``, ``lasting_s`` and ``lasting_range``.
    """

    __pydantic_config__ = _FORBID

    # Of the variance that the sensor reports.
    inflation: float = 1.0  # Source: by construction, neutral
    # Of the variance, that is a bias, at first. Source: plain simulation: below 0.3 good poses are
    # rejected before it is learnt
    bias_share: Annotated[float, _key("bias_share")] = 0.6
    # s, correlation time of the bias. Source: Mitsuba approach: with 30 s the place is off by
    # 10.6 mm between 15 and 7.5 m, not by 7.2
    bias_s: Annotated[float, _key("bias_s")] = 100.0
    # Change of ln(range) over which the bias decorrelates. Source: as bias_s
    bias_range: Annotated[float, _key("bias_range")] = 1.0
    # Probability that a measurement is an outlier. Source: by construction
    outliers: float = 0.02
    # s, σ of a constant by which its times are late; it is estimated. 0: they are right. At most
    # one of two sensors may have it: their difference is all that shows. Source: neutral
    late_s: float = 0.0

    @model_validator(mode="before")
    @classmethod
    def _old_keys(cls, content: Any) -> Any:
        old = ("gate", "lock_after", "loose_after", "unlock_after", "window", "nis_limit")
        return _without(content, (*old, "floor_rad", "floor_range"))

    def __post_init__(self) -> None:
        _check_sizes(self)
        if not (0.0 < self.inflation < math.inf and 0.0 <= self.bias_share < 1.0):
            raise ValueError(
                f"inflation must be positive and lasting from 0 to below 1: "
                f"{self.inflation}, {self.bias_share}"
            )
        if not (self.bias_s > 0.0 and self.bias_range > 0.0):
            raise ValueError("lasting_s and lasting_range must be positive")
        if not 0.0 <= self.late_s < math.inf:
            raise ValueError(f"late_s must not be negative: {self.late_s}")
        if not 0.0 < self.outliers < 0.5:
            raise ValueError(f"outliers must be a probability below 0.5, not {self.outliers}")

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
    # Relative, of the ring's radius; 0: it is known. Source: fusion-approach, seeds 0–5: a mesh
    # draws a ring with corners, and 0.07 % of its range is missing; a real one has tolerances
    ring_radius_sigma: float = 1e-3
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
    # Probability that the state is beyond its protection level. Source: by construction
    risk: float = 1e-3

    @model_validator(mode="before")
    @classmethod
    def _old_keys(cls, content: Any) -> Any:
        return _without(content, ("recent_s",))

    def __post_init__(self) -> None:
        _check_sizes(self)
        if not LEAST_RISK <= self.risk <= MOST_RISK:
            raise ValueError(f"risk must be from {LEAST_RISK:g} to {MOST_RISK:g}, not {self.risk}")
        if not 0.0 <= self.ring_other_edge < 1.0:
            raise ValueError(f"ring_other_edge must be a probability, not {self.ring_other_edge}")
        for name in ("ring_radius_sigma", "ring_depth_sigma_m", "history_s", "coasting_after_s"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be finite, not negative: {getattr(self, name)}")
        for name in ("lost_range_fraction", "lost_rad", "start_with", "history_most"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive: {getattr(self, name)}")
