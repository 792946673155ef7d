"""The target before a bright sky: what the network makes of it, and the outlines from that."""

import numpy as np
import pytest

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.sensors.appearance.edges.network import Sketcher
from rendezview.sensors.appearance.outline.silhouette import (
    Missing,
    SilhouetteOptions,
    silhouette_of_mask,
)
from rendezview.sensors.observation import Status
from rendezview_ground.simulate import Earth, SceneOptions, SensorOptions, render_frame
from rendezview_ground.simulate.random_craft import random_craft

CAMERA = Camera(width=640, height=480, fx=640.0, fy=640.0, cx=319.5, cy=239.5)


@pytest.fixture(scope="module")
def body_of():
    sketcher = Sketcher()

    def body(frame, times=1):
        first = sketcher.find(frame)
        if first is None:
            return Missing(Status.EMPTY, "the sketch shows nothing")
        odds = sketcher.closer(frame, first).odds(frame.shape, times)
        mask = np.where(odds > 0.0, 255, 0).astype(np.uint8)
        found = silhouette_of_mask(mask, SilhouetteOptions(rival_fraction=2.0, merge_gap=0.6))
        return found if isinstance(found, Missing) else found.enlarged(times)

    return body


def test_before_the_earth_the_body_is_where_the_target_is(body_of):
    around = 0
    for seed in range(80, 90):
        rng = np.random.default_rng(seed)
        mesh = random_craft(rng)
        centre, radius = mesh.bounding_sphere
        truth = Pose(np.eye(3), np.array([0.0, 0.0, 4.5 * radius]) - centre)
        options = SceneOptions(sky_frame="camera", earth=Earth(seed=seed))
        frame = render_frame(mesh, CAMERA, truth, [0.3, -0.4, -0.8], options, rng)
        body = body_of(frame)
        assert not isinstance(body, Missing)
        points = CAMERA.project(truth.apply(mesh.vertices_m))
        left, top = points.min(axis=0)
        right, bottom = points.max(axis=0)
        box = np.array([left, top, right, bottom])
        around += np.abs(body.box_px - box).max() < 0.1 * (right - left)
    assert around >= 6


@pytest.mark.requirement("RV-REC-3")
def test_clouds_alone_are_no_body(body_of):
    mesh = random_craft(np.random.default_rng(0))
    away = Pose(np.eye(3), [500.0, 0.0, 9.0])
    claimed = 0
    for seed in range(10):
        options = SceneOptions(
            sky_frame="camera", earth=Earth(seed=seed), sensor=SensorOptions(exposure=250.0)
        )
        rng = np.random.default_rng(seed)
        frame = render_frame(mesh, CAMERA, away, [0.3, 0.2, -1.0], options, rng)
        claimed += not isinstance(body_of(frame), Missing)
    assert claimed <= 5


def test_a_target_over_the_border_is_said_to_be_cut(body_of):
    mesh = random_craft(np.random.default_rng(3))
    centre, radius = mesh.bounding_sphere
    truth = Pose(np.eye(3), np.array([2.2 * radius, 0.0, 4.5 * radius]) - centre)
    options = SceneOptions(sky_frame="camera", earth=Earth(seed=3))
    rng = np.random.default_rng(3)
    frame = render_frame(mesh, CAMERA, truth, [0.3, -0.4, -0.8], options, rng)
    found = body_of(frame)
    assert isinstance(found, Missing)
    assert found.status is Status.BORDER


def test_a_picture_with_more_pixels_shows_the_same_body(body_of):
    """Pixels are repeated, so both sketches show the same, to rounding."""
    mesh = random_craft(np.random.default_rng(3))
    centre, radius = mesh.bounding_sphere
    truth = Pose(np.eye(3), np.array([0.0, 0.0, 4.5 * radius]) - centre)
    options = SceneOptions(sky_frame="camera", earth=Earth(seed=3))
    rng = np.random.default_rng(3)
    frame = render_frame(mesh, CAMERA, truth, [0.3, -0.4, -0.8], options, rng)
    assert 640 * 480 <= frame.size < 2 * 640 * 480
    small = body_of(frame)
    large = body_of(np.repeat(np.repeat(frame, 3, axis=0), 3, axis=1), 3)
    assert not isinstance(small, Missing)
    assert not isinstance(large, Missing)
    assert large.area_px == pytest.approx(9 * small.area_px, rel=0.02)
    whole = [3 * place + (2 if k > 1 else 0) for k, place in enumerate(small.box_px)]
    assert large.box_px == pytest.approx(whole, abs=6)
