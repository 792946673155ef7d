"""The compiled loops of simulation against plain numpy."""

from __future__ import annotations

import math

import numpy as np
import pytest

from rendezview_ground.simulate.background import _fractal, _lattice, _noise
from rendezview_ground.simulate.lighting import _sunlight, shade_samples
from rendezview_ground.simulate.ring_frames import _grey, _plate_at
from rendezview_ground.simulate.shadows import _visible_bounds


def rotation(rng: np.random.Generator) -> np.ndarray:
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return np.ascontiguousarray(turn * np.linalg.det(turn))


def units(rng: np.random.Generator, count: int) -> np.ndarray:
    vectors = rng.normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1)[:, None]


def test_sunlight_compares_four_texels_with_the_plane_of_the_face():
    rng = np.random.default_rng(0)
    axes, origin, texel = rotation(rng), rng.normal(size=3), 0.1
    nearness = rng.uniform(0.0, 2.0, (9, 11)).astype(np.float32)
    owner = rng.integers(0, 3, (9, 11)).astype(np.int32)
    normals = units(rng, 3)
    shares = []
    for _ in range(200):
        face = int(rng.integers(3))
        place = np.array([*rng.uniform(0.0, [10.0, 8.0]), 0.0]) * texel
        place[2] = rng.uniform(0.0, 2.0)
        point = origin + place @ axes
        x, y = place[:2] / texel
        column, row = math.floor(x), math.floor(y)
        n = axes @ normals[face]
        slope = -texel * n[:2] / max(n[2], 0.03)
        share = 0.0
        for i in (0, 1):
            for j in (0, 1):
                offset = np.array([column + j - x, row + i - y])
                plane = place[2] + slope @ offset + 2.0 * texel
                free = nearness[row + i, column + j] <= plane or owner[row + i, column + j] == face
                share += free * (1.0 - abs(offset[0])) * (1.0 - abs(offset[1]))
        found = _sunlight(point, normals, face, nearness, owner, axes, origin, texel)
        assert found == pytest.approx(share, abs=1e-9)
        shares.append(share)
    assert 0.2 < np.mean(shares) < 0.95


def test_shading_is_lambert_and_blinn_phong_averaged_over_the_samples():
    rng = np.random.default_rng(1)
    n, height, width, faces = 2, 5, 7, 6
    nearness = rng.uniform(0.1, 0.5, (n * height, n * width)).astype(np.float32)
    owner = rng.integers(-1, faces, nearness.shape).astype(np.int32)
    normals = units(rng, faces)
    normals[normals[:, 2] > 0.0] *= -1.0
    sun = units(rng, 1)[0]
    sun_cosine = np.maximum(normals @ sun, 0.0)
    diffuse, glow = rng.uniform(0.1, 0.9, faces) * sun_cosine, rng.uniform(0.0, 0.1, faces)
    fx, fy, cx, cy = 40.0, 41.0, 6.2, 4.7
    radiance, coverage, depth = (np.zeros((height, width), np.float32) for _ in range(3))
    no_shadow = np.zeros((1, 1), np.float32), np.full((1, 1), -1, np.int32), np.eye(3), np.zeros(3)
    shade_samples(
        nearness, owner, n, fx, fy, cx, cy, normals, diffuse, sun_cosine, glow, 0.3, 12.0, sun,
        *no_shadow, 1.0, radiance, coverage, depth,
    )  # fmt: skip
    rows, columns = np.indices(owner.shape)
    z = 1.0 / nearness.astype(float)
    points = np.stack([z * (columns - cx) / fx, z * (rows - cy) / fy, z], axis=-1)
    half = sun - points / np.linalg.norm(points, axis=-1, keepdims=True)
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    shine = np.maximum(np.sum(half * normals[owner], axis=-1), 0.0) ** 12.0
    shine = np.where((shine > 1e-4) & (sun_cosine[owner] > 0.0), shine, 0.0)
    light = glow[owner] + diffuse[owner] + 0.3 * sun_cosine[owner] * shine
    covered = owner >= 0

    def pixels(values: np.ndarray) -> np.ndarray:
        return np.where(covered, values, 0.0).reshape(height, n, width, n).sum(axis=(1, 3))

    count = pixels(np.ones_like(z))
    assert np.allclose(radiance, pixels(light) / n**2, atol=1e-6)
    assert np.allclose(coverage, count / n**2)
    seen = count > 0
    assert np.allclose(depth[seen], pixels(z)[seen] / count[seen], rtol=1e-6)


