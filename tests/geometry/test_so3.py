"""The compiled exponential and logarithm against scipy's rotations, and the group's axioms."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rendezview.geometry import so3

ANGLES = (0.0, 1e-12, 1e-6, 1e-4, 1.1e-4, 0.1, 1.0, 3.0, np.pi - 1e-3, np.pi - 1e-7, np.pi)


def _vectors():
    rng = np.random.default_rng(1)
    for angle in ANGLES:
        for _ in range(20):
            axis = rng.normal(size=3)
            yield angle * axis / np.linalg.norm(axis)


def test_exponential_equals_scipy():
    for w in _vectors():
        np.testing.assert_allclose(so3.exp(w), Rotation.from_rotvec(w).as_matrix(), atol=3e-16 * 8)


def test_logarithm_inverts_the_exponential_up_to_half_a_turn():
    for w in _vectors():
        back = so3.log(so3.exp(w))
        if np.linalg.norm(w) > np.pi - 1e-9 and back @ w < 0.0:
            back = -back  # at half a turn both axes are right
        np.testing.assert_allclose(back, w, atol=1e-9 if np.linalg.norm(w) > 3.1 else 1e-14)


def test_logarithm_is_exact_near_half_a_turn():
    for w in _vectors():
        rotation = Rotation.from_rotvec(w).as_matrix()
        np.testing.assert_allclose(so3.exp(so3.log(rotation)), rotation, atol=1e-14)


def test_perturbation_is_on_the_left():
    rng = np.random.default_rng(2)
    rotation = Rotation.random(random_state=3).as_matrix()
    w, out = rng.normal(size=3), np.empty((3, 3))
    so3.perturb_into(w, rotation, out)
    np.testing.assert_allclose(out, Rotation.from_rotvec(w).as_matrix() @ rotation, atol=1e-15)
    np.testing.assert_allclose(so3.between(out, rotation), w, atol=1e-14)


def test_orthonormalising_squares_the_error():
    rotation = Rotation.random(random_state=4).as_matrix()
    bent = rotation + 1e-6 * np.random.default_rng(5).normal(size=(3, 3))
    so3.orthonormalise(bent)
    np.testing.assert_allclose(bent @ bent.T, np.eye(3), atol=1e-10)
    np.testing.assert_allclose(bent, rotation, atol=1e-5)


def test_hat_is_the_cross_product():
    rng = np.random.default_rng(6)
    w, v = rng.normal(size=(2, 3))
    np.testing.assert_allclose(so3.hat(w) @ v, np.cross(w, v))


@pytest.mark.parametrize("w", [np.zeros(3), np.array([0.3, -0.2, 0.9])])
def test_exponential_is_a_rotation(w):
    turn = so3.exp(w)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(turn) == pytest.approx(1.0)


def test_both_directions_fill_the_array_that_they_are_given():
    turn, back = np.full((3, 3), np.nan), np.full(3, np.nan)
    for w in _vectors():
        so3.exp_into(w, turn)
        np.testing.assert_allclose(turn, Rotation.from_rotvec(w).as_matrix(), atol=3e-16 * 8)
        so3.log_into(turn, back)
        np.testing.assert_array_equal(back, so3.log(turn))
        twin = Rotation.from_matrix(turn).as_rotvec()
        if np.linalg.norm(w) > np.pi - 1e-9 and back @ twin < 0.0:
            twin = -twin  # at half a turn both axes are right
        np.testing.assert_allclose(back, twin, atol=1e-9 if np.linalg.norm(w) > 3.1 else 1e-14)


def test_a_vector_is_rotated_and_rotated_back():
    rng = np.random.default_rng(4)
    rotation, v, out = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3), np.empty(3)
    so3.rotate_into(rotation, v, out)
    np.testing.assert_allclose(out, rotation @ v, atol=1e-15)
    so3.rotate_back_into(rotation, v, out)
    np.testing.assert_allclose(out, rotation.T @ v, atol=1e-15)
