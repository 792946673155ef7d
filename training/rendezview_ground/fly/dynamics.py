"""True motion: both craft in orbit, thrusters with their errors, attitude control with jitter.

The chaser's centre of mass flies by the exact transition of Clohessy and Wiltshire's equations,
with a constant push in each step (`rendezview.trajectory.relative_orbit`). The target turns free of
torque. Hill's frame coincides with the inertial axes at time 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from rendezview.geometry import so3
from rendezview.geometry.pose import Array, Pose
from rendezview.trajectory.relative_orbit import response, transition
from rendezview_ground.fly.faults import Fault
from rendezview_ground.fly.options import FlyPlan
from rendezview_ground.fly.port import Port, Relative
from rendezview_ground.simulate.trajectories import torque_free

_STREAM = 1  # of the seed, beside those of the sensors
_DAMPING = 0.7  # of a wandering attitude. Source: chosen, of a usual controller


@dataclass(frozen=True, slots=True, eq=False)
class Command:
    """What a controller asks for until the next step, camera frame."""

    push_m_s: Array  # (3,) change of velocity
    rate_rad_s: Array  # (3,) of the chaser against inertial space
    mode: str = ""
    reason: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """Everything true at a time."""

    time_s: float
    state: Array  # (6,) place and velocity of the chaser's centre of mass, Hill's frame
    inertial_from_target: Array  # (3, 3)
    spin: Array  # (3,) of the target, its own axes, rad/s
    body: Array  # (3, 3) inertial_from_chaser, without jitter
    body_rate: Array  # (3,) rad/s, chaser's axes
    inertial_from_camera: Array  # (3, 3)
    turning: Array  # (3,) mean rate of the camera in the last step, its own axes
    pose: Pose  # camera_from_target
    rates: Array  # (6,) as of `Relative.of`
    told_m_s: Array  # (3,) what the thrusters were told to do in the last step, camera frame
    spent_m_s: float  # sum of all pulses
    step: int = 0


class OrbitDynamics:
    """The default dynamics of a flight; the same seed gives the same motion."""

    def __init__(self, plan: FlyPlan, port: Port, seed: int, fault: Fault | None = None) -> None:
        self.plan, self.port = plan, port
        self._rng = np.random.default_rng([_STREAM, seed])
        self._n, self._dt = plan.target.mean_motion_rad_s, plan.guidance.step_s
        self._free = transition(self._n, self._dt)
        self._turning_frame = so3.hat(np.array([0.0, 0.0, self._n]))  # Hill's, ω×
        self._place, self._pushed = _pushes(self._n, self._dt)
        chaser, rng = plan.chaser, self._rng
        self._scale = 1.0 + chaser.thrust_scale * rng.standard_normal()
        if fault is not None and fault.kind == "thrust":
            self._scale *= fault.size
        askew = math.radians(chaser.thrust_askew_deg) * rng.standard_normal(3)
        self._askew = so3.exp(askew)
        self._gyro_bias = math.radians(chaser.gyro_bias_deg_s) * rng.standard_normal(3)
        jitter = math.radians(chaser.jitter_deg) * np.ones(3)
        self._jitter = wander(self._dt, chaser.jitter_s, plan.steps + 2, jitter, rng)
        self._turn_target(fault)

    def _turn_target(self, fault: Fault | None) -> None:
        target, rng = self.plan.target, self._rng
        # Its axis along the orbital velocity, Hill's y.
        straight = Rotation.align_vectors([[0.0, 1.0, 0.0]], self.port.axis[None])[0]
        off = Rotation.from_rotvec(np.radians(target.attitude_sigma_deg) * rng.standard_normal(3))
        first = (off * straight).as_matrix()
        extra = math.radians(target.rate_sigma_deg_s) * rng.standard_normal(3)
        way = rng.standard_normal(3)
        if fault is not None and fault.kind == "spin":
            extra += math.radians(fault.size) * way / np.linalg.norm(way)
        spin = first.T @ [0.0, 0.0, self._n] + extra
        times = self._dt * np.arange(self.plan.steps + 2, dtype=np.float64)
        turned, self._spins = torque_free(target.inertia, spin, times)
        self._targets = first @ turned

    def start(self) -> Truth:
        """At rest in the target's axes, one start range before its port, with errors."""
        chaser, port, rng = self.plan.chaser, self.port, self._rng
        target, spin = self._targets[0], self._spins[0]
        aligned = target @ port.facing.T
        offset = chaser.place_sigma_m * rng.standard_normal(3)
        far = port.centre_m + (chaser.start_m + port.behind_m) * port.axis
        place = target @ far + offset
        drift = chaser.velocity_sigma_m_s * rng.standard_normal(3)
        inertial = so3.hat(target @ spin) @ place + drift
        hill = inertial - self._turning_frame @ place
        rate = port.facing @ spin
        return self._truth(0, np.r_[place, hill], aligned, rate, rate, np.zeros(3), 0.0)

    def step(self, truth: Truth, command: Command) -> Truth:
        """One control step later."""
        told, real = self._thrust(command.push_m_s, truth)
        dt, camera = self._dt, truth.inertial_from_camera
        # Hill's frame turns by n dt in a step: that of its middle.
        hill_from_inertial = so3.about_z(-self._n * (truth.time_s + 0.5 * dt))
        push = hill_from_inertial @ camera @ real / dt
        push = push - [0.0, self.plan.target.drag_m_s2, 0.0]
        state = self._free @ truth.state
        state[:3] += self._place @ push
        state[3:] += self._pushed @ push
        wanted = command.rate_rad_s + self._gyro_bias
        lag = math.exp(-dt / self.plan.chaser.attitude_s)
        rate = wanted + lag * (truth.body_rate - wanted)
        body = truth.body @ so3.exp(0.5 * dt * (truth.body_rate + rate))
        spent = truth.spent_m_s + float(np.abs(real).sum())
        after = self._truth(truth.step + 1, state, body, rate, rate, told, spent)
        turned = so3.log(np.ascontiguousarray(camera.T @ after.inertial_from_camera)) / dt
        return self._with_turning(after, turned)

    def _thrust(self, push_m_s: Array, truth: Truth) -> tuple[Array, Array]:
        """What the pulses are told to give and what they give, camera frame."""
        chaser, dt = self.plan.chaser, self._dt
        most = np.full(3, chaser.thrust_m_s2)
        near = Relative.of(self.port, truth.pose, truth.rates, truth.turning).range_m
        if push_m_s[2] < 0.0 and near < chaser.plume_m:  # braking blows at the target
            most[2] *= chaser.plume_share
        on_s = np.minimum(np.abs(push_m_s) / most, dt)
        on_s[on_s < chaser.least_on_s] = 0.0
        told = np.sign(push_m_s) * most * on_s
        uneven = 1.0 + chaser.thrust_scale_each * self._rng.standard_normal(3)
        return told, self._askew @ (self._scale * uneven * told)

    def _truth(
        self, step: int, state: Array, body: Array, body_rate: Array, turning: Array, told: Array,
        spent: float,
    ) -> Truth:  # fmt: skip
        time_s, target = step * self._dt, self._targets[step]
        camera = body @ so3.exp(self._jitter[step])
        inertial_from_hill = so3.about_z(self._n * time_s)
        place = inertial_from_hill @ state[:3] + self.port.behind_m * camera[:, 2]
        pose = Pose(camera.T @ target, -camera.T @ place)
        truth = Truth(
            time_s, state, target, self._spins[step], body, body_rate, camera, turning, pose,
            np.zeros(6), told, spent, step,
        )  # fmt: skip
        return self._with_turning(truth, turning)

    def _with_turning(self, truth: Truth, turning: Array) -> Truth:
        """With the rates that belong to a turning camera."""
        camera = truth.inertial_from_camera
        hill = truth.state[3:] + self._turning_frame @ truth.state[:3]
        moving = camera.T @ so3.about_z(self._n * truth.time_s) @ hill
        moving = moving + self.port.behind_m * so3.hat(turning)[:, 2]
        rates = np.r_[truth.pose.rotation @ truth.spin, -moving]
        return replace(truth, turning=turning, rates=rates)


