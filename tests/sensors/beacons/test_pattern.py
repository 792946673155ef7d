"""Rates of the six numbers, and the mirrored pose, against plain numpy."""

from __future__ import annotations

from dataclasses import astuple

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rendezview.estimation.motion import extrapolate
from rendezview.geometry.pose import Pose
from rendezview.sensors.beacons import SixNumbers, patterns_of, pose_of
from rendezview.sensors.beacons.constellation import Face
from rendezview.sensors.beacons.match.mirrored_pose import mirror


@pytest.fixture
def pattern(client):
    return patterns_of(client, ("far",))[0]


@pytest.mark.parametrize("roll_rad", [0.3, np.pi - 1e-7])
def test_rates_of_the_six_numbers_are_differences_of_them(pattern, roll_rad):
    pose = pose_of(SixNumbers(6.0, 0.1, -0.05, roll_rad, 0.1, -0.2), pattern)
    rates = np.array([0.02, -0.03, 0.05, 0.1, -0.2, 0.3])
    face, h = Face.of(pattern), 1e-3
    later, before = (
        np.array(astuple(face.six_numbers(extrapolate(pose, rates, t)))) for t in (h, -h)
    )
    change = later - before
    change[3:] -= 2.0 * np.pi * np.rint(change[3:] / (2.0 * np.pi))
    assert face.six_rates(pose, rates) == pytest.approx(change / (2.0 * h), abs=1e-6)


def test_the_mirrored_pose_is_that_of_two_reflections(five):
    rng, some = np.random.default_rng(4), np.array([0, 1, 3])
    pose = Pose(Rotation.random(random_state=rng).as_matrix(), np.array([0.4, -0.3, 5.0]))
    points = five.positions_m[some]
    middle = points.mean(axis=0)
    normal = np.linalg.svd(points - middle)[2][2]
    place = pose.apply(middle)
    sight = place / np.linalg.norm(place)
    flip, keep = np.outer(sight, sight), np.outer(normal, normal)
    expected = (np.eye(3) - 2.0 * flip) @ pose.rotation @ (np.eye(3) - 2.0 * keep)
    found = mirror(pose, five, some)
    assert found.rotation == pytest.approx(expected, abs=1e-14)
    assert found.apply(middle) == pytest.approx(place)
