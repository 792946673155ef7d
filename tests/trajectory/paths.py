"""Clouds of known paths."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from rendezview.geometry.pose import Array
from rendezview.trajectory import PointCloud

RANGE_M = 30.0
SPAN_S = 200.0
TIMES = np.linspace(0.0, SPAN_S, 101)


def circle(rng: np.random.Generator, climb_m_s: float = 0.0) -> tuple[Array, Array, Array]:
    """Turn (3, 3), places over the first radian (101, 3) and over the second."""
    turn = Rotation.random(random_state=rng).as_matrix()

    def places(times: Array) -> Array:
        angle = times / SPAN_S
        flat = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
        return ((RANGE_M + climb_m_s * times)[:, None] * flat) @ turn.T

    return turn, places(TIMES), places(TIMES + SPAN_S)


def refined(places: Array, rng: np.random.Generator, sigma_m: float = 0.03) -> PointCloud:
    """Places with noise, as refined poses give them."""
    noisy = places + sigma_m * rng.standard_normal(places.shape)
    spread = np.tile(sigma_m**2 * np.eye(3), (len(places), 1, 1))
    return PointCloud.of_places(TIMES[: len(places)], noisy, spread)


def nodes(places: Array, rng: np.random.Generator, each: int = 5) -> PointCloud:
    """On nodes scattered by 6° an axis, one in twenty anywhere, ranges to 2 %."""
    far = np.linalg.norm(places, axis=1).repeat(each)
    directions = (places / np.linalg.norm(places, axis=1)[:, None]).repeat(each, axis=0)
    directions = directions + 0.1 * rng.standard_normal(directions.shape)
    lost = rng.uniform(size=len(directions)) < 0.05
    directions[lost] = rng.standard_normal((int(lost.sum()), 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    points = directions * (far * (1.0 + 0.02 * rng.standard_normal(len(far))))[:, None]
    return PointCloud.of_nodes(TIMES[: len(places)].repeat(each), points)


def off(found: Array, truth: Array) -> float:
    """Median distance over the range."""
    return float(np.median(np.linalg.norm(found - truth, axis=1) / np.linalg.norm(truth, axis=1)))
