"""Sensor fusion: takes measurements as they arrive and gives the estimate at any time."""

from __future__ import annotations

import bisect
import math
import threading
from dataclasses import dataclass
from typing import overload

from rendezview.fusion.options import FusionOptions
from rendezview.fusion.state import RING, FilterState, predict
from rendezview.fusion.step import Snapshot, resumed, step, useless
from rendezview.fusion.trust import Trust, Verdict
from rendezview.geometry.pose import Array, Pose
from rendezview.sensors.measurement import Measurement, PoseMeasurement
from rendezview.sensors.observation import Status

_ROUNDING_S = 1e-9  # Source: by construction


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """The relative state at a time, camera frame."""

    time_s: float
    status: Status
    reason: str | None
    pose: Pose | None  # camera_from_target; None: waiting or lost
    rates: Array | None  # (6,) angular rate (rad/s), velocity of the target's origin (m/s)
    covariance: Array | None  # (12, 12) rotation vector, translation, angular rate, velocity
    ring_radius: float | None = None  # estimated true radius divided by the given one
    ring_depth_m: float | None = None  # estimated offset along its axis from the given place
    # (2, 2) of these two; 0 where one is known. None: neither is estimated.
    ring_covariance: Array | None = None


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
        self._floor_s = -math.inf  # nothing earlier can be put in
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
        time_s = measurement.time_s
        if time_s < self._floor_s:
            reason = f"later than {self.options.history_s:g} s: no longer remembered"
            return Verdict(measurement.sensor, time_s, False, reason)
        place = bisect.bisect_right(self._measurements, time_s, key=_time_of)
        before = self._after[place - 1] if place else self._base
        after, verdict = step(before, measurement, self.options)
        self._measurements.insert(place, measurement)
        self._after.insert(place, after)
        for k in range(place + 1, len(self._measurements)):  # what came before it, but is later
            after, _ = step(after, self._measurements[k], self.options)
            self._after[k] = after
        self._forget()
        return verdict

    def resume(self, last: Estimate) -> None:
        """Go on from the last estimate of another filter; nothing may have been added yet.

        Raises:
            ValueError: the estimate has no pose, or this filter has measurements.
        """
        pose, rates, covariance = last.pose, last.rates, last.covariance
        if pose is None or rates is None or covariance is None:
            raise ValueError(f"an estimate without a pose ({last.status}) cannot be resumed")
        with self._lock:
            if self._measurements or self._base.state is not None:
                raise ValueError("this filter has begun: resume a new one")
            start = PoseMeasurement(last.time_s, "before", pose, covariance[:6, :6])
            confirmed = last.status in (Status.TRACKING, Status.COASTING)
            self._base = resumed(start, rates, covariance, confirmed, self.options)
            self._floor_s = last.time_s

    def state_at(self, time_s: float) -> Estimate:
        """The estimate at a time: now, shortly ahead, or within the memory.

        Of a time in the past, it is the estimate by the measurements up to then.

        Raises:
            ValueError: the time is not finite, or earlier than the memory reaches.
        """
        if not math.isfinite(time_s):
            raise ValueError(f"the time must be finite, not {time_s}")
        with self._lock:
            place = bisect.bisect_right(self._measurements, time_s, key=_time_of)
            snapshot = self._after[place - 1] if place else self._base
        state = snapshot.state
        if state is None:
            reason = "no sensor has given a whole pose yet"
            return Estimate(time_s, Status.WAITING, reason, None, None, None)
        ahead_s = time_s - state.time_s
        if ahead_s < -_ROUNDING_S:
            raise ValueError(
                f"{time_s} s is before the earliest remembered time ({state.time_s} s)"
            )
        return self._estimate(snapshot, predict(state, max(ahead_s, 0.0), self.options))

    @property
    def trusts(self) -> dict[str, Trust]:
        """The current trust in each sensor."""
        return dict(self._newest.trusts)

    @property
    def starts(self) -> int:
        """How often the filter began, the first time included."""
        return self._newest.starts

    @property
    def time_s(self) -> float | None:
        """Time of the newest measurement that is part of the state."""
        state = self._newest.state
        return None if state is None else state.time_s

    @property
    def _newest(self) -> Snapshot:
        with self._lock:
            return self._after[-1] if self._after else self._base

    def _estimate(self, snapshot: Snapshot, state: FilterState) -> Estimate:
        options = self.options
        status, reason = Status.TRACKING, None
        why = useless(state, options)
        silent_s = state.time_s - snapshot.last_accepted_s
        if why is not None:
            return Estimate(state.time_s, Status.LOST, why, None, None, None)
        if snapshot.agreed < options.start_with:
            status = Status.STARTING
            reason = f"{snapshot.agreed} of {options.start_with} poses agree"
        elif silent_s > options.coasting_after_s:
            locked = [name for name, trust in snapshot.trusts.items() if trust.locked]
            status = Status.COASTING
            reason = f"nothing believed for {silent_s:.1f} s" + (
                f"; locked out: {', '.join(locked)}" if locked else ""
            )
        return Estimate(
            state.time_s,
            status,
            reason,
            state.pose,
            state.rates.copy(),
            state.motion_covariance.copy(),
            1.0 + float(state.extras[0]) if options.ring_radius_sigma > 0.0 else None,
            float(state.extras[1]) if options.ring_depth_sigma_m > 0.0 else None,
            state.covariance[RING, RING].copy()
            if options.ring_radius_sigma > 0.0 or options.ring_depth_sigma_m > 0.0
            else None,
        )

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


def _time_of(measurement: Measurement) -> float:
    return measurement.time_s
