"""Segments fitted to clouds of known paths."""

from dataclasses import replace

import numpy as np
import pytest
from tests.trajectory.closed_loop import push
from tests.trajectory.paths import RANGE_M, SPAN_S, TIMES, circle, nodes, off, refined

from rendezview.geometry.pose import Pose
from rendezview.trajectory import (
    FitOptions,
    Method,
    NoFit,
    PointCloud,
    Segment,
    Shape,
    camera_place,
    centre_place,
    fit_segment,
)
from rendezview.trajectory.relative_orbit import transition
from rendezview.trajectory.scaling import held, inverse_of, robust_root

N = 0.0011


def fitted(cloud, shape, **how) -> Segment:
    segment = fit_segment(cloud, shape, **how)
    assert isinstance(segment, Segment), segment
    return segment


@pytest.mark.parametrize(("shape", "climb"), [(Shape.CIRCULAR, 0.0), (Shape.SPIRAL, -0.03)])
def test_circle_and_spiral_are_found_and_go_on(shape, climb):
    rng = np.random.default_rng(2)
    turn, first, second = circle(rng, climb)
    segment = fitted(refined(first, rng), shape)
    assert off(segment.places(TIMES), first) < 5e-4
    assert off(segment.places(TIMES + SPAN_S), second) < 2e-3
    assert segment.rate_rad_s == pytest.approx(1.0 / SPAN_S, rel=2e-3)
    assert segment.frame[:, 2] @ turn[:, 2] > np.cos(2e-3)


@pytest.mark.requirement("RV-PATH-1")
def test_cloud_of_on_nodes_with_outliers_gives_the_segment():
    rng = np.random.default_rng(3)
    _, first, _ = circle(rng)
    segment = fitted(nodes(first, rng), Shape.CIRCULAR)
    assert off(segment.places(TIMES), first) < 0.01


def test_hops_are_found_where_there_are_some_and_only_there():
    rng = np.random.default_rng(4)
    distance = 50.0 - 0.05 * TIMES
    flat = np.stack([0 * TIMES, distance, 0 * TIMES], axis=1)
    high = 0.03 * distance * np.abs(np.sin(np.pi * (TIMES - 20.0) / 67.0))
    hopping = flat + np.stack([high, 0 * high, 0 * high], axis=1)
    segment = fitted(refined(hopping, rng), Shape.VBAR)
    assert off(segment.places(TIMES), hopping) < 5e-4
    assert segment.described()["hop_period_s"] == pytest.approx(67.0, rel=0.02)
    straight = fitted(refined(flat, rng), Shape.VBAR)
    assert "hop_period_s" not in straight.described()
    assert off(straight.places(TIMES + SPAN_S), flat - [0.0, 10.0, 0.0]) < 1e-3


@pytest.mark.parametrize("shape", [Shape.ORBIT, Shape.DRIFT])
def test_relative_orbit_is_the_linear_answer(shape):
    rng = np.random.default_rng(5)
    state = np.array([5.0, 40.0, -3.0, 0.01, -0.05, 0.02])
    pushed = np.array([0.0, -2e-5, 0.0]) if shape is Shape.DRIFT else np.zeros(3)
    truth = np.array([(transition(N, t) @ state + push(N, t, pushed))[:3] for t in TIMES])
    cloud = refined(truth, rng)
    segment = fitted(cloud, shape, mean_motion_rad_s=N)
    assert off(segment.places(TIMES), truth) < 3e-4
    # Plain least squares of the same cloud, by numpy.
    columns = []
    for t in TIMES:
        from_middle = t - segment.middle_s
        row = [transition(N, from_middle)[:3]]
        if shape is Shape.DRIFT:
            row.append(np.stack([push(N, from_middle, axis)[:3] for axis in np.eye(3)], axis=1))
        columns.append(np.hstack(row))
    linear = np.linalg.lstsq(np.concatenate(columns), cloud.places_m.ravel(), rcond=None)[0]
    sigmas = np.sqrt(np.diag(segment.covariance))
    assert np.all(np.abs(segment.parameters - linear) < sigmas)


@pytest.mark.parametrize("seed", [7, 12, 27])
def test_a_braking_approach_has_a_covariance_though_its_hop_has_no_period(seed):
    rng, times = np.random.default_rng(seed), np.linspace(0.0, 165.0, 25)
    places = np.stack([-60.0 + 0.4 * times - 6e-4 * times**2, 0 * times + 3, 0 * times + 2], axis=1)
    noisy = places + 0.05 * rng.standard_normal(places.shape)
    cloud = PointCloud.of_places(times, noisy, np.tile(0.05**2 * np.eye(3), (25, 1, 1)))
    segment = fitted(cloud, Shape.VBAR)
    assert segment.described()["hop_period_s"] > 100.0 * times[-1]  # it is a parabola
    assert (np.diag(segment.covariance) > 0.0).all()
    for after_s in (0.0, 165.0):
        values = np.linalg.eigvalsh(segment.state_covariance(times[-1] + after_s))
        assert values[0] > -1e-12 * values[-1]
        assert values[-1] < 1.0  # m², and of the velocity


