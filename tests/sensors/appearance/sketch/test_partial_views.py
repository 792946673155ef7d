"""Views beside sketches that show a part of the target, or more than it."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from rendezview.geometry.so3 import exp
from rendezview.sensors.appearance import Recognizer
from rendezview.sensors.appearance.edges.network import Sketch
from rendezview.sensors.appearance.model.sketches import COVER, EDGE, GRID, MAPS, REACH, on_grid
from rendezview.sensors.appearance.search.by_sketch import towards
from rendezview.sensors.appearance.search.partial_views import (
    COARSE,
    WEIGHTS,
    PartialViews,
    coarse_grids,
    extents,
)

SIDE = 256


def test_what_lies_beyond_the_frame_is_nothing_in_the_grids_of_a_cut_target() -> None:
    maps = np.ones((MAPS, 90, 120), np.float32)
    middle, size = np.array([119.0, 44.5]), 69.15  # half of its grid lies right of the frame
    upright, turned = coarse_grids(maps, [(middle, size)], [np.array([0.0, np.pi])], COARSE)
    cells = upright.shape[-1]
    assert upright.shape == (MAPS + 1, cells, cells)
    cell_px = 2.0 * REACH * size / cells
    along = middle[0] + cell_px * (np.arange(cells) - 0.5 * (cells - 1))
    # The share of each cell that lies left of the last pixel's border.
    share = np.clip((119.5 - (along - 0.5 * cell_px)) / cell_px, 0.0, 1.0)
    inside = slice(cells // 2 - 3, cells // 2 + 3)  # rows that the frame's height contains
    assert upright[-1, inside] == pytest.approx(np.tile(share, (6, 1)), abs=0.02)
    assert np.array_equal(upright[:-1], np.repeat(upright[-1:], MAPS, 0))
    assert turned == pytest.approx(upright[:, ::-1, ::-1], abs=1e-4)


def test_a_target_cut_by_the_frame_is_compared_with_what_the_frame_shows():
    rng = np.random.default_rng(8)
    maps = cv2.GaussianBlur(rng.random((GRID, GRID, 30 * MAPS)).astype(np.float32), (0, 0), 3.0)
    maps = np.ascontiguousarray(maps.reshape(GRID, GRID, 30, MAPS).transpose(2, 3, 0, 1))
    within = np.zeros((1, GRID, GRID), np.float32)
    within[:, :, : GRID // 2 + 4] = 1.0
    seen = maps[17:18] * within[:, None]
    halves = (part.reshape(*part.shape[:-2], GRID // 2, 2, GRID // 2, 2).mean((-3, -1))
              for part in (seen, within))  # fmt: skip
    alike = PartialViews(maps, WEIGHTS, alone=False).alike(*halves)
    assert alike.shape == (1, 30)
    assert int(np.argmax(alike)) == 17


def test_a_view_alone_is_compared_where_it_lies_whatever_stands_beside_it():
    rng = np.random.default_rng(9)
    maps = np.zeros((20, MAPS, GRID, GRID), np.float32)
    for view in maps:  # covers of several shapes, with an edge each
        x, y = rng.integers(6, 14, 2)
        view[COVER, y : GRID - y, x : GRID - x] = 1.0
        view[EDGE] = rng.random((GRID, GRID)) * view[COVER]
    joined = maps[13:14].copy()
    outside = cv2.dilate(joined[0, COVER], np.ones((7, 7))) == 0.0
    joined[0, :, outside] = 1.0  # another body all around
    halves = joined.reshape(1, MAPS, GRID // 2, 2, GRID // 2, 2).mean((-3, -1))
    within = np.ones((1, GRID // 2, GRID // 2), np.float32)
    alone = PartialViews(maps, WEIGHTS, alone=True).alike(halves, within)
    assert int(np.argmax(alone)) == 13
    assert alone[0, 13] == pytest.approx(sum(WEIGHTS.values()) - WEIGHTS[2], abs=0.05)


def test_extents_are_those_of_turned_covers():
    maps = np.zeros((1, MAPS, GRID, GRID), np.float32)
    maps[0, COVER, 18:31, 10:24] = 1.0
    maps[0, COVER, 30:33, 23:25] = 1.0
    times, cell = 20, 2.0 * REACH / GRID
    side = GRID * times
    large = cv2.resize(maps[0, COVER], (side, side), interpolation=cv2.INTER_NEAREST)
    found = extents(maps, 8)
    for k, turn in enumerate(2.0 * np.pi * np.arange(8) / 8):
        # The picture is the grid's content turned from right to down.
        warp = cv2.getRotationMatrix2D((0.5 * side - 0.5,) * 2, -np.rad2deg(turn), 1.0)
        rows, columns = np.nonzero(cv2.warpAffine(large, warp, (side, side)) > 0.5)
        middle = 0.5 * side - 0.5
        box = [columns.min(), rows.min(), columns.max(), rows.max()]
        assert found[k, 0] == pytest.approx((np.array(box) - middle) / times * cell, abs=cell)


@pytest.mark.parametrize("seed", range(4))
def test_a_target_on_a_plate_is_found_in_its_box(seed, refining_model, camera):
    """The plate is one body with the target, and its outline is sharper."""
    rng = np.random.default_rng([12, seed])
    recognizer = Recognizer(refining_model, camera)
    retrieval, views = recognizer.sketch.retrieval, refining_model.sketches
    view, turn = int(rng.integers(len(views.size_radii))), float(rng.uniform(0.0, 2.0 * np.pi))
    size, place = 60.0, np.array([130.0, 120.0])
    cell = 2.0 * REACH * size / GRID
    # What the grid of that size and turn reads there: the view.
    c, s = np.cos(turn), np.sin(turn)
    linear = cell * np.array([[c, -s], [s, c]])
    warp = np.column_stack([linear, place - linear @ np.full(2, 0.5 * (GRID - 1))])
    planes = [cv2.warpAffine(p, warp, (SIDE, SIDE)) for p in views.decoded(view)]
    maps = np.stack(planes).astype(np.float32)
    assert on_grid(maps, place, size, turn)[COVER] == pytest.approx(planes_of(views, view), abs=0.2)
    rows, columns = np.nonzero(maps[COVER] > 0.5)
    box = np.array([columns.min(), rows.min(), columns.max(), rows.max()], float)
    maps[EDGE] *= 0.5
    corners = np.array([[20, 60], [235, 35], [250, 200], [40, 225]])
    plate = np.zeros((SIDE, SIDE), np.float32)
    maps[COVER] = np.maximum(maps[COVER], cv2.fillConvexPoly(plate.copy(), corners, 1.0))
    maps[EDGE] = np.maximum(maps[EDGE], cv2.polylines(plate, [corners], True, 1.0, 2))
    sketch = Sketch(maps, np.zeros((SIDE, SIDE), np.uint8), 1.0, 0.0, 0.0, np.zeros((2, 2), bool),
                    1.0)  # fmt: skip
    sides = box[2:] - box[:2]
    known = box + np.tile(rng.uniform(-0.1, 0.1, 2) * sides, 2)
    rotations, centres = retrieval.starts_in(sketch, tuple(known.tolist()), 40)
    ray = np.asarray(camera.rays(place[None])[0])
    turned = exp(np.array([0.0, 0.0, turn])) @ views.rotation[view]
    truth = towards(ray / np.linalg.norm(ray)) @ turned
    cosines = 0.5 * (np.einsum("kij,ij->k", rotations, truth) - 1.0)
    nearest = int(np.argmax(cosines))
    assert np.rad2deg(np.arccos(cosines[nearest])) < 12.0
    focal = float(np.sqrt(camera.fx * camera.fy))
    range_m = focal * refining_model.target_radius_m * views.size_radii[view] / size
    assert np.linalg.norm(centres[nearest]) == pytest.approx(range_m, rel=0.25)


def planes_of(views, view: int) -> np.ndarray:
    """(GRID, GRID) the cover of a view."""
    return views.decoded(view)[COVER]
