"""The robust cost of a segment and its minimum against plain numpy and scipy."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from rendezview.geometry.pose import Array
from rendezview.trajectory.descent import Descent
from rendezview.trajectory.misfits import cost, jacobian, normal_equations, residuals
from rendezview.trajectory.relative_orbit import response
from rendezview.trajectory.shapes import CIRCULAR, DRIFT, HOPS, LINE, SPIRAL, places
from rendezview.trajectory.start import _scan_hops

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
    return Descent(LINE, TRUTH + 0.3 * SCALES, SCALES, data, weights).down(cut, 50)


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


def line_data(nodes: bool) -> tuple:
    points, whitening, by_node = cloud(np.random.default_rng(5), nodes)
    still = np.zeros((COUNT, 3))
    return (TIMES, np.eye(3), np.zeros(2), still, points, whitening, by_node)


@pytest.mark.parametrize("nodes", [False, True])
def test_residuals_their_slopes_and_the_normal_equations_are_those_of_numpy(nodes: bool):
    data = line_data(nodes)
    place, out = np.empty((COUNT, 3)), np.empty((COUNT, 4))
    residuals(LINE, TRUTH, data, place, out)
    points, whitening, by_node = data[4:]
    assert np.allclose((out**2).sum(axis=1), squares(TRUTH, points, whitening, by_node))
    slopes = jacobian(LINE, TRUTH, SCALES, data, place, out.copy())
    sizes = 1e-3 * SCALES

    def at(p: Array) -> Array:
        made = np.empty((COUNT, 4))
        residuals(LINE, p, data, place, made)
        return made

    numeric = np.stack(
        [(at(TRUTH + d) - at(TRUTH - d)) / (2.0 * h)
         for d, h in zip(np.diag(sizes), sizes, strict=True)], axis=2
    )  # fmt: skip
    assert np.allclose(slopes, numeric, rtol=1e-4, atol=1e-4 * np.abs(numeric).max())
    cut, weights = 12.0, np.random.default_rng(6).uniform(0.5, 2.0, COUNT)
    q = (out**2).sum(axis=1)
    weight = weights / (1.0 + q / cut) ** 2
    whole = cost(LINE, TRUTH, data, weights, cut, place, out.copy())
    assert whole == pytest.approx(np.sum(weights * q / (1.0 + q / cut)))
    matrix, right = normal_equations(LINE, TRUTH, SCALES, data, weights, cut)
    assert np.allclose(matrix, np.einsum("n,nia,nib->ab", weight, slopes, slopes))
    assert np.allclose(right, -np.einsum("n,nia,ni->a", weight, slopes, out))


@pytest.mark.parametrize("mean_motion_rad_s", [0.0, 1e-5, 0.0011, 0.02])
def test_free_motion_is_that_of_the_integrated_equations(mean_motion_rad_s: float):
    """Clohessy and Wiltshire (1960): x outwards, y along the orbit, z across; a constant push."""
    n, t = mean_motion_rad_s, 120.0
    position, velocity, pushed = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    response(n, t, position, velocity, pushed)
    rng = np.random.default_rng(7)
    place, speed, push = 30.0 * rng.standard_normal((3, 3)) * [[1.0], [1e-3], [1e-5]]

    def change(_: float, state: Array) -> Array:
        x, _y, z, vx, vy, vz = state
        force = [3.0 * n * n * x + 2.0 * n * vy, -2.0 * n * vx, -n * n * z]
        return np.concatenate([[vx, vy, vz], force + push])

    flown = solve_ivp(change, (0.0, t), [*place, *speed], rtol=1e-11, atol=1e-11).y[:3, -1]
    assert position @ place + velocity @ speed + pushed @ push == pytest.approx(flown, abs=1e-7)


def test_places_of_each_shape_are_those_of_its_formula():
    rng = np.random.default_rng(8)
    times, base = np.array([-50.0, -50.0, -10.0, 0.0, 30.0]), Rotation.random(random_state=rng)
    constants, out = np.array([0.0011, 2e-3]), np.empty((5, 3))

    def made(code: int, p: list[float]) -> Array:
        places(code, np.array(p), times, base.as_matrix(), constants, out)
        return out.copy()

    tilt, t = [0.1, -0.2, 0.3], times[:, None]
    frame = base.as_matrix() @ Rotation.from_rotvec(tilt).as_matrix()
    circle = np.cos(0.02 * t) * frame[:, 0] + np.sin(0.02 * t) * frame[:, 1]
    assert np.allclose(made(CIRCULAR, [*tilt, 30.0, 0.02]), 30.0 * circle)
    assert np.allclose(made(SPIRAL, [*tilt, 30.0, 0.02, -0.05]), (30.0 - 0.05 * t) * circle)
    first, speed, up = rng.standard_normal((3, 3))
    high = (1.0 - 2e-3 * t) * np.abs(np.sin(np.pi * (t - 7.0) / 40.0))
    hops = made(HOPS, [*first, *speed, *up, 40.0, 7.0])
    assert np.allclose(hops, first + speed * t + up * high)
    rows = []
    for at in times:
        parts = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
        response(0.0011, at, *parts)
        rows.append(parts[0] @ first + parts[1] @ speed + parts[2] @ up)
    assert np.allclose(made(DRIFT, [*first, *speed, *up]), rows)


@pytest.mark.parametrize("seed", range(3))
def test_a_line_with_hops_starts_from_robust_least_squares(seed: int):
    rng = np.random.default_rng(seed)
    times, closing, periods = np.sort(rng.uniform(-50.0, 50.0, 25)), 1e-3, np.array([30.0, 45.0])
    height = abs(np.sin(np.pi * (times - 15.0) / 45.0))
    places = np.outer(times, [0.1, 0.0, 0.02]) + np.outer(height, [0.0, 2.0, 1.0])
    places += rng.normal(scale=0.05, size=(25, 3))
    places[::6] += 3.0
    weights, best = rng.uniform(0.5, 2.0, 25), (np.inf, np.empty(11))
    for period in periods:
        for phase in period * np.arange(6) / 6:
            hop = (1.0 - closing * times) * abs(np.sin(np.pi * (times - phase) / period))
            rows, own = np.stack([np.ones(25), times, hop], axis=1), weights
            for _ in range(3):
                root = np.sqrt(own)[:, None]
                answer = np.linalg.lstsq(root * rows, root * places)[0]
                square = np.sum((places - rows @ answer) ** 2, axis=1)
                own = weights / (1.0 + square / (5.0 * np.median(square))) ** 2
            found = np.array([*answer.ravel(), period, phase])
            best = min(best, (np.median(square), found), key=lambda one: one[0])
    ours = _scan_hops(times, places, weights, closing, periods, 6, 2)
    np.testing.assert_allclose(ours, best[1], rtol=1e-6, atol=1e-6)
    # Hops that have no answer leave the others.
    beside = _scan_hops(times, places, weights, closing, np.append(np.nan, periods), 6, 2)
    np.testing.assert_array_equal(beside, ours)
