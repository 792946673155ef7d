"""Time of a segment fit beside the simplexes of scipy and nlopt."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from rendezview.geometry.pose import Array, Pose
from rendezview.trajectory import (
    FitOptions,
    FollowerOptions,
    Method,
    PathFollower,
    PointCloud,
    Segment,
    Shape,
    fit_segment,
)
from rendezview.trajectory.relative_orbit import transition
from rendezview.trajectory.shapes import code_of
from rendezview.trajectory.simplex import RESIDUALS, cost, downhill_simplex, gauss_newton

try:
    import nlopt
except ImportError:
    nlopt = None

POINTS, SPAN_S, RANGE_M, NOISE = 100, 200.0, 30.0, 0.001
MEAN_MOTION_RAD_S = 0.0011
CUT = 12.0
NEAR = 0.01


def points(shape: Shape, rng: np.random.Generator) -> tuple[Array, Array]:
    """Times and noisy places."""
    times = np.linspace(0.0, SPAN_S, POINTS)
    if shape is Shape.CIRCULAR:
        angle = times / SPAN_S
        flat = RANGE_M * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
        places = flat @ Rotation.random(random_state=rng).as_matrix().T
    else:
        first = np.array([0.0, RANGE_M, 0.0, 0.01, -0.05, 0.01])
        places = np.array([(transition(MEAN_MOTION_RAD_S, t) @ first)[:3] for t in times])
    noisy = places + NOISE * RANGE_M * rng.standard_normal(places.shape)
    far = rng.choice(POINTS, POINTS // 10, replace=False)
    noisy[far] += 0.1 * RANGE_M * rng.standard_normal((len(far), 3))
    return times, noisy


def timed(run: Callable[[], tuple[Array, int]], repeats: int) -> tuple[float, Array, int]:
    """Least milliseconds, the answer, and the evaluations."""
    spent = []
    for _ in range(repeats):
        begin = time.perf_counter()
        answer, evaluations = run()
        spent.append(1e3 * (time.perf_counter() - begin))
    return min(spent), answer, evaluations


Way = Callable[[], tuple[Array, int]]


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """One cloud, the ways to fit a segment to it, and Gauss–Newton's answer to go by."""

    ways: dict[str, Way]
    whole: Callable[[Segment | None], tuple[Array, int]]
    best: Segment
    goal: Array
    sigmas: Array

    def gap(self, answer: Array) -> float:
        """How far off Gauss–Newton's an answer is, in standard deviations."""
        return float(np.max(np.abs(answer - self.goal) / self.sigmas))


def problem(shape: Shape, seed: int) -> Problem:
    rng = np.random.default_rng(seed)
    times, places = points(shape, rng)
    cloud = PointCloud.of_places(
        times, places, np.tile((NOISE * RANGE_M) ** 2 * np.eye(3), (POINTS, 1, 1))
    )
    n = MEAN_MOTION_RAD_S
    fit_segment(cloud, shape, mean_motion_rad_s=n)  # compiles
    best = fit_segment(
        cloud, shape, mean_motion_rad_s=n, options=FitOptions(method=Method.GAUSS_NEWTON)
    )
    assert isinstance(best, Segment)
    data = (
        times - best.middle_s, best.base, best.constants, np.zeros((POINTS, 3)),
        cloud.points, cloud.whitening, cloud.by_node,
    )  # fmt: skip
    weights, code = cloud.weights, code_of(shape)
    sigmas = np.sqrt(np.diag(best.covariance))
    scales = np.maximum(np.abs(best.parameters), 0.02)
    goal, _ = gauss_newton(code, best.parameters, scales, data, weights, CUT, 20)
    start = goal + 0.02 * scales * rng.choice([-1.0, 1.0], len(scales))
    steps = 0.02 * scales
    place, out = np.empty((POINTS, 3)), np.empty((POINTS, RESIDUALS))

    def asked(p: Array, *_: object) -> float:
        return float(cost(code, p, data, weights, CUT, place, out))

    def ours() -> tuple[Array, int]:
        answer, _, count = downhill_simplex(code, start, steps, data, weights, CUT, 5000, NEAR)
        return answer, count

    def scipys() -> tuple[Array, int]:
        corners = np.vstack([start, start + np.diag(steps)])
        options = {"initial_simplex": corners, "fatol": NEAR, "xatol": np.inf}
        options |= {"adaptive": True, "maxfev": 5000}
        found = minimize(asked, start, method="Nelder-Mead", options=options)
        return found.x, found.nfev

    def nlopts() -> tuple[Array, int]:
        simplex = nlopt.opt(nlopt.LN_NELDERMEAD, len(start))
        simplex.set_min_objective(asked)
        simplex.set_ftol_abs(NEAR)
        simplex.set_maxeval(5000)
        simplex.set_initial_step(steps)
        return simplex.optimize(start), simplex.get_numevals()

    def newtons() -> tuple[Array, int]:
        answer, _ = gauss_newton(code, start, scales, data, weights, CUT, 20)
        return answer, 0

    ways: dict[str, Way] = {"simplex, ours": ours, "simplex, scipy": scipys}
    if nlopt is not None:
        ways["simplex, nlopt"] = nlopts
    ways["Gauss–Newton, ours"] = newtons

    def whole(previous: Segment | None) -> tuple[Array, int]:
        found = fit_segment(cloud, shape, mean_motion_rad_s=n, previous=previous)
        assert isinstance(found, Segment)
        return found.parameters, found.evaluations

    return Problem(ways, whole, best, goal, sigmas)


