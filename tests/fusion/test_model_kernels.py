"""The compiled models of measurements and the update beside plain numpy."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rendezview.fusion.kernels import whitened, with_bias
from rendezview.fusion.model_kernels import (
    mixture,
    other_edge,
    pose_covariance,
    pose_model,
    ring_expected,
    ring_model,
    ring_residual,
)


def covariance_of(rng, n):
    root = rng.standard_normal((n, n))
    return root @ root.T / n + 0.1 * np.eye(n)


def test_a_whitened_residual_is_that_of_numpy():
    rng = np.random.default_rng(1)
    covariance, design = covariance_of(rng, 15), rng.standard_normal((5, 15))
    noise, residual = covariance_of(rng, 5), rng.standard_normal(5)
    fits, nis, log_volume, across, lower, white = whitened(covariance, design, noise, residual)
    spread = design @ covariance @ design.T + noise
    assert fits
    assert nis == pytest.approx(residual @ np.linalg.solve(spread, residual), rel=1e-12)
    assert log_volume == pytest.approx(np.linalg.slogdet(spread)[1], rel=1e-12)
    assert across == pytest.approx(covariance @ design.T, abs=1e-12)
    assert lower == pytest.approx(np.linalg.cholesky(spread), abs=1e-12)
    assert white == pytest.approx(np.linalg.solve(lower, residual), abs=1e-12)


def test_a_bias_is_a_column_of_the_design_and_taken_from_the_residual():
    rng = np.random.default_rng(2)
    extras, slope = rng.standard_normal(10), rng.standard_normal((5, 14))
    root, measured = rng.standard_normal((5, 4)), rng.standard_normal(5)
    design, residual = with_bias(extras, slope, root, 16, measured)
    assert design[:, :14] == pytest.approx(slope)
    assert design[:, 16:20] == pytest.approx(root)
    assert not design[:, [14, 15, 20, 21]].any()
    assert residual == pytest.approx(measured - root @ extras[4:8], abs=1e-12)


def test_a_poses_residual_and_covariance_are_those_of_numpy():
    rng = np.random.default_rng(3)
    one, other = (Rotation.random(random_state=rng).as_matrix() for _ in range(2))
    place, expected, given = rng.standard_normal(3), rng.standard_normal(3), covariance_of(rng, 6)
    whole = 1.5 * given + np.diag([0.1**2] * 3 + [0.2**2 * (place @ place)] * 3)
    assert pose_covariance(place, given, 1.5, 0.1, 0.2) == pytest.approx(whole, rel=1e-12)
    residual, white, root = pose_model(one, place, given, other, expected, 1.5, 0.1, 0.2, 0.7)
    turn = Rotation.from_matrix(one @ other.T).as_rotvec()
    assert residual == pytest.approx(np.concatenate([turn, place - expected]), abs=1e-12)
    assert white == pytest.approx(0.3 * whole, rel=1e-12)
    assert root @ root.T == pytest.approx(0.7 * whole, rel=1e-12, abs=1e-14)


def ring(rng):
    rotation = Rotation.random(random_state=rng).as_matrix()
    centre, axis = rng.standard_normal(3), rng.standard_normal(3)
    return centre, axis / np.linalg.norm(axis), rotation, np.array([0.3, -0.2, 8.0])


def test_a_ring_is_where_numpy_puts_it():
    rng = np.random.default_rng(4)
    centre, axis, rotation, place = ring(rng)
    found, direction, basis, slope = ring_model(centre, axis, rotation, place, 1.1, 0.2)
    expected = (rotation @ (centre + 0.2 * axis) + place) / 1.1
    assert found == pytest.approx(expected, abs=1e-12)
    assert direction == pytest.approx(rotation @ axis, abs=1e-12)
    frame = np.column_stack([basis, direction])
    assert frame.T @ frame == pytest.approx(np.eye(3), abs=1e-12)
    assert slope[:3, 3:6] == pytest.approx(np.eye(3) / 1.1, abs=1e-12)
    assert slope[:3, 12] == pytest.approx(-expected / 1.1, abs=1e-12)
    assert slope[:3, 13] == pytest.approx(direction / 1.1, abs=1e-12)
    for j, w in enumerate(1e-6 * np.eye(3)):  # left perturbations of the attitude
        ahead, behind = (
            ring_model(centre, axis, Rotation.from_rotvec(s * w).as_matrix() @ rotation, place,
                       1.1, 0.2)
            for s in (1.0, -1.0)
        )  # fmt: skip
        moved = np.concatenate([ahead[0] - behind[0], basis.T @ (ahead[1] - behind[1])]) / 2e-6
        assert slope[:, j] == pytest.approx(moved, abs=1e-8)


def test_a_circle_beside_the_expected_one_is_that_of_numpy():
    rng = np.random.default_rng(5)
    centre, axis, basis, _ = ring_model(*ring(rng), 1.0, 0.0)
    measured, given = centre + 0.1 * rng.standard_normal(3), covariance_of(rng, 6)
    normal = -(axis + 0.05 * rng.standard_normal(3))
    normal /= np.linalg.norm(normal)
    args = (measured, normal, given, centre, axis, basis, 1.2, 0.1, 0.02, 0.6)
    residual, white, root = ring_residual(*args)
    flat = np.zeros((5, 6))
    flat[:3, :3], flat[3:, 3:] = np.eye(3), -basis.T  # a circle has no front
    whole = 1.2 * flat @ given @ flat.T
    whole += np.diag([0.02**2 * (measured @ measured)] * 3 + [0.1**2] * 2)
    expected = np.concatenate([measured - centre, -basis.T @ normal])
    assert residual == pytest.approx(expected, abs=1e-12)
    assert white == pytest.approx(0.4 * whole, rel=1e-12, abs=1e-14)
    assert (root @ root.T) == pytest.approx(0.6 * whole, rel=1e-12, abs=1e-14)
    assert not root[:, 5:].any()


def test_another_edge_has_its_own_bias():
    place = np.array([0.3, -0.2, 5.0])
    white, root = other_edge(place)
    assert not root[:, :5].any()
    assert np.linalg.eigvalsh(white + root @ root.T)[0] > 0.0


def test_a_mixture_has_the_mean_and_the_spread_of_its_parts():
    rng = np.random.default_rng(6)
    logs, residuals = np.array([0.0, -1.0, -50.0]), rng.standard_normal((3, 5))
    whites = np.array([covariance_of(rng, 5) for _ in range(3)])
    roots = rng.standard_normal((3, 5, 10))
    residual, white, root = mixture(logs, 0, residuals, whites, roots)
    share = np.exp(logs[:2]) / np.exp(logs[:2]).sum()  # the third is too unlikely
    mean = share @ residuals[:2]
    spread = np.einsum("k,ki,kj->ij", share, residuals[:2] - mean, residuals[:2] - mean)
    assert residual == pytest.approx(mean, abs=1e-12)
    assert white == pytest.approx(np.tensordot(share, whites[:2], 1) + spread, abs=1e-12)
    assert root == pytest.approx(np.tensordot(share, roots[:2], 1), abs=1e-12)


def test_one_candidate_alone_is_its_own_measurement():
    rng = np.random.default_rng(7)
    centre, axis, rotation, place = ring(rng)
    found, direction, basis, slope = ring_model(centre, axis, rotation, place, 1.0, 0.0)
    given = covariance_of(rng, 6)
    measured = found + 0.01 * rng.standard_normal(3)
    look = ring_residual(measured, direction, given, found, direction, basis, 1.0, 0.0, 0.0, 0.5)
    before, other, residual, slopes, white, root = ring_expected(
        measured[None], direction[None], given[None], centre, axis, rotation, place, np.zeros(2),
        np.eye(14), 14, 1.0, 0.0, 0.0, 0.5, 0.0,
    )  # fmt: skip
    assert before
    assert not other
    assert slopes == pytest.approx(slope)
    for one, expected in zip((residual, white, root), look, strict=True):
        assert one == pytest.approx(expected, abs=1e-12)
