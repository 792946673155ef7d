"""Attitude, spin and tumble of a target, against independent integration."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rendezview.geometry.pose import Array, Pose
from rendezview.trajectory import NoFit, Spin, fit_spin, fit_spin_of_directions, in_line_of_sight
from rendezview.trajectory.rotation import rotations
from rendezview_ground.simulate.trajectories import torque_free

TIMES = np.linspace(0.0, 200.0, 101)
INERTIA = (1.0, 1.6, 2.0)
RATE = np.array([0.002, 0.004, 0.0025])


def seen(turned: Array, rng: np.random.Generator, sigma: float = 0.002) -> tuple[Array, Array]:
    off = Rotation.from_rotvec(sigma * rng.standard_normal((len(turned), 3))).as_matrix()
    return off @ turned, np.tile(sigma**2 * np.eye(3), (len(turned), 1, 1))


def test_compiled_euler_equations_agree_with_dormand_prince():
    times = np.linspace(0.0, 900.0, 301)
    rate = np.array([0.03, 0.05, 0.01])
    truth, true_rates = torque_free(INERTIA, rate, times)
    found, rates = np.empty_like(truth), np.empty_like(true_rates)
    middle = 150
    rotations(
        np.array(INERTIA), truth[middle].copy(), true_rates[middle].copy(),
        times - times[middle], found, rates,
    )  # fmt: skip
    assert np.abs(found - truth).max() < 1e-5
    assert np.abs(rates - true_rates).max() < 1e-7


def test_constant_spin_is_found_to_its_uncertainty():
    rng = np.random.default_rng(1)
    truth, _ = torque_free((1.0, 1.0, 1.0), RATE, TIMES)
    first = Rotation.random(random_state=rng).as_matrix()
    spin = fit_spin(TIMES, *seen(first @ truth, rng), tumbling=False)
    assert isinstance(spin, Spin)
    assert spin.speed_rad_s == pytest.approx(np.linalg.norm(RATE), rel=2e-3)
    assert spin.axis @ RATE / np.linalg.norm(RATE) > np.cos(np.deg2rad(0.2))
    assert abs(spin.speed_rad_s - np.linalg.norm(RATE)) < 4.0 * spin.speed_sigma_rad_s
    found, _ = spin.at(TIMES + 200.0)
    ahead, _ = torque_free((1.0, 1.0, 1.0), RATE, np.concatenate([[0.0], TIMES + 200.0]))
    assert Pose(found[-1], np.zeros(3)).angle_to(Pose(first @ ahead[-1], np.zeros(3))) < 0.01


def test_tumble_is_told_from_spin_and_its_moments_found():
    rng = np.random.default_rng(2)
    rate = np.array([0.01, 0.02, 0.012])
    truth, rates = torque_free(INERTIA, rate, TIMES)
    tumble = fit_spin(TIMES, *seen(truth, rng))
    assert isinstance(tumble, Spin)
    assert tumble.tumbling
    np.testing.assert_allclose(tumble.moments, INERTIA, rtol=0.02)
    np.testing.assert_allclose(tumble.rate_rad_s, rates[50], atol=1e-4)
    steady = fit_spin(TIMES, *seen(torque_free((1.0, 1.0, 1.0), rate, TIMES)[0], rng))
    assert isinstance(steady, Spin)
    assert not steady.tumbling


def test_outliers_do_not_turn_the_spin():
    rng = np.random.default_rng(3)
    truth, _ = torque_free((1.0, 1.0, 1.0), RATE, TIMES)
    attitudes, spreads = seen(truth, rng)
    for k in range(0, 101, 10):
        attitudes[k] = Rotation.random(random_state=rng).as_matrix()
    spin = fit_spin(TIMES, attitudes, spreads, tumbling=False)
    assert isinstance(spin, Spin)
    assert np.linalg.norm(spin.rate_rad_s - RATE) < 0.005 * np.linalg.norm(RATE)


def test_directions_alone_show_the_spin_over_a_long_arc():
    rng = np.random.default_rng(4)
    rate = np.array([0.002, 0.025, 0.015])
    truth, _ = torque_free((1.0, 1.0, 1.0), rate, TIMES)
    directions = np.einsum("nji,j->ni", truth, [0.3, 0.5, -0.8])
    each = directions.repeat(5, axis=0) + 0.1 * rng.standard_normal((505, 3))
    spin = fit_spin_of_directions(TIMES.repeat(5), each)
    assert isinstance(spin, Spin)
    assert not spin.roll_known
    assert np.linalg.norm(spin.rate_rad_s - rate) < 0.02 * np.linalg.norm(rate)


def test_line_of_sight_forgets_how_the_camera_points():
    rng = np.random.default_rng(5)
    centre = np.array([0.2, -1.0, 0.4])
    pose = Pose(Rotation.random(random_state=rng).as_matrix(), [0.0, 0.0, 20.0])
    pose = Pose(pose.rotation, np.array([0.0, 0.0, 20.0]) - pose.rotation @ centre)
    shaken = Pose(Rotation.from_rotvec([0.05, -0.03, 0.0]).as_matrix(), np.zeros(3)) @ pose
    np.testing.assert_allclose(
        in_line_of_sight(shaken, centre), in_line_of_sight(pose, centre), atol=1e-12
    )


@pytest.mark.parametrize(
    ("times", "change", "words"),
    [
        (TIMES[:3], 1.0, "3 frames"),
        (TIMES[::-1], 1.0, "do not rise"),
        (TIMES, np.nan, "not finite"),
    ],
)
def test_nonsense_gets_a_reason(times, change, words):
    truth, _ = torque_free((1.0, 1.0, 1.0), RATE, TIMES[: len(times)])
    found = fit_spin(times, change * truth)
    assert isinstance(found, NoFit)
    assert words in found.reason
    of_directions = fit_spin_of_directions(times, change * truth[:, 2])
    assert isinstance(of_directions, NoFit)
    assert words in of_directions.reason
