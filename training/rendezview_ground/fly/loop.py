"""The closed loop: sensor, estimator, controller and dynamics, each of which may be another's."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from rendezview.fusion import Fusion, Measurement, RateMeasurement
from rendezview.geometry.pose import Array
from rendezview_ground.fly.dynamics import Command, Truth
from rendezview_ground.fly.guidance import Known, Mode
from rendezview_ground.fly.options import FlyPlan
from rendezview_ground.fly.port import Contact, Port, Relative


class Sensor(Protocol):
    """Reads the truth, as its estimator takes it; what is known already may help, as a prior."""

    def read(self, truth: Truth, known: Known | None) -> Sequence[Any]: ...


class Estimator(Protocol):
    """Joins readings to a state."""

    def update(self, time_s: float, readings: Sequence[Any]) -> Known: ...


class Controller(Protocol):
    """Says what to do until the next step."""

    def command(self, known: Known) -> Command: ...


class Dynamics(Protocol):
    """Moves both craft."""

    port: Port
    plan: FlyPlan

    def start(self) -> Truth: ...

    def step(self, truth: Truth, command: Command) -> Truth: ...


class FusedEstimator:
    """The project's fusion at its defaults."""

    def __init__(self) -> None:
        self.fusion = Fusion()
        self._turning: Array = np.zeros(3)

    def update(self, time_s: float, readings: Sequence[Measurement]) -> Known:
        """The state at a time, with the readings since the last one."""
        used = []
        for reading in readings:
            if self.fusion.add(reading).accepted and reading.size:
                used.append(reading.sensor)
            if isinstance(reading, RateMeasurement):
                self._turning = reading.rate_rad_s
        state, rivals = self.fusion.state_at(time_s), tuple(self.fusion.rivals.items())
        return Known(time_s, state, self._turning, tuple(used), rivals, self.fusion.state_at)


@dataclass(frozen=True, slots=True, eq=False)
class Moment:
    """One step of a flight, for its report. NaN where there is no state."""

    time_s: float
    mode: str
    reason: str
    status: str
    true: Relative
    place_m: Array  # (3,) of the chaser's port off the port's centre: along, right and down
    known_m: Array  # (3,) the same by the state
    error_m: float  # of the target's place in the camera frame
    error_rad: float
    level_m: float  # protection level of that
    level_rad: float
    alarm: bool
    used: tuple[str, ...]
    spent_m_s: float
    rivals: tuple[tuple[str, float], ...] = ()  # and how likely each is


@dataclass
class Flight:
    """A whole flight."""

    moments: list[Moment] = field(default_factory=list)
    contact: Contact | None = None
    touch_m: Array | None = None  # (2,) where the port's plane was met, right and down
    outside: str | None = None  # which condition of contact was outside the envelope
    end: str = ""  # contact, outside, held or aborted

    @property
    def beyond(self) -> int:
        """Steps in which an error was above its protection level without an alarm."""
        return sum(
            (m.error_m > m.level_m or m.error_rad > m.level_rad) and not m.alarm
            for m in self.moments
        )

    @property
    def known(self) -> int:
        """Steps with a protection level."""
        return sum(not math.isnan(m.level_m) for m in self.moments)


class Loop:
    """Closes the loop around any four parts that keep the protocols.

    flight = Loop(sensor, FusedEstimator(), controller, dynamics).run()
    """

    def __init__(
        self, sensor: Sensor, estimator: Estimator, controller: Controller, dynamics: Dynamics
    ) -> None:
        self.sensor, self.estimator = sensor, estimator
        self.controller, self.dynamics = controller, dynamics

    def run(self) -> Flight:
        """Fly until contact, a safe hold, or the longest time."""
        dynamics, plan, flight = self.dynamics, self.dynamics.plan, Flight()
        truth, known = dynamics.start(), None
        still_s = 0.0
        before = Relative.of(dynamics.port, truth.pose, truth.rates, truth.turning)
        for _ in range(plan.steps):
            known = self.estimator.update(truth.time_s, self.sensor.read(truth, known))
            command = self.controller.command(known)
            flight.moments.append(_moment(dynamics.port, truth, known, command, before))
            truth = dynamics.step(truth, command)
            now = Relative.of(dynamics.port, truth.pose, truth.rates, truth.turning)
            if now.range_m <= 0.0:
                touch = _crossing(before, now)
                flight.contact = Contact.of(dynamics.port, touch)
                flight.touch_m = dynamics.port.facing[:2] @ touch.aside_m
                flight.outside = flight.contact.outside(plan.envelope)
                flight.end = "contact" if flight.outside is None else "outside"
                return flight
            before = now
            slow = float(np.linalg.norm(now.speed_m_s)) < plan.envelope.lateral_m_s
            still_s = still_s + plan.guidance.step_s if slow else 0.0
            if command.mode == Mode.ABORT and still_s > plan.guidance.patience_s:
                break
        flight.end = "aborted" if flight.moments[-1].mode == Mode.ABORT else "held"
        return flight


def _crossing(before: Relative, after: Relative) -> Relative:
    """Where the port's plane is crossed, on the straight line between two steps."""
    share = before.range_m / (before.range_m - after.range_m)

    def between(name: str) -> Array:
        one, two = getattr(before, name), getattr(after, name)
        return np.asarray(one + share * (two - one))

    names = ("aside_m", "turn", "speed_m_s", "rate", "mass_m", "mass_speed_m_s")
    middle = {name: between(name) for name in names}
    return Relative(range_m=0.0, closing_m_s=float(between("closing_m_s")), **middle)


def _moment(port: Port, truth: Truth, known: Known, command: Command, true: Relative) -> Moment:
    estimate, axes = known.estimate, np.vstack([port.axis, port.facing[0], port.facing[1]])
    place = axes @ (true.aside_m + true.range_m * port.axis)
    seen, error_m, error_rad = np.full(3, np.nan), math.nan, math.nan
    level_m, level_rad, alarm = math.nan, math.nan, True
    if estimate.pose is not None and estimate.protection is not None:
        nose = estimate.pose.inverse().apply([0.0, 0.0, port.ahead_m])
        seen = axes @ (nose - port.centre_m)
        error_m = float(np.linalg.norm(estimate.pose.translation_m - truth.pose.translation_m))
        error_rad = estimate.pose.angle_to(truth.pose)
        levels = estimate.protection
        level_m, level_rad, alarm = levels.position_m, levels.attitude_rad, levels.alarm
    return Moment(
        truth.time_s, command.mode, command.reason, str(estimate.status), true, place, seen,
        error_m, error_rad, level_m, level_rad, alarm, known.used, truth.spent_m_s, known.rivals,
    )  # fmt: skip