def followed(seed: int, spin: bool) -> list[float]:
    """Processor milliseconds of each frame in a follower whose window of 100 poses is full."""
    rng = np.random.default_rng(seed)
    options = FollowerOptions(turn_rad=None, segment_s=SPAN_S, spin=spin)
    follower = PathFollower(np.zeros(3), Shape.CIRCULAR, options=options)
    covariance = np.diag([1e-6] * 3 + [(NOISE * RANGE_M) ** 2] * 3)
    spent = []
    for time_s in np.arange(0.0, 2.0 * SPAN_S, SPAN_S / POINTS):
        turn = Rotation.from_rotvec([0.0, -time_s / SPAN_S, 0.0])
        noise = Rotation.from_rotvec(1e-3 * rng.standard_normal(3))
        pose = Pose((noise * turn).as_matrix(), np.array([0.0, 0.0, RANGE_M]))
        begin = time.process_time()
        report = follower.update(float(time_s), pose, covariance)
        spent.append(1e3 * (time.process_time() - begin))
    assert isinstance(report.segment, Segment)
    return spent[POINTS:]


def run(*, repeats: int = 30, seed: int = 0) -> None:
    """Time of a segment fit beside the simplexes of scipy and nlopt.

    100 points of a circle of 1 rad (0.1 % noise, a tenth of them outliers) and of a free relative
    orbit. All simplexes have the same start (the truth, off by 2 %), compiled cost and tolerance.
    Printed: the best of the repeats, and the distance of each answer from Gauss–Newton's in
    standard deviations. For the orbit, Gauss–Newton is the robust linear least-squares answer.
    """
    print("| segment | way | ms | evaluations | off Gauss–Newton, σ |")
    print("|---|---|---|---|---|")
    for shape in (Shape.CIRCULAR, Shape.ORBIT):
        fit = problem(shape, seed)
        for name, run in fit.ways.items():
            run()
            spent, answer, count = timed(run, repeats)
            gap = fit.gap(answer)
            print(f"| {shape} | {name} | {spent:.2f} | {count or '–'} | {gap:.2f} |")
        for name, previous in (
            ("whole fit, cold", None),
            ("whole fit, from the last one", fit.best),
        ):
            spent, _, count = timed(partial(fit.whole, previous), repeats)
            print(f"| {shape} | {name} | {spent:.2f} | {count} | |")
    for spin, words in ((False, "segment"), (True, "segment and spin")):
        spent = followed(seed, spin)
        print(
            f"each frame in a follower, {words}: median {np.median(spent):.2f} ms, "
            f"least {min(spent):.2f}"
        )
