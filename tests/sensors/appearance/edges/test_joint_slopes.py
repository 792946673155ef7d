"""Slopes of edges with the angles of joints, beside numerical derivatives of the projection."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rendezview.sensors.appearance.edges.articulation import _joint_slopes
from rendezview.sensors.appearance.edges.predicted import (
    COLUMNS,
    FOUND,
    NOT_FOUND,
    OUTSIDE,
    RESIDUAL,
    STATE,
)
from rendezview.sensors.appearance.model.contours import POINT_UNIT

RADIUS_M, FOCAL_PX = 2.0, 500.0


def test_edges_of_moving_parts_have_the_slope_of_their_projection_with_the_angle():
    rng = np.random.default_rng(12)
    rotation, centre = Rotation.random(rng=rng).as_matrix(), np.array([0.3, -0.2, 9.0])
    point = rng.integers(-9000, 9000, size=(3, 20, 3), dtype=np.int16)
    part = rng.integers(0, 3, size=(3, 20), dtype=np.uint8)  # 0: fixed; hinges 1 and 2
    chosen, joint = np.array([2, 0]), np.array([1, 0])
    axes = np.array([[0.0, 0.6, 0.8], [1.0, 0.0, 0.0]])
    origins_m = rng.normal(size=(2, 3))
    places_m = point[chosen].reshape(-1, 3) * (POINT_UNIT * RADIUS_M)
    parts = part[chosen].ravel()
    edges = np.zeros((40, COLUMNS))
    edges[:, STATE] = rng.choice([FOUND, FOUND, NOT_FOUND, OUTSIDE], size=40)
    edges[:, RESIDUAL] = rng.uniform(-2.0, 2.0, size=40)
    normal = np.array([0.6, -0.8])

    def pixel(place_m):
        x, y, z = rotation @ place_m + centre
        return FOCAL_PX * normal @ [x / z, y / z]

    moved = np.zeros(40, dtype=bool)
    moved[5] = True  # another place than the table's: the angle does not move it
    for n, place_m in enumerate(places_m + 0.5 * moved[:, None]):
        x, y, z = rotation @ place_m + centre
        j = FOCAL_PX / z * np.array([*normal, -normal @ [x / z, y / z]])
        edges[n, :6] = [*np.cross(rotation @ place_m, j), *j]
    counted, slopes = np.empty(40, dtype=np.int64), np.empty((40, 8))
    support = np.empty(2)
    count = _joint_slopes(
        edges, 1.5, part, point, chosen, rotation, centre, joint, axes, origins_m, RADIUS_M,
        counted, slopes, support,
    )  # fmt: skip

    used = (edges[:, STATE] == FOUND) & (abs(edges[:, RESIDUAL]) < 1.5)
    assert counted[:count].tolist() == np.flatnonzero(used).tolist()
    expected = np.hstack([edges[used, :6], np.zeros((count, 2))])
    for row, n in enumerate(np.flatnonzero(used)):
        if parts[n] and not moved[n]:
            k = parts[n] - 1
            turn = Rotation.from_rotvec(1e-6 * axes[k]).as_matrix()
            turned_m = origins_m[k] + turn @ (places_m[n] - origins_m[k])
            expected[row, 6 + joint[k]] = (pixel(turned_m) - pixel(places_m[n])) / 1e-6
    assert (np.count_nonzero(expected[:, 6:], axis=0) > 2).all()
    np.testing.assert_allclose(slopes[:count], expected, rtol=1e-4, atol=1e-3)
    looked = edges[:, STATE] >= 0.0
    for k in (0, 1):
        own = parts == 1 + k
        assert support[joint[k]] == pytest.approx(np.sum(own & used) / np.sum(own & looked))
