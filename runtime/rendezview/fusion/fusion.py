"""Sensor fusion: takes measurements as they arrive and gives the estimate at any time."""

from __future__ import annotations

import bisect
import math
import threading
from dataclasses import dataclass
from typing import overload

import numpy as np
from scipy.special import chdtri, expit

from rendezview.fusion.choice import Snapshot, resumed, step, useless_covariance
from rendezview.fusion.options import FusionOptions
from rendezview.fusion.prediction import estimate_of, predict
from rendezview.fusion.rivals import Kind, Rival
from rendezview.fusion.state import RING_GEOMETRY, FilterState
from rendezview.fusion.trust import Trust, Verdict
from rendezview.geometry.pose import Array, Pose
from rendezview.sensors.measurement import (
    Measurement,
    PoseMeasurement,
    RateMeasurement,
    ThrustMeasurement,
)
from rendezview.sensors.observation import Status
from rendezview.sensors.protection import ESTIMATORS_DISAGREE, Protection

# Of a variance, in directions in which readings share no error. Source: by construction, nothing
_LEAST_SHARE = 1e-6
_ALARM = 0.1  # probability of a rival that raises an alarm. Source: by construction


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """The relative state at a time, camera frame."""

    time_s: float
    status: Status
    reason: str | None
    pose: Pose | None  # camera_from_target; None: waiting or lost
    # (6,) angular rate (rad/s), velocity of the target's origin (m/s); None: starting, too
    rates: Array | None
    covariance: Array | None  # (12, 12) rotation vector, translation, angular rate, velocity
    ring_radius: float | None = None  # estimated true radius divided by the given one
    ring_depth_m: float | None = None  # estimated offset along its axis from the given place
    # (2, 2) of these two; 0 where one is known. None: neither is estimated.
    ring_covariance: Array | None = None
    protection: Protection | None = None  # None: no pose
    note: str | None = None  # why the filter last restarted


