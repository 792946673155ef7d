"""The compiled loops beside plain numpy and SciPy."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rendezview.estimation.linear_algebra import square_root
from rendezview.estimation.motion import predict_covariance
from rendezview.fusion.kernels import (
    corrected,
    craft_accelerations,
    distance,
    gain,
    predicted,
    turned,
)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 1.0, 3.0, np.pi - 1e-6])
def test_a_turned_rotation_is_that_of_scipy(angle):
    rng = np.random.default_rng(1)
    for _ in range(20):
        start = Rotation.random(random_state=rng).as_matrix()
        axis = rng.standard_normal(3)
        vector = angle * axis / np.linalg.norm(axis)
        expected = Rotation.from_rotvec(vector).as_matrix() @ start
        assert np.allclose(turned(vector, start), expected, atol=1e-14)


def test_a_rotation_stays_one_over_a_million_turns():
    rotation = np.eye(3)
    for _ in range(20000):
        rotation = turned(np.array([0.1, -0.2, 0.3]), rotation)
    assert np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-14


def random_covariance(rng, n):
    root = rng.standard_normal((n, n))
    return root @ root.T / n


def test_the_predicted_covariance_is_that_of_dense_matrices():
    rng = np.random.default_rng(2)
    n, dt = 20, 0.7
    covariance = random_covariance(rng, n)
    arm, fade = rng.standard_normal(3), rng.uniform(0.2, 1.0, n - 12)
    turn = Rotation.from_rotvec([0.1, 0.2, -0.3]).as_matrix()
    angular, linear, along, pointing = 0.3, 0.2, 0.4, 0.5
    step = np.eye(n)
    step[:3, :3] = turn
    step[:6, 6:12] = dt * np.eye(6)
    step[12:, 12:] = np.diag(fade)
    x, y, z = arm
    swing = -np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])  # w × arm = −[arm]× w
    drive = np.vstack([np.eye(3), swing])
    density = np.diag([angular] * 3 + [linear] * 3) + pointing * drive @ drive.T
    density[3:, 3:] += along * np.outer(arm, arm) / (arm @ arm)
    noise = np.zeros((n, n))
    noise[:6, :6], noise[6:12, 6:12] = density * dt**3 / 3.0, density * dt
    noise[:6, 6:12] = noise[6:12, :6] = density * dt**2 / 2.0
    noise[12:, 12:] = np.diag(1.0 - fade**2)
    made = craft_accelerations(arm, angular, linear, along, pointing)
    assert np.allclose(made, density, atol=1e-12)
    out = predict_covariance(covariance, turn, dt, density, fade)
    assert np.allclose(out, step @ covariance @ step.T + noise, atol=1e-12)


def test_the_gain_is_that_of_the_textbook():
    rng = np.random.default_rng(3)
    covariance, design = random_covariance(rng, 15), rng.standard_normal((5, 15))
    noise, residual = random_covariance(rng, 5) + 0.1 * np.eye(5), rng.standard_normal(5)
    fits, nis, log_volume, correction, after = gain(covariance, design, noise, residual)
    innovation = design @ covariance @ design.T + noise
    weight = covariance @ design.T @ np.linalg.inv(innovation)
    assert fits
    assert nis == pytest.approx(residual @ np.linalg.solve(innovation, residual))
    assert log_volume == pytest.approx(np.linalg.slogdet(innovation)[1])
    assert np.allclose(correction, weight @ residual)
    assert np.allclose(after, (np.eye(15) - weight @ design) @ covariance)


def test_a_distance_is_that_of_the_gain_with_the_bias_in_it():
    rng = np.random.default_rng(4)
    covariance = random_covariance(rng, 20)
    slope, root = rng.standard_normal((5, 14)), np.tril(rng.standard_normal((5, 5)))
    white, measured = random_covariance(rng, 5) + 0.1 * np.eye(5), rng.standard_normal(5)
    extras = rng.standard_normal(8)
    design = np.hstack([slope, np.zeros((5, 6))])
    design[:, 15:20] += root
    _, nis, log_volume, _, _ = gain(covariance, design, white, measured - root @ extras[3:])
    found = distance(extras, covariance, slope, root, 15, white, measured)
    assert found == pytest.approx((True, nis, log_volume))


def test_a_semi_definite_matrix_has_a_root():
    rng = np.random.default_rng(5)
    thin = rng.standard_normal((5, 3))
    root = square_root(thin @ thin.T)
    assert np.allclose(root @ root.T, thin @ thin.T, atol=1e-7)
    assert not square_root(np.zeros((4, 4))).any()


def test_a_prediction_is_that_of_constant_rates_and_fading_extras():
    rng = np.random.default_rng(6)
    rotation, translation = Rotation.random(random_state=rng).as_matrix(), np.array([0.3, -1.0, 8])
    rates, extras = 0.05 * rng.standard_normal(6), rng.standard_normal(4)
    covariance, fading = random_covariance(rng, 16), rng.uniform(0.01, 0.1, (4, 2))
    dt, drive = 1.7, (0.3, 0.2, 0.4, 0.5)
    later, place, kept, after = predicted(
        rotation, translation, rates, extras, covariance, fading, dt, *drive
    )
    turn = Rotation.from_rotvec(dt * rates[:3]).as_matrix()
    closing = abs(translation @ rates[3:]) / (translation @ translation)
    fade = np.exp(-dt * (fading[:, 0] + closing * fading[:, 1]))
    expected = predict_covariance(
        covariance, turn, dt, craft_accelerations(translation, *drive), fade
    )
    assert np.allclose(later, turn @ rotation, atol=1e-14)
    assert np.allclose(place, translation + dt * rates[3:])
    assert np.allclose(kept, fade * extras)
    assert np.allclose(after, expected)


def test_a_correction_moves_every_part_of_the_state_by_the_gain():
    rng = np.random.default_rng(7)
    covariance, extras = random_covariance(rng, 20), rng.standard_normal(8)
    slope, root = rng.standard_normal((5, 14)), np.tril(rng.standard_normal((5, 5)))
    white, measured = random_covariance(rng, 5) + 0.1 * np.eye(5), 0.1 * rng.standard_normal(5)
    rotation, translation = Rotation.random(random_state=rng).as_matrix(), rng.standard_normal(3)
    rates = rng.standard_normal(6)
    design = np.hstack([slope, np.zeros((5, 6))])
    design[:, 15:20] += root
    residual = measured - root @ extras[3:]
    weight = covariance @ design.T @ np.linalg.inv(design @ covariance @ design.T + white)
    step = weight @ residual
    found = corrected(
        rotation, translation, rates, extras, covariance, slope, root, 15, white, measured
    )
    assert found[0]
    assert np.allclose(found[3], residual)
    assert np.allclose(found[4], Rotation.from_rotvec(step[:3]).as_matrix() @ rotation)
    assert np.allclose(found[5], translation + step[3:6])
    assert np.allclose(found[6], rates + step[6:12])
    assert np.allclose(found[7], extras + step[12:])
    assert np.allclose(found[8], (np.eye(20) - weight @ design) @ covariance)
