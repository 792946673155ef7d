"""The sketch network on drawn frames, and the places of a sketch in the frame."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from rendezview.geometry.pose import Pose
from rendezview.sensors.appearance.edges.network import (
    SIDE_PX,
    Sketch,
    Sketcher,
    from_squares,
    to_squares,
)
from rendezview.sensors.appearance.model.sketches import COVER, EDGE, MAPS


@pytest.fixture(scope="module")
def sketcher() -> Sketcher:
    return Sketcher()


def disc(height: int, width: int, x: float, y: float, radius: float) -> np.ndarray:
    v, u = np.mgrid[0:height, 0:width]
    return np.clip(radius + 0.5 - np.hypot(u - x, v - y), 0.0, 1.0)


def test_squares_there_and_back_are_the_same_pixels():
    planes = np.random.default_rng(0).random((3, 16, 24)).astype(np.float32)
    squares = to_squares(planes)
    assert squares.shape == (48, 4, 6)
    assert squares[1, 0, 0] == planes[0, 0, 1]  # row by row within the square
    assert squares[4, 0, 0] == planes[0, 1, 0]
    assert np.array_equal(from_squares(squares), planes)


@pytest.mark.parametrize("left", [200.0, -100.0])
def test_a_closer_look_is_as_fine_where_the_frame_cuts_it(sketcher, left):
    frame = np.full((400, 600), 20, np.uint8)
    box = (left, 100.0, left + 150.0, 250.0)
    first, closer = sketcher.near(frame, box), sketcher.near(frame, box, 2)
    assert (first.fineness, closer.fineness) == (1.0, 2.0)
    assert closer.scale == pytest.approx(2.0 * first.scale, rel=0.02)


def test_a_closer_look_draws_little_more_than_the_box(sketcher):
    frame = np.full((400, 600), 20, np.uint8)
    closer = sketcher.near(frame, (200.0, 150.0, 350.0, 200.0), 2)
    left, top = -closer.left_px / closer.scale, -closer.top_px / closer.scale
    height, width = closer.maps.shape[1:]
    assert (left, top) == pytest.approx((185.0, 135.0), abs=1.0)  # a tenth of the longer side
    drawn = width / closer.scale, height / closer.scale
    assert drawn == pytest.approx((180.0, 80.0), abs=2.0)


@pytest.mark.parametrize("turned", [False, True])
def test_a_sketch_keeps_the_picture_of_its_part_upright(sketcher, turned):
    frame = np.random.default_rng(3).integers(0, 255, (256, 256), np.uint8)
    sketch = sketcher.look(frame, (-0.5, -0.5, 255.5, 255.5), turned=turned)
    assert np.array_equal(sketch.grey, frame)


@pytest.mark.parametrize("times", [1, 3])
def test_the_odds_of_the_target_lie_where_the_frame_shows_it(times):
    maps = np.zeros((MAPS, 40, 60), np.float32)
    maps[COVER, 10:30, 12:48] = 1.0
    no_side = np.zeros((2, 2), bool)
    sketch = Sketch(maps, np.zeros((40, 60), np.uint8), 0.25, -20.0, -15.0, no_side, 1.0)
    odds = sketch.odds((300, 480), times)
    assert odds.shape == (300 // times, 480 // times)
    assert odds.min() < -10.0
    rows, columns = np.flatnonzero((odds > 0).any(1)), np.flatnonzero((odds > 0).any(0))
    sides = columns[0], rows[0], columns[-1] + 1, rows[-1] + 1
    found = [times * side - 0.5 for side in sides]
    left, top, right, bottom = sketch.box_in_frame((12, 10, 48, 30))
    assert found == pytest.approx([left, top, right, bottom], abs=times)


@pytest.mark.parametrize(("x", "y", "radius"), [(300.0, 200.0, 60.0), (900.0, 500.0, 150.0)])
def test_the_cover_lies_where_the_frame_shows_the_body(sketcher, x, y, radius):
    """Half a pixel of shift or scale would show: the border of the disc is known exactly."""
    rng = np.random.default_rng(3)
    grey = 20.0 + 150.0 * disc(800, 1200, x, y, radius) + rng.normal(0.0, 3.0, (800, 1200))
    sketch = sketcher.find(np.clip(grey, 0, 255).astype(np.uint8))
    assert sketch is not None
    assert not sketch.is_cut
    assert sketch.maps.shape[0] == MAPS
    rows, columns = np.mgrid[0 : sketch.maps.shape[1], 0 : sketch.maps.shape[2]]
    u = (columns - sketch.left_px) / sketch.scale
    v = (rows - sketch.top_px) / sketch.scale
    cover = sketch.maps[COVER]
    weight = cover / cover.sum()
    assert (u * weight).sum() == pytest.approx(x, abs=0.02 * radius)
    assert (v * weight).sum() == pytest.approx(y, abs=0.02 * radius)
    assert np.sqrt(cover.sum() / np.pi) / sketch.scale == pytest.approx(radius, rel=0.03)
    ring = sketch.maps[EDGE] * (sketch.maps[EDGE] > 0.3)
    assert (np.hypot(u - x, v - y) * ring).sum() / ring.sum() == pytest.approx(radius, rel=0.03)


def test_a_body_that_leaves_the_frame_is_said_to_be_cut(sketcher):
    grey = 20.0 + 180.0 * disc(480, 640, 40.0, 240.0, 90.0)
    sketch = sketcher.find(grey.astype(np.uint8))
    assert sketch is not None
    assert sketch.rest.tolist() == [-1.0, 0.0]
    assert not sketch.overflows


def test_a_body_that_is_larger_than_the_frame_overflows_it(sketcher):
    grey = 20.0 + 180.0 * disc(300, 640, 320.0, 150.0, 200.0)
    sketch = sketcher.look(grey.astype(np.uint8), (-0.5, -0.5, 639.5, 299.5))
    assert sketch.crossed.tolist() == [[False, False], [True, True]]
    assert sketch.overflows


def test_a_sketch_is_no_larger_than_asked_and_as_sharp_as_the_frame(sketcher):
    frame = np.zeros((300, 400), np.uint8)
    sketch = sketcher.look(frame, (-0.5, -0.5, 399.5, 299.5))
    assert sketch.maps.shape == (MAPS, 192, SIDE_PX)
    outside = sketcher.near(frame, (500.0, 20.0, 600.0, 90.0))
    assert outside is None


def test_a_turned_look_is_the_upright_one_of_the_turned_frame(sketcher, bumpy_mesh, camera, draw):
    frame = draw(bumpy_mesh, Pose(np.eye(3), [0.3, -0.2, 6.0]), camera)[:256, :320]
    box = (-0.5, -0.5, 319.5, 255.5)
    turned = sketcher.look(frame, box, turned=True)
    upright = sketcher.look(np.ascontiguousarray(frame[::-1, ::-1]), box)
    assert np.array_equal(turned.maps, upright.maps[:, ::-1, ::-1])
    straight = sketcher.look(frame, box)
    assert np.array_equal(turned.place, straight.place)
    assert not np.array_equal(turned.maps, straight.maps)
    both = (turned.maps[COVER] > 0.5) & (straight.maps[COVER] > 0.5)
    either = (turned.maps[COVER] > 0.5) | (straight.maps[COVER] > 0.5)
    assert both.sum() > 0.8 * either.sum()


@pytest.mark.parametrize("size", [(1, 1), (3, 700), (33, 31)])
def test_frames_of_any_size_are_sketched_or_show_nothing(sketcher, size):
    assert sketcher.find(np.zeros(size, np.uint8)) is None


def test_threads_share_one_network(sketcher, bumpy_mesh, camera, draw):
    frame = draw(bumpy_mesh, Pose(np.eye(3), [0.0, 0.0, 6.0]), camera)
    alone = sketcher.find(frame)
    found: list = []
    threads = [threading.Thread(target=lambda: found.append(sketcher.find(frame))) for _ in "ab"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert alone is not None
    assert [f.maps.tobytes() == alone.maps.tobytes() for f in found] == [True, True]
