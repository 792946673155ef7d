"""Shading, the lens and the choice of views beside plain numpy, on random surfaces."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import uniform_filter
from scipy.spatial.transform import Rotation

from rendezview.geometry.camera import Camera
from rendezview.geometry.geodesic import Geodesic
from rendezview.geometry.lens import lens_vector
from rendezview.sensors.appearance.edges.lighting import ROUNDS, light_strengths
from rendezview.sensors.appearance.judge.shading import (
    SurfaceTables,
    _correlations,
    shading,
    visible_points,
)
from rendezview.sensors.appearance.model.view_tables import read_only, through_lens
from rendezview.sensors.appearance.outline.similarity import _squared_distances, spread_out

PINHOLE = Camera(400, 300, 520.0, 530.0, 199.0, 151.0)
BENT = Camera(400, 300, 520.0, 530.0, 199.0, 151.0, (-0.2, 0.1, 0.001, -0.002, 0.0))
RADIUS_M = 2.0


def lens_of(camera: Camera) -> tuple[np.ndarray, bool]:
    return lens_vector(camera), camera.is_distorted


def test_the_lens_and_its_derivatives_are_those_of_the_camera():
    lens = lens_of(BENT)
    scale, offset = np.array([520.0, 530.0]), np.array([199.0, 151.0])

    def bent(x: float, y: float) -> np.ndarray:
        return (BENT.project(np.array([x, y, 1.0])) - offset) / scale

    h = 1e-6
    for x, y in np.random.default_rng(1).uniform(-0.4, 0.4, (20, 2)):
        u, v, *rates = through_lens(x, y, lens)
        assert [u, v] == pytest.approx(bent(x, y), abs=1e-12)
        by_x = (bent(x + h, y) - bent(x - h, y)) / (2.0 * h)
        by_y = (bent(x, y + h) - bent(x, y - h)) / (2.0 * h)
        # The kernel's step of 1e-5 to one side only.
        assert rates == pytest.approx([by_x[0], by_y[0], by_x[1], by_y[1]], abs=2e-5)
        assert through_lens(x, y, lens_of(PINHOLE)) == (x, y, 1.0, 0.0, 0.0, 1.0)


class Body:
    """Points with random normals and random visibility, and a frame of noise."""

    def __init__(self, seed: int, count: int = 1500) -> None:
        rng = np.random.default_rng(seed)
        point = rng.normal(size=(count, 3))
        point *= (
            RADIUS_M
            * rng.uniform(0.3, 0.95, (count, 1))
            / np.linalg.norm(point, axis=1, keepdims=True)
        )
        normal = rng.normal(size=(count, 3))
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        nodes = np.ascontiguousarray(Geodesic.of_order(3).nodes)
        self.seen = rng.random((len(nodes), count)) < 0.5
        bits = np.packbits(self.seen, axis=1, bitorder="little")
        albedo = rng.uniform(0.2, 0.9, count)
        self.tables = SurfaceTables(
            np.ascontiguousarray(point.T),
            normal,
            albedo,
            read_only(bits),
            read_only(nodes),
            RADIUS_M,
        )
        self.rotation = np.ascontiguousarray(Rotation.random(random_state=rng).as_matrix())
        self.centre = np.array([0.9, -0.4, 6.0])  # partly out of the picture
        self.image = rng.integers(0, 255, (300, 400)).astype(np.uint8)

    def visible(self, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Index, pixel, normal towards the camera and grey level of the points in the picture."""
        point, normal, nodes = self.tables.point.T, self.tables.normal, self.tables.nodes
        eye = -self.rotation.T @ self.centre
        node = np.argmax((eye - point) @ nodes.T, axis=1)
        placed, turned = point @ self.rotation.T + self.centre, normal @ self.rotation.T
        towards = -np.sum(placed * turned, axis=1) / np.linalg.norm(placed, axis=1)
        u, v = camera.project(placed).T
        kept = self.seen[node, np.arange(len(point))] & (np.abs(towards) >= 0.08)
        kept &= (u > 1.0) & (v > 1.0) & (u < 398.0) & (v < 298.0)
        which = np.flatnonzero(kept)
        pixels = np.stack([u, v], axis=1)[which]
        column, row = np.floor(pixels + 0.5).astype(int).T
        levels = uniform_filter(self.image.astype(float), 3)[row, column]
        return which, pixels, (turned * np.sign(towards)[:, None])[which], levels

    def brightness(
        self, which: np.ndarray, facing: np.ndarray, node: int, sun: np.ndarray
    ) -> np.ndarray:
        lit = np.maximum(facing @ sun, 0.0) * self.seen[node, which]
        return np.asarray(self.tables.albedo[which] * lit)


@pytest.mark.parametrize("camera", [PINHOLE, BENT])
def test_visible_points_are_those_that_the_node_on_their_line_of_sight_sees(camera):
    body = Body(2)
    count = len(body.tables.albedo)
    which, u, v = np.empty(count, dtype=np.int64), np.empty(count), np.empty(count)
    facing, levels = np.empty((count, 3)), np.empty(count)
    found = visible_points(
        body.image, lens_of(camera), body.tables, body.rotation, body.centre, 7.0, which, u, v,
        facing, levels,
    )  # fmt: skip
    expected, pixels, normals, greys = body.visible(camera)
    assert 200 < len(expected) < 0.5 * count
    assert which[:found].tolist() == expected.tolist()
    assert np.stack([u, v], axis=1)[:found] == pytest.approx(pixels, abs=1e-9)
    assert facing[:found] == pytest.approx(normals, abs=1e-12)
    assert levels[:found] == pytest.approx(greys - 7.0, abs=1e-9)


