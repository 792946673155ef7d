"""The true motion against the closed form, numerical integration and the two-body problem."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from rendezview.io.bundled import find_target
from rendezview_ground.fly.dynamics import Command, OrbitDynamics
from rendezview_ground.fly.options import ChaserOptions, FlyPlan, GuidanceOptions, TargetOptions
from rendezview_ground.fly.port import Port, Relative

_EARTH = 3.986004418e14  # m³/s². Source: WGS 84
PERFECT = FlyPlan(
    target=TargetOptions(drag_m_s2=0.0),
    chaser=ChaserOptions(
        thrust_scale=0.0, thrust_scale_each=0.0, thrust_askew_deg=0.0, jitter_deg=0.0,
        gyro_bias_deg_s=0.0,
    ),
    guidance=GuidanceOptions(longest_s=200.0),
)  # fmt: skip


def dynamics(plan: FlyPlan = PERFECT, seed: int = 3) -> OrbitDynamics:
    return OrbitDynamics(plan, Port.of(find_target("client"), plan), seed)


def drift(truth, steps: int, motion: OrbitDynamics, push=(0.0, 0.0, 0.0)):
    for _ in range(steps):
        truth = motion.step(truth, Command(np.array(push), truth.body_rate))
    return truth


def test_thrusts_move_it_as_hills_equations_integrated_numerically():
    motion = dynamics()
    start, n = motion.start(), PERFECT.target.mean_motion_rad_s
    push = np.array([2e-3, -3e-3, 4e-3])
    truth, pushes = start, []
    for _ in range(40):
        hill = Rotation.from_rotvec([0.0, 0.0, -n * (truth.time_s + 0.25)]).as_matrix()
        pushes.append(hill @ truth.inertial_from_camera @ push / 0.5)
        truth = drift(truth, 1, motion, push)

    def slope(time_s, state):
        a = pushes[min(int(time_s / 0.5), 39)]
        x, _, z, vx, vy, vz = state
        gravity = [3 * n * n * x + 2 * n * vy, -2 * n * vx, -n * n * z]
        return [vx, vy, vz, *(a + gravity)]

    state = start.state
    for k in range(40):
        span = (0.5 * k, 0.5 * k + 0.5 - 1e-12)
        state = solve_ivp(slope, span, state, rtol=1e-11, atol=1e-12).y[:, -1]
    np.testing.assert_allclose(truth.state, state, atol=1e-7)


def test_two_bodies_about_the_earth_part_as_the_linear_motion_says():
    motion = dynamics()
    start, n = motion.start(), PERFECT.target.mean_motion_rad_s
    end = drift(start, 300, motion)
    radius = (_EARTH / n**2) ** (1.0 / 3.0)
    target = np.array([radius, 0.0, 0.0, 0.0, n * radius, 0.0])
    place, moving = start.state[:3], start.state[3:]
    chaser = target + np.r_[place, moving + np.cross([0.0, 0.0, n], place)]

    def fall(_, state):
        return np.r_[state[3:], -_EARTH * state[:3] / np.linalg.norm(state[:3]) ** 3]

    ends = [
        solve_ivp(fall, (0.0, 150.0), one, method="DOP853", rtol=1e-13, atol=1e-6).y[:3, -1]
        for one in (target, chaser)
    ]
    hill = Rotation.from_rotvec([0.0, 0.0, -n * 150.0]).as_matrix()
    np.testing.assert_allclose(end.state[:3], hill @ (ends[1] - ends[0]), atol=2e-4)


def test_the_target_turns_free_of_torque():
    motion = dynamics(seed=5)
    start = motion.start()
    inertia = np.array(PERFECT.target.inertia)
    end = drift(start, 300, motion)
    before, after = (truth.inertial_from_target @ (inertia * truth.spin) for truth in (start, end))
    np.testing.assert_allclose(after, before, rtol=1e-8)


def test_the_rates_are_those_of_the_poses():
    plan = FlyPlan(guidance=GuidanceOptions(step_s=0.02, longest_s=2.0))
    motion = dynamics(plan)
    one = drift(motion.start(), 10, motion, (1e-4, 2e-4, -1e-4))
    two = drift(one, 1, motion)
    at = [Relative.of(motion.port, t.pose, t.rates, t.turning) for t in (one, two)]
    mass = (at[1].mass_m - at[0].mass_m) / 0.02
    np.testing.assert_allclose(mass, at[1].mass_speed_m_s, atol=2e-5)
    nose = motion.port.centre_m
    moved = [a.aside_m + a.range_m * motion.port.axis + nose for a in at]
    np.testing.assert_allclose((moved[1] - moved[0]) / 0.02, at[1].speed_m_s, atol=1e-4)
    np.testing.assert_allclose((at[0].turn - at[1].turn) / 0.02, at[1].rate, atol=1e-5)


def test_pulses_have_a_least_length_and_a_limit_near_the_target():
    motion = dynamics()
    truth = motion.start()
    least = 0.02 * 0.02
    small = drift(truth, 1, motion, (0.9 * least, 0.0, 0.0))
    assert not small.told_m_s.any()
    assert small.spent_m_s == 0.0
    full = drift(truth, 1, motion, (0.0, 0.0, -1.0))
    assert full.told_m_s[2] == pytest.approx(-0.5 * 0.02)
    near = FlyPlan(chaser=ChaserOptions(start_m=4.0), guidance=GuidanceOptions(longest_s=2.0))
    close = dynamics(near)
    braked = drift(close.start(), 1, close, (0.0, 0.0, -1.0))
    assert braked.told_m_s[2] == pytest.approx(-0.5 * 0.5 * 0.02)
    pushed = drift(close.start(), 1, close, (0.0, 0.0, 1.0))
    assert pushed.told_m_s[2] == pytest.approx(0.5 * 0.02)


def test_the_camera_jitters_by_its_sigma():
    plan = FlyPlan(target=TargetOptions(mean_motion_rad_s=0.0, rate_sigma_deg_s=0.0))
    motion = dynamics(plan)
    truth, off = motion.start(), []
    for _ in range(1200):
        truth = motion.step(truth, Command(np.zeros(3), np.zeros(3)))
        off.append(Rotation.from_matrix(truth.body.T @ truth.inertial_from_camera).as_rotvec())
    assert math.degrees(float(np.std(off))) == pytest.approx(0.1, rel=0.15)