class Fusion:
    """The filter with a short memory: late measurements are put where they belong.

    fusion = Fusion()
    fusion.add(PoseMeasurement(time_s, "camera", pose, covariance))
    fusion.state_at(time_s + 0.1).pose
    """

    def __init__(self, options: FusionOptions | None = None) -> None:
        self.options = options or FusionOptions()
        self._base = Snapshot()  # before the first measurement that is remembered
        self._measurements: list[Measurement] = []
        self._after: list[Snapshot] = []  # beside them
        # By sensor that gives places: what its readings have in common; None: not known.
        self._common: dict[str, Array | None] = {}
        self._floor_s = -math.inf  # nothing earlier can be put in
        self._asked: tuple[float, Estimate] | None = None  # last, since the newest measurement
        self._lock = threading.Lock()  # of all of the above

    @overload
    def add(self, measurement: Measurement) -> Verdict: ...

    @overload
    def add(self, measurement: Measurement | None) -> Verdict | None: ...

    def add(self, measurement: Measurement | None) -> Verdict | None:
        """Process a measurement, late or not, and report what was done with it.

        ``None``, as from an observation that cannot be fused, changes nothing and returns
        ``None``.
        """
        if measurement is None:
            return None
        with self._lock:
            return self._add(measurement)

    def _add(self, measurement: Measurement) -> Verdict:
        time_s, self._asked = measurement.time_s, None
        if time_s < self._floor_s:
            reason = f"later than {self.options.history_s:g} s: no longer remembered"
            return Verdict(measurement.sensor, time_s, False, reason, None, measurement.size)
        place = bisect.bisect_right(self._measurements, time_s, key=_time_of)
        before = self._after[place - 1] if place else self._base
        after, verdict = step(before, measurement, self.options)
        later = self._measurements[place:]
        del self._measurements[place:], self._after[place:]
        self._measurements.append(measurement)
        self._after.append(after)
        for other in later:
            self._measurements.append(other)
            self._after.append(step(self._after[-1], other, self.options)[0])
        self._forget()
        if verdict.accepted and not isinstance(measurement, RateMeasurement | ThrustMeasurement):
            common = measurement.common if isinstance(measurement, PoseMeasurement) else None
            self._common[measurement.sensor] = common
        return verdict

    def resume(self, last: Estimate) -> None:
        """Go on from the last estimate of another filter; nothing may have been added yet.

        Raises:
            ValueError: the estimate has no pose, or this filter has measurements.
        """
        pose, rates, covariance = last.pose, last.rates, last.covariance
        if pose is None or covariance is None:
            raise ValueError(f"an estimate without a pose ({last.status}) cannot be resumed")
        with self._lock:
            if self._measurements or self._base.main is not None:
                raise ValueError("this filter has begun: resume a new one")
            start = PoseMeasurement(last.time_s, "before", pose, covariance[:6, :6])
            confirmed = last.status in (Status.TRACKING, Status.COASTING)
            self._base = resumed(
                start, np.zeros(6) if rates is None else rates, covariance, confirmed, self.options
            )
            self._floor_s, self._asked = last.time_s, None

    def state_at(self, time_s: float) -> Estimate:
        """The estimate at a time: now, shortly ahead, or within the memory.

        Of a time in the past, it is the estimate by the measurements up to then. Asked again for
        the same time before the next measurement, it is the same object: its arrays are to read.

        Raises:
            ValueError: the time is not finite, or earlier than the memory reaches.
        """
        if not math.isfinite(time_s):
            raise ValueError(f"the time must be finite, not {time_s}")
        with self._lock:
            if self._asked is None or self._asked[0] != time_s:
                self._asked = time_s, self._state_at(time_s)
            return self._asked[1]

    def _state_at(self, time_s: float) -> Estimate:
        place = bisect.bisect_right(self._measurements, time_s, key=_time_of)
        snapshot = self._after[place - 1] if place else self._base
        if snapshot.main is None:
            reason = "no sensor has given a whole pose yet"
            return Estimate(time_s, Status.WAITING, reason, None, None, None)
        state = snapshot.main.state
        ahead_s = time_s - state.time_s
        if time_s < self._floor_s:
            raise ValueError(
                f"{time_s} s is before the earliest remembered time ({state.time_s} s)"
            )
        return self._estimate(snapshot, predict(state, max(ahead_s, 0.0), self.options))

    @property
    def trusts(self) -> dict[str, Trust]:
        """The current trust in each sensor."""
        return dict(self._newest.trusts)

    @property
    def rivals(self) -> dict[str, float]:
        """Probability of what else may be true, by kind: the likeliest of each."""
        found: dict[str, float] = {}
        for rival in self._newest.rivals:
            found[rival.kind] = max(float(expit(rival.score)), found.get(rival.kind, 0.0))
        return found

    @property
    def starts(self) -> int:
        """How often the filter began, the first time included."""
        return self._newest.starts

    @property
    def note(self) -> str | None:
        """Why it last restarted."""
        return self._newest.note

    @property
    def time_s(self) -> float | None:
        """Time of the newest measurement that is part of the state."""
        main = self._newest.main
        return None if main is None else main.state.time_s

    @property
    def _newest(self) -> Snapshot:
        with self._lock:
            return self._after[-1] if self._after else self._base

    def _estimate(self, snapshot: Snapshot, state: FilterState) -> Estimate:
        options, main = self.options, snapshot.main
        assert main is not None
        status, reason = Status.TRACKING, None
        pose, rates, covariance = estimate_of(state)
        covariance = _floored(covariance, list(self._common.values()))
        limit_m = options.lost_range_fraction * math.sqrt(pose.translation_m @ pose.translation_m)
        why = useless_covariance(covariance, limit_m, options.lost_rad)
        silent_s = state.time_s - main.last_accepted_s
        if why is not None:
            return Estimate(state.time_s, Status.LOST, why, None, None, None)
        if main.accepted < options.start_with:
            status = Status.STARTING
            reason = f"{main.accepted} of {options.start_with} poses agree"
        elif silent_s > options.coasting_after_s:
            locked = [name for name, trust in snapshot.trusts.items() if trust.locked]
            status = Status.COASTING
            reason = f"nothing believed for {silent_s:.1f} s" + (
                f"; locked out: {', '.join(locked)}" if locked else ""
            )
        radius, depth_m, ring_covariance = _ring_geometry(state, options)
        return Estimate(
            state.time_s, status, reason, pose, None if status is Status.STARTING else rates,
            covariance, radius, depth_m, ring_covariance,
            _protection(pose, covariance, snapshot, state.time_s, options), snapshot.note,
        )  # fmt: skip

    def _forget(self) -> None:
        """Drop snapshots older than the memory, except the last of them."""
        newest_s = self._measurements[-1].time_s
        count = max(len(self._measurements) - self.options.history_most, 0)
        while newest_s - self._measurements[count].time_s > self.options.history_s:
            count += 1
        if count:
            self._base = self._after[count - 1]
            self._floor_s = self._measurements[count - 1].time_s
            del self._measurements[:count], self._after[:count]