def correlation(
    pixels: np.ndarray, levels: np.ndarray, bright: np.ndarray, side: float, even: float
) -> float:
    """Of the deviations from the means of square windows with five points or more."""
    windows = np.floor((pixels - pixels.min(axis=0)) / side).astype(int)
    _, of, counts = np.unique(windows, axis=0, return_inverse=True, return_counts=True)
    of = of.ravel()
    enough = counts[of] >= 5
    a, b = (
        (values - (np.bincount(of, values) / counts)[of])[enough] for values in (levels, bright)
    )
    same = np.sum(enough) * even
    return float((a @ b + same) / np.sqrt((a @ a + 1e-6 + same) * (b @ b + 1e-6 + same)))


@pytest.mark.parametrize("even", [0.0, 400.0])
def test_the_correlations_are_within_windows_and_over_all(even):
    body, rng = Body(3), np.random.default_rng(3)
    which, pixels, facing, _ = body.visible(PINHOLE)
    node, sun = 17, np.array([0.6, 0.0, -0.8])
    strengths = np.array([150.0, 20.0])
    bright = 150.0 * body.brightness(which, facing, node, sun) + 20.0 * body.tables.albedo[which]
    levels = bright + rng.normal(0.0, 20.0, len(which))
    u, v = (np.ascontiguousarray(column) for column in pixels.T)
    found = _correlations(
        body.tables, which, u, v, facing, levels, len(which), node, sun, strengths, 19.0, even
    )
    for correlated, side in zip(found, (19.0, np.inf), strict=True):
        assert correlated == pytest.approx(
            correlation(pixels, levels, bright, side, even), abs=1e-9
        )
        assert 0.3 < correlated < 0.99


@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize("known", [False, True])
def test_shading_is_the_correlation_under_the_best_sun_of_three_levels(dark, known):
    body = Body(4)
    which, pixels, facing, levels = body.visible(BENT)
    black = 9.0 if dark else 0.0
    levels = levels - black
    every = 1 + len(levels) // 240
    some, of, normals = levels[::every], which[::every], facing[::every]
    albedo = body.tables.albedo[of]
    bright_level = np.percentile(some, 80)
    suns = body.tables.nodes @ body.rotation.T
    away = body.centre / np.linalg.norm(body.centre)
    given = suns[100] if known else np.zeros(3)
    best, node, light = np.inf, -1, np.zeros(2)
    strengths = np.empty(2)
    for count, near in ((42, -2.0), (162, np.cos(np.deg2rad(25.0))), (642, np.cos(np.deg2rad(13)))):
        middle = suns[node] if node >= 0 else np.zeros(3)
        possible = suns @ given >= 0.99 if known else suns @ away <= 0.3
        if not known and count > 42:
            possible &= suns @ middle >= near
        for s in np.flatnonzero(possible[:count]):
            lit = body.brightness(of, normals, int(s), suns[s])
            cost = light_strengths(
                some, lit, albedo, 0.4 * bright_level + 2.0, np.inf, strengths, ROUNDS, False
            )
            if cost < best:
                best, node, light = cost, int(s), strengths.copy()
    bright = light[0] * body.brightness(which, facing, node, suns[node])
    bright += light[1] * body.tables.albedo[which]
    side = 2.0 * RADIUS_M * 520.0 / body.centre[2] / 18.0
    even = (0.06 * bright_level) ** 2 if dark else 0.0
    frame = np.array([2.0, 9.0, float(dark), *given])
    sun = np.zeros(3)
    at = body.rotation, body.centre, sun
    found = shading(body.image, lens_of(BENT), frame, body.tables, *at)
    np.testing.assert_allclose(sun, suns[node])
    assert every > 1
    for correlated, wide in zip(found, (side, np.inf), strict=True):
        assert correlated == pytest.approx(
            correlation(pixels, levels, bright, wide, even), abs=1e-9
        )
        assert correlated != 0.0


def test_few_visible_points_say_nothing():
    body = Body(5, 100)
    assert 0 < len(body.visible(BENT)[0]) < 60
    frame = np.array([2.0, 9.0, 1.0, 0.0, 0.0, 0.0])
    sun = np.zeros(3)
    at = body.rotation, body.centre, sun
    assert shading(body.image, lens_of(BENT), frame, body.tables, *at) == (0.0, 0.0)
    assert not sun.any()


def test_views_near_one_before_at_the_same_roll_are_left_out():
    rng = np.random.default_rng(6)
    directions = np.ascontiguousarray(Geodesic.of_order(3).nodes)
    views = rng.integers(0, 40, 400)
    shifts = rng.integers(0, 90, 400)
    cosine = np.cos(np.deg2rad(7.0))
    chosen: list[int] = []
    for k in range(len(views)):
        near = directions[views[chosen]] @ directions[views[k]] > cosine
        rolls = (shifts[k] - shifts[chosen] + 45) % 90 - 45
        if not np.any(near & (np.abs(rolls) <= 3)):
            chosen.append(k)
    assert 60 < len(chosen) < 350
    for most in (50, 400):
        found = spread_out(views, shifts, directions, cosine, 90, most)
        assert found.tolist() == chosen[:most]


def test_squared_distances():
    rng = np.random.default_rng(7)
    rows = rng.normal(size=(50, 90)).astype(np.float32)
    one = rng.normal(size=90).astype(np.float32)
    expected = np.sum((rows.astype(float) - one) ** 2, axis=1)
    assert _squared_distances(rows, one) == pytest.approx(expected, rel=1e-5)
