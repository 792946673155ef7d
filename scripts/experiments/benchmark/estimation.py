"""Rows of the benchmark: steps of the filter, and fits of segments."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from experiments.benchmark.check import Bench, Row, Way, times
from experiments.frame import CLIENT
from rendezview import BeamSurface, Fusion, Pose, RangeMeasurement, Target
from rendezview.estimation.p3p import solve_p3p_batch
from rendezview.fusion import Measurement, PoseMeasurement, RingCandidate, RingMeasurement
from rendezview.geometry.pose import Array
from rendezview.trajectory import FitOptions, Method, PointCloud, Segment, Shape, fit_segment
from rendezview.trajectory.descent import NEAR, SIDES, Descent
from rendezview.trajectory.relative_orbit import transition
from rendezview.trajectory.shapes import CODES

STEPS = 101  # of each kind
POINTS, SPAN_S, RANGE_M, NOISE = 100, 200.0, 30.0, 0.001
MEAN_MOTION_RAD_S = 0.0011
MOST = 5000  # evaluations


def measurements() -> dict[str, list[Measurement]]:
    """Good measurements of a target at rest, of each kind, 10 a second."""
    rng = np.random.default_rng(0)
    ring = Target.load(CLIENT).docking_ring
    assert ring is not None
    rotation = Rotation.from_rotvec([0.0, -0.5 * np.pi, 0.0]).as_matrix()
    truth = Pose(rotation, np.array([0.1, -0.2, 12.0]))
    sigma = np.array([2e-3, 2e-3, 1e-3, 5e-3, 5e-3, 2e-2])
    surface = BeamSurface(ring.centre_m, ring.axis)
    normal = rotation @ ring.axis
    distance = float(normal @ truth.apply(ring.centre_m)) / float(normal[2])
    found: dict[str, list[Measurement]] = {"pose": [], "ring": [], "range": []}
    for k in range(STEPS):
        t = 0.1 * k
        noisy = truth.perturbed(sigma * rng.standard_normal(6))
        found["pose"].append(PoseMeasurement(t, "camera", noisy, np.diag(sigma**2)))
        centre = truth.apply(ring.centre_m) + 5e-3 * rng.standard_normal(3)
        axis = normal + 5e-3 * rng.standard_normal(3)
        flat = 5e-3**2 * (np.eye(3) - np.outer(normal, normal))
        covariance = np.block([[5e-3**2 * np.eye(3), np.zeros((3, 3))], [np.zeros((3, 3)), flat]])
        both = (axis, axis + np.array([0.02, 0.0, 0.0]))
        candidates = tuple(RingCandidate(centre, a / np.linalg.norm(a), covariance) for a in both)
        found["ring"].append(RingMeasurement(t, "ring", candidates, ring))
        echo = distance + 0.02 * rng.standard_normal()
        found["range"].append(RangeMeasurement(t, "laser", echo, 0.02, (surface,)))
    return found


def plain_numpy() -> None:
    """100 steps of a 12-state Kalman filter: no gate, no attitude, no biases."""
    step, noise = np.eye(12), 1e-6 * np.eye(12)
    step[:6, 6:] = 0.1 * np.eye(6)
    design = np.hstack([np.eye(6), np.zeros((6, 6))])
    white, value, identity = 1e-4 * np.eye(6), 1e-3 * np.ones(6), np.eye(12)
    for _ in range(100):
        state, covariance = np.zeros(12), np.eye(12)
        state = step @ state
        covariance = step @ covariance @ step.T + noise
        across = covariance @ design.T
        gain = np.linalg.solve(design @ across + white, across.T).T
        state = state + gain @ (value - design @ state)
        covariance = (identity - gain @ design) @ covariance


def fusion(bench: Bench) -> Iterator[Row]:
    """One step of the filter beside one of 12 states in plain numpy."""
    kinds, numpy = measurements(), "plain numpy, 12 states, no gate"

    def added(kind: str) -> Way:
        def add() -> None:
            state = Fusion()  # all three have reported: the state has its full size
            for each in kinds.values():
                state.add(each[0])
            for measurement in kinds[kind][1:]:
                state.add(measurement)

        return Way(add, STEPS + 2)

    ways = {f"fusion, {kind}": added(kind) for kind in kinds}
    spent = bench.race(ways | {numpy: Way(plain_numpy, 100)})
    yield from times("fusion-approach", spent, dict.fromkeys(ways, (numpy,)))


def cloud_of(shape: Shape) -> tuple[PointCloud, np.random.Generator]:
    """A circle of 1 rad, or a free relative orbit: 0.1 % noise, a tenth of them outliers."""
    rng = np.random.default_rng(0)
    times_s = np.linspace(0.0, SPAN_S, POINTS)
    if shape is Shape.CIRCULAR:
        angle = times_s / SPAN_S
        flat = RANGE_M * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
        places = flat @ Rotation.random(random_state=rng).as_matrix().T
    else:
        first = np.array([0.0, RANGE_M, 0.0, 0.01, -0.05, 0.01])
        places = np.array([(transition(MEAN_MOTION_RAD_S, t) @ first)[:3] for t in times_s])
    noisy = places + NOISE * RANGE_M * rng.standard_normal(places.shape)
    far = rng.choice(POINTS, POINTS // 10, replace=False)
    noisy[far] += 0.1 * RANGE_M * rng.standard_normal((len(far), 3))
    spread = np.tile((NOISE * RANGE_M) ** 2 * np.eye(3), (POINTS, 1, 1))
    return PointCloud.of_places(times_s, noisy, spread), rng


def ways_of(shape: Shape) -> dict[str, Callable[[], object]]:
    """Ways down with the same start (the answer, off by 2 %), compiled cost and tolerance."""
    cloud, rng = cloud_of(shape)
    n = MEAN_MOTION_RAD_S
    newton = FitOptions(method=Method.GAUSS_NEWTON)
    best = fit_segment(cloud, shape, mean_motion_rad_s=n, options=newton)
    assert isinstance(best, Segment)
    data = (
        cloud.times_s - best.middle_s, best.base, best.constants, np.zeros((POINTS, 3)),
        cloud.points, cloud.whitening, cloud.by_node,
    )  # fmt: skip
    scales = np.maximum(np.abs(best.parameters), 0.02)
    goal = Descent(CODES[shape], best.parameters, scales, data, cloud.weights)
    off = SIDES * scales * rng.choice([-1.0, 1.0], len(scales))
    start = replace(goal, parameters=goal.down(steps=20)[0] + off)
    ways: dict[str, Callable[[], object]] = {
        "simplex": start.by_simplex,
        "Gauss–Newton": lambda: start.down(steps=20),
    }
    if importlib.util.find_spec("nlopt") is not None:
        import nlopt

        def by_nlopt() -> object:
            asked, simplex = start.cost_at(), nlopt.opt(nlopt.LN_NELDERMEAD, len(scales))
            simplex.set_min_objective(lambda p, _: asked(p))
            simplex.set_ftol_abs(NEAR)
            simplex.set_maxeval(MOST)
            simplex.set_initial_step(SIDES * scales)
            return simplex.optimize(start.parameters)

        ways["simplex, nlopt"] = by_nlopt
    return ways


def segments(bench: Bench) -> Iterator[Row]:
    """Fits of segments: the simplex beside nlopt's, Gauss–Newton beside it; one cost."""
    for shape in (Shape.CIRCULAR, Shape.ORBIT):
        spent = bench.race({f"{shape}: {name}": way for name, way in ways_of(shape).items()})
        simplex, newton = f"{shape}: simplex", f"{shape}: Gauss–Newton"
        peers = tuple(name for name in spent if name not in (simplex, newton))
        yield from times("trajectory-accuracy", spent, {simplex: peers, newton: (simplex,)})


