"""Self-calibration of a pattern: places, their σ, and the reflector that is off."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from tests import plain_pictures as plain
from tests.plain_readings import CAMERA, PINHOLE, frames_of

from rendezview.calibration.pattern import (
    KnownLength,
    Sighting,
    loosened,
    measure_pattern,
    sightings_of_readings,
)
from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Pose
from rendezview.sensors.beacons import ReflectorPattern, ReflectorSensor

HALF, POST, SIGMA_PX = 0.184, 0.1, 0.015
PLACES = np.array([[-HALF, 0, 0], [0, 0, POST], [HALF, 0, 0], [0, 0.14, 0], [0, -0.14, 0]])


def pattern_of(places, diameter_m=0.025, **more) -> ReflectorPattern:
    count = len(places)
    names = ("left", "post", "right", "top", "bottom")[:count]
    normals = np.tile([0.0, 0.0, 1.0], (count, 1))
    return ReflectorPattern("p", names, places, normals, np.full(count, diameter_m), **more)


FIVE, POINTS = pattern_of(PLACES), pattern_of(PLACES, 1e-6)


def poses(rng, count):
    """An approach from 4 to 1.5 m of a target that sways by 20°."""
    phase = rng.uniform(0.0, 6.3, 4)
    for t in np.arange(count) / count:
        sway = plain.turn([1, 0, 0], 0.35 * math.sin(6 * t + phase[0]))
        sway = sway @ plain.turn([0, 1, 0], 0.35 * math.sin(5 * t + phase[1]))
        way = np.array([0.1 * math.sin(4 * t + phase[2]), 0.08 * math.sin(5 * t + phase[3]), 1.0])
        yield Pose(sway @ np.diag([1.0, -1.0, -1.0]), (4.0 - 2.5 * t) * way)


def sighted(places, rng, count=40, sigma_px=SIGMA_PX):
    """Readings of points: a pinhole's projection and noise; poses are a little off."""
    found = []
    for pose in poses(rng, count):
        spots = PINHOLE.project(pose.apply(places)) + rng.normal(0.0, sigma_px, (len(places), 2))
        near = pose.perturbed(np.append(rng.normal(0.0, 0.003, 3), rng.normal(0.0, 0.003, 3)))
        which, sigma = np.arange(len(places)), np.full(len(places), SIGMA_PX)
        found.append(Sighting(near, which, spots, sigma))
    return found


def pictured(mounted, given, rng, count=24):
    """Readings of the plain simulator's pictures."""
    sensor, readings = ReflectorSensor(CAMERA, loosened([given])), []
    for k, pose in enumerate(poses(rng, count)):
        readings.append(sensor.update(0.5 * k, frames_of(PINHOLE, mounted, pose, rng)))
    return sightings_of_readings(readings, given)


def off_by(which, move_m):
    moved = PLACES.copy()
    moved[which] += move_m
    return moved


@pytest.mark.parametrize(("which", "move_m"), [(3, (2e-3, -1e-3, 2e-3)), (0, (0.0, 1e-3, 0.0))])
def test_the_reflector_that_is_off_is_named_and_its_place_found_in_pictures(which, move_m):
    rng = np.random.default_rng(1)
    mounted = replace(FIVE, positions_m=off_by(which, move_m))
    found = measure_pattern(CAMERA, [FIVE], pictured(mounted, FIVE, rng))
    assert found.named == (FIVE.names[which],)
    assert found.suspects == ()
    error = np.linalg.norm(found.pattern.positions_m - mounted.positions_m, axis=1)
    assert error[which] < 0.2e-3
    assert np.delete(error, which).max() < 0.05e-3
    assert (error < 3.0 * found.pattern.sigmas_m).all()
    assert found.pattern.sigmas_m.max() < 0.3e-3
    assert found.pattern.sigmas_known


def test_a_clean_pattern_has_no_name_and_keeps_its_places():
    found = measure_pattern(CAMERA, [FIVE], pictured(FIVE, FIVE, np.random.default_rng(2)))
    assert found.named == found.suspects == ()
    assert np.linalg.norm(found.moved_m, axis=1).max() < 0.06e-3
    assert found.off.max() < 0.01
    assert found.roll_ambiguous  # after half a turn it looks the same


def test_places_are_off_by_what_they_claim():
    """The file states a σ, and the places are drawn from it: 3 is right, by place and by file."""
    rng, stated = np.random.default_rng(3), np.full(5, 2e-4)
    given, nees, of_file = replace(POINTS, sigmas_m=stated, sigmas_known=True), [], []
    for _ in range(12):
        off = stated[:, None] * rng.normal(0.0, 1.0, (5, 3))
        found = measure_pattern(CAMERA, [given], sighted(PLACES + off, rng))
        assert found.named == ()
        for k, error in enumerate(found.moved_m - off):
            own = slice(3 * k, 3 * k + 3)
            nees.append(error @ np.linalg.solve(found.covariance[own, own], error))
            of_file.append(error @ error / found.pattern.sigmas_m[k] ** 2)
    assert 2.0 < np.mean(nees) < 4.2
    assert np.mean(of_file) < np.mean(nees)  # the file's single σ cover every direction