def _pushes(n: float, dt_s: float) -> tuple[Array, Array]:
    """(3, 3) from a constant acceleration to the place, and to the velocity, after a step."""
    rr, rv, pushed = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    response(n, dt_s, rr, rv, pushed)
    return pushed, rv  # a push gives the velocity what an impulse gives the place


def wander(
    dt_s: float, period_s: float, count: int, sigma: Array, rng: np.random.Generator
) -> Array:
    """(count, K) of damped oscillators driven by white noise, stationary, of these σ (K,)."""
    omega = 2.0 * math.pi / period_s
    rate = np.array([[0.0, 1.0], [-(omega**2), -2.0 * _DAMPING * omega]])
    # Van Loan: transition and noise of one step, of σ 1, from one matrix exponential.
    noise = np.diag([0.0, 4.0 * _DAMPING * omega**3])
    whole = expm(np.block([[-rate, noise], [np.zeros((2, 2)), rate.T]]) * dt_s)
    step = whole[2:, 2:].T
    root = np.linalg.cholesky(step @ whole[:2, 2:])
    state = rng.standard_normal((2, len(sigma))) * np.array([[1.0], [omega]])
    out = np.empty((count, len(sigma)))
    for k in range(count):
        out[k] = sigma * state[0]
        state = step @ state + root @ rng.standard_normal(state.shape)
    return out
