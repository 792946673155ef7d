"""Compiled loops of the ring against plain numpy."""

from __future__ import annotations

import math

import numpy as np
import pytest

from rendezview.geometry.camera import Camera
from rendezview.geometry.lens import LENS_LENGTH, lens_vector
from rendezview.sensors.ring.arcs import FIRST, LAST, TURN, find_arcs, group_arcs
from rendezview.sensors.ring.circle_pose import circles_of_shapes, cones_of_shapes, shape_of_circle
from rendezview.sensors.ring.conic import (
    MOMENTS,
    add_point,
    conic_of,
    distance,
    ellipse_of_conic,
    root_into,
    semi_axes,
    within,
)
from rendezview.sensors.ring.ellipse import Ellipse
from rendezview.sensors.ring.samples import (
    ANGLE,
    ARC,
    COLUMNS,
    CONTRAST,
    NX,
    NY,
    OFFSET,
    U0,
    U1,
    WEIGHT,
    add_equation,
    begin_sample,
    bend,
    frame_at,
    sample_gradients,
    solve_equations,
    update_shape,
)
from rendezview.sensors.ring.spread import (
    covariance_of,
    covered,
    scale_of,
    systematic_of,
    trim,
)
from rendezview.sensors.ring.verify import twins

CAMERA = Camera(640, 480, 800.0, 790.0, 320.0, 241.0, (-0.2, 0.05, 1e-3, -5e-4))
SHAPE = np.array([310.0, 230.0, 90.0, 12.0, 70.0])


def matrix_of(shape):
    return np.array([[shape[2], shape[3]], [shape[3], shape[4]]])


def on_ellipse(shape, angles):
    return shape[:2] + np.column_stack([np.cos(angles), np.sin(angles)]) @ matrix_of(shape)


def random_samples(rng, count=200):
    """Samples about `SHAPE` with places, normals, offsets and weights."""
    samples = np.zeros((count, COLUMNS))
    samples[:, ANGLE] = np.linspace(0.0, 2.0 * math.pi, count, endpoint=False)
    samples[:, U0], samples[:, U1] = np.cos(samples[:, ANGLE]), np.sin(samples[:, ANGLE])
    normals = samples[:, [U0, U1]] @ np.linalg.inv(matrix_of(SHAPE))
    samples[:, [NX, NY]] = normals / np.linalg.norm(normals, axis=1)[:, None]
    samples[:, OFFSET] = rng.normal(0.0, 0.3, count)
    samples[:, CONTRAST] = rng.choice([-40.0, 50.0], count)
    samples[:, WEIGHT] = np.where(rng.random(count) < 0.2, 0.0, rng.uniform(10.0, 200.0, count))
    samples[:, ARC] = 2.0 * math.pi / count
    return samples


def test_add_point_and_conic_of_are_the_linear_fit():
    rng = np.random.default_rng(0)
    for _ in range(20):
        points = (on_ellipse(SHAPE, rng.uniform(0.0, 5.0, 80)) - SHAPE[:2]) / 100.0
        points += rng.normal(0.0, 0.01, points.shape)
        sums, conic = np.zeros((MOMENTS, MOMENTS)), np.empty(6)
        for x, y in points:
            add_point(sums, x, y)
        assert conic_of(sums, conic)
        x, y = points.T
        design = np.column_stack([x * x - y * y, x * y, x, y, np.ones_like(x)])
        a, *rest = np.linalg.lstsq(design, -0.5 * (x * x + y * y), rcond=None)[0]
        np.testing.assert_allclose(conic, [0.5 + a, rest[0], 0.5 - a, *rest[1:]], atol=1e-8)
    assert not conic_of(np.zeros((MOMENTS, MOMENTS)), conic)


