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
# Probability that a new start gives to a fault of the others, a doubt to its own sensor. Source: by
# construction
_PRESUMED = 0.9


class Kind(StrEnum):
    """What a rival holds to be true."""

    FAST = "a fast target"
    MANOEUVRE = "a manoeuvre"
    START = "a new start"
    DOUBT = "a state without a reading that was believed"


PRIOR = -4.0  # of a rival. Source: by construction, one in fifty
# Of a fast target. Source: plain situations: with that of the others the first of all readings, if
# it is wrong, is beyond its level without an alarm
FAST_PRIOR = -2.0
# σ of a manoeuvre's jump, m/s, rad/s. Source: a thruster's burn, an object that a hand turns
_JUMP, _TURN = 0.15, 0.05
# Prior of a new start against a confirmed state, unless two sensors speak for it or nothing has
# agreed for long. Source: below what wins less what one sensor may say
_CONFIRMED_PRIOR = -8.0
# Readings that fit a rival when it wins. Source: with two a wrong first pose looks like a fast
# target
FITTING = 3
# s after which a rival without a lead goes. Source: fusion-faults
PATIENCE_S = {Kind.FAST: 5.0, Kind.MANOEUVRE: 5.0, Kind.START: 30.0,
              Kind.DOUBT: 20.0}  # fmt: skip
LOSES = -7.0  # score at which a doubt goes. Source: below the default risk


class Rival(NamedTuple):
    """A hypothesis beside the main one."""

    kind: Kind
    hypothesis: Hypothesis
    prior: float
    born_s: float
    ratios: Mapping[str, float] = MappingProxyType({})  # by sensor
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
    main: Hypothesis, rivals: list[Rival], measurement: Measurement, options: FusionOptions
) -> list[Rival]:
    """Rivals that would explain a reading that the main hypothesis turns away."""
    kinds, found = {rival.kind for rival in rivals}, []
    time_s, name = measurement.time_s, measurement.sensor
    known = main.trusts.get(name) or Trust(name)
    ago_s = time_s - known.last_s if known.received else 0.0  # since when it may have jumped
    # What has been turned away for longer has not jumped just now.
    if Kind.MANOEUVRE not in kinds and known.rejected < CONTRADICTS:
        trust = known._replace(fault=0.0, offset=None)
        opened = main._replace(
            state=_with_jump(main.state, ago_s), trusts={**main.trusts, name: trust}
        )
        seen = look(opened.state, measurement, options)
        if not isinstance(seen, str):
            after, fits = judged(opened, measurement, seen, options)
            if fits:
                # It keeps the state, which has fitted before.
                found.append(Rival(Kind.MANOEUVRE, after, PRIOR, time_s, fitting=2))
    if Kind.START not in kinds and isinstance(measurement, PoseMeasurement):
        motion, moving = options.motion, main.state.confirmed
        state = begin(
            measurement, options,
            (main.state.rate.copy(), main.state.velocity.copy()) if moving else None,
            None if moving else (motion.fast_rate, motion.fast_velocity),
        )  # fmt: skip
        trusts = {
            other: trust._replace(
                fault=_PRESUMED, offset=_off(main.state, measurement), rejected=0
            )
            if other != name and trust.fault < 0.5 and trust.poses
            else trust._replace(fault=0.0, offset=None, rejected=0)
            for other, trust in main.trusts.items()
        }  # fmt: skip
        prior = _CONFIRMED_PRIOR if moving else PRIOR
        fresh = begun(state, measurement, trusts)
        found.append(Rival(Kind.START, fresh, prior, time_s))
    return found


def _with_jump(state: FilterState, ago_s: float) -> FilterState:
    """The state if velocity and rate have jumped so long ago."""
    moves = np.zeros((state.deviations.shape[1], 6))
    moves[3:6, :3], moves[9:12, :3] = ago_s * _JUMP * np.eye(3), _JUMP * np.eye(3)
    moves[:3, 3:], moves[6:9, 3:] = ago_s * _TURN * state.rotation, _TURN * np.eye(3)
    moves[3:6, 3:] = ago_s * _TURN * so3.hat(state.place_m)
    return state._replace(covariances=state.covariances + moves @ moves.T)


def _off(state: FilterState, pose: PoseMeasurement) -> Array:
    """(6,) innovation that a sensor at the state has beside a new start at a pose."""
    turn = so3.between(state.rotation, np.array(pose.pose.rotation))
    away = -state.rotation @ state.place_m - pose.pose.translation_m
    return np.concatenate([turn, away])