def test_what_a_run_shows_is_the_shape_and_not_the_place_of_the_whole():
    rng, stated = np.random.default_rng(4), np.full(5, 1e-3)
    given = replace(POINTS, sigmas_m=stated, sigmas_known=True)
    off = 1e-3 * rng.normal(0.0, 1.0, (5, 3))
    found = measure_pattern(CAMERA, [given], sighted(PLACES + off, rng, 60))
    along = np.tile(np.eye(3), 5) / 5.0  # mean place
    together = along @ found.covariance @ along.T
    np.testing.assert_allclose(np.sqrt(np.diag(together)), 1e-3 / math.sqrt(5.0), rtol=0.15)
    step = np.zeros((5, 3))
    step[0, 1], step[2, 1], step[3, 1], step[4, 1] = -0.5, -0.5, 0.5, 0.5  # bends the cross: shape
    bend = step.ravel()
    assert bend @ found.covariance @ bend < (0.2e-3) ** 2


def test_a_length_fixes_the_size_of_a_print():
    rng = np.random.default_rng(5)
    printed = 0.97 * PLACES
    length = KnownLength("left", "right", 0.97 * 2 * HALF, 2e-4)
    found = measure_pattern(CAMERA, [POINTS], sighted(printed, rng), lengths=[length])
    assert found.size == pytest.approx(0.97, abs=3.0 * found.size_sigma)
    assert found.size_sigma < 1.5e-3
    assert found.named == ()
    apart = np.linalg.norm(found.pattern.positions_m[3] - found.pattern.positions_m[4])
    assert apart == pytest.approx(0.97 * 0.28, abs=5e-4)
    without = measure_pattern(CAMERA, [POINTS], sighted(printed, rng))
    assert without.size == pytest.approx(1.0, abs=1e-3)  # no run of one camera shows the size


def test_three_reflectors_need_a_length():
    three = pattern_of(PLACES[:3])
    with pytest.raises(RendezviewError, match="three reflectors always fit"):
        measure_pattern(CAMERA, [three], [])
    found = measure_pattern(None, [three], [], lengths=[KnownLength("left", "right", 0.36, 1e-4)])
    assert found.size == pytest.approx(0.36 / (2 * HALF), abs=2e-3)
    for first, second, length_m in (("left", "left", 0.36), ("left", "x", 0.36), ("left", "right", 1.0)):  # fmt: skip # noqa: E501
        with pytest.raises(RendezviewError, match=r"a length is between|cannot be theirs"):
            measure_pattern(None, [three], [], lengths=[KnownLength(first, second, length_m, 1e-4)])


def test_a_focal_length_that_is_off_names_no_reflector():
    """The file of the camera states no σ: 1 % is among its errors."""
    camera = replace(CAMERA, fx=656.5, fy=656.5, cx=CAMERA.cx + 3.0)
    found = measure_pattern(camera, [POINTS], sighted(PLACES, np.random.default_rng(6)))
    assert found.named == ()
    assert np.linalg.norm(found.moved_m, axis=1).max() < 0.15e-3


def test_a_few_false_readings_are_left_out_and_no_pattern_is_refused():
    rng = np.random.default_rng(7)
    moved = off_by(4, (0.0, 0.0, 2e-3))
    sightings = sighted(moved, rng)
    for k in (5, 11, 30):
        sightings[k].spots_px[k % 5] += 1.5
    found = measure_pattern(CAMERA, [POINTS], sightings)
    assert found.named == ("bottom",)
    assert (found.used, found.given) == (37, 40)
    with pytest.raises(RendezviewError, match="do not fit one rigid pattern"):
        measure_pattern(CAMERA, [POINTS], sighted(PLACES, rng, sigma_px=0.3))


def test_a_run_at_rest_counts_once():
    """A spot's error depends on where in its pixel it is: repeated, it does not average."""
    rng = np.random.default_rng(8)
    (pose,) = poses(rng, 1)
    sensor, readings = ReflectorSensor(CAMERA, loosened([FIVE])), []
    for k in range(8):
        readings.append(sensor.update(0.5 * k, frames_of(PINHOLE, FIVE, pose, rng)))
    assert sum(reading.pose is not None for reading in readings) == 7
    assert len(sightings_of_readings(readings, FIVE)) == 1
