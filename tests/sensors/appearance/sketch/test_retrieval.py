"""Starting poses from the views of a model: the likeliest that are some angle apart."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rendezview.geometry.so3 import exp
from rendezview.sensors.appearance.model.sketches import MAPS, REACH
from rendezview.sensors.appearance.search.by_sketch import _distinct, _partly


def one_by_one(
    alike: np.ndarray, spins: np.ndarray, views: np.ndarray, most: int, apart_rad: float
) -> list[int]:
    """Takes the likeliest, then the next that is far enough from all taken."""
    kept: list[int] = []
    known: list[np.ndarray] = []
    for place in np.argsort(-alike, axis=None, kind="stable"):
        _, roll, view = np.unravel_index(place, alike.shape)
        turned = spins[roll] @ views[view]
        if not np.isfinite(alike.ravel()[place]) or len(kept) == most:
            break
        if all((Rotation.from_matrix(turned @ k.T)).magnitude() >= apart_rad for k in known):
            kept.append(int(place))
            known.append(turned)
    return kept


def test_distinct_starts_are_those_found_one_by_one() -> None:
    rng = np.random.default_rng(6)
    spins = np.array([exp(np.array([0.0, 0.0, turn])) for turn in np.linspace(0.0, 6.0, 20)])
    views = Rotation.random(60, random_state=6).as_matrix()
    alike = rng.standard_normal((2, 20, 60))
    alike[:, :, ::3] = -np.inf  # not allowed
    for most, apart_deg in ((15, 25.0), (400, 40.0), (3, 170.0)):
        apart_rad = np.deg2rad(apart_deg)
        found = _distinct(alike, spins, views, most, apart_rad)
        assert found == one_by_one(alike, spins, views, most, apart_rad)
        assert 1 < len(found) <= most


def test_no_start_is_given_where_none_is_allowed() -> None:
    alike = np.full((1, 2, 5), -np.inf)
    assert _distinct(alike, np.stack([np.eye(3)] * 2), np.stack([np.eye(3)] * 5), 4, 0.1) == []


def test_what_lies_beyond_the_frame_is_nothing_in_the_grids_of_a_cut_target() -> None:
    maps = np.ones((MAPS, 90, 120), np.float32)
    middle, size = np.array([119.0, 44.5]), 69.15  # half of its grid lies right of the frame
    upright, turned = _partly(maps, [(middle, size)], np.array([0.0, np.pi]))
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
