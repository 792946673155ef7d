"""The rows of a view's contour points, made in one loop, beside those made in plain code."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rendezview.geometry.camera import Camera, LensModel
from rendezview.geometry.lens import distorted, is_polynomial, lens_vector, polynomial
from rendezview.geometry.pose import Array
from rendezview.sensors.appearance.edges.predicted import (
    COLUMNS,
    NOT_FOUND,
    NX,
    NY,
    OUTSIDE,
    STATE,
    U,
    V,
    edge_of_row,
    point_count,
    predict_edges,
)
from rendezview.sensors.appearance.model.contours import NO_POINT
from rendezview.sensors.appearance.model.view_tables import (
    LEAST_DEPTH_M,
    LEAST_LENGTH,
    LENS_STEP,
    Lens,
    ProjectedEdge,
    read_only,
)

UNIT_M = 1e-3
COUNT = 60
ROTATION = Rotation.from_rotvec([0.4, -0.7, 0.2]).as_matrix()
FAR = np.array([0.1, -0.05, 3.0])
AMID = np.array([0.0, 0.0, 0.1])  # some of the points are behind the camera
POLYNOMIAL = (-0.22, 0.51, -7e-4, -2e-4, -0.13)
PRISM = (0.01, 0.0, 0.0, 0.0, *[1e-3] * 8)
FISHEYE = (0.02, -0.01, 0.002, 0.0)


@pytest.fixture
def points(rng):
    tangents = rng.integers(-127, 128, (COUNT, 3)).astype(np.int8)
    places = rng.integers(-1000, 1001, (COUNT, 3)).astype(np.int16)
    return read_only(places), read_only(tangents)


@pytest.fixture
def rng():
    return np.random.default_rng(3)


def lens_of(terms: tuple[float, ...] = (), model: LensModel = LensModel.OPENCV) -> Lens:
    camera = Camera(640, 480, 700.0, 710.0, 320.0, 238.0, terms, model)
    return lens_vector(camera), camera.is_distorted


def predicted(points, lens: Lens, centre: Array, stride: int = 1) -> Array:
    rows = np.full((COUNT, COLUMNS), 7.0)
    predict_edges(*points, COUNT, stride, lens, UNIT_M, ROTATION, centre, rows)
    return rows


def project_edge(point: Array, tangent: Array, lens: Lens, centre: Array) -> ProjectedEdge:
    """The projection of an edge through a point, target axes at the view centre, m."""
    q, t = ROTATION @ point, ROTATION @ tangent
    x, y = (q + centre)[:2] / (q + centre)[2]
    camera, h = lens[0], LENS_STEP
    (u, v), beside, below = (
        distorted(*place, camera) for place in ((x, y), (x + h, y), (x, y + h))
    )
    m = np.stack([np.subtract(beside, (u, v)), np.subtract(below, (u, v))], axis=1) / h
    b = camera[:2] * (m @ (t[:2] - np.array([x, y]) * t[2]))
    length = float(np.hypot(*b))
    nx, ny = b[1] / max(length, LEAST_LENGTH), -b[0] / max(length, LEAST_LENGTH)
    gx, gy = np.array([nx, ny]) * camera[:2] @ m
    depth = float((q + centre)[2])
    return ProjectedEdge(
        depth > LEAST_DEPTH_M and length >= LEAST_LENGTH, camera[0] * u + camera[2],
        camera[1] * v + camera[3], nx, ny, gx, gy, x, y, 1.0 / depth, *q,
    )  # fmt: skip


def pose_slope(edge: ProjectedEdge) -> Array:
    """(6,) of a place along the normal with the pose: rotation about the view centre, shift."""
    shift = np.array([edge.gx, edge.gy, -(edge.gx * edge.x + edge.gy * edge.y)]) * edge.inverse
    return np.concatenate([np.cross([edge.qx, edge.qy, edge.qz], shift), shift])


@pytest.mark.parametrize(
    "lens",
    [lens_of(), lens_of(POLYNOMIAL), lens_of(PRISM), lens_of(FISHEYE, LensModel.FISHEYE)],
    ids=["pinhole", "polynomial", "prism", "fisheye"],
)
@pytest.mark.parametrize("centre", [FAR, AMID], ids=["far", "amid"])
def test_each_row_is_that_of_project_edge(points, lens, centre):
    rows, hidden = predicted(points, lens, centre), 0
    for row, point, tangent in zip(rows, *points, strict=True):
        one = project_edge(point * UNIT_M, tangent, lens, centre)
        assert row[STATE] == (NOT_FOUND if one.is_visible else OUTSIDE)
        hidden += not one.is_visible
        if one.is_visible and np.isfinite(one.u):  # NaN beyond the edge of a fisheye's picture
            assert row[:6] == pytest.approx(pose_slope(one), rel=1e-4, abs=1e-3)
            assert row[[U, V, NX, NY]] == pytest.approx([one.u, one.v, one.nx, one.ny], rel=1e-5)
            again = edge_of_row(row, *(point * UNIT_M), ROTATION, centre)
            assert again == pytest.approx(one, rel=1e-4, abs=1e-6)
    assert (hidden > 0) == (centre is AMID)


def test_a_row_has_the_derivatives_of_the_place_along_the_normal(points):
    lens = lens_of(POLYNOMIAL)
    rows = predicted(points, lens, FAR)
    camera = Camera(640, 480, 700.0, 710.0, 320.0, 238.0, POLYNOMIAL)

    def pixels(turn: Array, move: Array) -> Array:
        turned = Rotation.from_rotvec(turn).as_matrix() @ ROTATION
        return np.asarray(camera.project(UNIT_M * points[0] @ turned.T + FAR + move))

    for step in 1e-6 * np.eye(6):
        rate = (pixels(step[:3], step[3:]) - pixels(-step[:3], -step[3:])) / 2e-6
        along = np.sum(rate * rows[:, [NX, NY]], axis=1)
        assert rows[:, np.argmax(step)] == pytest.approx(along, rel=1e-3, abs=0.05)


def test_with_a_stride_the_rows_between_are_left_alone(points):
    every, some = predicted(points, lens_of(), FAR), predicted(points, lens_of(), FAR, 4)
    assert np.array_equal(some[::4, :6], every[::4, :6])
    assert np.all(some[np.arange(COUNT) % 4 != 0] == 7.0)


def test_an_edge_along_the_line_of_sight_has_no_place():
    along = read_only(np.array([[0, 0, 127]], np.int8))
    rows = np.zeros((1, COLUMNS))
    origin = read_only(np.zeros((1, 3), np.int16))
    predict_edges(origin, along, 1, 1, lens_of(), UNIT_M, np.eye(3), np.array([0, 0, 7.0]), rows)
    assert rows[0, STATE] == OUTSIDE
    assert np.isfinite(rows).all()


def test_a_polynomial_is_all_of_a_lens_without_prism_tilt_or_fisheye():
    for terms in ((), POLYNOMIAL, (*POLYNOMIAL, 0.01, -0.02, 0.003)):
        lens, _ = lens_of(terms)
        assert is_polynomial(lens)
        assert polynomial(0.2, -0.3, lens) == distorted(0.2, -0.3, lens)
    for lens, _ in (lens_of(PRISM), lens_of(FISHEYE, LensModel.FISHEYE)):
        assert not is_polynomial(lens)
        assert polynomial(0.2, -0.3, lens) != distorted(0.2, -0.3, lens)


def test_points_are_counted_up_to_the_first_row_without_one():
    kind = np.zeros(9, np.uint8)
    assert point_count(kind) == 9
    kind[4:] = NO_POINT
    assert point_count(kind) == 4
    assert point_count(kind[4:]) == 0
