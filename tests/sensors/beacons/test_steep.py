"""Targets that are steeply tilted, or so far away that a pose is hardly determined."""

from __future__ import annotations

import math

import numpy as np
import pytest
from tests import plain_pictures as plain
from tests.plain_readings import CAMERA, HALF_TURN, PINHOLE, frames_of

from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Pose
from rendezview.sensors.beacons import ReflectorSensor, TrackingOptions, predict_spots
from rendezview.sensors.beacons.match.acquisition_options import AcquisitionOptions
from rendezview.sensors.beacons.pose.refinement import SpotFit
from rendezview.sensors.observation import Status


def outcomes(pattern, tilts_deg, count, rng, options=None):
    """How many of so many single readings at 3 m are right, and how many wrong."""
    right, wrong = 0, 0
    least, most = np.radians(tilts_deg)
    for _ in range(count):
        truth = Pose(*plain.look_at(rng, PINHOLE, 3.0, most, 150.0, least))
        frames = frames_of(PINHOLE, pattern, truth, rng)
        sensor = ReflectorSensor(
            CAMERA, [pattern], acquisition=options, tracking=TrackingOptions(confirm=False)
        )
        found = sensor.update(0.0, frames)
        if found.pose is None:
            continue
        near = min(found.pose.angle_to(pose) for pose in (truth, truth @ HALF_TURN))
        right, wrong = right + (near < 0.09), wrong + (near >= 0.09)
    return right, wrong


@pytest.mark.parametrize("tilts_deg", [(50.0, 60.0), (60.0, 75.0)])
def test_a_steep_target_of_five_is_found_and_no_other_pose_passes_for_it(five, tilts_deg):
    """Where only poses to 54° were tried, others of three or four spots passed: 7 of 34."""
    right, wrong = outcomes(five, tilts_deg, 14, np.random.default_rng(51))
    assert right >= 9
    assert wrong == 0


def test_a_steep_target_of_three_is_found(three):
    right, wrong = outcomes(three, (55.0, 70.0), 14, np.random.default_rng(52))
    assert right >= 10
    assert wrong == 0


def test_a_limit_of_the_tilt_holds_for_all_poses(three):
    flat = AcquisitionOptions(tilt_rad=math.radians(45.0))
    assert outcomes(three, (60.0, 70.0), 6, np.random.default_rng(53), flat) == (0, 0)
    with pytest.raises(RendezviewError, match="tilt_rad"):
        AcquisitionOptions(tilt_rad=2.0)


def test_a_pose_that_its_spots_hardly_determine_converges(five):
    """Far away the steps shrink slowly: a minimum that counts as none leaves its rival alone."""
    rng = np.random.default_rng(54)
    for _ in range(40):
        truth = Pose(*plain.look_at(rng, PINHOLE, 20.0, 0.5, 80.0))
        sigma = np.full(5, 0.014)
        sigma[1] = 0.4
        spots = predict_spots(CAMERA, five, truth) + rng.normal(0.0, 0.014, (5, 2))
        found = SpotFit(CAMERA, five).fit(spots, np.arange(5), truth, sigma)
        assert found is not None


def test_few_spots_of_a_steep_target_are_no_pose(five):
    """Three of five, tilted by 65°: false spots may show that, too."""
    rng, statuses = np.random.default_rng(55), []
    for _ in range(6):
        pose = Pose(*plain.look_at(rng, PINHOLE, 3.0, 1.2, 150.0, 1.1))
        frames = frames_of(PINHOLE, five, pose, rng, hidden=(3,))
        sensor = ReflectorSensor(CAMERA, [five], tracking=TrackingOptions(confirm=False))
        statuses.append(sensor.update(0.0, frames).status)
    assert Status.OK not in statuses
    assert Status.AMBIGUOUS in statuses
