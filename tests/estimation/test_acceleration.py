"""Filters of constant acceleration: against plain numpy, and their errors against their claims."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rendezview.estimation.acceleration import (
    AccelerationBank,
    AccelerationOptions,
    mix_rates,
    step_filters,
)
from rendezview.geometry.pose import Pose

SIGMA = np.array([3e-3, 3e-3, 3e-4, 1e-3, 1e-3, 5e-3])  # rad and m: reflectors at 5 m


def swinging(t):
    """Pose and rates (6,) of a target that swings at up to 10°/s and moves at up to 0.2 m/s."""
    axis = np.array([0.3, 0.8, 0.5]) / np.linalg.norm([0.3, 0.8, 0.5])
    angle, rate = 0.25 * np.sin(0.7 * t), 0.175 * np.cos(0.7 * t)
    place = np.array([0.3 * np.sin(0.6 * t), 0.1 * t, 5.0 - 0.2 * t])
    speed = np.array([0.18 * np.cos(0.6 * t), 0.1, -0.2])
    return Pose(Rotation.from_rotvec(angle * axis).as_matrix(), place), np.append(
        rate * axis, speed
    )


def readings(hertz, seconds, rng):
    for t in np.arange(0.0, seconds, 1.0 / hertz):
        pose, rates = swinging(t)
        yield float(t), pose.perturbed(rng.normal(0.0, SIGMA)), rates


def test_a_filter_is_that_of_plain_numpy():
    rng = np.random.default_rng(0)
    root = rng.normal(0.0, 0.1, (18, 18))
    covariance, rates = root @ root.T, rng.normal(0.0, 0.1, 12)
    rotation, place, dt = Rotation.random(rng=rng).as_matrix(), np.array([0.1, 0.2, 4.0]), 0.3
    density = np.array([1e-3] * 3 + [1e-4] * 3)
    measured = np.diag(SIGMA**2)
    turn = Rotation.from_rotvec(dt * rates[:3] + 0.5 * dt**2 * rates[6:9]).as_matrix()
    carry = np.kron([[1, dt, dt**2 / 2], [0, 1, dt], [0, 0, 1]], np.eye(6))
    carry[:3, :3] = turn
    jerk = np.array(
        [[dt**5 / 20, dt**4 / 8, dt**3 / 6], [dt**4 / 8, dt**3 / 3, dt**2 / 2],
         [dt**3 / 6, dt**2 / 2, dt]]
    )  # fmt: skip
    before = carry @ covariance @ carry.T + np.kron(jerk, np.diag(density))
    ahead = Pose(turn @ rotation, place + dt * rates[3:6] + 0.5 * dt**2 * rates[9:12])
    seen = ahead.perturbed([0.01, -0.02, 0.01, 0.02, 0.0, 0.03])
    moved = np.append(
        Rotation.from_matrix(seen.rotation @ ahead.rotation.T).as_rotvec(),
        seen.translation_m - ahead.translation_m,
    )
    spread = before[:6, :6] + measured
    gain = before[:, :6] @ np.linalg.inv(spread)
    change = gain @ moved
    wanted = rates + dt * np.append(rates[6:], np.zeros(6)) + change[6:]
    state = [rotation[None].copy(), place[None].copy(), rates[None].copy(), covariance[None].copy()]
    scores = np.array([[2.0, 4.0]])
    step_filters(
        dt, *state, density[None], seen.rotation, seen.translation_m, measured, 0.5, scores
    )
    np.testing.assert_allclose(state[2][0], wanted, atol=1e-12)
    np.testing.assert_allclose(state[3][0], before - gain @ before[:6], atol=1e-12)
    np.testing.assert_allclose(state[1][0], ahead.translation_m + change[3:6], atol=1e-12)
    for k, kept in enumerate((1.0, 2.0)):
        part = slice(3 * k, 3 * k + 3)
        own, off = spread[part, part], moved[part]
        likely = -0.5 * (off @ np.linalg.solve(own, off) + np.linalg.slogdet(own)[1])
        assert scores[0, k] == pytest.approx(kept + likely)


def test_a_target_that_only_moves_has_a_steady_turn():
    """Which filter counts for the angular rate is not decided by the velocity, which swings."""
    rng, bank, off = np.random.default_rng(6), AccelerationBank(), []
    for t in np.arange(0.0, 30.0, 0.2):
        turn = Rotation.from_rotvec([0.0, 0.14 * t, 0.0]).as_matrix()
        pose = Pose(turn, np.array([0.3 * np.sin(0.9 * t), 0.0, 5.0]))
        found = bank.add(float(t), pose.perturbed(rng.normal(0.0, SIGMA)), np.diag(SIGMA**2))
        if t > 10.0:
            off.append(found.rates[:3] - (0.0, 0.14, 0.0))
            assert np.linalg.eigvalsh(found.covariance).min() > 0.0
    assert np.sqrt(np.mean(np.square(off))) < 2.5e-3


@pytest.mark.parametrize("hertz", [2.0, 10.0, 30.0])
def test_rates_have_the_errors_that_they_claim(hertz):
    nees = []
    for seed in range(5):
        bank = AccelerationBank()
        for t, pose, truth in readings(hertz, 12.0, np.random.default_rng(seed)):
            found = bank.add(t, pose, np.diag(SIGMA**2))
            if found is not None and t > 3.0:
                off = found.rates - truth
                nees.append(off @ np.linalg.solve(found.covariance, off))
    assert 3.0 < np.mean(nees) < 10.0


def test_a_swinging_target_is_followed_five_times_nearer_than_by_a_line_of_eight_readings():
    bank, kept, ours, lines = AccelerationBank(), [], [], []
    for t, pose, truth in readings(2.0, 30.0, np.random.default_rng(3)):
        found = bank.add(t, pose, np.diag(SIGMA**2))
        kept = [*kept, (t, pose)][-8:]
        if t > 6.0:
            slope = np.polyfit([k[0] for k in kept], [k[1].translation_m[0] for k in kept], 1)[0]
            ours.append(found.rates[3] - truth[3])
            lines.append(slope - truth[3])
    assert np.sqrt(np.mean(np.square(lines))) > 5.0 * np.sqrt(np.mean(np.square(ours)))


def test_a_target_at_rest_has_small_rates_with_small_errors():
    rng, bank = np.random.default_rng(4), AccelerationBank(AccelerationOptions())
    for t in np.arange(0.0, 10.0, 0.1):
        found = bank.add(
            float(t), Pose.identity().perturbed(rng.normal(0.0, SIGMA)), np.diag(SIGMA**2)
        )
    assert np.abs(found.rates).max() < 5e-3
    assert np.sqrt(np.diag(found.covariance)).max() < 5e-3


def test_mixed_rates_are_those_of_plain_numpy():
    rng = np.random.default_rng(3)
    root = rng.normal(0.0, 0.1, (4, 18, 18))
    covariances, rates = root @ root.transpose(0, 2, 1), rng.normal(0.0, 0.1, (4, 12))
    scores, mean, spread = rng.normal(0.0, 2.0, (4, 2)), np.empty(6), np.empty((6, 6))
    assert mix_rates(scores, rates, covariances, mean, spread)
    weights = np.repeat(np.exp(scores) / np.exp(scores).sum(axis=0), 3, axis=1)
    expected = (weights * rates[:, :6]).sum(axis=0)
    off = rates[:, :6] - expected
    both = weights[:, :, None] * np.ones(6)  # each part by its own weights
    both[:, :3, 3:] = both[:, 3:, :3] = (weights[:, 0] * weights[:, 3])[:, None, None]
    wanted = (both * covariances[:, 6:12, 6:12]).sum(axis=0)
    for part in (slice(0, 3), slice(3, 6)):
        wanted[part, part] += (weights[:, part] * off[:, part]).T @ off[:, part]
    assert mean == pytest.approx(expected)
    assert spread == pytest.approx(wanted)
    assert np.linalg.eigvalsh(spread).min() > 0.0
    scores[2, 1] = np.nan
    assert not mix_rates(scores, rates, covariances, mean, spread)
