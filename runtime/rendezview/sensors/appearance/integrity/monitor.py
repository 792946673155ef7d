"""The integrity of poses by appearance: a protection level for each, and an alarm.

A level has three parts: the tails of the pose's own error, from its covariance; the rival of the
search; and any other pose, with the probability that the evidence of the track leaves it. Evidence
is that of each frame (edges, trees, shading), of the motion, and of the sketch as a second
estimator, which is asked where the others leave more doubt than the user's risk.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from rendezview.errors import RendezviewError
from rendezview.estimation.protection import LEAST_RISK, MOST_RISK, Drift, Overbound, shared
from rendezview.geometry.pose import Array, Pose
from rendezview.sensors.appearance.integrity.evidence import Evidence, Other, Second
from rendezview.sensors.appearance.integrity.model import (
    SAME_RAD,
    IntegrityModel,
    SecondEstimator,
    frame_features,
    track_features,
)
from rendezview.sensors.appearance.observation import AppearanceObservation
from rendezview.sensors.protection import ESTIMATORS_DISAGREE, Protection

_JUMP_RAD = math.radians(15.0)  # rad; such a change is no motion. Source: reach of tracking


@dataclass(frozen=True, kw_only=True)
class IntegrityOptions:
    """The user's risk and limits."""

    risk: float = 1e-3  # probability that an error exceeds its level. Source: the user's to choose
    alarm_attitude_rad: float = math.inf  # rad; a higher level is an alarm. Source: the user's
    alarm_position_m: float = math.inf  # m; the same. Source: the user's
    # Acceleration that is no drift: a slow tumble of 3°/s, a thruster of a small craft.
    turn_rad_s2: float = math.radians(0.1)  # rad/s². Source: torque-free motion
    move_m_s2: float = 2e-3  # m/s². Source: cold-gas thrusters
    second_every: int = 5  # frames; the second estimator is not asked more often. Source: its cost

    def __post_init__(self) -> None:
        if not LEAST_RISK <= self.risk <= MOST_RISK:
            raise RendezviewError(
                f"the integrity risk must be {LEAST_RISK:g} to {MOST_RISK:g}, not {self.risk:g}"
            )
        for name in ("alarm_attitude_rad", "alarm_position_m"):
            if not getattr(self, name) > 0.0:
                raise RendezviewError(f"{name} must be positive, not {getattr(self, name)}")


@dataclass(frozen=True, slots=True, eq=False)
class _Step:
    """What a later innovation needs of a pose."""

    time_s: float
    variance: Array  # (6,)


