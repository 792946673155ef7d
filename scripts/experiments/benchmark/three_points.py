"""Rows of the benchmark: P3P beside poselib's and OpenCV's."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterator
from functools import partial

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from experiments.benchmark.check import Bench, Row, times
from experiments.timing import Way
from rendezview.estimation.p3p import solve_p3p, solve_p3p_batch

SEED, ONE_BY_ONE = 11, 50  # problems that are solved a call each

Array = np.ndarray


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
        "P3P": solve_p3p,
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
