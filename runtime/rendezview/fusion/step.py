"""One measurement through the filter: start, prediction, trust, update, and restart.

Everything is a value: `step` makes the next `Snapshot` from the last. A late measurement is
inserted at its time, and the later ones are processed again.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from rendezview.fusion.models import gate_of
from rendezview.fusion.options import FusionOptions
from rendezview.fusion.state import (
    MOTION,
    FilterState,
    begin,
    predict,
    sensor_options,
)
from rendezview.fusion.trust import Trust, Verdict, is_sharp, judge
from rendezview.fusion.update import Rejected, innovation
from rendezview.geometry.pose import Array
from rendezview.sensors.measurement import Measurement, PoseMeasurement

# Sensors that must agree against the state to overrule it.
_VOTES = 2  # Source: by construction, the least number of sensors that outvote one
# Times in a row that a sensor was turned away, or not taken whole, to have a vote. Source: by
# construction, a single one may be an outlier
_DOUBT = 2
_LOOSE = "another edge than the ring's: for its bearing only"
# Variance of the rates that are taken over into a new start. Source: by construction, twice the σ
_WIDER = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """The filter after a measurement."""

    state: FilterState | None = None
    trusts: Mapping[str, Trust] = field(default_factory=dict)
    recent: Mapping[str, Measurement] = field(default_factory=dict)  # the last of each sensor
    agreed: int = 0  # measurements that confirmed the start
    started_by: str = ""  # the sensor that began it
    last_accepted_s: float = -math.inf
    starts: int = 0


def useless(state: FilterState, options: FusionOptions) -> str | None:
    """Why a forecast is no longer usable; ``None`` while it is."""
    place = state.covariance[3:6, 3:6]
    limit_m = options.lost_range_fraction * math.sqrt(state.translation_m @ state.translation_m)
    if not _within(place, limit_m):
        return f"the place is known to {math.sqrt(np.linalg.eigvalsh(place)[-1]):.2g} m only"
    attitude = state.covariance[:3, :3]
    if not _within(attitude, options.lost_rad):
        sigma_deg = math.degrees(math.sqrt(np.linalg.eigvalsh(attitude)[-1]))
        return f"the attitude is known to {sigma_deg:.2g}° only"
    return None


def _within(block: Array, sigma: float) -> bool:
    """Whether the largest σ of a (3, 3) covariance is below a limit."""
    if block[0, 0] + block[1, 1] + block[2, 2] < sigma**2:  # the trace is above it
        return True
    return bool(np.linalg.eigvalsh(block)[-1] < sigma**2)


def _blind(state: FilterState) -> bool:
    """Whether the forecast is so wide that nothing can contradict it: start at the next pose."""
    covariance = state.covariance
    place = covariance[3, 3] + covariance[4, 4] + covariance[5, 5]
    attitude = covariance[0, 0] + covariance[1, 1] + covariance[2, 2]
    return bool(attitude > 1.0 or place > state.translation_m @ state.translation_m)


def step(
    before: Snapshot, measurement: Measurement, options: FusionOptions
) -> tuple[Snapshot, Verdict]:
    """The filter after a measurement that is not earlier than those before."""
    name, time_s = measurement.sensor, measurement.time_s
    recent = {**before.recent, name: measurement}
    if before.state is None:
        return _first(replace(before, recent=recent), measurement, options)
    state = predict(before.state, max(time_s - before.state.time_s, 0.0), options)
    why = useless(state, options) if isinstance(measurement, PoseMeasurement) else None
    if why is not None and _blind(state):
        assert isinstance(measurement, PoseMeasurement)
        return _start(replace(before, recent=recent), measurement, options, f"restarted: {why}")
    trust = before.trusts.get(name) or Trust(name)
    found = innovation(state, measurement, options)
    if isinstance(found, Rejected):
        trust = replace(trust, received=trust.received + 1, last_s=time_s)
        trusts = {**before.trusts, name: trust}
        after = replace(before, state=state, trusts=trusts, recent=recent)
        return after, Verdict(name, time_s, False, found.reason, None, found.size)
    if why is not None and found.nis <= _gate(measurement, options):
        # A forecast that is lost believes every pose that it does not contradict.
        trust = replace(trust, locked=False, rejected=0, fault=None)
    trust, reason = judge(trust, found, time_s, sensor_options(measurement, options))
    trusts = {**before.trusts, name: trust}
    if reason is None:
        agreed = before.agreed + (1 if found.size > 1 and not found.loose else 0)
        after = Snapshot(
            found.updated, trusts, recent, agreed, before.started_by, time_s, before.starts
        )
        reason = _LOOSE if found.loose else None
        return after, Verdict(name, time_s, True, reason, found.nis, found.size)
    after = replace(before, state=state, trusts=trusts, recent=recent)
    # Restart if, before any confirmation, the sensor that started the filter contradicts its own
    # start or another sensor is locked out.
    if (
        before.agreed < options.start_with
        and isinstance(measurement, PoseMeasurement)
        and (name == before.started_by or trust.locked)
    ):
        return _start(
            after, measurement, options, f"restarted, the start was not confirmed: {reason}"
        )
    if why is not None and trust.locked and isinstance(measurement, PoseMeasurement):
        return _start(after, measurement, options, f"restarted: {why}")
    if (
        isinstance(measurement, PoseMeasurement)
        and trust.locked
        and trust.returned
        and not is_sharp(found)
    ):
        reason = f"restarted: the sensor was silent and the forecast is not sharp, {reason}"
        return _start(after, measurement, options, reason)
    overruled = _overruled(after, state, options)
    if overruled is not None:
        pose, reason = overruled
        return _start(after, pose, options, reason, state)
    return after, Verdict(name, time_s, False, reason, found.nis, found.size)


def _first(
    before: Snapshot, measurement: Measurement, options: FusionOptions
) -> tuple[Snapshot, Verdict]:
    if isinstance(measurement, PoseMeasurement):
        return _start(before, measurement, options, "begun")
    reason = "no sensor has given a whole pose yet"
    return before, Verdict(measurement.sensor, measurement.time_s, False, reason)


def _start(
    before: Snapshot,
    pose: PoseMeasurement,
    options: FusionOptions,
    reason: str,
    old: FilterState | None = None,
) -> tuple[Snapshot, Verdict]:
    """Begin at a pose; from a state that was overruled the rates are taken over."""
    now_s = pose.time_s if old is None else old.time_s
    state = _trial(pose, old, options) if old is not None else begin(pose, options)
    trust = before.trusts.get(pose.sensor) or Trust(pose.sensor)
    trusts = {
        name: replace(
            t,
            locked=False,
            rejected=0,
            agreed=0,
            fault=None,
            mean_nis=1.0,
            loose=0,
            returned=False,
        )
        for name, t in {**before.trusts, pose.sensor: trust}.items()
    }
    own = trusts[pose.sensor]
    received = own.received + (1 if before.state is None or old is None else 0)
    trusts[pose.sensor] = replace(
        own, received=received, accepted=own.accepted + 1, last_s=now_s, last_accepted_s=now_s
    )
    after = Snapshot(
        predict(state, max(now_s - state.time_s, 0.0), options), trusts, before.recent, 1,
        pose.sensor, now_s, before.starts + 1,
    )  # fmt: skip
    return after, Verdict(pose.sensor, now_s, True, reason, None, 6, began=True)


def resumed(
    pose: PoseMeasurement, rates: Array, covariance: Array, confirmed: bool, options: FusionOptions
) -> Snapshot:
    """The state of a filter that has ended: its pose, rates (6,) and their covariance (12, 12).

    What it knew of its sensors' biases is gone, so the rates get twice their σ, as in a restart.
    """
    state = begin(pose, options, rates)
    state.covariance[6:MOTION, 6:MOTION] = _WIDER * covariance[6:MOTION, 6:MOTION]
    agreed = options.start_with if confirmed else 1
    return Snapshot(state, {}, {}, agreed, pose.sensor, pose.time_s, 1)


def _trial(pose: PoseMeasurement, old: FilterState, options: FusionOptions) -> FilterState:
    """A start at a pose with the rates of another state."""
    state = begin(pose, options, old.rates)
    state.covariance[6:MOTION, 6:MOTION] = _WIDER * old.covariance[6:MOTION, 6:MOTION]
    return state


def _overruled(
    before: Snapshot, state: FilterState, options: FusionOptions
) -> tuple[PoseMeasurement, str] | None:
    """The pose on which at least two sensors agree against the state, and more than not."""
    doubting = [
        name
        for name, t in before.trusts.items()
        if (t.locked or max(t.rejected, t.loose) >= _DOUBT)
        and state.time_s - t.last_s <= options.recent_s
    ]
    if len(doubting) < _VOTES:
        return None
    for name in doubting:
        pose = before.recent.get(name)
        if not isinstance(pose, PoseMeasurement):
            continue
        trial = _trial(pose, state, options)
        votes = 1 + sum(_fits(trial, before.recent[o], options) for o in doubting if o != name)
        against = sum(
            not _fits(trial, before.recent[o], options)
            for o, t in before.trusts.items()
            if o not in doubting and state.time_s - t.last_accepted_s <= options.recent_s
        )
        if votes >= _VOTES and votes > against:
            return pose, f"restarted: {votes} sensors agree against the forecast"
    return None


def _fits(trial: FilterState, measurement: Measurement, options: FusionOptions) -> bool:
    """Whether a measurement passes the gate of a trial state, from before it or after."""
    ahead_s = measurement.time_s - trial.time_s
    if ahead_s < 0.0:
        trial = replace(trial, rates=-trial.rates)  # backwards in time
    moved = replace(predict(trial, abs(ahead_s), options), time_s=measurement.time_s)
    found = innovation(moved, measurement, options)
    if isinstance(found, Rejected):
        return False
    return found.nis <= _gate(measurement, options) and not found.loose


def _gate(measurement: Measurement, options: FusionOptions) -> float:
    return gate_of(measurement.size, sensor_options(measurement, options).gate)
