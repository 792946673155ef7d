"""Dots that differ from the target file, lit rooms, black dots, the printed card."""

from __future__ import annotations

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
from tests.plain_pictures import Look, eight_bits, look_at, pair
from tests.plain_readings import PAPER, frames_of, light_of

from rendezview.geometry.pose import Pose
from rendezview.io.target import Target
from rendezview.sensors.beacons import (
    LitDark,
    ReflectorSensor,
    SixNumbers,
    find_spots,
    patterns_of,
    pose_of,
)
from rendezview.sensors.beacons.card import Paper, dots_m, write_card
from rendezview.sensors.beacons.detect.difference import ThresholdOptions, background_of, faint_mask
from rendezview.sensors.beacons.match.acquisition_options import AcquisitionOptions
from rendezview.sensors.beacons.tolerance import fit_dots, scaled

SIX = SixNumbers(2.0, 0.02, -0.03, 0.3, 0.2, -0.15)


@pytest.mark.parametrize("factor", [0.8, 1.12, 1.25])
def test_dots_of_another_diameter_are_found_and_told(three, paper_camera, factor):
    rng, look, pose = np.random.default_rng(0), Look(), pose_of(SIX, three)
    sensor, reading = ReflectorSensor(paper_camera, [three]), None
    dots = replace(three, diameters_m=factor * three.diameters_m)
    for k in range(4):
        reading = sensor.update(0.1 * k, frames_of(PAPER, dots, pose, rng, look))
    assert reading.pose.angle_to(pose) < 0.01
    told = re.fullmatch(
        r"dots measure (\d+) % (larger|smaller) than target.toml says", reading.note
    )
    assert int(told[1]) == pytest.approx(100 * abs(factor - 1.0), abs=4)
    assert told[2] == ("larger" if factor > 1.0 else "smaller")
    assert reading.record()["note"] == reading.note


def test_dots_of_the_right_diameter_are_not_told(three, paper_camera):
    rng, pose = np.random.default_rng(5), pose_of(SIX, three)
    for look in (Look(), Look(blur=0.85), Look(even=True), Look(peak=400.0)):
        sensor = ReflectorSensor(paper_camera, [three])
        for k in range(4):
            reading = sensor.update(0.1 * k, frames_of(PAPER, three, pose, rng, look))
        assert reading.pose is not None
        assert reading.note is None


def test_another_blur_is_found(three, paper_camera):
    rng, look = np.random.default_rng(1), Look(blur=2.5)
    pose = pose_of(SixNumbers(4.0, 0.0, 0.0, 0.3, 0.1, 0.1), three)
    frames = frames_of(PAPER, three, pose, rng, look)
    fitted = fit_dots(paper_camera, [three], AcquisitionOptions(), find_spots(frames))
    assert fitted.options.blur_px == pytest.approx(2.5, rel=0.12)
    assert fitted.found.refined.camera_from_target.translation_m[2] == pytest.approx(4.0, rel=0.02)
    assert "blur" in fitted.note
    assert scaled([three], 2.0)[0].diameters_m[0] == 2.0 * three.diameters_m[0]


def test_black_dots_on_a_white_card_in_a_room_lit_from_one_side(three, paper_camera):
    rng, look, pose = np.random.default_rng(2), Look(even=True, black=0.0), pose_of(SIX, three)
    shade = light_of(PAPER, three, pose, look) / look.peak
    room = np.linspace(120.0, 230.0, PAPER.width)[None, :] * (1.0 - 0.85 * shade)
    sensor, readings = ReflectorSensor(paper_camera, [three]), []
    for k in range(4):
        frames = LitDark(eight_bits(room, look, rng)).inverted()
        readings.append(sensor.update(0.1 * k, frames))
    assert readings[-1].tracked
    assert readings[-1].pose.angle_to(pose) < 0.02


def test_black_dots_on_a_card_on_a_darker_desk_are_followed(three, paper_camera):
    """The windows reach over the card's edges; JPEG hides the noise of neighbouring pixels."""
    rng, look = np.random.default_rng(4), Look(even=True, black=0.0)
    sensor, readings = ReflectorSensor(paper_camera, [three]), []
    for k in range(8):
        pose = pose_of(SixNumbers(1.6 - 0.02 * k, 0.02, -0.03, 0.05, 0.2, -0.15), three)
        shade = light_of(PAPER, three, pose, look) / look.peak
        place = pose.apply(three.centre_m)
        middle = PAPER.cy + PAPER.focal_px * place[1] / place[2]
        rows = np.abs(np.arange(PAPER.height) - middle)[:, None]
        room = np.where(rows < 26.0, 220.0, np.linspace(90.0, 130.0, PAPER.width)[None, :])
        grey = eight_bits(room * (1.0 - 0.85 * shade), look, rng)
        _, coded = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, 90])
        frames = LitDark(cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE)).inverted()
        readings.append(sensor.update(0.1 * k, frames))
    assert all(reading.tracked for reading in readings[2:])
    assert readings[-1].pose.angle_to(pose) < 0.02


