"""Which stored views a pose is refined on."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rendezview.geometry.geodesic import Geodesic
from rendezview.sensors.appearance.edges.alignment import nearest_views

_DIRECTIONS = np.ascontiguousarray(Geodesic.of_order(3).nodes)
_SHELLS_M = np.array([10.0, 15.0, 30.0])


@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize(("range_m", "shell"), [(8.0, 0), (11.9, 0), (12.1, 1), (500.0, 2)])
def test_the_nearest_views_come_first_and_the_shell_by_the_inverse_of_the_range(
    count, range_m, shell
):
    rng = np.random.default_rng(4)
    for rotation in Rotation.random(20, random_state=rng).as_matrix():
        line = np.array([*rng.uniform(-0.3, 0.3, 2), 1.0])  # well off the boresight
        centre = range_m * line / np.linalg.norm(line)
        views = np.zeros(count, dtype=np.int64)
        found = nearest_views(_DIRECTIONS, _SHELLS_M, np.ascontiguousarray(rotation), centre, views)
        camera_seen_from_target = -rotation.T @ centre
        expected = np.argsort(-(_DIRECTIONS @ camera_seen_from_target))[:count]
        assert found == shell
        assert views.tolist() == expected.tolist()
