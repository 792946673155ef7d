"""Guidance by hold points, glide slope and corridor; control by discrete linear regulators.

The chaser approaches while nothing is in doubt. A doubt (no state, an alarm, a protection level or
a place outside the corridor, contact conditions that are not certain) makes it hold; a doubt that
lasts, or one in the last metre, makes it retreat to a hold point; too many retreats make it abort.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import lru_cache

import numpy as np
from scipy.linalg import solve_discrete_are
from scipy.special import chdtri

from rendezview.fusion import Estimate
from rendezview.geometry import so3
from rendezview.geometry.pose import Array
from rendezview.sensors.observation import Status
from rendezview.sensors.protection import Protection
from rendezview_ground.fly.dynamics import Command
from rendezview_ground.fly.options import FlyPlan
from rendezview_ground.fly.port import Contact, Port, Relative

# Bryson's rule: a state at its bound costs as much as the actuator at its own. The bounds grow with
# the range, as the errors of the fused state do. Source: half the envelope; `fusion-approach`
_ASIDE_M, _ASIDE_SHARE = 0.05, 0.005
_SPEED_M_S, _SPEED_SHARE = 0.01, 0.001
_TURN_RAD, _RATE_RAD_S = math.radians(0.25), math.radians(0.05)  # Source: an eighth of the envelope
_STEPS = 1.25  # ratio of the ranges at which gains are computed. Source: chosen


class Mode(StrEnum):
    """What the chaser does."""

    APPROACH = "approach"
    HOLD = "hold"
    RETREAT = "retreat"
    ABORT = "abort"


@dataclass(frozen=True, slots=True, eq=False)
class Known:
    """What the chaser knows at a time."""

    time_s: float
    estimate: Estimate
    turning: Array  # (3,) by its gyroscope, rad/s, camera frame
    used: tuple[str, ...] = ()  # sensors whose readings were accepted since the last step
    rivals: tuple[tuple[str, float], ...] = ()  # what else may be true, and how likely
    forecast: Callable[[float], Estimate] | None = None  # of a time shortly ahead


@lru_cache(maxsize=256)
def regulator(place: float, speed: float, effort: float, dt_s: float) -> tuple[float, float]:
    """Gains on place and velocity of a discrete double integrator, 1/s² and 1/s, Bryson's rule."""
    a = np.array([[1.0, dt_s], [0.0, 1.0]])
    b = np.array([[0.5 * dt_s**2], [dt_s]])
    cost = np.diag([place**-2, speed**-2])
    effort_cost = np.array([[effort**-2]])
    p = solve_discrete_are(a, b, cost, effort_cost)
    gain = np.linalg.solve(effort_cost + b.T @ p @ b, b.T @ p @ a)[0]
    return float(gain[0]), float(gain[1])


@lru_cache(maxsize=256)
def rate_regulator(bound: float, effort: float, dt_s: float) -> float:
    """Gain of a discrete single integrator, 1/s."""
    one = np.ones((1, 1))
    p = solve_discrete_are(one, dt_s * one, one / bound**2, one / effort**2)[0, 0]
    return float(dt_s * p / (effort**-2 + dt_s**2 * p))


