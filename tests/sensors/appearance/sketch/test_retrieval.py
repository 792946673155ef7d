"""Starting poses from the views of a model: the likeliest that are some angle apart."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from rendezview.geometry.so3 import exp
from rendezview.sensors.appearance.search.by_sketch import _distinct


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