class IntegrityMonitor:
    """Judges the poses of one track, in order of time."""

    def __init__(
        self, options: IntegrityOptions | None = None, model: IntegrityModel | None = None
    ) -> None:
        """A monitor before its first pose.

        Args:
            options: risk and limits.
            model: the fitted numbers; ``None``: those that come with the program.
        """
        self.options = options or IntegrityOptions()
        self.model = model or IntegrityModel.packaged()
        self._restart()

    def _restart(self) -> None:
        self._smoothed: Array | None = None
        self._followed = 0
        self._second = SecondEstimator()
        self._asked = -self.options.second_every
        self._steps: list[_Step] = []
        self._drift = Drift.none(6)
        self._others: tuple[Other, ...] = ()  # of the track's first pose, or a later search

    def protected(
        self,
        observation: AppearanceObservation,
        time_s: float,
        predicted: Pose | None,
        centre_m: Array,
        second: Callable[[Pose], Second | None] | None = None,
    ) -> AppearanceObservation:
        """The observation with its protection; unchanged without a refined pose.

        Args:
            observation: of the frame.
            time_s: of the frame, later than those before.
            predicted: camera_from_target that the frames before led to; ``None``: a new track.
            centre_m: (3,) view centre, target frame.
            second: asks a second estimator for its pose beside a given one.
        """
        evidence = Evidence.of(observation, time_s, predicted, centre_m)
        pose = observation.pose
        if evidence is None or pose is None:
            return observation
        ask = None if second is None else partial(second, pose)
        return replace(observation, protection=self.judge(evidence, ask))

    def judge(
        self, evidence: Evidence, ask: Callable[[], Second | None] | None = None
    ) -> Protection:
        """The protection of the next pose of the track; ``ask`` asks the second estimator."""
        innovation = evidence.innovation
        if innovation is None or np.linalg.norm(innovation[:3]) > _JUMP_RAD:
            self._restart()
        self._others = evidence.others or self._others
        features = frame_features(evidence)
        if self._smoothed is None:
            self._smoothed = features
        else:
            self._smoothed = self._smoothed + self.model.smoothing * (features - self._smoothed)
            self._followed += 1
        self._move(evidence)
        protection = self._protection(evidence)
        waited = self._followed - self._asked >= self.options.second_every
        doubt = protection.wrong > self.options.risk or ESTIMATORS_DISAGREE in protection.alarms
        if ask is None or evidence.sketched or not (waited and doubt):
            return protection  # of its own pose a sketch is no second estimator
        second = ask()
        self._asked, self._second = self._followed, self._second.after(second)
        if second is not None:
            self._others = tuple(_after(other, second) for other in self._others)
        return self._protection(evidence)

    @property
    def features(self) -> Array:
        """(21,) ``FRAME_FEATURES`` and ``TRACK_FEATURES`` of the last pose."""
        assert self._smoothed is not None
        return np.concatenate([self._smoothed, track_features(self._followed, self._second)])

    def _move(self, evidence: Evidence) -> None:
        """Compare the pose with the motion of the two before it."""
        step = _Step(evidence.time_s, np.diag(evidence.covariance)[:6])
        if evidence.innovation is not None and len(self._steps) == 2:
            before, last = self._steps
            ahead_s = step.time_s - last.time_s
            ratio = ahead_s / (last.time_s - before.time_s)
            # Of x₁ + ratio (x₁ − x₀) and of the new pose.
            variance = step.variance + (1.0 + ratio) ** 2 * last.variance
            variance = variance + ratio**2 * before.variance
            options = self.options
            change = np.repeat([options.turn_rad_s2, options.move_m_s2], 3)
            variance = variance + (0.5 * ahead_s * (ahead_s + ahead_s / ratio) * change) ** 2
            normalised = evidence.innovation / np.sqrt(variance)
            self._drift = self._drift.after(normalised, self.model.allowance, self.model.most)
        self._steps = [*self._steps[-1:], step]

    def _protection(self, evidence: Evidence) -> Protection:
        model, options = self.model, self.options
        wrong = model.probability_wrong(self.features)
        rival = 0.0 if math.isnan(evidence.rival_rad) else model.at_rival * wrong
        beside = sum(other.probability for other in self._others)
        anywhere = max(wrong - rival - beside, 0.0)
        shown, covariance = self._smoothed, evidence.covariance
        assert shown is not None
        turning = model.attitude_spread.widened(covariance[:3, :3], shown, 1.0)
        moving = model.position_spread.widened(covariance[3:6, 3:6], shown, evidence.range_m)
        attitude, turn = _level(
            model.attitude, turning, options.risk,
            [(evidence.rival_rad, rival), (math.pi, anywhere),
             *((other.angle_rad, other.probability) for other in self._others)],
            math.pi, 1.0,
        )  # fmt: skip
        position, move = _level(
            model.position, moving, options.risk,
            [(evidence.rival_m, rival), (math.inf, anywhere),
             *((other.apart_m, other.probability) for other in self._others)],
            math.inf, evidence.range_m,
        )  # fmt: skip
        return Protection(
            risk=options.risk,
            attitude_rad=attitude,
            position_m=position,
            axes=np.concatenate([turn, move]),
            wrong=max(wrong, rival + beside),
            drift=self._drift.largest,
            alarms=self._alarms(attitude, position),
        )

    def _alarms(self, attitude_rad: float, position_m: float) -> tuple[str, ...]:
        options, alarms = self.options, []
        if attitude_rad > options.alarm_attitude_rad or attitude_rad >= math.pi:
            alarms.append("attitude")
        if position_m > options.alarm_position_m or math.isinf(position_m):
            alarms.append("position")
        if self._second.contradicts(attitude_rad):
            alarms.append(ESTIMATORS_DISAGREE)
        if self._drift.largest > self.model.limit:
            alarms.append("drift")
        return tuple(alarms)


def _after(other: Other, second: Second) -> Other:
    """Another answer after a second estimator's: its odds are multiplied (Bayes)."""
    sure = min(max(second.confidence, 1e-6), 1.0 - 1e-6)
    agrees = second.angle_rad < SAME_RAD
    against = (1.0 - sure) / sure if agrees else sure / (1.0 - sure)
    odds = against * other.probability / max(1.0 - other.probability, 1e-12)
    return other._replace(probability=odds / (1.0 + odds))


def _level(
    bound: Overbound,
    covariance: Array,
    risk: float,
    others: list[tuple[float, float]],
    most: float,
    unit: float,
) -> tuple[float, Array]:
    """A level and that of each axis, both at most the largest that there is."""
    radius = bound.radius(covariance, unit)
    share = shared(radius, [other for other in others if other[1] > 0.0], risk)
    level = share.level(radius)
    if level >= most:
        return most, np.full(3, most)
    axes = np.maximum(share.covered, bound.each(covariance, share.risk, unit))
    return level, np.minimum(axes, level)
