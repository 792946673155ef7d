"""Rivals of the true pose: another group's shape, a glint, a mirrored picture."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from tests.plain_pictures import Pinhole, look_at
from tests.plain_readings import HALF_TURN, PAPER, frames_of

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.sensors.beacons import (
    Acquirer,
    LitDark,
    ReflectorPattern,
    ReflectorSensor,
    Rig,
    RigCamera,
    SixNumbers,
    Spots,
    StereoTracker,
    find_spots,
    pose_of,
)
from rendezview.sensors.observation import Status


def scaled(pattern, factor):
    return replace(
        pattern, name="near", names=("a", "b", "c"), positions_m=factor * pattern.positions_m,
        diameters_m=factor * pattern.diameters_m,
    )  # fmt: skip


def test_a_group_of_the_same_shape_at_another_range_is_a_rival(three, paper_camera):
    """Near group 0.22 times as large: either could be there, 7 m or 1.5 m away."""
    rng, near = np.random.default_rng(1), scaled(three, 0.22)
    acquirer = Acquirer(paper_camera, [three, near])
    for range_m in (7.0, 8.0, 9.0, 10.0):
        pose = pose_of(SixNumbers(range_m, 0.02, -0.03, 0.3, 0.1, -0.05), three)
        spots = find_spots(frames_of(PAPER, three, pose, rng))
        found = acquirer.acquire(spots)
        assert found.status is Status.AMBIGUOUS, range_m
        chosen = acquirer.acquire(spots, pose.perturbed([0.02, 0.0, 0.0, 0.0, 0.0, 0.3]))
        off = chosen.refined.camera_from_target.translation_m - pose.translation_m
        assert np.linalg.norm(off) < 0.01 * range_m


def test_both_groups_in_view_are_no_rivals(three, paper_camera):
    rng, near = np.random.default_rng(2), scaled(three, 0.22)
    near = replace(near, positions_m=near.positions_m + np.array([0.0, 0.2, 0.0]))
    both = Acquirer(paper_camera, [three, near]).constellation
    pose = pose_of(SixNumbers(2.5, 0.02, -0.03, 0.3, 0.1, -0.05), three)
    spots = find_spots(frames_of(PAPER, both, pose, rng))
    found = Acquirer(paper_camera, [three, near]).acquire(spots)
    assert found.status is Status.OK
    assert found.refined.camera_from_target.angle_to(pose) < 0.02


def glint_run(three, paper_camera, step_px):
    """Readings while a reflector is covered and a glint like it moves away from its place."""
    rng, sensor = np.random.default_rng(3), ReflectorSensor(paper_camera, [three])
    pose = pose_of(SixNumbers(3.0, 0.03, -0.02, 0.2, 0.15, -0.1), three)
    place = PAPER.project(pose.apply(three.positions_m))[1]
    for k in range(26):
        covered = (1,) if 12 <= k < 17 else ()
        at = place + max(k - 11, 0) * np.array(step_px)
        false = np.array([[*at, 1.55, 180.0]]) if covered else None
        frames = frames_of(PAPER, three, pose, rng, hidden=covered, false=false)
        yield sensor.update(0.2 * k, frames), pose


@pytest.mark.parametrize("step_px", [(2.0, 1.0), (0.0, -3.0), (-4.0, 0.0)])
def test_a_glint_in_place_of_a_reflector_is_not_followed(three, paper_camera, step_px):
    readings = list(glint_run(three, paper_camera, step_px))
    for reading, pose in readings:
        if reading.pose is not None:
            off = min(reading.pose.angle_to(pose), reading.pose.angle_to(pose @ HALF_TURN))
            assert off < math.radians(5.0)
    statuses = [reading.status for reading, _ in readings]
    assert statuses[1:12] == [Status.OK] * 11
    assert statuses[12] is not Status.OK or statuses[13] is not Status.OK
    assert statuses[-1] is Status.OK


@pytest.mark.parametrize("grey", [130.0, 180.0])
def test_a_glint_that_creeps_away_from_a_covered_reflector_is_no_pose(three, paper_camera, grey):
    """It never jumps; light tells the dim one, and motion the other while that is known."""
    rng, sensor = np.random.default_rng(6), ReflectorSensor(paper_camera, [three])
    pose = pose_of(SixNumbers(3.0, 0.03, -0.02, 0.2, 0.15, -0.1), three)
    place = PAPER.project(pose.apply(three.positions_m))[1]
    for k in range(30):
        covered = (1,) if k >= 12 else ()
        at = place + 1.0 * max(k - 11, 0) * np.array([0.8, -0.6])
        false = np.array([[*at, 1.55, grey]]) if covered else None
        frames = frames_of(PAPER, three, pose, rng, hidden=covered, false=false)
        reading = sensor.update(0.2 * k, frames)
        if reading.pose is not None:
            off = min(reading.pose.angle_to(pose), reading.pose.angle_to(pose @ HALF_TURN))
            assert off < math.radians(5.0)
        assert not (k >= 12 and grey < 150.0 and reading.pose is not None)


def test_a_glint_that_was_one_with_a_covered_reflector_is_not_found_in_its_place(
    three, paper_camera
):
    """While both shine their spot is no reflector's; the one that is left may be either."""
    rng, sensor = np.random.default_rng(7), ReflectorSensor(paper_camera, [three])
    pose = pose_of(SixNumbers(3.5, 0.03, -0.02, 0.2, 0.15, -0.1), three)
    place, statuses = PAPER.project(pose.apply(three.positions_m))[1], []
    for k in range(16):
        covered = (1,) if k >= 6 else ()
        at = place + (k - 4.0) * np.array([0.6, -0.4]) + (1.0, 1.0)
        false = np.array([[*at, 1.55, 180.0]])
        frames = frames_of(PAPER, three, pose, rng, hidden=covered, false=false)
        statuses.append(sensor.update(0.2 * k, frames).status)
    assert statuses[5] is not Status.OK
    assert Status.UNCONFIRMED in statuses[6:]  # it passes for the target
    assert Status.OK not in statuses[6:]


