"""Pointing jitter of a camera: its estimate, and rates in spite of it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.estimation.swings import SIGMA, swinging

from rendezview.estimation.pointing_jitter import PointingJitter, jitter_covariance, take
from rendezview.estimation.rates import RateBank
from rendezview.geometry.pose import Pose


def moving(t):
    return swinging(t, 0.1)


def seen(t, jitter, rng):
    """A pose with the errors of reflectors, of a camera that points off by a turn."""
    turn = Rotation.from_rotvec(rng.normal(0.0, 1.0, 3) * jitter).as_matrix()
    return (Pose(turn, np.zeros(3)) @ moving(t)[0]).perturbed(rng.normal(0.0, SIGMA))


def test_five_readings_are_taken_as_plain_numpy_takes_them():
    rng = np.random.default_rng(1)
    times = np.cumsum(rng.uniform(0.1, 0.3, 5))
    poses = [seen(t, 0.005, rng) for t in times]
    root = rng.normal(0.0, 0.01, (5, 6, 6))
    errors, sums = root @ root.transpose(0, 2, 1), np.full(6, 0.7)
    rotations = np.array([p.rotation for p in poses])
    places = np.array([p.translation_m for p in poses])
    take(times, rotations, places, errors, sums)
    gaps = times[:, None] - times + np.eye(5)
    weights = 1.0 / gaps.prod(axis=1)
    weights /= np.linalg.norm(weights)
    assert weights @ np.vander(times, 4) == pytest.approx(np.zeros(4), abs=1e-9)  # of a cubic
    turns = Rotation.from_matrix(rotations @ rotations[-1].T).as_rotvec()
    x, y, z = places[-1]
    lever = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) / (places[-1] @ places[-1])
    attitude, bearing = weights @ turns, lever @ (weights @ places)
    whole = np.block([[np.eye(3), np.zeros((3, 3))], [np.zeros((3, 3)), lever]])
    own = whole @ np.einsum("i,iab->ab", weights**2, errors) @ whole.T
    turned, both, alone = own[:3, :3], own[:3, 3:], own[3:, 3:]
    sight = places[-1] / np.linalg.norm(places[-1])
    wanted = [
        1.0, attitude @ bearing - np.trace(both),
        np.sum(turned * alone) + np.trace(both @ both), bearing @ bearing - np.trace(alone),
        2.0 * np.sum(alone**2), (attitude @ sight) ** 2 - sight @ turned @ sight,
    ]  # fmt: skip
    kept = 0.7 * np.array([1.0, 1.0, 0.9975, 1.0, 0.9975, 1.0]) * 0.9975
    np.testing.assert_allclose(sums, kept + wanted, rtol=1e-9, atol=1e-12)


def test_jitter_adds_the_covariance_of_turned_poses():
    rng, place = np.random.default_rng(2), np.array([0.5, -0.4, 3.0])
    across, about = 0.005, 0.002
    sight = place / np.linalg.norm(place)
    turns = across * rng.normal(size=(20000, 3))
    turns += ((about / across - 1.0) * (turns @ sight))[:, None] * sight
    moved = np.hstack([turns, np.cross(turns, place)])
    told = jitter_covariance((across**2, about**2), place)
    scale = np.sqrt(np.outer(np.diag(told), np.diag(told)))
    np.testing.assert_allclose(np.cov(moved.T) / scale, told / scale, atol=0.03)


@pytest.mark.parametrize("jitter_deg", [0.0, 0.05, 0.3])
def test_the_jitter_is_told_and_a_motion_is_not_taken_for_one(jitter_deg):
    found, jitter = [], np.deg2rad([jitter_deg, jitter_deg, 0.2 * jitter_deg])
    for seed in range(4):
        rng, estimate = np.random.default_rng(seed), PointingJitter()
        for t in np.arange(0.0, 15.0, 0.1):
            estimate.add(float(t), seen(t, jitter, rng), np.diag(SIGMA**2))
        found.append(np.rad2deg(np.sqrt(estimate.variances)))
    if not jitter_deg:
        assert np.max(found) == 0.0
    else:
        assert np.mean(found, axis=0)[0] == pytest.approx(jitter_deg, rel=0.25)
        assert np.mean(found, axis=0)[1] < 0.5 * jitter_deg


@pytest.mark.parametrize("hertz", [5.0, 30.0])
def test_rates_are_as_near_as_they_claim_in_spite_of_jitter(hertz):
    """0.3° of jitter is 26 mm at 5 m; without its estimate velocities were 180 mm/s off."""
    jitter, off, normalised = np.full(3, np.deg2rad(0.3)), [], []
    for seed in range(3):
        rng, bank = np.random.default_rng(seed), RateBank()
        for t in np.arange(0.0, 15.0, 1.0 / hertz):
            found = bank.add(float(t), seen(t, jitter, rng), np.diag(SIGMA**2))
            if t > 4.0:
                off.append(found.rates[3:] - moving(t)[1][3:])
                normalised.append(off[-1] @ np.linalg.solve(found.covariance[3:, 3:], off[-1]))
    assert 1.5 < np.mean(normalised) < 5.0
    assert np.sqrt(np.mean(np.square(off))) < 0.025


def test_the_jitter_is_known_after_readings_are_forgotten():
    rng, bank = np.random.default_rng(3), RateBank()
    jitter, spread = np.full(3, np.deg2rad(0.3)), []
    for first_s in (0.0, 20.0):
        for k in range(60 if not first_s else 4):
            t = first_s + 0.1 * k
            found = bank.add(t, seen(t, jitter, rng), np.diag(SIGMA**2))
        spread.append(found.covariance[3, 3])
        bank.clear()
    fresh = RateBank()
    for k in range(4):
        found = fresh.add(20.0 + 0.1 * k, seen(20.0 + 0.1 * k, jitter, rng), np.diag(SIGMA**2))
    assert spread[1] > 10.0 * found.covariance[3, 3]


def test_covariances_without_a_root_show_no_jitter():
    """Of a flat target head-on, whose numeric slopes leave one a rounding below 0."""
    estimate, rng = PointingJitter(), np.random.default_rng(3)
    covariance = np.diag([1e-6, 1e-6, 1e-6, -1e-8, -1e-8, 1e-6])
    for k in range(6):
        turn = Rotation.from_rotvec(rng.normal(0.0, 1e-3, 3)).as_matrix()
        estimate.add(0.1 * k, Pose(turn, np.array([0.0, 0.0, 3.0])), covariance)
    assert estimate.variances == (0.0, 0.0)
