"""An edge of the picture counts for one edge of the model: the nearer of two that lie there."""

from __future__ import annotations

import numpy as np
import pytest

from rendezview.sensors.appearance.edges.measured import MeasuredEdges
from rendezview.sensors.appearance.edges.predicted import (
    COLUMNS,
    FOUND,
    NOT_FOUND,
    NX,
    NY,
    OUTSIDE,
    RESIDUAL,
    STATE,
    WEIGHT,
    U,
    V,
)
from rendezview.sensors.appearance.edges.shared_edges import without_shared

RANGE_M, RADIUS_M, CUT_PX = 50.0, 2.5, 1.25
LOOSE = 1e-4 * np.array([1.0, 1.0, 1.0, RADIUS_M**-2, RADIUS_M**-2, RADIUS_M**-2])


def rim(depth_m: float, radius_px: float, points: int = 48):
    """Rows of a circle about the boresight, all found, without a residual."""
    rows = np.zeros((points, COLUMNS))
    for row, angle in zip(rows, np.linspace(0.0, 2.0 * np.pi, points, endpoint=False), strict=True):
        nx, ny = np.cos(angle), np.sin(angle)
        x, y = radius_px * nx / 800.0, radius_px * ny / 800.0
        place = np.array([x * depth_m, y * depth_m, depth_m - RANGE_M])
        shift = 800.0 / depth_m * np.array([nx, ny, -(nx * x + ny * y)])
        row[:3], row[3:6] = np.cross(place, shift), shift
        row[WEIGHT], row[STATE] = 1.0, FOUND
        row[U], row[V], row[NX], row[NY] = 500.0 + radius_px * nx, 500.0 + radius_px * ny, nx, ny
    return rows


def tilt_rad(edges) -> float:
    """σ about an axis across the line of sight."""
    known = MeasuredEdges.of(edges, CUT_PX, np.eye(3), np.zeros(3))
    return 0.1 * float(np.sqrt(known.covariance(LOOSE, np.zeros(3))[0, 0]))


def test_a_body_seen_end_on_has_the_attitude_that_its_near_rim_shows():
    near, far = rim(48.0, 40.0), rim(52.0, 40.8)
    both = np.concatenate([near, far])
    known = without_shared(both, CUT_PX, RADIUS_M, RANGE_M)
    assert (known[:48, STATE] == FOUND).all()
    assert (known[48:, STATE] == OUTSIDE).all()
    assert (both[:, STATE] == FOUND).all()  # its own are left
    assert tilt_rad(known) == pytest.approx(tilt_rad(near))
    assert tilt_rad(known) > 10.0 * tilt_rad(both)


def test_rims_that_stand_apart_in_the_picture_all_count():
    both = np.concatenate([rim(48.0, 40.0), rim(52.0, 44.0)])
    assert without_shared(both, CUT_PX, RADIUS_M, RANGE_M) is both


def test_an_edge_that_was_not_found_hides_none():
    near, far = rim(48.0, 40.0), rim(52.0, 40.8)
    near[:, STATE] = NOT_FOUND
    missing = np.concatenate([near, far])
    assert without_shared(missing, CUT_PX, RADIUS_M, RANGE_M) is missing
    near[:, STATE], near[:, RESIDUAL] = FOUND, 2.0 * CUT_PX
    off = np.concatenate([near, far])
    assert without_shared(off, CUT_PX, RADIUS_M, RANGE_M) is off


def test_the_compiled_loop_does_as_a_plain_one():
    rng = np.random.default_rng(5)
    edges = np.zeros((300, COLUMNS))
    edges[:, U], edges[:, V] = rng.uniform(0.0, 40.0, (2, 300))
    angle = rng.uniform(0.0, 2.0 * np.pi, 300)
    edges[:, NX], edges[:, NY] = np.cos(angle), np.sin(angle)
    depth = rng.uniform(48.0, 52.0, 300)
    edges[:, 3], edges[:, 4] = 800.0 * edges[:, NX] / depth, 800.0 * edges[:, NY] / depth
    edges[:, STATE] = rng.choice([FOUND, NOT_FOUND], 300)
    edges[:, RESIDUAL] = rng.normal(0.0, 1.0, 300)
    counted = (edges[:, STATE] == FOUND) & (abs(edges[:, RESIDUAL]) < CUT_PX)
    behind = []
    for k in np.flatnonzero(counted):
        apart = np.hypot(edges[:, U] - edges[k, U], edges[:, V] - edges[k, V]) <= 2.5
        along = abs(edges[:, NX] * edges[k, NX] + edges[:, NY] * edges[k, NY]) >= 0.9
        nearer = depth[k] > depth * (1.0 + 0.05 * RADIUS_M / RANGE_M)
        if (counted & apart & along & nearer).any():
            behind.append(k)
    known = without_shared(edges, CUT_PX, RADIUS_M, RANGE_M)
    assert len(behind) > 20
    assert np.flatnonzero(known[:, STATE] != edges[:, STATE]).tolist() == behind
