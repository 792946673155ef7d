"""Large targets: they are searched for in a smaller picture, and nothing shows it but the time."""

from __future__ import annotations

import numpy as np
import pytest

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.io.grey_frame import shrunk
from rendezview.sensors.appearance import Recognizer
from rendezview.sensors.appearance.search.levels import (
    LARGEST_RADIUS_PX,
    shrunk_blur,
    shrunk_sky,
    times_smaller,
)
from rendezview.sensors.appearance.sky import Sky
from rendezview.sensors.observation import Status

LARGE = Camera(1601, 1203, 3000.0, 3010.0, 790.0, 610.0, (-0.2, 0.4, -0.001, 0.0005))


def test_a_point_lies_at_the_same_place_of_a_shrunk_picture():
    points = np.random.default_rng(1).uniform((-0.2, -0.15, 1.0), (0.2, 0.15, 2.0), (50, 3))
    for times in (2, 3, 5):
        small = LARGE.binned(times)
        assert (small.width, small.height) == (1601 // times, 1203 // times)
        # A pixel of the small picture is the square of ``times`` pixels around its centre.
        there = (LARGE.project(points) + 0.5) / times - 0.5
        assert np.allclose(small.project(points), there, atol=1e-9)


def test_a_shrunk_picture_has_the_means_of_squares_and_less_noise():
    rng = np.random.default_rng(2)
    image = np.clip(rng.normal(30.0, 6.0, (605, 807)), 0, 255).astype(np.uint8)
    small = shrunk(image, 3)
    means = image[:603, :807].reshape(201, 3, 269, 3).mean(axis=(1, 3))
    assert np.abs(small - means).max() <= 0.5 + 1e-9
    assert shrunk(image, 1) is image
    sky = Sky.of(image, (0.0, 0.0, -1.0))
    less = shrunk_sky(small, sky)
    assert less.noise_grey == pytest.approx(sky.noise_grey / 3.0, rel=0.15)
    assert less.dark == sky.dark
    assert less.sun_camera is sky.sun_camera


def test_the_blur_of_a_shrunk_edge_goes_down_to_that_of_reading():
    assert shrunk_blur(0.85, 1) == pytest.approx(0.85)
    assert shrunk_blur(0.85, 32) == pytest.approx(0.5, abs=1e-3)
    assert shrunk_blur(0.3, 4) == pytest.approx(0.5)


def test_the_level_follows_from_the_size_of_the_target():
    camera = Camera.from_fov(5120, 3840, np.deg2rad(30.0))
    for range_m in (0.5, 3.0, 10.0, 30.0, 1000.0):
        times = times_smaller(camera, 1.0, range_m)
        radius_px = camera.fx / max(range_m, 1.0)
        assert radius_px / times <= LARGEST_RADIUS_PX
        assert times == 1 or radius_px / times > 0.5 * LARGEST_RADIUS_PX


def test_a_large_target_is_found_at_its_level(refining_model, bumpy_mesh, draw):
    camera = Camera.from_fov(1800, 1350, np.deg2rad(25.0))
    recognizer = Recognizer(refining_model, camera, trees=False)
    rng = np.random.default_rng(4)
    found = 0
    for seed in range(4):
        turn = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
        rotation = turn * np.sign(np.linalg.det(turn))
        depth = camera.fx * refining_model.target_radius_m / 550.0
        truth = Pose(rotation, [0.02 * depth, -0.01 * depth, depth])
        frame = draw(bumpy_mesh, truth, camera, rng)
        first = recognizer.recognize(frame)
        near = recognizer.recognize(frame, truth)
        assert near.status is Status.OK
        assert near.pose.angle_to(truth) < np.deg2rad(0.3)
        assert np.linalg.norm(near.pose.translation_m - truth.translation_m) < 3e-3 * depth
        found += first.pose is not None and first.pose.angle_to(truth) < np.deg2rad(0.5)
    assert found >= 3
    assert recognizer.search is not None
    assert sorted(recognizer.search.levels._levels) == [1, 2]