def test_ellipse_of_conic_and_distance_are_those_of_the_equation():
    rng = np.random.default_rng(1)
    for _ in range(30):
        a, angle = rng.uniform(20.0, 90.0), rng.uniform(-1.5, 1.5)
        centre, b = rng.uniform(0.0, 50.0, 2), rng.uniform(0.3, 0.95) * a
        turn = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
        q = turn.T @ np.diag([a**-2.0, b**-2.0]) @ turn
        d = -2.0 * q @ centre
        conic = np.array([q[0, 0], 2 * q[0, 1], q[1, 1], *d, centre @ q @ centre - 1.0])
        shape = np.empty(5)
        assert ellipse_of_conic(rng.choice([-1.0, 1.0]) * conic, shape)
        np.testing.assert_allclose(shape[:2], centre, rtol=1e-8)
        np.testing.assert_allclose(np.linalg.inv(matrix_of(shape) @ matrix_of(shape)), q, rtol=1e-8)
        np.testing.assert_allclose(semi_axes(shape), (a, b), rtol=1e-9)
        np.testing.assert_allclose(Ellipse(centre, (a, b), angle).shape, shape, rtol=1e-8)
        p = centre + rng.uniform(0.99, 1.01) * np.array([math.cos(angle), math.sin(angle)]) * a
        value = (p - centre) @ q @ (p - centre) - 1.0
        slope = np.linalg.norm(2.0 * q @ (p - centre))
        assert distance(shape, *p) == pytest.approx(value / slope, rel=0.01)
    assert not ellipse_of_conic(np.array([1.0, 0.0, -1.0, 0.0, 0.0, -1.0]), np.empty(5))
    assert not ellipse_of_conic(np.array([1.0, 0.0, 1.0, 0.0, 0.0, 1.0]), np.empty(5))


def test_a_root_is_the_matrix_whose_square_is_given_and_limits_are_of_its_axes():
    shape = SHAPE.copy()
    square = matrix_of(SHAPE) @ matrix_of(SHAPE)
    assert root_into(square[0, 0], square[0, 1], square[1, 1], shape)
    np.testing.assert_allclose(shape, SHAPE)
    assert not root_into(1.0, 2.0, 1.0, shape)
    np.testing.assert_allclose(semi_axes(SHAPE)[::-1], np.linalg.eigvalsh(matrix_of(SHAPE)))
    assert within(SHAPE, np.array([60.0, 100.0, 0.5]))
    for limits in ([70.0, 100.0, 0.5], [60.0, 90.0, 0.5], [60.0, 100.0, 0.8]):
        assert not within(SHAPE, np.array(limits))


def test_a_circles_picture_is_that_of_its_points_and_back():
    rng = np.random.default_rng(3)
    camera = lens_vector(CAMERA)
    for _ in range(50):
        centre = np.array([*rng.uniform(-1, 1, 2), rng.uniform(3, 9)])
        axis = rng.normal(0.0, 1.0, 3) - np.array([0.0, 0.0, 2.0])
        axis /= np.linalg.norm(axis)
        if axis @ centre > 0.0:
            axis = -axis
        shape = shape_of_circle(CAMERA, centre, axis, 0.6)
        first = np.cross(axis, [0.0, 1.0, 0.0])
        first /= np.linalg.norm(first)
        t = np.linspace(0.0, 6.0, 20)[:, None]
        points = centre + 0.6 * (np.cos(t) * first + np.sin(t) * np.cross(axis, first))
        flat = points[:, :2] / points[:, 2:] * camera[:2] + camera[2:4]
        u = np.linalg.solve(matrix_of(shape), (flat - shape[:2]).T)
        np.testing.assert_allclose(np.linalg.norm(u, axis=0), 1.0, atol=1e-9)
        rays = points / points[:, 2:]
        np.testing.assert_allclose(
            np.sum((rays @ cones_of_shapes(CAMERA, shape[None])[0]) * rays, axis=1), 0.0, atol=1e-9
        )
        centres, axes = circles_of_shapes(CAMERA, shape[None])
        off = np.linalg.norm(0.6 * centres[0] - centre, axis=1)
        off += np.linalg.norm(axes[0] - axis, axis=1)
        assert off.min() < 1e-6


def test_a_frame_on_an_ellipse_and_the_distance_from_it():
    rng = np.random.default_rng(5)
    for angle in rng.uniform(0.0, 6.28, 30):
        u = np.array([math.cos(angle), math.sin(angle)])
        x, y, nx, ny = frame_at(SHAPE, *u)
        np.testing.assert_allclose([x, y], SHAPE[:2] + matrix_of(SHAPE) @ u, rtol=1e-12)
        tangent = matrix_of(SHAPE) @ [-u[1], u[0]]
        assert abs(tangent @ [nx, ny]) < 1e-9 * np.linalg.norm(tangent)
        assert math.hypot(nx, ny) == pytest.approx(1.0)
        for off in (-0.5, 0.3):
            assert distance(SHAPE, x + off * nx, y + off * ny) == pytest.approx(off, abs=0.01)


