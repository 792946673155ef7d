"""A ring's reading over its picture: the colours say whether a pose is given."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rendezview.sensors.observation import Status
from rendezview.sensors.ring import RingPrior, RingSensor
from rendezview.sensors.ring.overlay import draw_reading

ORANGE, PURPLE = (0, 165, 255), (167, 121, 204)  # blue green red


def has(picture: np.ndarray, colour: tuple[int, int, int]) -> bool:
    return bool((np.abs(picture.astype(int) - colour).max(axis=2) < 12).any())


def test_an_ellipse_without_a_pose_is_not_in_the_rings_colour(make, ring_camera):
    scene, image = make([20, 0])
    sensor = RingSensor(ring_camera, scene.ring.radius_m)
    sure = sensor.update(1.0, image, RingPrior(axis=scene.ring.axis))
    assert sure.circle is not None
    drawn = draw_reading(image, sure, ring_camera)
    assert has(drawn, ORANGE)
    assert not has(drawn, PURPLE)
    words = "which of two circles it is cannot be told from one frame, " * 3
    open_choice = replace(sure, status=Status.AMBIGUOUS, reason=words, choice=None)
    drawn = draw_reading(image, open_choice, ring_camera)
    assert has(drawn, PURPLE)
    assert not has(drawn, ORANGE)


def test_a_long_reason_is_written_on_several_lines(make, ring_camera):
    scene, image = make([20, 0])
    sure = RingSensor(ring_camera, scene.ring.radius_m).update(1.0, image)
    written = []
    for words in ("short", "a reason as long as the picture is wide, and then more of it " * 4):
        unsure = replace(sure, edges=(), circles=(), choice=None, reason=words)
        drawn = draw_reading(np.zeros_like(image), unsure, ring_camera)
        rows = np.flatnonzero(drawn.max(axis=(1, 2)))
        written.append(rows.max())
        assert not drawn[:, -4:].any()
    assert written[1] > written[0] + 30


def test_a_reason_keeps_its_signs(make, ring_camera):
    scene, image = make([20, 0])
    sure = RingSensor(ring_camera, scene.ring.radius_m).update(1.0, image)
    drawn = [
        draw_reading(
            image, replace(sure, circles=(), choice=None, reason=f"12 {sign} 1"), ring_camera
        )
        for sign in "±?"
    ]
    assert (drawn[0] != drawn[1]).any()
