"""Spots that run together: cut apart at the valley, and fitted at once."""

from __future__ import annotations

import numpy as np
import pytest
from tests import plain_pictures as plain
from tests.plain_readings import CAMERA, HALF_TURN, PINHOLE, frames_of, squared_error

from rendezview.geometry.pose import Pose
from rendezview.sensors.beacons import LitDark, ReflectorSensor, TrackingOptions, find_spots
from rendezview.sensors.beacons.detect import blended
from rendezview.sensors.beacons.detect.difference import (
    Centroid,
    Opening,
    ThresholdOptions,
    cut_valleys,
    noise_grey,
    spot_mask,
    threshold_of,
)


def reading(pattern, range_m, rng):
    pose = Pose(*plain.look_at(rng, PINHOLE, range_m, 0.5, 30.0))
    return frames_of(PINHOLE, pattern, pose, rng), pose


def lights(places, rng, size=0.8, peak=180.0):
    small = plain.Pinhole(40, 40, 650.0, 19.5, 19.5)
    spots = np.column_stack([places, np.full((len(places), 2), (size, peak))])
    look = plain.Look()
    return LitDark(*plain.pair(small, plain.lights(small, spots), look, rng))


@pytest.mark.parametrize(("range_m", "least"), [(20.0, 20), (30.0, 19), (40.0, 18)])
def test_a_far_target_is_found_where_its_spots_run_together(three, five, range_m, least):
    """Before, 12 of 40 and none of 40 were found at 30 and 40 m."""
    for pattern, enough in ((three, least), (five, least - 5)):
        rng, right, nees = np.random.default_rng(4), 0, []
        for _ in range(20):
            frames, truth = reading(pattern, range_m, rng)
            sensor = ReflectorSensor(CAMERA, [pattern], tracking=TrackingOptions(confirm=False))
            found = sensor.update(0.0, frames)
            if found.pose is None:
                continue
            truths = truth, truth @ HALF_TURN
            nees.append(squared_error(found, *truths))
            right += min(map(found.pose.angle_to, truths)) < 0.15
        assert right >= enough
        assert right == len(nees)
        assert 3.0 < np.mean(nees) < 10.0


def test_errors_of_blended_spots_are_the_errors_made():
    """Two and three lights of σ 0.8 px, 2.5 to 4.5 px apart."""
    rng, off = np.random.default_rng(6), []
    for count in (2, 3) * 30:
        away = rng.uniform(2.5, 4.0) / 2.0 if count == 2 else rng.uniform(3.2, 4.5) / np.sqrt(3.0)
        ways = rng.uniform(0.0, 6.3) + 2.0 * np.pi * np.arange(count) / count
        places = rng.uniform(18.0, 21.0, 2) + away * np.column_stack([np.cos(ways), np.sin(ways)])
        spots = find_spots(lights(places, rng))
        assert len(spots) == count
        for place in places:
            k = int(np.argmin(np.linalg.norm(spots.centroids_px - place, axis=1)))
            off.append((spots.centroids_px[k] - place) / spots.sigma_px[k])
    assert 0.8 < np.sqrt(np.mean(np.square(off))) < 1.3


def test_a_streak_and_a_covered_disc_stay_one_spot(three):
    """What no Gaussians of two peaks explain is not cut in two."""
    rng = np.random.default_rng(7)
    for length in (1.5, 2.0, 3.0):
        steps = np.linspace(-0.5 * length, 0.5 * length, 41)
        small = plain.Pinhole(40, 40, 650.0, 19.5, 19.5)
        spots = np.array([[19.6 + step, 20.2, 0.8, 9.0] for step in steps])
        frames = LitDark(*plain.pair(small, plain.lights(small, spots), plain.Look(), rng))
        assert len(find_spots(frames)) == 1
    for _ in range(20):
        pose = Pose(*plain.look_at(rng, PINHOLE, 4.0, 0.5, 150.0))
        covers = {1: (rng.uniform(0.0, 6.3), rng.uniform(-0.3, 0.5))}
        assert len(find_spots(frames_of(PINHOLE, three, pose, rng, covers=covers))) == 3


def test_other_centroids_and_empty_pictures_part_nothing():
    """Regions have one binary and one weighted centroid; a picture without light has no spots."""
    rng = np.random.default_rng(9)
    frames = lights(np.array([[18.0, 20.0], [21.0, 20.5]]), rng)
    assert len(find_spots(frames)) == 2
    for centroid in (Centroid.BINARY, Centroid.WEIGHTED):
        assert len(find_spots(frames, centroid=centroid)) == 1
    dark = lights(np.zeros((0, 2)), rng)
    assert [len(find_spots(dark, faint=faint)) for faint in (False, True)] == [0, 0]


def test_lights_in_a_corner_are_parted_or_left():
    rng = np.random.default_rng(10)
    for corner in ((1.0, 1.0), (38.0, 1.5), (0.5, 38.5)):
        places = np.array(corner) + np.array([[0.0, 0.0], [2.0, 0.4], [0.3, 2.2], [2.1, 2.3]])
        spots = find_spots(lights(places, rng))
        assert np.isfinite(spots.table[:, [0, 1, 5, 7]]).all()


def test_slopes_of_the_light_are_its_differences():
    at = np.array([[5.2, 4.1, 4.0, -0.2], [8.0, 5.0, 4.2, 0.1]])
    box = (0, 14, 0, 10)
    slopes = blended._light(at, box)[1]
    for k in range(at.size):
        step = np.zeros(at.size)
        step[k] = 1e-6
        ahead, behind = (blended._light(at + way * step.reshape(-1, 4), box)[0] for way in (1, -1))
        assert np.allclose(slopes[k], (ahead - behind) / 2e-6, atol=1e-7 * np.abs(slopes).max())


def test_valleys_are_those_of_a_plain_search():
    """A pixel with brighter ones on both sides of it, on any line past its middle."""
    rng = np.random.default_rng(8)
    for _ in range(10):
        places = 20.0 + rng.uniform(-5.0, 5.0, (5, 2))
        frames = lights(places, rng)
        level = threshold_of(ThresholdOptions(), noise_grey(frames), frames)
        mask = spot_mask(frames, level, ThresholdOptions(opening=Opening.NONE))
        cut_valleys(mask, frames, level)
        grey = frames.lit.astype(int) - frames.dark
        plain_mask = grey > level
        around = [(dx, dy) for dx in range(-2, 3) for dy in range(-2, 3)]
        for y, x in np.argwhere(plain_mask):
            for ax, ay in around:
                for bx, by in around:
                    if ax * bx + ay * by >= 0:
                        continue
                    if abs(ax * by - ay * bx) >= 0.5 * np.hypot(ax - bx, ay - by):
                        continue
                    u, v = np.array([x + ax, x + bx]), np.array([y + ay, y + by])
                    if min(u.min(), v.min()) < 0 or max(u.max(), v.max()) > 39:
                        continue
                    least = grey[v, u].min()
                    if grey[y, x] < 0.735 * least and grey[y, x] < least - level:
                        plain_mask[y, x] = False
        assert np.array_equal(mask > 0, plain_mask)