def test_a_root_is_that_of_the_sandwich_and_says_what_is_unknown():
    rng, size = np.random.default_rng(3), 4
    slopes, out = rng.normal(size=(30, 3, size)), rng.normal(size=(30, 3))
    times, first, scales = np.linspace(-1.0, 1.0, 30), np.arange(30), np.array([1.0, 1e3, 1e-3, 1])
    slopes /= scales
    matrix = np.einsum("nka,nkb->ab", slopes, slopes)
    nothing = np.zeros(30)

    def covariance(matrix, slopes):
        inverse, prior = inverse_of(matrix, scales), held(matrix, scales)
        root = robust_root(inverse, slopes, out, first, times, nothing, prior)
        return root @ root.T

    scores = np.einsum("nkp,nk->np", slopes, out)
    bread = np.linalg.inv(matrix)
    alike = max(np.sum(out[1:] * out[:-1]) / np.sum(out**2), 0.0)
    plain = bread @ scores.T @ scores @ bread * 30 / (30 - size) * (1 + alike) / (1 - alike)
    assert covariance(matrix, slopes) / plain == pytest.approx(1.0, rel=1e-6)
    slopes[:, :, 3] = slopes[:, :, 0]  # only the sum of the two shows
    found = covariance(np.einsum("nka,nkb->ab", slopes, slopes), slopes)
    both = np.array([1.0, 0.0, 0.0, 1.0])
    assert (np.diag(found)[[0, 3]] > 1e6).all()
    assert 0.0 <= both @ found @ both < 0.1


def test_covariance_of_the_place_covers_errors_that_all_frames_share():
    squares = []
    for seed in range(40):
        rng = np.random.default_rng([8, seed])
        _, first, _ = circle(rng)
        common = 0.024 * rng.standard_normal(3)
        segment = fitted(refined(first + common, rng), Shape.CIRCULAR)
        miss = segment.places([100.0])[0] - first[50]
        squares.append(miss @ np.linalg.solve(segment.place_covariance(100.0), miss))
    assert 1.0 < np.mean(squares) < 6.0


@pytest.mark.parametrize("shape", [Shape.CIRCULAR, Shape.SPIRAL, Shape.DRIFT])
def test_covariance_of_the_state_is_that_of_fits_drawn_from_the_parameters(shape):
    rng = np.random.default_rng(12)
    segment = fitted(refined(circle(rng)[1], rng), shape, mean_motion_rad_s=N)
    root = np.linalg.cholesky(segment.covariance + 1e-30 * np.eye(len(segment.parameters)))
    drawn = []
    for _ in range(2000):
        turned = segment.parameters + root @ rng.standard_normal(len(segment.parameters))
        other = replace(segment, parameters=turned)
        drawn.append([*other.places(70.0)[0], *other.velocity(70.0)])
    expected = segment.state_covariance(70.0)
    sigmas = np.sqrt(np.diag(expected))
    scatter = np.cov(np.transpose(drawn)) / np.outer(sigmas, sigmas)
    np.testing.assert_allclose(scatter, expected / np.outer(sigmas, sigmas), atol=0.12)
    np.testing.assert_allclose(expected[:3, :3], segment.place_covariance(70.0), rtol=1e-9)


def test_a_carrier_takes_the_forced_part_of_a_path():
    rng = np.random.default_rng(9)
    _, first, _ = circle(rng)
    drift = np.array([(transition(N, t) @ [0.2, -0.1, 0.1, 0.001, 0.002, 0.0])[:3] for t in TIMES])

    def carrier(times):
        return np.array([np.interp(times, TIMES, column) for column in first.T]).T

    cloud = refined(first + drift, rng)
    segment = fitted(cloud, Shape.ORBIT, mean_motion_rad_s=N, carrier=carrier)
    assert off(segment.places(TIMES), first + drift) < 4e-4


def test_camera_place_has_the_covariance_of_perturbed_poses():
    rng = np.random.default_rng(10)
    pose = Pose.from_quat_wxyz(rng.standard_normal(4), [0.5, -1.0, 30.0])
    centre = np.array([0.3, 1.0, -2.0])
    root = 1e-3 * rng.standard_normal((6, 6))
    covariance = root @ root.T
    steps = rng.multivariate_normal(np.zeros(6), covariance, size=4000)
    for function, axes in ((camera_place, None), (centre_place, "camera")):
        _, found = function(pose, covariance, centre)
        moved = []
        for step in steps:
            other = pose.perturbed(step)
            place = other.inverse().translation_m - centre
            moved.append(place if axes is None else other.rotation @ place)
        np.testing.assert_allclose(np.cov(np.array(moved).T), found, atol=0.08 * np.trace(found))


def cloud_of(times, places) -> PointCloud:
    return PointCloud.of_places(times, places)


