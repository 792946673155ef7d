"""Lights in pictures: places at the bound, identity from geometry alone."""

from __future__ import annotations

import numpy as np
import pytest
from tests.plain_laboratory import rotation_of

from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Pose
from rendezview.sensors.beacons import Spots, StereoTracker
from rendezview.sensors.beacons.detect.led_spots import SpotOptions, find_spots
from rendezview.sensors.observation import Status
from rendezview_ground.simulate.led_laboratory import Laboratory
from rendezview_ground.simulate.led_pictures import PictureOptions, draw, picture_rig

POSE = Pose(rotation_of(0.7, 0.2, -0.1), [0.05, -0.08, 0.3])


@pytest.mark.parametrize("width_px", [1.2, 2.5])
def test_a_spot_is_placed_at_the_bound(width_px: float):
    rng = np.random.default_rng(1)
    v, u = np.mgrid[:96, :96]
    errors, told = [], []
    for _ in range(150):
        at = rng.uniform(30.0, 66.0, 2)
        spot = 150.0 * np.exp(-0.5 * ((u - at[0]) ** 2 + (v - at[1]) ** 2) / width_px**2)
        grey = np.clip(np.rint(20.0 + spot + rng.normal(0.0, 2.0, u.shape)), 0, 255)
        found = find_spots(grey.astype(np.uint8))
        assert len(found) == 1
        errors.append(found.positions[0] - at)
        told.append(found.sigma[0])
    scatter = np.sqrt(np.mean(np.square(errors)))
    bound = np.sqrt(2.0 / np.pi * (4.0 + 1.0 / 12.0)) / 150.0
    assert scatter == pytest.approx(bound, rel=0.12)
    assert np.mean(told) == pytest.approx(scatter, rel=0.15)


def test_dark_noisy_bright_and_crowded_pictures_have_no_lights():
    rng = np.random.default_rng(2)
    assert len(find_spots(np.zeros((60, 80), np.uint8))) == 0
    assert len(find_spots(np.full((60, 80), 255, np.uint8))) == 0
    noisy = np.clip(rng.normal(60.0, 5.0, (300, 300)), 0, 255).astype(np.uint8)
    assert len(find_spots(noisy)) == 0
    large = np.zeros((200, 200), np.uint8)
    large[50:150, 50:150] = 200
    assert len(find_spots(large)) == 0
    cut = np.zeros((60, 80), np.uint8)
    cut[20:24, 0:3] = 200
    assert len(find_spots(cut)) == 0


def test_a_dark_picture_takes_a_sunlit_craft_out_of_the_places():
    """Lights on the edge of a lit plate: in one picture they move by many times the noise."""
    rng, places = np.random.default_rng(3), np.array([[40.3, 30.0], [40.0, 60.4], [40.6, 90.1]])
    v, u = np.mgrid[:120, :120]
    plate = np.where((u >= 40) & (u < 110), 25.0, 0.0)
    lights = sum(200.0 * np.exp(-0.5 * ((u - x) ** 2 + (v - y) ** 2) / 1.5**2) for x, y in places)

    def picture(light: np.ndarray | float) -> np.ndarray:
        noisy = 20.0 + plate + light + rng.normal(0.0, 1.0, plate.shape)
        return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)

    def off(spots: Spots) -> np.ndarray:
        apart = spots.positions[:, None] - places
        return apart[np.arange(len(spots)), np.linalg.norm(apart, axis=2).argmin(axis=1)]

    lit = picture(lights)
    both = find_spots(lit, dark=picture(0.0))
    assert len(both) == 3
    assert (np.abs(off(both)) < 4.0 * both.sigma).all()
    assert both.sigma.max() < 0.01
    assert np.abs(off(find_spots(lit))).max() > 0.1


@pytest.mark.parametrize("image", [np.zeros((5, 5), np.uint8), np.zeros((60, 80, 3), np.uint8),
                                   np.full((60, 80), np.nan)])  # fmt: skip
def test_what_is_no_grey_picture_is_refused(image: np.ndarray):
    with pytest.raises(RendezviewError, match="a picture must be"):
        find_spots(image)
    with pytest.raises(RendezviewError, match="a picture must be"):
        find_spots(np.zeros((60, 80), np.uint8), dark=image)
    with pytest.raises(RendezviewError, match="threshold"):
        SpotOptions(threshold_grey=0.0)


def test_unnamed_lights_in_two_pictures_give_the_pose(laboratory: Laboratory, scole):
    options = PictureOptions()
    rig = picture_rig(laboratory, options)
    tracker = StereoTracker.of_target(rig, scole)
    rng = np.random.default_rng(3)
    for k in range(3):
        pose = Pose(rotation_of(0.7 + 0.03 * k, 0.2, -0.1), POSE.translation_m)
        spots = [find_spots(draw(rig, c, pose.apply(tracker.leds), options, rng)) for c in (0, 1)]
        observation = tracker.update(float(k), spots)
        assert observation.status is Status.OK, observation.reason
        assert observation.restarted == (k == 0)
        assert np.rad2deg(observation.rig_from_target.angle_to(pose)) < 0.02
        assert sorted(observation.spots[0].led) == list(range(6))


@pytest.mark.parametrize(("hidden", "false"), [(0, 0), (1, 0), (1, 2)])
def test_identity_survives_hidden_lights_and_false_spots(
    laboratory: Laboratory, scole, hidden: int, false: int
):
    rig = picture_rig(laboratory, PictureOptions())
    rng = np.random.default_rng(4)
    for _ in range(4):
        pose = Pose(rotation_of(rng.uniform(-3, 3), *rng.uniform(-0.3, 0.3, 2)), np.zeros(3))
        tracker = StereoTracker.of_target(rig, scole)
        spots = []
        for camera in rig.cameras:
            seen = camera.project(pose.apply(tracker.leds))[rng.permutation(6)[hidden:]]
            seen = np.concatenate([rng.uniform(0.0, 1023.0, (false, 2)), seen])
            seen = seen + rng.normal(0.0, 0.05, seen.shape)
            spots.append(Spots(seen, np.full(seen.shape, 0.05), np.full(len(seen), -1)))
        observation = tracker.update(0.0, spots)
        assert observation.status is Status.OK, observation.reason
        assert np.rad2deg(observation.rig_from_target.angle_to(pose)) < 0.1


def test_unnamed_spots_that_are_not_the_target_are_refused(laboratory: Laboratory, scole):
    rig = picture_rig(laboratory, PictureOptions())
    rng = np.random.default_rng(5)
    for count in (2, 6, 60):
        tracker = StereoTracker.of_target(rig, scole)
        spots = [
            Spots(rng.uniform(0, 1023, (count, 2)), np.full((count, 2), 0.05), np.full(count, -1))
            for _ in rig.cameras
        ]
        observation = tracker.update(0.0, spots)
        assert observation.pose is None
        assert observation.reason