class Guidance:
    """The default controller of a flight."""

    def __init__(self, plan: FlyPlan, port: Port) -> None:
        self.plan, self.port = plan, port
        self.mode, self.reason = Mode.HOLD, "no state yet"
        self.hold_m = max(plan.guidance.holds_m)
        self.retreats = 0
        self.stuck_s = 0.0  # how long the present hold has had a doubt
        self.at: Relative | None = None  # by the last state
        self._ordered = ""  # hold or retreat, by an operator
        self._turns_back = False  # as soon as it can
        self._clear_s = 0.0
        self._pushed = False  # away from the target, since the state was lost

    def order(self, order: str) -> None:
        """What an operator orders: ``hold``, ``retreat`` (and hold there), or ``go_on``."""
        self._ordered = "" if order == "go_on" else f"{order} ordered"
        self._turns_back = order == "retreat"

    def command(self, known: Known) -> Command:
        """What to do until the next step."""
        estimate = known.estimate
        if estimate.pose is None or estimate.rates is None:
            return self._blind(known)
        self._pushed = False
        at = Relative.of(self.port, estimate.pose, estimate.rates, known.turning)
        self.at = at
        self._decide(self._doubt(known, at) or self._ordered or None, at)
        return self._steer(known, at)

    def _doubt(self, known: Known, at: Relative) -> str | None:
        """Why the chaser may not go on; None: it may."""
        estimate, guidance = known.estimate, self.plan.guidance
        if estimate.status is not Status.TRACKING:
            return estimate.reason or str(estimate.status)
        levels = estimate.protection
        if levels is None or levels.alarm:
            return "alarm of the filter"
        half_m = guidance.corridor_m + math.tan(math.radians(guidance.corridor_deg)) * max(
            at.range_m, 0.0
        )
        if levels.position_m > half_m:
            return f"protection level {levels.position_m:.2f} m"
        if levels.attitude_rad > math.radians(self.plan.envelope.angle_deg):
            return f"protection level {math.degrees(levels.attitude_rad):.1f}°"
        if float(np.linalg.norm(at.aside_m)) > half_m:
            return "outside the corridor"
        if at.range_m < guidance.commit_m and self.mode is Mode.APPROACH:
            now = Contact.of(self.port, at)
            slower = guidance.slope_per_s * at.range_m  # by the glide slope until contact
            then = replace(now, closing_m_s=now.closing_m_s - slower)
            bad = then.outside(self.plan.envelope, self._margin(estimate, levels))
            return None if bad is None else f"contact not certain: {bad}"
        return None

    def _margin(self, estimate: Estimate, levels: Protection) -> Contact:
        """By how much the contact conditions may be worse than the state says."""
        assert estimate.covariance is not None
        factor = math.sqrt(float(chdtri(3, levels.risk)))
        spread = np.linalg.eigvalsh(estimate.covariance[9:, 9:])[-1]
        rate = np.linalg.eigvalsh(estimate.covariance[6:9, 6:9])[-1]
        gyro = math.radians(self.plan.chaser.gyro_deg_s)
        speed = factor * math.sqrt(spread)
        angle, turning = levels.attitude_rad, factor * math.sqrt(rate) + gyro
        # The port stands ahead of the camera: its place is off by the attitude, too.
        lateral = levels.position_m + self.port.ahead_m * angle
        return Contact(lateral, angle, angle, speed, speed, turning, turning)

    def _decide(self, doubt: str | None, at: Relative) -> None:
        """The mode for the next step."""
        guidance, dt = self.plan.guidance, self.plan.guidance.step_s
        self._clear_s = self._clear_s + dt if doubt is None else 0.0
        if self.mode is Mode.ABORT:
            return
        if self.mode is Mode.APPROACH:
            # A retreat begun too near to stop would only touch more slowly than the latches need.
            coasts_m = max(at.closing_m_s, 0.0) * dt  # until the next step
            if doubt is not None and self._stop_m(at) + coasts_m <= at.range_m:
                if at.range_m < guidance.commit_m or self._turns_back:
                    self._retreat(at, doubt)
                else:
                    self._hold(at.range_m - self._stop_m(at), doubt)
        elif self.mode is Mode.RETREAT:
            if at.range_m > self.hold_m - 0.1 * self.hold_m:
                self._hold(self.hold_m, self.reason)
        else:
            waits = doubt is None or doubt == self._ordered  # for as long as its operator wants
            self.stuck_s = 0.0 if waits else self.stuck_s + dt
            if doubt is None and self._clear_s >= guidance.settle_s:
                self.mode, self.reason = Mode.APPROACH, ""
            elif doubt is not None:
                self.reason = doubt
                if self.stuck_s > guidance.patience_s or self._turns_back:
                    self._retreat(at, doubt)

    def _stop_m(self, at: Relative) -> float:
        chaser = self.plan.chaser
        share = chaser.plume_share if at.range_m < chaser.plume_m else 1.0
        return max(at.closing_m_s, 0.0) ** 2 / (2.0 * share * chaser.thrust_m_s2)

    def _hold(self, range_m: float, reason: str) -> None:
        nearest = min(self.plan.guidance.holds_m)
        self.mode, self.reason, self.stuck_s = Mode.HOLD, reason, 0.0
        self.hold_m = max(range_m, min(nearest, self.plan.guidance.commit_m))

    def _retreat(self, at: Relative, reason: str) -> None:
        """To the next hold point behind, the farthest after too many retreats."""
        holds = self.plan.guidance.holds_m
        self.retreats += reason != self._ordered
        self._turns_back = False
        self.reason, self.stuck_s, self._clear_s = reason, 0.0, 0.0
        behind = [hold for hold in holds if hold > at.range_m + 0.5]
        if self.retreats > self.plan.guidance.retreats:
            self.mode, self.hold_m = Mode.ABORT, max(holds)
        else:
            self.mode, self.hold_m = Mode.RETREAT, min(behind, default=max(holds))

    def _closing(self, at: Relative) -> tuple[float, float]:
        """Wanted closing speed, and its acceleration."""
        guidance = self.plan.guidance
        if self.mode is Mode.APPROACH:
            wanted = guidance.contact_m_s + guidance.slope_per_s * max(at.range_m, 0.0)
            if wanted < guidance.fastest_m_s:
                return wanted, -guidance.slope_per_s * at.closing_m_s
            return guidance.fastest_m_s, 0.0
        # Towards the hold point, slower as it comes near, from both sides.
        off = at.range_m - self.hold_m
        stop = math.sqrt(abs(off) * self.plan.chaser.plume_share * self.plan.chaser.thrust_m_s2)
        return math.copysign(min(stop, 0.2 * abs(off), guidance.fastest_m_s), off), 0.0

    def _steer(self, known: Known, at: Relative) -> Command:
        plan, port, pose, rates = self.plan, self.port, known.estimate.pose, known.estimate.rates
        assert pose is not None
        assert rates is not None
        dt, effort = plan.guidance.step_s, plan.chaser.thrust_m_s2
        far = _STEPS ** round(math.log(max(at.range_m, 1.0), _STEPS))
        speed = _SPEED_M_S + _SPEED_SHARE * far
        stiff, damped = regulator(_ASIDE_M + _ASIDE_SHARE * far, speed, effort, dt)
        axis, spin = port.axis, pose.rotation.T @ rates[:3]
        off = at.mass_m - port.centre_m
        aside, slide = off - (off @ axis) * axis, at.mass_speed_m_s
        along = -float(slide @ axis)
        slide = slide + along * axis
        closing, change = self._closing(at)
        push = -stiff * aside - damped * slide
        push = push - axis * (change + rate_regulator(speed, effort, dt) * (closing - along))
        # Against inertial space, in axes that turn with the target.
        turns = so3.hat(spin)
        push = push + 2.0 * turns @ at.mass_speed_m_s + turns @ turns @ at.mass_m
        gain = rate_regulator(_TURN_RAD, _RATE_RAD_S, dt)
        # The chaser turns as the target does, and back to the aligned attitude: the rotation
        # vector is of pose.rotation = exp(turn) facing, and a turn of the camera takes it off.
        rate = rates[:3] + gain * at.turn
        return Command(dt * (pose.rotation @ push), rate, str(self.mode), self.reason)

    def _blind(self, known: Known) -> Command:
        """Without a state: stop closing in by the last one, and move away slowly."""
        self.reason = known.estimate.reason or str(known.estimate.status)
        self._clear_s = 0.0
        last, push = self.at, np.zeros(3)
        if last is not None and not self._pushed:
            self.mode, self.hold_m = Mode.RETREAT, max(self.plan.guidance.holds_m)
            self.retreats += 1
            self._away_m_s = max(last.closing_m_s, 0.0) + self.plan.guidance.contact_m_s
            self._pushed = True
        if self._pushed and self._away_m_s > 0.0:
            most = self.plan.chaser.plume_share * self.plan.chaser.thrust_m_s2
            push[2] = -min(most * self.plan.guidance.step_s, self._away_m_s)
            self._away_m_s += push[2]
        return Command(push, np.zeros(3), str(self.mode), self.reason)