def _floored(covariance: Array, commons: list[Array | None]) -> Array:
    """A covariance (12, 12) of which no direction of the pose is below what readings share.

    Of several sensors each tells what the others do not: their information adds. Where one of them
    does not say what its readings share, there is no floor.
    """
    known = [common for common in commons if common is not None and common.any()]
    if not known or len(known) < len(commons):
        return covariance
    least = np.diag(covariance)[:6] * _LEAST_SHARE  # a common error may leave a direction out
    floor = np.linalg.inv(sum(np.linalg.inv(one + np.diag(least)) for one in known))
    root = np.linalg.cholesky(floor)
    inverse = np.linalg.inv(root)
    values, vectors = np.linalg.eigh(inverse @ covariance[:6, :6] @ inverse.T)
    sides = root @ vectors * np.sqrt(np.maximum(1.0 - values, 0.0))
    raised = covariance.copy()
    raised[:6, :6] += sides @ sides.T
    return raised


def _ring_geometry(
    state: FilterState, options: FusionOptions
) -> tuple[float | None, float | None, Array | None]:
    """True radius over the given one, offset along the axis, and their (2, 2) covariance."""
    slot = state.slots.get(RING_GEOMETRY)
    if slot is None:
        return None, None, None
    sigmas = np.array([options.ring_radius_sigma, options.ring_depth_sigma_m])
    rows = slice(slot.start, slot.start + 2)
    means = sigmas * (state.weights @ state.deviations[:, rows])
    spread = np.einsum("m,mij->ij", state.weights, state.covariances[:, rows, rows])
    return (
        1.0 + float(means[0]) if sigmas[0] > 0.0 else None,
        float(means[1]) if sigmas[1] > 0.0 else None,
        spread * np.outer(sigmas, sigmas),
    )


def _protection(
    pose: Pose, covariance: Array, snapshot: Snapshot, time_s: float, options: FusionOptions
) -> Protection:
    """Levels that hold for the state and for every rival that is likelier than the risk.

    Multiple hypothesis solution separation (Blanch et al., IEEE Trans. Aerospace and Electronic
    Systems 51(1), 2015).
    """
    factor, wrong = math.sqrt(float(chdtri(3, options.risk))), 0.0
    possible = [(np.zeros(6), covariance[:6, :6])]  # how far off, and how uncertain
    for rival in snapshot.rivals:
        likely = float(expit(rival.score))
        if rival.kind is not Kind.DOUBT:  # of a doubt the level says it all
            wrong = max(wrong, likely)
        if likely >= options.risk:
            other, spread = _at(rival, time_s, options)
            possible.append((np.abs(pose.delta_from(other)), spread[:6, :6]))
    axes = np.max([off + factor * np.sqrt(p.diagonal()) for off, p in possible], axis=0)
    attitude = max(_level(off[:3], p[:3, :3], factor) for off, p in possible)
    position_m = max(_level(off[3:], p[3:, 3:], factor) for off, p in possible)
    alarms: tuple[str, ...] = ()
    if wrong > _ALARM or time_s - snapshot.contested_s < options.coasting_after_s:
        alarms = (ESTIMATORS_DISAGREE,)
    return Protection(
        options.risk, min(attitude, math.pi), position_m, axes, wrong, 0.0, alarms
    )  # fmt: skip


def _at(rival: Rival, time_s: float, options: FusionOptions) -> tuple[Pose, Array]:
    state = rival.hypothesis.state
    pose, _, covariance = estimate_of(predict(state, max(time_s - state.time_s, 0.0), options))
    return pose, covariance


def _level(off: Array, covariance: Array, factor: float) -> float:
    return float(np.linalg.norm(off)) + factor * math.sqrt(
        float(np.linalg.eigvalsh(covariance)[-1])
    )


def _time_of(measurement: Measurement) -> float:
    return measurement.time_s