def test_bend_is_the_cameras_distortion():
    lens = np.append(lens_vector(CAMERA), 1.0)
    for x, y in np.random.default_rng(6).uniform((0, 0), (640, 480), (30, 2)):
        ray = [(x - CAMERA.cx) / CAMERA.fx, (y - CAMERA.cy) / CAMERA.fy, 1.0]
        np.testing.assert_allclose(bend(x, y, lens), CAMERA.project(np.array(ray)), atol=1e-9)
    lens[LENS_LENGTH] = 0.0
    assert bend(3.0, 4.0, lens) == (3.0, 4.0)
    row = np.zeros(COLUMNS)
    begin_sample(row, SHAPE, lens, 0.0, 1.0, 0.0, 5.0, 640, 480)
    assert row[WEIGHT] == 0.0
    begin_sample(row, SHAPE, lens, 0.0, 1.0, 0.0, 5.0, 402, 480)
    assert row[WEIGHT] == -1.0


def test_equations_and_their_solution_are_numpys():
    rng = np.random.default_rng(7)
    rows, values, weights = rng.normal(size=(20, 5)), rng.normal(size=20), rng.uniform(1, 3, 20)
    normal, right, step = np.zeros((5, 5)), np.zeros(5), np.empty(5)
    for row, value, weight in zip(rows, values, weights, strict=True):
        add_equation(row, weight, value, normal, right)
    assert solve_equations(normal, right, 1e-7, step)
    wanted = rows.T @ (weights[:, None] * rows)
    np.testing.assert_allclose(normal, wanted, rtol=1e-12)
    damped = wanted + 1e-7 * np.trace(wanted) * np.eye(5)
    np.testing.assert_allclose(step, np.linalg.solve(damped, right), rtol=1e-10)
    assert not solve_equations(np.zeros((5, 5)), right, 1e-7, step)
    covariance = np.empty((5, 5))
    assert covariance_of(wanted.copy(), 2.0, covariance)
    np.testing.assert_allclose(covariance, 2.0 * np.linalg.inv(wanted), rtol=1e-9)


def test_a_shape_moves_by_the_robust_least_squares_step():
    samples = random_samples(np.random.default_rng(8))
    shape, normal = SHAPE.copy(), np.empty((5, 5))
    moved = update_shape(samples, len(samples), 1.0, shape, normal)
    s = samples[(samples[:, WEIGHT] > 0.0) & (np.abs(samples[:, OFFSET]) < 1.0)]
    weight = s[:, WEIGHT] * (1.0 - s[:, OFFSET] ** 2) ** 2
    mixed = s[:, NX] * s[:, U1] + s[:, NY] * s[:, U0]
    rows = np.column_stack([s[:, NX], s[:, NY], s[:, NX] * s[:, U0], mixed, s[:, NY] * s[:, U1]])
    wanted = rows.T @ (weight[:, None] * rows)
    np.testing.assert_allclose(normal, wanted, rtol=1e-10, atol=1e-9)
    damped = wanted + 1e-7 * np.trace(wanted) * np.eye(5)
    step = np.linalg.solve(damped, rows.T @ (weight * s[:, OFFSET]))
    np.testing.assert_allclose(shape - SHAPE, step, atol=1e-10)
    assert moved == pytest.approx(np.abs(step).max(), rel=1e-9)


