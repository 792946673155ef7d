"""Stars and Earth are where they should be, and lit by the same Sun."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rendezview.geometry.camera import Camera
from rendezview_ground.simulate.background import (
    Earth,
    Stars,
    earth_radiance,
    ground_rotation,
    star_radiance,
)
from rendezview_ground.simulate.distortion import pixel_rays

CAMERA = Camera.from_fov(80, 60, math.radians(50.0))
AHEAD, TO_CAMERA = np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, -1.0])


@pytest.mark.parametrize("radius_rad", [0.15, 0.3])
def test_the_limb_stands_at_the_asked_angle_from_the_centre(radius_rad: float) -> None:
    towards = np.array([0.1, -0.05, 1.0]) / np.linalg.norm([0.1, -0.05, 1.0])
    _, clear = earth_radiance(CAMERA, towards, TO_CAMERA, Earth(angular_radius_rad=radius_rad))
    rays = pixel_rays(CAMERA)
    angle = np.arccos(rays @ towards / np.linalg.norm(rays, axis=2))
    assert (clear[angle < radius_rad - 1e-3] == 0.0).all()
    assert (clear[angle > radius_rad + 0.02] == 1.0).all(), "the air is thin"


def test_an_earth_below_a_low_orbit_fills_the_frame_with_varied_grey() -> None:
    radiance, clear = earth_radiance(CAMERA, AHEAD, TO_CAMERA, Earth())
    assert not clear.any()
    assert 0.05 < radiance.mean() < 0.8
    assert radiance.std() > 0.02


def test_the_earth_is_bright_towards_the_sun_and_dark_away_from_it() -> None:
    radiance, clear = earth_radiance(
        CAMERA, AHEAD, np.array([1.0, 0.0, 0.0]), Earth(angular_radius_rad=0.35)
    )
    right, left = radiance[:, 45:], radiance[:, :35]
    assert right.sum() > 50 * left.sum()
    assert (clear[:, :35] < 0.5).any(), "the night side hides the stars all the same"


def test_other_ground_comes_by_as_time_passes() -> None:
    frames = [
        earth_radiance(CAMERA, AHEAD, TO_CAMERA, Earth(), ground_rotation(AHEAD, angle))[0]
        for angle in (0.0, 0.0, 0.05)
    ]
    np.testing.assert_array_equal(frames[0], frames[1])
    assert np.abs(frames[0] - frames[2]).mean() > 0.01


def test_the_ground_turns_about_an_axis_across_the_view() -> None:
    turn = ground_rotation(AHEAD, 0.3)
    assert AHEAD @ turn @ AHEAD == pytest.approx(math.cos(0.3))


def test_a_stars_light_is_centred_on_its_projection() -> None:
    stars = Stars(count=1, seed=2, brightest=1.0)
    direction = np.random.default_rng(2).standard_normal((1, 3))[0]
    direction /= np.linalg.norm(direction)
    place = np.array([0.1, -0.07, 1.0])
    turn, _ = Rotation.align_vectors([place / np.linalg.norm(place)], [direction])
    sky = star_radiance(CAMERA, turn.as_matrix(), stars)
    rows, columns = np.indices(sky.shape)
    centre = np.array([(sky * columns).sum(), (sky * rows).sum()]) / sky.sum()
    np.testing.assert_allclose(centre, CAMERA.project(place), atol=1e-4)
    assert (sky > 0).sum() <= 4


def test_stars_fill_the_sky_evenly_and_repeat_with_the_seed() -> None:
    stars = Stars(count=20_000)
    sky = star_radiance(CAMERA, np.eye(3), stars)
    np.testing.assert_array_equal(sky, star_radiance(CAMERA, np.eye(3), stars))
    assert np.abs(sky - star_radiance(CAMERA, np.eye(3), Stars(count=20_000, seed=1))).sum() > 1
    opposite = star_radiance(CAMERA, np.diag([1.0, -1.0, -1.0]), stars)
    assert (sky > 0).sum() == pytest.approx((opposite > 0).sum(), rel=0.2)


def test_no_stars_is_a_black_sky() -> None:
    assert not star_radiance(CAMERA, np.eye(3), Stars(count=0)).any()