SEED, ONE_BY_ONE = 11, 50  # problems that are solved a call each


def problems(count: int) -> tuple[Array, Array]:
    """Rays (z = 1) and points (N, 3, 3) of any triangles at any attitude, 2.5 to 100 m away."""
    rng = np.random.default_rng(SEED)
    points = rng.uniform(-1.0, 1.0, (count, 3, 3))
    far = 10.0 ** rng.uniform(np.log10(2.5), 2.0, (count, 1))
    places = far * np.column_stack([rng.uniform(-0.3, 0.3, (count, 2)), np.ones(count)])
    turned = np.einsum("nij,nkj->nki", Rotation.random(count, rng=rng).as_matrix(), points)
    seen = turned + places[:, None]
    return seen / seen[..., 2:], points


def solvers() -> dict[str, Callable[[Array, Array], object]]:
    """Name → function of rays and points (3, 3)."""

    def by_opencv(solve: Callable[..., tuple], flag: int, rays: Array, points: Array) -> object:
        pixels = np.ascontiguousarray(rays[:, :2])
        _, turns, moves, *_ = solve(points, pixels, np.eye(3), None, flags=flag)
        return [(cv2.Rodrigues(a)[0], b.ravel()) for a, b in zip(turns, moves, strict=True)]

    found = {
        "P3P": lambda rays, points: solve_p3p_batch(rays[None], points),
        "cv2.solveP3P P3P": partial(by_opencv, cv2.solveP3P, cv2.SOLVEPNP_P3P),
        "cv2.solveP3P AP3P": partial(by_opencv, cv2.solveP3P, cv2.SOLVEPNP_AP3P),
        "cv2 SQPNP": partial(by_opencv, cv2.solvePnPGeneric, cv2.SOLVEPNP_SQPNP),
    }
    if importlib.util.find_spec("poselib") is not None:
        import poselib

        def by_poselib(rays: Array, points: Array) -> object:
            units = list(rays / np.linalg.norm(rays, axis=1)[:, None])
            return [(np.asarray(p.R), np.asarray(p.t)) for p in poselib.p3p(units, list(points))]

        found["poselib p3p"] = by_poselib
    return found


def three_points(bench: Bench) -> Iterator[Row]:
    """P3P beside poselib's and OpenCV's: time a problem."""
    rays, points = problems(bench.problems)
    corners = [(rays[k].copy(), points[k].copy()) for k in range(ONE_BY_ONE)]
    every = solvers()
    ways = {
        name: Way(lambda s=solve: [s(ray, corner) for ray, corner in corners], len(corners))
        for name, solve in every.items()
    }
    ways["P3P in a batch"] = Way(lambda: solve_p3p_batch(rays, points), len(rays))
    peers = tuple(name for name in every if name != "P3P")
    yield from times("benchmark", bench.race(ways), {"P3P": peers, "P3P in a batch": peers})