def test_scale_cover_and_trim_count_samples_as_numpy_does():
    samples = random_samples(np.random.default_rng(9))
    n, good = len(samples), samples[:, WEIGHT] > 0.0
    size = np.abs(samples[good, OFFSET])
    assert scale_of(samples, n) == pytest.approx(5.0 * 1.483 * np.median(size))
    bright = samples[:, CONTRAST] > 0.0
    near = good & (np.abs(samples[:, OFFSET]) < 0.2)
    np.testing.assert_allclose(
        covered(samples, n, 0.2),
        [samples[near & bright, ARC].sum(), samples[near & ~bright, ARC].sum()],
    )
    used, contrast, rms, spread = trim(samples, n, 0.3)
    kept = size <= 0.3
    assert used == kept.sum() == (samples[:, WEIGHT] > 0.0).sum()
    assert contrast == pytest.approx(samples[samples[:, WEIGHT] > 0.0, CONTRAST].mean())
    assert rms == pytest.approx(np.sqrt(np.mean(size[kept] ** 2)))
    chi2 = np.sum(samples[:, WEIGHT].clip(0.0) * samples[:, OFFSET] ** 2)
    assert spread == pytest.approx(max(chi2 / (used - 5), 1.0))


def test_white_samples_spread_as_their_weights_say():
    rng = np.random.default_rng(10)
    samples = random_samples(rng, 600)
    samples[:, WEIGHT] = 100.0
    samples[:, OFFSET] = rng.normal(0.0, 0.1, 600)
    assert 0.7 < trim(samples, 600, 1.0)[3] < 1.8


def test_the_common_part_of_offsets_is_that_of_neighbours():
    rng = np.random.default_rng(12)
    samples = random_samples(rng, 600)
    samples[:, WEIGHT] = 1.0
    samples[:, OFFSET] = rng.normal(0.0, 0.1, 600)
    assert systematic_of(samples, 600) < 0.03
    samples[:, OFFSET] += np.where(np.arange(600) < 150, 0.4, -0.1)
    assert systematic_of(samples, 600) == pytest.approx(np.std([0.4, -0.1, -0.1, -0.1]), abs=0.03)
    samples[:, WEIGHT] = 0.0
    assert systematic_of(samples, 600) == 0.0


def test_shapes_are_twins_where_no_number_is_farther_off():
    assert twins(SHAPE, SHAPE + 1.4, 1.5)
    assert not twins(SHAPE, SHAPE + 1.6 * np.eye(5)[2], 1.5)


def test_gradients_along_a_drawn_circle_are_its_edge():
    rows, columns = np.mgrid[:200, :200].astype(float)
    off = np.hypot(columns - 100.3, rows - 99.1) - 60.0
    grey = 4000.0 * np.exp(-0.5 * off**2 / 1.2**2)
    size = np.hypot(columns - 100.3, rows - 99.1) + 1e-9
    dx = (grey * (columns - 100.3) / size).astype(np.int16)
    dy = (grey * (rows - 99.1) / size).astype(np.int16)
    lens = np.append(lens_vector(Camera(200, 200, 200.0, 200.0, 99.5, 99.5)), 0.0)
    samples = np.zeros((60, COLUMNS))
    shape = np.array([100.3, 99.1, 59.0, 0.0, 59.0])
    assert sample_gradients(dx, dy, 100.0, lens, shape, 60, 3.0, samples) == 60
    assert abs(np.mean(samples[:, OFFSET]) - 1.0) < 0.1
    assert np.abs(samples[:, OFFSET] - 1.0).max() < 0.8
    assert (samples[:, CONTRAST] > 0.0).all()


def test_a_chain_along_an_ellipse_is_arcs_of_that_ellipse():
    angles = np.linspace(0.2, 4.2, 400)
    points = np.zeros((400, 4))
    points[:, :2] = on_ellipse(SHAPE, angles)
    normals = np.column_stack([np.cos(angles), np.sin(angles)]) @ np.linalg.inv(matrix_of(SHAPE))
    points[:, 2:] = normals / np.linalg.norm(normals, axis=1)[:, None]
    arcs = find_arcs(points, np.array([0, 400], np.int32), np.zeros(1, np.bool_))
    assert len(arcs) >= 1
    assert (arcs[:, LAST] - arcs[:, FIRST]).sum() > 350
    assert abs(arcs[:, TURN]).sum() == pytest.approx(4.0, rel=0.15)
    limits = np.array([8.0, 1000.0, 0.2])
    found, length = group_arcs(points, arcs, 100.0, 320.0, 240.0, 1.2, 120, limits)
    np.testing.assert_allclose(found[0], SHAPE, atol=0.5)
    assert length[0] > 200.0
