"""Which circle of a pass is the ring's outer edge: pictures, and circles without noise."""

from __future__ import annotations

import math
from functools import partial

import numpy as np
import pytest
from tests.sensors.ring.flyaround import (
    DISTANCE_M,
    RADIUS_M,
    WIDTH_M,
    camera_at,
    draw,
    plane_range,
)
from tests.sensors.ring.test_ring_size import CAMERA, pose_at, sight

from rendezview.geometry.camera import Camera
from rendezview.io.sequences.frame import Frame
from rendezview.sensors.ring import Ellipse, shape_of_circle
from rendezview.sensors.ring.edge_sides import EdgeSides
from rendezview.sensors.ring.rectangle import Beam
from rendezview.sensors.ring.size_choice import which_is_the_ring
from rendezview.sensors.ring.size_circles import Ellipses, circles_of_pass
from rendezview.sensors.ring.size_run import Echo, SizeResult, measure_pass

ANGLES = (-0.9, -0.75, -0.6, -0.45, 0.5, 0.65, 0.8, 0.95)
INNER_M = RADIUS_M - WIDTH_M
PLAIN = EdgeSides(near_px=0.05, cut_px=0.0, unlit=False, shown=1.0)


def measured(panels_grey: list[float], ring_grey: float = 220.0, **kinds: float) -> SizeResult:
    """A pass of eight frames before panels of these shades."""
    camera, rng = Camera.from_fov(512, 512, math.radians(42.0)), np.random.default_rng(5)
    frames, echoes = [], {}
    for k, (angle, panel_grey) in enumerate(zip(ANGLES, panels_grey, strict=True)):
        pose = camera_at(angle)
        image = draw(camera, pose, rng, panel_grey=panel_grey, ring_grey=ring_grey, **kinds)
        frames.append(Frame(k, str(k), None, camera, None, 1, partial(np.copy, image)))
        echoes[k] = Echo(plane_range(pose) + rng.normal(0.0, 0.005), 0.005, Beam())
    return measure_pass(frames, lambda frame: echoes[frame.im_id])  # type: ignore[arg-type]


def test_an_outer_edge_that_three_of_eight_frames_do_not_show_is_the_rings():
    found = measured([220.0] * 3 + [110.0] * 5)
    assert len(found.circles[0].members) == 5
    assert max(len(circle.members) for circle in found.circles) == 8  # the inner edge
    assert found.size.radius_m == pytest.approx(RADIUS_M, rel=0.005)
    sigma = np.sqrt(np.diag(found.size.covariance))
    assert abs(found.size.radius_m - RADIUS_M) < 3.0 * sigma[0]
    assert abs(found.size.distance_m - DISTANCE_M) < 3.0 * sigma[1]


def test_an_inner_edge_alone_is_no_answer_and_the_reason_names_it():
    found = measured([220.0] * 8)
    assert found.size is None
    assert found.record()["status"] == "ambiguous"
    radius = f"{found.circles[0].radius_m:.4g} m"
    assert f"more than {radius}, if that is an inner edge" in found.reason
    assert found.record()["circles"][0]["radius_m"] == pytest.approx(INNER_M, rel=0.005)


def test_a_circle_without_light_is_not_sure_to_be_the_ring():
    found = measured([110.0] * 8, ring_grey=2.0)
    assert found.record()["status"] == "ambiguous"
    assert "at another distance, if that is a shadow" in found.reason


def test_an_overexposed_ring_has_the_error_of_its_edge():
    found = measured([110.0] * 8, ring_grey=700.0)
    error, sigma = found.size.radius_m - RADIUS_M, math.sqrt(found.size.covariance[0, 0])
    assert 0.003 * RADIUS_M < error < 3.0 * sigma < 0.1 * RADIUS_M


def circle(pose, radius_m, distance_m=DISTANCE_M, offset_m=(0.08, -0.06)):
    """The exact sight of a circle that is off the panel's middle."""
    one = sight(pose, 0.0, 0.0, 0.0, np.random.default_rng(0))
    centre, axis = pose.apply([distance_m, *offset_m]), pose.rotation[:, 0]
    ellipse = Ellipse.from_shape(shape_of_circle(CAMERA, centre, axis, radius_m), 1e-4 * np.eye(5))
    return type(one)(one.corners_px, ellipse, one.range_m, 0.02, 0.002)


def test_circles_of_a_pass_are_exact_without_noise_wherever_they_are():
    poses = [pose_at(angle) for angle in (-0.8, -0.4, 0.3, 0.7)]
    truth = {(0.597, 1.68), (0.477, 1.68), (0.3, -0.4)}
    sights = [[circle(pose, *numbers) for numbers in truth] for pose in poses]
    sights[2].append(circle(poses[2], 0.5, 1.0))  # of one frame only
    found = circles_of_pass(Ellipses(CAMERA, sights), 3)
    assert {tuple(np.round(one.numbers[:2], 6)) for one in found} == truth
    for one in found:
        np.testing.assert_allclose(one.offset_m, (0.08, -0.06), atol=1e-6)
        assert len(one.members) == 4


def test_a_ring_and_an_equally_visible_foot_of_its_adapter_are_rivals():
    poses = [pose_at(angle) for angle in (-0.8, -0.4, 0.3, 0.7)]
    bodies = ((0.597, 1.68), (0.557, 1.68), (0.71, 1.43), (0.6466, 1.43))
    ellipses = Ellipses(CAMERA, [[circle(pose, *one) for one in bodies] for pose in poses])
    answers = which_is_the_ring(circles_of_pass(ellipses, 3), [[PLAIN] * 4] * 4, ellipses)
    assert sorted(round(one.circle.radius_m, 6) for one in answers) == [0.597, 0.71]
    assert not any(one.instead for one in answers)


def test_ellipses_that_no_circle_explains_are_none():
    poses = [pose_at(angle) for angle in (-0.8, -0.4, 0.3, 0.7)]
    sights = [[circle(p, 0.5 + 0.02 * k, 1.0 + 0.3 * k)] for k, p in enumerate(poses)]
    assert circles_of_pass(Ellipses(CAMERA, sights), 3) == []


def test_one_picture_twice_gives_no_distance():
    one = [circle(pose_at(0.4), 0.597)]
    assert circles_of_pass(Ellipses(CAMERA, [one, one, one]), 3) == []
