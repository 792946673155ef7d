"""Constant velocity: extrapolation, rates, and covariance beside dense matrices."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rendezview.estimation.motion import extrapolate, predict_covariance, rates_between
from rendezview.geometry.pose import Pose


def test_extrapolation_is_that_of_scipy_about_a_point():
    rng = np.random.default_rng(1)
    pose = Pose(Rotation.random(random_state=rng).as_matrix(), rng.standard_normal(3))
    rates, about = rng.standard_normal(6), rng.standard_normal(3)
    later = extrapolate(pose, rates, 0.7, about)
    turn = Rotation.from_rotvec(0.7 * rates[:3]).as_matrix()
    assert later.rotation == pytest.approx(turn @ pose.rotation, abs=1e-14)
    assert later.apply(about) == pytest.approx(pose.apply(about) + 0.7 * rates[3:], abs=1e-14)


def test_rates_between_two_poses_are_what_leads_from_one_to_the_other():
    rng = np.random.default_rng(2)
    for _ in range(20):
        pose = Pose(Rotation.random(random_state=rng).as_matrix(), rng.standard_normal(3))
        rates, about = rng.standard_normal(6), rng.standard_normal(3)
        later = extrapolate(pose, rates, 0.5, about)
        assert rates_between(pose, later, 0.5, about) == pytest.approx(rates, abs=1e-12)


def test_the_predicted_covariance_is_that_of_dense_matrices():
    rng = np.random.default_rng(3)
    root = rng.standard_normal((12, 12))
    covariance, dt, density = root @ root.T / 12, 0.7, np.diag(rng.uniform(0.2, 1.0, 6))
    turn = Rotation.from_rotvec([0.1, 0.2, -0.3]).as_matrix()
    step = np.eye(12)
    step[:3, :3], step[:6, 6:] = turn, dt * np.eye(6)
    noise = np.kron([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]], density)
    out = predict_covariance(covariance, turn, dt, density.diagonal())
    assert out == pytest.approx(step @ covariance @ step.T + noise, abs=1e-12)
