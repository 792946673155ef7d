"""Noise that pixels do not show, and a background that moves between lit and dark."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from tests import plain_pictures as plain

from rendezview.sensors.beacons import LitDark, find_spots
from rendezview.sensors.beacons.detect.background import Background
from rendezview.sensors.beacons.detect.difference import ThresholdOptions, registered
from rendezview.sensors.beacons.detect.hidden_noise import HiddenNoise, quantisation_step
from rendezview.sensors.beacons.detect.registration import background_motion, register
from rendezview.sensors.beacons.detect.spot_columns import COLUMNS

CAMERA = plain.Pinhole()
LOOK = plain.Look()


def pair(shift, grey, seed=2):
    """Lit and dark before a wall that lies ``shift`` px further in the dark one, six lights."""
    rng = np.random.default_rng(seed)
    wall = plain.texture(CAMERA, rng, 3.0, grey) if grey else np.zeros((384, 512))
    affine = np.float32([[1, 0, shift[0]], [0, 1, shift[1]]])
    moved = cv2.warpAffine(
        wall, affine, (512, 384), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT
    )
    places = rng.uniform((20, 20), (480, 360), (6, 2))
    lights = plain.lights(CAMERA, np.column_stack([places, np.full(6, 5.0), np.full(6, 150.0)]))
    return LitDark(*plain.pair(CAMERA, lights, LOOK, rng, background=(wall, moved)))


def jpeg(picture, quality):
    _, coded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.3, 0.0), (0.6, -0.4), (6.0, -9.0)])
def test_the_motion_of_a_background_is_found_and_taken_out(shift):
    frames = pair(shift, 60.0)
    motion = background_motion(frames)
    assert motion == pytest.approx(np.negative(shift), abs=0.1)
    still = register(frames)
    off = still.lit[20:-20, 20:-20].astype(int) - still.dark[20:-20, 20:-20]
    assert 1.4826 * np.median(np.abs(off - np.median(off))) < 3.5


@pytest.mark.parametrize("shift", [0.3, 0.5])
def test_a_picture_that_is_moved_keeps_its_noise_white(shift):
    """The noise of a mean of 16 pixels is that of one over four: neighbours tell the whole."""
    rng = np.random.default_rng(4)
    noise = np.clip(np.rint(rng.normal(60.0, 3.0, (384, 512))), 0, 255).astype(np.uint8)
    moved = registered(noise, np.array([[1.0, 0.0, shift], [0.0, 1.0, 0.0]]))[8:-8, 8:-8]
    means = moved.reshape(92, 4, 124, 4).mean(axis=(1, 3))
    steps = np.diff(moved.astype(float), axis=1).std() / np.sqrt(2.0)
    assert 4.0 * means.std() == pytest.approx(3.0, rel=0.05)
    assert steps == pytest.approx(3.0, rel=0.2)  # linear interpolation gives 1.8 and 1.5


def test_a_background_without_texture_is_left_alone():
    frames = pair((0.0, 0.0), 0.0)
    assert background_motion(frames) is None
    assert register(frames) is frames
    assert background_motion(LitDark(frames.lit)) is None


@pytest.mark.parametrize("shift", [(0.3, 0.0), (1.0, -0.5)])
def test_the_dark_picture_is_moved_where_that_leaves_less_and_only_there(shift):
    background, frames = Background(), pair(shift, 60.0)
    spots = background.spots(0.0, frames, ThresholdOptions())
    assert background.moves
    table = spots.table
    left = HiddenNoise.of(frames, table).of_cells
    assert background.hidden.of_cells.max() < 0.25 * left.max()
    kept = background.followed(frames, table, 0.5)
    np.testing.assert_array_equal(kept.dark, register(frames).dark)
    still = pair((0.0, 0.0), 60.0)
    assert background.followed(still, table, 1.5) is still  # measured again after a second
    assert not background.moves


def test_jpeg_is_known_by_its_steps_and_raw_pictures_have_none():
    for grey in (0.0, 60.0):
        raw = pair((0.0, 0.0), grey).lit
        assert quantisation_step(raw) == 0.0
        assert quantisation_step(jpeg(raw, 75)) == pytest.approx(6.0, abs=0.7)
    assert quantisation_step(jpeg(pair((0.0, 0.0), 60.0).lit, 50)) > 10.0
    assert quantisation_step(np.zeros((5, 5), np.uint8)) == 0.0


@pytest.mark.parametrize("quality", [30, 40, 50, 60])
def test_a_dark_jpeg_of_few_lights_is_known_by_its_even_blocks(quality):
    """Nothing but three spots has coefficients: too few for a common divisor."""
    rng = np.random.default_rng(4)
    spots = np.column_stack([rng.uniform(40.0, 340.0, (3, 2)), np.full(3, 1.2), np.full(3, 170.0)])
    light = plain.lights(plain.Pinhole(), spots)
    lit, dark = (jpeg(p, quality) for p in plain.pair(plain.Pinhole(), light, plain.Look(), rng))
    step = 11.0 * (2.0 - 0.02 * quality if quality >= 50 else 50.0 / quality)
    assert 0.9 * step < quantisation_step(lit) < 3.0 * step
    assert quantisation_step(dark) < 2.0 * step
    for noise in (0.3, 2.0):  # not coded
        raw, _ = plain.pair(plain.Pinhole(), light, plain.Look(noise=noise), rng)
        assert quantisation_step(raw) == 0.0


def test_texture_that_moved_counts_in_wide_spots_most():
    white, moved = HiddenNoise.of(pair((0.0, 0.0), 60.0)), HiddenNoise.of(pair((0.3, 0.0), 60.0))
    assert white.of_cells.max() < 2.0
    assert white.of_compression == 0.0
    # Centroids have errors as of white noise of 2.8, 6.0, 6.8 and 6.8 grey levels: measured. Behind
    # the smallest spots most of the pattern is a plane, which the ring around them tells.
    claimed = np.sqrt(8.0 + moved.of_cells)
    assert claimed == pytest.approx([4.1, 7.0, 6.8, 6.8], abs=0.5)
    table = np.zeros((2, COLUMNS))
    table[:, 3], table[:, 5], table[:, 7] = 176.0, (1.2, 4.0), 0.01
    moved.widen(table)
    assert 0.01 < table[0, 7] < table[1, 7]


def test_false_lights_are_no_texture_and_hide_none():
    rng = np.random.default_rng(5)
    places = rng.uniform(0.0, (512.0, 384.0), (40, 2))
    false = np.column_stack([places, rng.uniform(0.6, 6.0, 40), rng.uniform(20.0, 240.0, 40)])
    for shift in (0.0, 0.3):
        still = pair((shift, 0.0), 60.0)
        light = np.rint(plain.lights(CAMERA, false))
        lit = np.minimum(still.lit + light, 255.0).astype(np.uint8)
        frames = LitDark(lit, still.dark)
        found = HiddenNoise.of(frames, find_spots(frames).table).of_cells
        assert found == pytest.approx(HiddenNoise.of(still).of_cells, rel=0.3, abs=2.5)
        assert HiddenNoise.of(frames).of_cells[2] > found[2] + 3.0


@pytest.mark.parametrize("grain_px", [1.5, 3.0, 6.0])
@pytest.mark.parametrize("sigma", [1.1, 2.0, 4.0])
def test_texture_behind_a_light_counts_at_the_lights_own_scale(sigma, grain_px):
    """Lights in single pictures before walls of any grain are where they are claimed to be."""
    rng, off = np.random.default_rng(21), []
    for _ in range(12):
        wall = plain.texture(CAMERA, rng, grain_px, 60.0)
        places = np.column_stack([np.linspace(60, 450, 6), rng.uniform(60, 320, 6)])
        places += rng.uniform(-0.5, 0.5, places.shape)
        lights = plain.lights(CAMERA, np.column_stack([places, np.tile([sigma, 150.0], (6, 1))]))
        picture = plain.eight_bits(lights + wall, LOOK, rng)
        frames = LitDark(picture)
        spots = find_spots(frames)
        HiddenNoise.of(frames).widen(spots.table)
        for place in places:
            away = np.linalg.norm(spots.centroids_px - place, axis=1)
            k = int(np.argmin(away))
            if away[k] < 3.0:
                off.append((spots.centroids_px[k] - place) / spots.sigma_px[k])
    assert len(off) > 50
    assert 0.6 < np.sqrt(np.mean(np.square(off))) < 1.4


def test_a_light_that_overlaps_a_disc_counts_in_its_error():
    """Discs of 10 px radius with a light at their rim: where they are claimed to be is right."""
    rng, look, camera = (
        np.random.default_rng(11),
        plain.Look(),
        plain.Pinhole(120, 120, 650.0, 59.5, 59.5),
    )
    off, claimed = [], []
    for _ in range(60):
        centre = np.append(rng.uniform(-0.5, 0.5, 2) / 650.0, 1.0) * 0.8
        light = plain.discs(
            camera, np.diag([1.0, -1.0, -1.0]), centre, np.zeros((1, 3)), np.array([[0.0, 0, 1]]),
            np.array([0.025]), look,
        )  # fmt: skip
        way, far = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(6.0, 16.0)
        beside = 59.5 + far * np.array([np.cos(way), np.sin(way)])
        false = np.array([[*beside, rng.uniform(1.0, 6.0), rng.uniform(20.0, 240.0)]])
        spots = find_spots(LitDark(*plain.pair(camera, light, look, rng, false=false)))
        place = camera.project(centre[None])[0]
        k = int(np.argmin(np.linalg.norm(spots.centroids_px - place, axis=1)))
        off.append(spots.centroids_px[k] - place)
        claimed.append(spots.sigma_px[k])
    ratios = np.abs(off) / np.array(claimed)[:, None]
    assert np.median(np.abs(off)) > 0.1  # ten times what noise does
    assert np.sqrt(np.mean(ratios**2)) < 1.2
    assert ratios.max() < 5.0
