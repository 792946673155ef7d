"""The plain laboratory of lights: its equations, and the product's laboratory beside it."""

from __future__ import annotations

import numpy as np
import pytest
from tests import plain_lights as plain
from tests.plain_laboratory import OwnLaboratory, PlainLaboratory

from rendezview.calibration.laboratory import calibrate_laboratory
from rendezview.geometry.pose import Pose
from rendezview.sensors.beacons import Lens, StereoTracker
from rendezview.sensors.beacons.detect.led_spots import find_spots
from rendezview_ground.simulate.led_laboratory import LaboratoryOptions
from rendezview_ground.simulate.led_pictures import PictureOptions

LEDS = np.array(
    [[1.3, 0, 0], [0.7, -0.2, 0.1], [0.3, 0.2, 0], [-0.5, -0.6, 0], [-0.4, 0.6, 0.1], [0, 0.1, 0]]
)
TILTED = Pose(plain.turn(np.array([1.0, 0.5, 0.0]), 0.3), np.array([0.05, -0.1, 0.2]))


@pytest.fixture(scope="module")
def crooked() -> PlainLaboratory:
    return PlainLaboratory(LEDS, LaboratoryOptions(), 3)


def test_equation_6_leads_from_the_measured_place_to_the_ideal_one(crooked: PlainLaboratory):
    diode = crooked.diodes[0]
    spots = diode.on_detector(TILTED.apply(LEDS))
    measured = (spots - diode.principal_m) / diode.focal_m
    local = diode.place(TILTED.apply(LEDS))
    lens = Lens.from_coefficients(diode.lens, corrects=True)  # the product's eq. 6
    np.testing.assert_allclose(lens.undistort(measured), local[:, :2] / local[:, 2:], atol=1e-12)
    assert np.abs(measured - local[:, :2] / local[:, 2:]).max() > 1e-4


def test_without_distortion_both_laboratories_see_the_lights_in_the_same_places():
    options = LaboratoryOptions(distorted=False)
    both = OwnLaboratory(LEDS, options, 1), PlainLaboratory(LEDS, options, 1)
    (own, _), (theirs, _) = (made.currents([TILTED, Pose.identity()], None) for made in both)

    def reading(currents: np.ndarray) -> np.ndarray:
        pairs = currents.reshape(*currents.shape[:-1], 2, 2)
        return (pairs[..., 0] - pairs[..., 1]) / pairs.sum(axis=-1)

    np.testing.assert_allclose(reading(theirs), reading(own), atol=1e-12)
    assert theirs[..., :2].sum(axis=-1).min() < 0.95 * theirs[..., :2].sum(axis=-1).max()


def test_a_crooked_laboratory_is_calibrated_from_its_own_measurements(crooked: PlainLaboratory):
    rig = calibrate_laboratory(crooked.calibration(np.random.default_rng(4))).rig
    rng, tracker = np.random.default_rng(5), StereoTracker(rig, LEDS)
    currents = np.mean([crooked.currents([TILTED], rng)[0] for _ in range(200)], axis=0)
    spots = [c.photodiode.read(row) for c, row in zip(rig.cameras, currents, strict=True)]
    found = tracker.update(0.0, spots)
    truth = rig.cameras[0].camera_from_rig @ TILTED
    assert found.pose.angle_to(truth) < np.deg2rad(0.2)


def test_lights_in_a_picture_are_where_opencv_projects_them(crooked: PlainLaboratory):
    options = PictureOptions(signal_to_noise=400.0)
    pictures = crooked.pictures(TILTED, options, np.random.default_rng(6))
    for eye, camera, picture in zip(
        crooked.eyes, crooked.picture_rig.cameras, pictures, strict=True
    ):
        wanted = eye.project(TILTED.apply(LEDS))
        np.testing.assert_allclose(camera.project(TILTED.apply(LEDS)), wanted, atol=1e-9)
        found = find_spots(picture).positions
        gaps = np.linalg.norm(found[None] - wanted[:, None], axis=2).min(axis=1)
        assert len(found) == len(LEDS)
        assert gaps.max() < 0.02


def test_the_bounds_of_both_laboratories_agree_where_the_light_is_the_same():
    options = LaboratoryOptions(distorted=False)
    own, theirs = OwnLaboratory(LEDS, options, 1), PlainLaboratory(LEDS, options, 1)
    ratio = np.diag(theirs.bound(Pose.identity())) / np.diag(own.bound(Pose.identity()))
    assert (np.abs(ratio - 1.0) < 0.5).all()  # the light falls with the cosine and the distance
    pictures = PictureOptions()
    ratio = np.diag(theirs.picture_bound(Pose.identity(), pictures)) / np.diag(
        own.picture_bound(Pose.identity(), pictures)
    )
    assert (np.abs(ratio - 1.0) < 0.5).all()
