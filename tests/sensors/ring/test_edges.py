"""Crests of the gradient, and ellipses that the gradients confirm."""

from __future__ import annotations

import itertools

import cv2
import numpy as np

from rendezview.geometry.camera import Camera
from rendezview.geometry.lens import lens_vector
from rendezview.sensors.ring.edges import find_edges, link
from rendezview.sensors.ring.verify import verify

Array = np.ndarray
CAMERA = Camera(320, 240, 500.0, 500.0, 160.0, 120.0)
SHAPE = np.array([150.0, 118.0, 60.0, 8.0, 45.0])  # x, y and the matrix of the ellipse
LIMITS = np.array([8.0, 640.0, 0.2])  # least short axis, greatest long axis (px), least ratio


def picture(shape: Array, grey: float = 120.0) -> Array:
    """A filled ellipse, 4 × 4 samples a pixel, blurred, with noise of 2 grey levels."""
    fine = 4
    y, x = np.mgrid[0 : 240 * fine, 0 : 320 * fine] / fine - 0.5 + 0.5 / fine
    matrix = np.array([[shape[2], shape[3]], [shape[3], shape[4]]])
    inside = np.stack([x - shape[0], y - shape[1]], axis=-1) @ np.linalg.inv(matrix)
    drawn = grey * ((inside**2).sum(axis=-1) < 1.0)
    coarse = drawn.reshape(240, fine, 320, fine).mean(axis=(1, 3)) + 20.0
    coarse = cv2.GaussianBlur(coarse, (0, 0), 0.7)
    noise = np.random.default_rng(3).normal(0.0, 2.0, coarse.shape)
    return np.clip(np.rint(coarse + noise), 0, 255).astype(np.uint8)


def crests(dx: Array, dy: Array, low: float) -> dict[tuple[int, int], Array]:
    """Column and row of every crest, to its place x, y: the plain form of the compiled search."""
    height, width = dx.shape
    power = dx.astype(np.float64) ** 2 + dy.astype(np.float64) ** 2
    found = {}
    for row, column in np.argwhere(power >= low * low):
        if not (3 <= row < height - 3 and 3 <= column < width - 3):
            continue
        here = power[row, column]
        gx, gy = float(dx[row, column]), float(dy[row, column])
        along_x = abs(gx) >= abs(gy)
        right, down = (1 if gx > 0 else -1), (1 if gy > 0 else -1)
        t = abs(gy / gx) if along_x else abs(gx / gy)

        def beside(sign: int, r=row, c=column, x=right, y=down, flat=along_x) -> tuple:
            straight = power[r, c + sign * x] if flat else power[r + sign * y, c]
            return straight, power[r + sign * y, c + sign * x]

        (p00, p01), (p10, p11) = beside(1), beside(-1)
        if (1 - t) * p00 + t * p01 >= here or (1 - t) * p10 + t * p11 > here:
            continue
        size = np.sqrt(here)
        a = (1 - t) * np.sqrt(p00) + t * np.sqrt(p01)
        b = (1 - t) * np.sqrt(p10) + t * np.sqrt(p11)
        shift = np.clip(0.5 * (b - a) / (a + b - 2 * size), -0.6, 0.6) * np.sqrt(1 + t * t)
        found[int(column), int(row)] = np.array([column, row]) + shift * np.array([gx, gy]) / size
    return found


def test_chains_hold_every_strong_crest_once_and_in_order():
    edges = find_edges(picture(SHAPE), 8.0, 5.0)
    number, power = np.zeros((240, 320), np.int32), np.empty((240, 320), np.float32)
    points, starts, closed = link(edges.dx, edges.dy, edges.least, number, power)
    assert not number.any(), "the scratch array is left as it was"
    assert starts[0] == 0
    assert starts[-1] == len(points)
    assert (np.diff(starts) >= 8).all()
    assert len(closed) == len(starts) - 1
    expected = crests(edges.dx, edges.dy, edges.least)
    places = np.array(list(expected.values()))
    apart = np.linalg.norm(points[:, None, :2] - places[None], axis=2)
    assert apart.min(axis=1).max() < 1e-4, "each point is a crest"
    assert len(set(apart.argmin(axis=1))) == len(points), "each crest is used once"
    strong = [
        place for (column, row), place in expected.items()
        if np.hypot(edges.dx[row, column], edges.dy[row, column]) > edges.least
    ]  # fmt: skip
    beside = [np.linalg.norm(points[:, :2] - place, axis=1).min() for place in strong]
    assert np.mean(np.array(beside) < 1e-4) > 0.7
    assert np.max(beside) < 1.0, "one left out is the second pixel of a step of its chain"
    for first, last in itertools.pairwise(starts):
        steps = np.diff(points[first:last, :2], axis=0)
        assert np.linalg.norm(steps, axis=1).max() < 4.0
        normals = points[first : last - 1, 2:]
        assert (steps[:, 1] * normals[:, 0] - steps[:, 0] * normals[:, 1] > 0.0).all()


def test_a_rough_ellipse_is_moved_onto_its_edge_and_a_false_one_dropped():
    edges = find_edges(picture(SHAPE), 8.0, 5.0)
    lens = np.append(lens_vector(CAMERA), float(CAMERA.is_distorted))
    near = SHAPE + np.array([1.5, -1.0, 1.0, -0.5, 1.0])
    again = SHAPE + np.array([-1.0, 1.0, -1.0, 0.5, 0.5])
    nowhere = np.array([60.0, 60.0, 30.0, 0.0, 30.0])
    rough = np.array([near, nowhere, again])
    found = verify(edges.dx, edges.dy, edges.least, lens, rough, 1.3, LIMITS, 10)
    assert found.shape == (1, 5), "one of two that are the same, none where no edge is"
    assert np.abs(found[0] - SHAPE).max() < 0.1
    narrow = verify(edges.dx, edges.dy, edges.least, lens, rough, 1.3, LIMITS * [8, 1, 1], 10)
    assert len(narrow) == 0, "its short axis is below the limit"
