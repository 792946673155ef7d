"""The target before a bright sky: what the network makes of it, and the outlines from that."""

import numpy as np
import pytest

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.sensors.appearance.outline.bright_sky import find_bodies
from rendezview.sensors.appearance.outline.foreground import Foreground, from_squares, to_squares
from rendezview.sensors.appearance.outline.silhouette import Missing
from rendezview.sensors.observation import Status
from rendezview_ground.simulate import Earth, SceneOptions, SensorOptions, render_frame
from rendezview_ground.simulate.foreground_frames import foreground_frame
from rendezview_ground.simulate.random_craft import random_craft

CAMERA = Camera(width=640, height=480, fx=640.0, fy=640.0, cx=319.5, cy=239.5)


@pytest.fixture(scope="module")
def foreground():
    return Foreground()


def overlap(a, b) -> float:
    return float(np.sum(a & b) / np.sum(a | b))


def test_squares_are_the_picture_again():
    picture = np.random.default_rng(0).random((32, 64), dtype=np.float32)
    assert to_squares(picture).shape == (16, 8, 16)
    np.testing.assert_array_equal(from_squares(to_squares(picture)), picture)


def test_craft_that_it_has_not_learned_from_are_told_from_the_sky(foreground):
    overlaps = []
    for seed in range(30):
        picture, cover = foreground_frame(np.random.default_rng([1000, seed]))
        overlaps.append(overlap(foreground.log_odds(picture) > 0.0, cover > 127))
    assert np.median(overlaps) > 0.6


def test_the_size_of_the_picture_does_not_matter(foreground):
    picture, _ = foreground_frame(np.random.default_rng([1000, 5]))
    twice = np.repeat(np.repeat(picture, 2, axis=0), 2, axis=1)
    same = foreground.log_odds(twice)[::2, ::2] > 0.0
    assert overlap(same, foreground.log_odds(picture) > 0.0) > 0.9
    for shape in ((37, 1001), (1024, 1024), (3, 5)):
        assert foreground.log_odds(np.full(shape, 90, np.uint8)).shape == shape


def test_before_the_earth_the_body_is_where_the_target_is(foreground):
    around = 0
    for seed in range(80, 90):
        rng = np.random.default_rng(seed)
        mesh = random_craft(rng)
        centre, radius = mesh.bounding_sphere
        truth = Pose(np.eye(3), np.array([0.0, 0.0, 4.5 * radius]) - centre)
        options = SceneOptions(sky_frame="camera", earth=Earth(seed=seed))
        frame = render_frame(mesh, CAMERA, truth, [0.3, -0.4, -0.8], options, rng)
        bodies = find_bodies(frame, foreground)
        assert not isinstance(bodies, Missing)
        points = CAMERA.project(truth.apply(mesh.vertices_m))
        left, top = points.min(axis=0)
        right, bottom = points.max(axis=0)
        box = np.array([left, top, right, bottom])
        around += any(np.abs(body.box_px - box).max() < 0.1 * (right - left) for body in bodies)
    assert around >= 6


@pytest.mark.requirement("RV-REC-3")
def test_clouds_alone_are_no_body(foreground):
    mesh = random_craft(np.random.default_rng(0))
    away = Pose(np.eye(3), [500.0, 0.0, 9.0])
    claimed = 0
    for seed in range(10):
        options = SceneOptions(
            sky_frame="camera", earth=Earth(seed=seed), sensor=SensorOptions(exposure=250.0)
        )
        rng = np.random.default_rng(seed)
        frame = render_frame(mesh, CAMERA, away, [0.3, 0.2, -1.0], options, rng)
        claimed += not isinstance(find_bodies(frame, foreground), Missing)
    assert claimed <= 5


def test_a_target_over_the_border_is_said_to_be_cut(foreground):
    mesh = random_craft(np.random.default_rng(3))
    centre, radius = mesh.bounding_sphere
    truth = Pose(np.eye(3), np.array([2.2 * radius, 0.0, 4.5 * radius]) - centre)
    options = SceneOptions(sky_frame="camera", earth=Earth(seed=3))
    rng = np.random.default_rng(3)
    frame = render_frame(mesh, CAMERA, truth, [0.3, -0.4, -0.8], options, rng)
    found = find_bodies(frame, foreground)
    assert isinstance(found, Missing)
    assert found.status is Status.BORDER


def test_a_picture_with_more_pixels_shows_the_same_bodies(foreground):
    """Pixels are repeated, so the shrunk picture is the small one."""
    mesh = random_craft(np.random.default_rng(3))
    centre, radius = mesh.bounding_sphere
    truth = Pose(np.eye(3), np.array([0.0, 0.0, 4.5 * radius]) - centre)
    options = SceneOptions(sky_frame="camera", earth=Earth(seed=3))
    rng = np.random.default_rng(3)
    frame = render_frame(mesh, CAMERA, truth, [0.3, -0.4, -0.8], options, rng)
    assert 640 * 480 <= frame.size < 2 * 640 * 480
    bodies = find_bodies(frame, foreground)
    larger = find_bodies(np.repeat(np.repeat(frame, 3, axis=0), 3, axis=1), foreground)
    assert not isinstance(bodies, Missing)
    assert not isinstance(larger, Missing)
    assert len(larger) == len(bodies)
    for small, large in zip(bodies, larger, strict=True):
        assert large.area_px == 9 * small.area_px
        assert large.box_px == tuple(
            3 * place + (2 if k > 1 else 0) for k, place in enumerate(small.box_px)
        )
        for a, b in zip(small.outlines_px, large.outlines_px, strict=True):
            assert np.allclose(b, 3.0 * a + 1.0)