def test_the_background_follows_the_room_and_not_the_dots():
    room = np.tile(np.linspace(40.0, 160.0, 320), (240, 1)).astype(np.uint8)
    room[100:120, 150:170] = 250
    behind = background_of(room).astype(float)
    assert abs(behind[110, 160] - 100.0) < 15.0
    mask = faint_mask(LitDark(room), background_of(room), 1.0, ThresholdOptions(faint_factor=30.0))
    assert mask[110, 160] == 255
    assert mask[30, 160] == 0


def test_faint_stars_are_found_and_noise_is_not():
    rng = np.random.default_rng(3)
    places = rng.uniform(15, 240, (40, 2))
    rows, columns = np.mgrid[:256, :256]
    sky = 20.0 + rng.normal(0.0, 3.0, (256, 256))
    nothing = np.clip(np.rint(sky), 0, 255).astype(np.uint8)
    assert len(find_spots(LitDark(nothing))) <= 1
    for x, y in places:
        sky += 20.0 * np.exp(-0.5 * ((columns - x) ** 2 + (rows - y) ** 2) / 0.85**2)
    spots = find_spots(LitDark(np.clip(np.rint(sky), 0, 255).astype(np.uint8))).centroids_px
    apart = np.linalg.norm(places[:, None] - spots[None], axis=2).min(axis=1)
    assert (apart < 1.0).mean() > 0.85  # some stand together


@pytest.mark.parametrize("shown", [(1,), (2,), (1, 2)])
def test_two_cards_of_unlike_dots_are_told_apart(tmp_path, paper_camera, shown):
    """Each is found where it is, and never the other in its place."""
    cards = {}
    for code in (1, 2):
        (tmp_path / str(code)).mkdir()
        write_card(tmp_path / str(code), 0.016, code=code)
        (cards[code],) = patterns_of(Target.load(tmp_path / str(code)))
    rng = np.random.default_rng(12)
    for _ in range(4):
        look, light, truths = Look(even=True), None, {}
        for code in shown:
            truth = Pose(*look_at(rng, PAPER, rng.uniform(1.0, 1.3), 0.4, 90.0))
            aside = np.array([0.0, 0.16 * (2 * code - 3), truth.translation_m[2]])
            truths[code] = Pose(truth.rotation, aside)  # one above the other
            own = light_of(PAPER, cards[code], truths[code], look)
            light = own if light is None else light + own
        frames = LitDark(*pair(PAPER, light, look, rng))
        for code, card in cards.items():
            sensor = ReflectorSensor(paper_camera, [card])
            reading = [sensor.update(0.1 * k, frames) for k in range(2)][-1]
            assert (reading.pose is not None) == (code in truths), reading.reason
            if reading.pose is not None:
                assert reading.pose.angle_to(truths[code]) < 0.05


@pytest.mark.parametrize(("paper", "wide_mm"), [(Paper.A4, 297.0), (Paper.LETTER, 279.4)])
def test_the_card_is_a_target_without_a_mesh_and_its_page_has_the_dots(tmp_path, paper, wide_mm):
    write_card(tmp_path, 0.016, paper)
    target = Target.load(tmp_path)
    assert target.mesh is None
    (pattern,) = patterns_of(target)
    assert not pattern.symmetries()  # the larger dot tells which way up
    assert pattern.names == ("left", "post", "right")
    page = (tmp_path / "card.pdf").read_bytes()
    assert page.startswith(b"%PDF-1.4")
    for number, place in enumerate(re.findall(rb"(\d{10}) 00000 n", page), 1):
        assert page[int(place) :].startswith(f"{number} 0 obj".encode())
    starts = [float(x) for x in re.findall(rb"^([\d.]+) [\d.]+ m$", page, re.MULTILINE)]
    assert len(starts) == 3
    assert b"MediaBox [0 0 %.3f " % (wide_mm * 72.0 / 25.4) in page
    assert starts[1] - 8.0 == pytest.approx(0.5 * wide_mm)  # the post stands in the middle
    # Unfolded, the post is 35 mm of riser farther from each outer dot than folded.
    folded = [place[0] for _, place, _ in dots_m(0.016)]
    assert starts[1] - starts[0] == pytest.approx(1e3 * (folded[1] - folded[0]) + 35.0, abs=0.01)