def test_a_known_target_is_not_found_with_other_dots(three, paper_camera):
    """Of a covered reflector and a glint, dots of another size would make a pose."""
    rng, larger = np.random.default_rng(8), replace(three, diameters_m=1.35 * three.diameters_m)
    pose = pose_of(SixNumbers(2.0, 0.03, -0.02, 0.2, 0.15, -0.1), three)
    for known in (False, True):
        sensor = ReflectorSensor(paper_camera, [three])
        for k in range(2 if known else 0):
            reading = sensor.update(0.2 * k, frames_of(PAPER, three, pose, rng))
            assert k == 0 or reading.status is Status.OK
        for k in range(2, 10):
            sensor.update(0.2 * k, frames_of(PAPER, larger, pose, rng))
        assert (sensor.patterns[0] is three) == known


def pattern_of(places, diameters):
    count = len(places)
    return ReflectorPattern(
        "p", tuple(f"dot{k}" for k in range(count)), np.array(places),
        np.tile([0.0, 0.0, 1.0], (count, 1)), np.array(diameters),
    )  # fmt: skip


FOUR = pattern_of(
    [[-0.1, 0.0, 0.0], [0.0, 0.02, 0.06], [0.1, 0.0, 0.0], [0.05, 0.08, 0.0]], [0.02] * 4
)


@pytest.mark.parametrize("flipped", [False, True])
def test_a_mirrored_picture_of_four_dots_has_no_pose_and_says_why(paper_camera, flipped):
    rng = np.random.default_rng(4)
    for _ in range(3):
        sensor = ReflectorSensor(paper_camera, [FOUR])
        pose = Pose(*look_at(rng, PAPER, 1.5, 0.4, 130.0))
        for k in range(2):
            frames = frames_of(PAPER, FOUR, pose, rng)
            if flipped:
                frames = LitDark(frames.lit[:, ::-1].copy(), frames.dark[:, ::-1].copy())
            reading = sensor.update(0.1 * k, frames)
        assert (reading.status is Status.OK) != flipped
        assert ("looks mirrored" in (reading.reason or "")) == flipped


def test_a_mirrored_picture_of_a_flat_card_with_unlike_dots_says_why(paper_camera):
    rng = np.random.default_rng(5)
    card = pattern_of([[-0.09, 0, 0], [0.02, 0.06, 0], [0.09, 0, 0]], [0.016, 0.016, 0.024])
    pose = pose_of(SixNumbers(1.2, 0.0, 0.0, 0.2, 0.3, -0.2), card)
    frames = frames_of(PAPER, card, pose, rng)
    sensor = ReflectorSensor(paper_camera, [card])
    reading = sensor.update(0.0, LitDark(frames.lit[:, ::-1].copy(), frames.dark[:, ::-1].copy()))
    assert reading.pose is None
    assert "looks mirrored" in reading.reason


def test_mirrored_spots_of_unnamed_lights_say_why(scole):
    leds = np.array([led.position_m for led in scole.leds])
    normals = np.array([led.normal for led in scole.leds])
    rig = Rig((RigCamera.from_camera("c", Camera(1024, 768, 900.0, 900.0, 511.5, 383.5),
                                     Pose.identity()),))  # fmt: skip
    eye, rng = Pinhole(1024, 768, 900.0, 511.5, 383.5), np.random.default_rng(6)
    for flipped in (False, True):
        rotation, place = look_at(rng, eye, 4.5, 0.5, 330.0)
        turned = leds @ (rotation @ np.diag([1.0, -1.0, -1.0])).T  # they look along -z
        places = eye.project(turned + place) + rng.normal(0.0, 0.05, (6, 2))
        if flipped:
            places[:, 0] = 1023.0 - places[:, 0]
        spots = Spots(places, np.full((6, 2), 0.05), np.full(6, -1), np.ones(6))
        reading = StereoTracker(rig, leds, normals).update(0.0, [spots])
        assert (reading.status is Status.OK) != flipped
        assert ("looks mirrored" in (reading.reason or "")) == flipped
