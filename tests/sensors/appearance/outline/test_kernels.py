"""Compiled loops of the outline's way beside plain numpy."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.lib.stride_tricks import sliding_window_view

from rendezview.sensors.appearance.model.signature import vector_area
from rendezview.sensors.appearance.outline.interpolation import descend
from rendezview.sensors.appearance.outline.silhouette import mean_above
from rendezview.sensors.appearance.outline.similarity import (
    Catalogue,
    most_similar,
    roll_and_distance,
    spread_out,
)
from rendezview.sensors.appearance.outline.votes import mean_shift
from rendezview.sensors.appearance.sky import sky_level


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(31)


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def distances_by_shift(view: np.ndarray, node: np.ndarray, shifts: np.ndarray) -> np.ndarray:
    """Squared distance of a view, moved by whole bins, to a node."""
    return np.array([np.sum((np.roll(view, -s) - node) ** 2, dtype=np.float64) for s in shifts])


def test_vector_area_is_half_the_sum_of_cross_products(rng):
    rays = rng.normal([0.0, 0.0, 1.0], 0.3, (40, 3))
    r = unit(rays)
    expected = -0.5 * np.cross(np.roll(r, 1, axis=0), r).sum(axis=0)
    np.testing.assert_allclose(vector_area(rays), expected, atol=1e-12)


@pytest.mark.parametrize("side", [3, 5, 15])
def test_the_mask_is_that_of_a_padded_moving_mean(rng, side):
    image = rng.integers(0, 256, (37, 53), dtype=np.uint8)
    padded = np.pad(image, side // 2, mode="edge").astype(np.int64)
    total = sliding_window_view(padded, (side, side)).sum(axis=(2, 3))
    for level in (20.0, 127.3, 140.5):
        expected = np.where(total > np.floor(level * side**2), 255, 0)
        assert np.array_equal(mean_above(image, level, side), expected)


def test_the_sky_is_the_median_and_lower_quantile_of_the_border(rng):
    image = np.clip(rng.normal(90.0, 6.0, (200, 300)), 0, 255).astype(np.uint8)
    rows = np.concatenate([image[k] for k in (0, 1, 2, -1, -2, -3)])
    columns = np.concatenate([image[:, k] for k in (0, 1, 2, -1, -2, -3)])
    border = np.sort(np.concatenate([rows, columns]))

    def quantile(share: float) -> float:
        wanted = share * len(border)
        grey = border[int(wanted)]
        below = np.count_nonzero(border < grey)
        return float(grey) - 0.5 + (wanted - below) / np.count_nonzero(border == grey)

    expected = (quantile(0.5), quantile(0.5) - quantile(0.1587))
    assert sky_level(image) == pytest.approx(expected, abs=1e-9)


def test_the_roll_is_the_vertex_of_the_distances_by_whole_bins(rng):
    bins = 90
    step = 2.0 * np.pi / bins
    for _ in range(20):
        node = rng.integers(200, 800, bins).astype(np.float32)
        view = np.roll(node, rng.integers(-3, 4)) + rng.integers(-9, 10, bins).astype(np.float32)
        shifts = np.arange(-4, 5)
        distance = distances_by_shift(view, node, shifts)
        k = int(np.argmin(distance))
        shift = float(shifts[k])
        if 0 < k < len(shifts) - 1:
            before, here, after = distance[k - 1 : k + 2]
            shift += 0.5 * (before - after) / (before - 2.0 * here + after)
        roll, least = roll_and_distance(view, node, 0.0, 3.9 * step)
        assert least == pytest.approx(distance[k], rel=1e-5)
        assert roll == pytest.approx(-shift * step, abs=1e-5)
        # Of three views the first is not like it, and the last lies outside the circle.
        readings, ahead = np.array([node + 300, node, view]), np.array([0.0, 0.0, 1.0])
        directions = unit(np.array([ahead, [0.0, 0.1, 1.0], [1.0, 0.0, 0.0]]))
        best, same_roll, same_least = most_similar(
            view, readings, directions, np.stack([np.eye(3)] * 3), ahead, 0.9, np.eye(3), 3.9 * step
        )
        assert (best, same_roll, same_least) == (1, pytest.approx(roll), pytest.approx(least))


def test_best_shifts_are_those_of_least_distance_within_reach(rng):
    bins, step = 30, 2.0 * np.pi / 30
    readings = rng.integers(200, 800, (12, bins)).astype(np.float32)
    view = rng.integers(200, 800, bins).astype(np.float32)
    candidates, expected_rad = np.array([3, 7, 1, 11]), rng.uniform(-3.0, 3.0, 4)
    found, distances = Catalogue(readings).nearest(view, candidates, -expected_rad / step, 4.5)
    distances = distances + np.sum(view**2)
    for k, node in enumerate(candidates):
        shifts = int(np.rint(-expected_rad[k] / step)) + np.arange(-5, 6)
        by_shift = distances_by_shift(view, readings[node], shifts)
        assert distances[k] == pytest.approx(by_shift.min(), rel=1e-5)
        assert found[k] == shifts[np.argmin(by_shift)] % bins


def test_directions_are_spread_out_in_order(rng):
    directions = unit(rng.normal(size=(80, 3)))
    order, cosine = rng.permutation(80), np.cos(0.6)
    chosen: list[int] = []
    for k in order:
        if all(directions[k] @ directions[j] <= cosine for j in chosen) and len(chosen) < 9:
            chosen.append(int(k))
    places = spread_out(order, np.zeros(80, np.intp), directions, cosine, 1, 9)
    assert order[places].tolist() == chosen


def test_the_mean_shift_climbs_from_the_direction_with_most_votes(rng):
    directions = unit(rng.normal([0.0, 0.6, 0.8], 0.15, (9, 3)))
    trust, width = rng.uniform(0.2, 1.0, 9), 0.02
    kernel = np.exp((directions @ directions.T - 1.0) / width)
    expected = directions[np.argmax(kernel @ trust)]
    for _ in range(5):
        expected_weights = trust * np.exp((directions @ expected - 1.0) / width)
        expected = unit(expected_weights @ directions)
    weights, mean = np.empty(9), np.empty(3)
    mean_shift(directions, trust, width, weights, mean)
    np.testing.assert_allclose(mean, expected, atol=1e-12)
    np.testing.assert_allclose(weights, expected_weights, atol=1e-12)


def test_the_descent_is_a_robust_gauss_newton(rng):
    """Beside plain numpy: eight steps, Geman–McClure weights, linear interpolation of bins."""
    bins = 90
    step = 2.0 * np.pi / bins
    angle = step * np.arange(bins)
    shape = 500.0 + 80.0 * np.cos(2.0 * angle) + 40.0 * np.sin(3.0 * angle)
    surface = np.column_stack([shape, rng.normal(0.0, 300.0, (bins, 2)), np.zeros((bins, 3))])
    surface[:, 3:] = rng.normal(0.0, 100.0, (bins, 3))
    misfit = rng.uniform(1.0, 5.0, bins)
    truth = np.array([0.05, -0.03, 0.0])
    terms = np.array([1.0, 0.05, -0.03, 0.0025, -0.0015, 0.0009])
    readings = np.rint(surface @ terms + rng.normal(0.0, 2.0, bins)).astype(np.float32)

    found = np.array([0.0, 0.0, 0.02])
    expected = found.copy()
    for k in range(9):
        x, y, roll = expected
        whole = int(np.floor(-roll / step))
        here, ahead = np.roll(readings, -whole), np.roll(readings, -whole - 1)
        part = -roll / step - whole
        off = here + part * (ahead - here) - surface @ [1.0, x, y, x * x, x * y, y * y]
        if k == 8:
            break
        slopes = np.column_stack(
            [
                -(surface @ [0.0, 1.0, 0.0, 2.0 * x, y, 0.0]),
                -(surface @ [0.0, 0.0, 1.0, 0.0, x, 2.0 * y]),
                -(ahead - here) / step,
            ]
        )
        variance = (1.4826 * np.median(np.abs(off)) + 3.0) ** 2 + misfit**2
        weight = 1.0 / variance / (1.0 + off**2 / variance / 6.25) ** 2
        matrix = slopes.T @ (weight[:, None] * slopes)
        matrix[np.diag_indices(3)] = np.diag(matrix) * (1.0 + 1e-6) + 1e-9
        move = np.linalg.solve(matrix, -slopes.T @ (weight * off))
        expected = expected + move
        if np.hypot(*move[:2]) < 1e-4 and abs(move[2]) < 1e-3:
            break
    residual = descend(readings, surface, misfit, found)
    np.testing.assert_allclose(found, expected, atol=1e-9)
    assert residual == pytest.approx(np.sqrt(np.mean(off**2)), abs=1e-9)
    np.testing.assert_allclose(found, truth, atol=0.01)
