"""Gauss–Newton against scipy's least squares on the same robust cost, by plain numpy."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from rendezview.geometry.pose import Array
from rendezview.trajectory.shapes import LINE
from rendezview.trajectory.simplex import gauss_newton

COUNT = 60
TIMES = np.linspace(-100.0, 100.0, COUNT)
TRUTH = np.array([2.0, 50.0, -1.0, 0.01, -0.05, 0.02])  # place m, velocity m/s
SCALES = np.array([1.0, 1.0, 1.0, 0.01, 0.01, 0.01])


def squares(p: Array, points: Array, whitening: Array, by_node: Array) -> Array:
    """(N,) squared misfits in variances of a straight line."""
    place = p[:3] + TIMES[:, None] * p[3:]
    far = np.linalg.norm(place, axis=1)
    across = whitening[:, 0, 0, None] * (place / far[:, None] - points)
    along = whitening[:, 1, 1] * (far - whitening[:, 2, 2])
    node = (across**2).sum(axis=1) + along**2
    pose = (np.einsum("nij,nj->ni", whitening, place - points) ** 2).sum(axis=1)
    return np.where(by_node, node, pose)


def cloud(rng: np.random.Generator, nodes: bool) -> tuple[Array, Array, Array]:
    """Points with noise and outliers, whitening, and which are nodes."""
    points = TRUTH[:3] + TIMES[:, None] * TRUTH[3:] + rng.normal(0.0, 0.1, (COUNT, 3))
    points[::7] += 4.0
    whitening = np.tile(np.linalg.cholesky(np.diag([90.0, 60.0, 120.0]) + 20.0), (COUNT, 1, 1))
    by_node = np.zeros(COUNT, bool)
    if nodes:
        by_node[1::2] = True
        far = np.linalg.norm(points[by_node], axis=1)
        points[by_node] /= far[:, None]
        whitening[by_node] = 0.0
        whitening[by_node, 0, 0] = 1.0 / 0.002
        whitening[by_node, 1, 1], whitening[by_node, 2, 2] = 1.0 / (0.01 * far), far
    return points, whitening, by_node


def run(points: Array, whitening: Array, by_node: Array, weights: Array, cut: float):
    data = (TIMES, np.eye(3), np.zeros(2), np.zeros((COUNT, 3)), points, whitening, by_node)
    return gauss_newton(LINE, TRUTH + 0.3 * SCALES, SCALES, data, weights, cut, 50)


@pytest.mark.parametrize("nodes", [False, True])
@pytest.mark.parametrize("cut", [9.0, np.inf])
def test_gauss_newton_ends_where_scipys_least_squares_ends(nodes: bool, cut: float):
    rng = np.random.default_rng(1)
    points, whitening, by_node = cloud(rng, nodes)
    weights = rng.uniform(0.2, 1.0, COUNT)

    def roots(p: Array) -> Array:
        q = squares(p, points, whitening, by_node)
        return np.sqrt(weights * q / (1.0 + q / cut))  # their squares sum to the robust cost

    p, reached = run(points, whitening, by_node, weights, cut)
    assert reached == pytest.approx((roots(p) ** 2).sum(), rel=1e-12)
    twin = least_squares(roots, TRUTH, x_scale=SCALES, xtol=1e-14, ftol=1e-14, gtol=1e-14)
    assert reached == pytest.approx(2.0 * twin.cost, abs=1e-4)  # it ends at a gain of so much
    off = (p - twin.x) @ (twin.jac.T @ twin.jac) @ (p - twin.x)
    assert off < 1e-3  # squared, in variances


def test_without_outlier_weights_the_straight_line_is_that_of_linear_least_squares():
    rng = np.random.default_rng(2)
    points, whitening, by_node = cloud(rng, nodes=False)
    weights = rng.uniform(0.2, 1.0, COUNT)
    p, _ = run(points, whitening, by_node, weights, np.inf)
    root = np.sqrt(weights)[:, None, None] * whitening
    matrix = np.concatenate([root, root * TIMES[:, None, None]], axis=2).reshape(-1, 6)
    right = np.einsum("nij,nj->ni", root, points).ravel()
    np.testing.assert_allclose(p, np.linalg.lstsq(matrix, right, rcond=None)[0], atol=1e-9)