@pytest.mark.parametrize("shape", list(Shape))
@pytest.mark.parametrize(
    ("cloud", "words"),
    [
        (cloud_of(TIMES[:3], np.eye(3) * 30.0), "3 frames"),
        (PointCloud.empty(), "0 frames"),
        (cloud_of(TIMES, np.tile([30.0, 0.0, 0.0], (101, 1))), "one"),
        (cloud_of(TIMES, np.full((101, 3), np.nan)), "not finite"),
        (cloud_of(np.where(TIMES > 90, np.nan, TIMES), np.ones((101, 3))), "time"),
        (cloud_of(TIMES[::-1], circle(np.random.default_rng(1))[1]), "do not rise"),
        (PointCloud.of_nodes(TIMES, np.zeros((101, 3))), "not finite"),
    ],
)
def test_nonsense_gets_a_reason_and_no_curve(shape, cloud, words):
    found = fit_segment(cloud, shape)
    assert isinstance(found, NoFit)
    assert not found
    assert words in found.reason


def test_scattered_points_turn_about_nothing():
    rng = np.random.default_rng(11)
    cloud = cloud_of(TIMES, RANGE_M * np.array([1.0, 0, 0]) + rng.standard_normal((101, 3)))
    found = fit_segment(cloud, Shape.CIRCULAR)
    assert isinstance(found, NoFit)
    assert "no turn" in found.reason


def cluttered(
    places: np.ndarray, rng: np.random.Generator, share: float, each: int = 5
) -> PointCloud:
    """Every fifth place with noise; a share of them a tenth of the range off."""
    times, some = TIMES[::each], places[::each]
    some = some + 0.03 * rng.standard_normal(some.shape)
    far = rng.choice(len(some), round(share * len(some)), replace=False)
    some[far] += 0.1 * RANGE_M * rng.standard_normal((len(far), 3))
    return PointCloud.of_places(times, some, np.tile(0.03**2 * np.eye(3), (len(some), 1, 1)))


@pytest.mark.parametrize("method", list(Method))
def test_each_method_finds_a_circle_among_outliers(method):
    for seed in range(5):
        rng = np.random.default_rng([12, seed])
        _, first, _ = circle(rng)
        cloud = cluttered(first, rng, 0.3)
        segment = fitted(cloud, Shape.CIRCULAR, options=FitOptions(method=method))
        assert off(segment.places(TIMES), first) < 3e-3
        assert segment.evaluations > 0 or method is not Method.SIMPLEX


def test_gauss_newton_alone_is_the_default_on_a_clean_circle():
    rng = np.random.default_rng(12)
    _, first, _ = circle(rng)
    found = fitted(refined(first, rng), Shape.CIRCULAR)
    assert found.evaluations == 0
    assert found.gap_sigma < 0.3
    few = [cluttered(first, rng, 0.0, each=8) for _ in range(12)]  # 13 frames
    asked = [fitted(cloud, Shape.CIRCULAR).evaluations > 0 for cloud in few]
    assert sum(asked) <= 4  # a point may seem to be off


def test_points_that_are_off_alike_do_not_draw_the_default_away():
    """Gauss–Newton may end between two groups, where nothing is off by many σ of the scatter."""
    failed = {Method.GAUSS_NEWTON: 0, Method.BEST: 0}
    for seed in range(12):
        rng = np.random.default_rng([14, seed])
        _, first, _ = circle(rng, -0.03)
        cloud = cluttered(first, rng, 0.0, each=3)
        moved = cloud.places_m.copy()
        moved[rng.permutation(len(cloud))[: round(0.4 * len(cloud))]] += (
            0.5 * RANGE_M * rng.normal(size=3)
        )
        spread = np.tile(0.03**2 * np.eye(3), (len(cloud), 1, 1))
        cloud = PointCloud.of_places(cloud.times_s, moved, spread)
        for method in failed:
            segment = fit_segment(cloud, Shape.SPIRAL, options=FitOptions(method=method))
            good = isinstance(segment, Segment) and off(segment.places(TIMES), first) < 3e-3
            failed[method] += not good
    assert failed[Method.GAUSS_NEWTON] >= 4
    assert failed[Method.BEST] == 0  # 4 without a limit of the scatter


def test_simplex_finds_hops_that_gauss_newton_misses():
    errors: dict[Method, list[float]] = {m: [] for m in (Method.GAUSS_NEWTON, Method.BEST)}
    for seed in range(6):
        rng = np.random.default_rng([13, seed])
        distance = 50.0 - 0.05 * TIMES
        flat = np.stack([0 * TIMES, distance, 0 * TIMES], axis=1)
        high = 0.03 * distance * np.abs(np.sin(np.pi * (TIMES - 20.0) / 67.0))
        hopping = flat + np.stack([high, 0 * high, 0 * high], axis=1)
        cloud = cluttered(hopping, rng, 0.2, each=2)
        for method, some in errors.items():
            segment = fitted(cloud, Shape.VBAR, options=FitOptions(method=method))
            some.append(off(segment.places(TIMES), hopping))
    assert np.median(errors[Method.BEST]) < 1e-3
    assert np.median(errors[Method.BEST]) < 0.5 * np.median(errors[Method.GAUSS_NEWTON])