def test_bounds_of_the_sunlit_samples_are_those_of_their_points():
    rng = np.random.default_rng(2)
    nearness = rng.uniform(0.1, 0.5, (12, 15)).astype(np.float32)
    owner = rng.integers(-1, 4, nearness.shape).astype(np.int32)
    lit, axes = np.array([0.0, 0.5, 0.2, 0.0]), rotation(rng)
    fx, fy, cx, cy = 30.0, 31.0, 7.2, 5.1
    rows, columns = np.nonzero((owner >= 0) & (lit[owner] > 0.0))
    z = 1.0 / nearness[rows, columns].astype(float)
    points = np.stack([z * (columns - cx) / fx, z * (rows - cy) / fy, z], axis=1) @ axes.T
    expected = (*points[:, :2].min(axis=0), *points[:, :2].max(axis=0), z.min())
    found = _visible_bounds(nearness, owner, fx, fy, cx, cy, lit, axes)
    assert np.allclose(found, expected, rtol=1e-12)


def test_value_noise_interpolates_its_lattice_smoothly():
    rng = np.random.default_rng(3)
    for x, y, z in rng.uniform(-20.0, 20.0, (50, 3)):
        corner = np.floor([x, y, z]).astype(int)
        part = np.array([x, y, z]) - corner
        part = part * part * (3.0 - 2.0 * part)
        total = 0.0
        for offset in np.ndindex(2, 2, 2):
            weight = np.prod(np.where(offset, part, 1.0 - part))
            total += weight * _lattice(*(corner + offset))
        assert _noise(x, y, z) == pytest.approx(total, abs=1e-12)
        assert 0.0 <= total < 1.0


def test_octaves_stop_at_the_footprint_of_a_pixel():
    assert _fractal(0.3, 0.4, 0.5, 4.0, 0.2) == 0.0
    x, y, z = 0.3, 0.4, 0.5
    first = 0.5 * (_noise(4.0 * x, 4.0 * y, 4.0 * z) - 0.5)
    assert _fractal(x, y, z, 4.0, 0.09) == pytest.approx(first, abs=1e-12)


def test_a_ray_meets_the_last_plate_in_the_table_that_it_hits():
    rng = np.random.default_rng(4)
    rows = []
    for k in range(6):
        basis = np.column_stack([rotation(rng)[:, :2], [*rng.uniform(-0.5, 0.5, 2), 4.0]])
        sizes = [0.2, 1.1] if k % 2 else [0.9, 0.6]
        kind = 0.0 if k % 2 else 1.0
        rows.append([*np.linalg.inv(basis).ravel(), kind, *sizes, 0.4, 5.0, 50.0 + k, 3.0, -2.0, 0])
    table, hits = np.array(rows), 0
    for x, y in rng.uniform(-0.4, 0.4, (300, 2)):
        expected, grey = -1, 12.0
        for k, row in enumerate(table):
            a, b, w = row[:9].reshape(3, 3) @ [x, y, 1.0]
            if w <= 0.0:
                continue
            a, b = a / w, b / w
            if k % 2:
                inside = 0.2 <= math.hypot(a, b) <= 1.1
                inside &= (math.atan2(b, a) - 0.4) % (2.0 * math.pi) <= 5.0
            else:
                inside = abs(a) <= 0.9 and abs(b) <= 0.6
            if inside:
                expected, grey = k, max(0.0, row[14] + 3.0 * a - 2.0 * b)
        found = _plate_at(table, x, y)
        assert found == expected
        assert _grey(table, found, x, y, 12.0) == pytest.approx(grey, abs=1e-9)
        hits += expected >= 0
    assert 30 < hits < 300
