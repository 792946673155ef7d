"""The panel's corners in drawn pictures."""

import math

import numpy as np
from tests.sensors.ring.flyaround import PANEL_M, camera_at, draw

from rendezview.geometry.camera import Camera
from rendezview.sensors.ring.panel import find_panel

CAMERA = Camera.from_fov(512, 512, math.radians(42.0))
Y, Z = 0.5 * PANEL_M[0], 0.5 * PANEL_M[1]
CORNERS_M = np.array([[0, Y, Z], [0, -Y, Z], [0, Y, -Z], [0, -Y, -Z]])


def test_corners_lie_within_their_uncertainty_and_have_the_panels_order():
    rng = np.random.default_rng(1)
    odd, before = [], None
    for angle in (-0.9, -0.5, 0.1, 0.6, 0.8):
        pose = camera_at(angle)
        panel = find_panel(draw(CAMERA, pose, rng), CAMERA)
        assert panel is not None
        corners, before = panel.ordered(CAMERA, before)
        odd.append((corners - CAMERA.project(pose.apply(CORNERS_M))) / panel.sigma_px)
        assert panel.sigma_px < 0.1
        assert panel.holds(CAMERA.project(pose.translation_m[None])[0])
    assert np.sqrt(np.mean(np.square(odd))) < 1.5
    assert np.abs(odd).max() < 4.0


def test_noise_and_a_disc_are_no_panel():
    rng = np.random.default_rng(2)
    assert find_panel(rng.integers(0, 30, (480, 640)).astype(np.uint8), CAMERA) is None
    y, x = np.mgrid[:512, :512]
    disc = np.where(np.hypot(x - 250, y - 260) < 120, 200, 20).astype(np.uint8)
    assert find_panel(disc, CAMERA) is None
