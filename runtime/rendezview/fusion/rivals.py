"""Rivals: what else may be true, each a whole filter with its own trust in the sensors.

- a slow or a fast target, at the first pose;
- a manoeuvre: a reading was turned away, and would fit a jump of the velocity;
- a new start: the pose that was turned away is right, and the sensors before it were not;
- a doubt: a reading that was believed was wrong, and its sensor still is.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from enum import StrEnum
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from rendezview.fusion.hypothesis import Hypothesis, judged, look
from rendezview.fusion.options import FusionOptions
from rendezview.fusion.state import FilterState, begin
from rendezview.fusion.trust import LOCK_AFTER, Trust, after_reading
from rendezview.geometry import so3
from rendezview.geometry.pose import Array
from rendezview.sensors.measurement import Measurement, PoseMeasurement

CONTRADICTS = 2  # readings of one sensor turned away in a row. Source: one may be an outlier
# Readings that confirm a hypothesis; against it a new start has a lower prior, unless two sensors
# speak for it, or nothing has agreed for long. Source: fusion-faults
_CONFIRMED = 10
# s ago that velocity or rate have jumped: since the sensor's reading before, within limits. Source:
# fusion-faults, a thrust
_JUMP_S, _MOST_JUMP_S = 0.7, 10.0
# σ of the rates that a new start takes over. Source: those of a slow target, `MotionOptions`
_NEW_RATE, _NEW_VELOCITY = 0.03, 0.5
# Probability that a new start gives to a fault of the others, a doubt to its own sensor. Source: by
# construction
_PRESUMED = 0.9
_UNIT = np.eye(3)  # Source: by construction


class Kind(StrEnum):
    """What a rival holds to be true."""

    FAST = "a fast target"
    MANOEUVRE = "a manoeuvre"
    TURN = "a sudden turn"
    START = "a new start"
    DOUBT = "a state without a reading that was believed"


# Of each: prior, least number of readings that fit, s after which a rival without a lead goes.
# Source: fusion-faults; with two fitting poses a wrong first one looks like a fast target
PRIOR = {Kind.FAST: -2.0, Kind.MANOEUVRE: -3.0, Kind.TURN: -4.0, Kind.START: -4.0}
# σ of the jump, m/s, rad/s. Source: a thruster's burn; an object that a hand turns
_JUMPS = {Kind.MANOEUVRE: (0.1, 0.0), Kind.TURN: (0.5, 0.2)}
_CONFIRMED_PRIOR = -8.0  # of a new start. Source: below what wins less what one sensor may say
# Source: as the priors
FITTING = {Kind.FAST: 3, Kind.MANOEUVRE: 2, Kind.TURN: 3, Kind.START: 3, Kind.DOUBT: 3}
# Source: fusion-faults, uncritical
PATIENCE_S = {Kind.FAST: 5.0, Kind.MANOEUVRE: 5.0, Kind.TURN: 5.0, Kind.START: 30.0,
              Kind.DOUBT: 20.0}  # fmt: skip
# Score at which it goes. Source: a doubt, below the default risk; else by construction
LOSES = {Kind.FAST: -40.0, Kind.MANOEUVRE: -40.0, Kind.TURN: -40.0, Kind.START: -40.0,
         Kind.DOUBT: -7.0}  # fmt: skip


class Rival(NamedTuple):
    """A hypothesis beside the main one."""

    kind: Kind
    hypothesis: Hypothesis
    prior: float
    born_s: float
    ratios: Mapping[str, float] = MappingProxyType({})  # by sensor
    heard: Mapping[str, int] = MappingProxyType({})
    fitting: int = 1  # readings that fit it, the one that it was made of included
    doubts: str | None = None  # the sensor whose reading was wrong, if it is right

    @property
    def score(self) -> float:
        """Logarithm of its odds against the main hypothesis."""
        return self.prior + sum(self.ratios.values())


def begun(state: FilterState, pose: PoseMeasurement, trusts: Mapping[str, Trust]) -> Hypothesis:
    """The hypothesis of a state that begins at a pose."""
    trust = trusts.get(pose.sensor) or Trust(pose.sensor)
    own = after_reading(trust, pose.time_s, True, 1.0, 6)
    return Hypothesis(state, {**trusts, pose.sensor: own}, 1, pose.time_s, pose.time_s)


def doubted(
    forecast: Hypothesis, trust: Trust, measurement: Measurement, innovation: Array
) -> Rival:
    """The rival that does without a reading which the main hypothesis believes.

    Args:
        forecast: the main hypothesis before the reading.
        trust: that of the main hypothesis after it.
        innovation: (k,) of the reading at the forecast, the offset that the sensor would have.
    """
    name, time_s = measurement.sensor, measurement.time_s
    known = forecast.trusts.get(name)
    wrong = LOCK_AFTER if known is None else max(LOCK_AFTER, known.rejected)  # in a row
    ill = trust._replace(fault=_PRESUMED, doubt=0.0, offset=innovation, rejected=wrong)
    hypothesis = forecast._replace(trusts={**forecast.trusts, name: ill})
    prior = math.log(trust.doubt) - math.log1p(-trust.doubt)
    return Rival(Kind.DOUBT, hypothesis, prior, time_s, fitting=0, doubts=name)


def with_doubt(rivals: list[Rival], fresh: Rival) -> list[Rival]:
    """The rivals with a new doubt; one that does without the same sensor already stands for it."""
    kept = list(rivals)
    for k, rival in enumerate(rivals):
        if rival.doubts == fresh.doubts:
            more = max(fresh.score - rival.score, 0.0)
            kept[k] = rival._replace(prior=rival.prior + more)
            return kept
    return [*kept, fresh]


def new_rivals(
    heard_s: Mapping[str, float], main: Hypothesis, rivals: list[Rival], measurement: Measurement,
    options: FusionOptions,
) -> list[Rival]:  # fmt: skip
    """Rivals that would explain a reading that the main hypothesis turns away."""
    kinds, found = {rival.kind for rival in rivals}, []
    time_s, name = measurement.time_s, measurement.sensor
    known = main.trusts.get(name) or Trust(name)
    ago_s = min(max(time_s - known.last_s, _JUMP_S), _MOST_JUMP_S)
    for kind, sigmas in _JUMPS.items():
        # What has been turned away for longer has not jumped just now.
        if kind in kinds or known.rejected >= CONTRADICTS:
            continue
        trust = known._replace(fault=0.0, offset=None)
        opened = main._replace(
            state=_with_jump(main.state, ago_s, *sigmas), trusts={**main.trusts, name: trust}
        )
        seen = look(opened.state, measurement, options)
        if isinstance(seen, str):
            continue
        after, fits = judged(opened, measurement, seen, options)
        if fits:
            found.append(Rival(kind, after, PRIOR[kind], time_s))
    if Kind.START not in kinds and isinstance(measurement, PoseMeasurement):
        moving = main.state.confirmed
        state = begin(
            measurement, options,
            (main.state.rate.copy(), main.state.velocity.copy()) if moving else None,
            (_NEW_RATE, _NEW_VELOCITY) if moving
            else (options.motion.fast_rate, options.motion.fast_velocity),
        )  # fmt: skip
        trusts = {
            other: trust._replace(
                fault=_PRESUMED, offset=_off(main.state, measurement), rejected=0
            )
            if trust.sensor in heard_s and other != name and trust.fault < 0.5
            and trust.poses
            else trust._replace(fault=0.0, offset=None, rejected=0)
            for other, trust in main.trusts.items()
        }  # fmt: skip
        confirmed = main.accepted >= _CONFIRMED
        prior = _CONFIRMED_PRIOR if confirmed else PRIOR[Kind.START]
        fresh = begun(state, measurement, trusts)
        found.append(Rival(Kind.START, fresh, prior, time_s))
    return found


def _with_jump(state: FilterState, ago_s: float, velocity: float, rate: float) -> FilterState:
    """The state if velocity (σ, m/s) and rate (σ, rad/s) have jumped so long ago."""
    moves = np.zeros((state.deviations.shape[1], 6))
    moves[3:6, :3], moves[9:12, :3] = ago_s * velocity * _UNIT, velocity * _UNIT
    moves[:3, 3:], moves[6:9, 3:] = ago_s * rate * state.rotation, rate * _UNIT
    moves[3:6, 3:] = ago_s * rate * so3.hat(state.place_m)
    return state._replace(covariances=state.covariances + moves @ moves.T)


def _off(state: FilterState, pose: PoseMeasurement) -> Array:
    """(6,) innovation that a sensor at the state has beside a new start at a pose."""
    turn = so3.between(state.rotation, np.array(pose.pose.rotation))
    away = -state.rotation @ state.place_m - pose.pose.translation_m
    return np.concatenate([turn, away])
