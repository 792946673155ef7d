"""Rows of the benchmark: P3P beside poselib's and OpenCV's, on five classes of problems."""

from __future__ import annotations

import contextlib
import importlib.util
from collections.abc import Callable, Iterator

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from experiments.benchmark.check import Bench, Row, times
from experiments.timing import Way
from rendezview.estimation.p3p import solve_p3p, solve_p3p_batch

# m, the paper's target
TARGET = np.array([[0.0, 0.0, 0.1016], [-0.5 * 0.3683, 0.0, 0.0], [0.5 * 0.3683, 0.0, 0.0]])
HEAD_ON = np.diag([1.0, -1.0, -1.0])
UP = np.array([0.0, 0.0, 1.0])
SEED, NEAR = 11, 1e-6  # an error, rad and of the range, of the true pose

Array = np.ndarray
Problem = tuple[Array, Array, Array]  # rotations, translations, points (N, 3, 3)
Solver = Callable[[Array, Array], list[tuple[Array, Array]]]


def away(rng: np.random.Generator, n: int, least_m: float) -> Array:
    """(N, 3) places anywhere in a 33° field, to 100 m."""
    far = 10.0 ** rng.uniform(np.log10(least_m), 2.0, n)
    return far[:, None] * np.column_stack([rng.uniform(-0.3, 0.3, (n, 2)), np.ones(n)])


def guidance(rng: np.random.Generator, n: int) -> Problem:
    """The guidance target at any tilt up to 40°, 0.5 to 100 m."""
    axis = rng.normal(size=(n, 3)) * (1.0, 1.0, 0.0)
    axis /= np.linalg.norm(axis, axis=1)[:, None]
    tilt = Rotation.from_rotvec(axis * np.deg2rad(rng.uniform(0.0, 40.0, (n, 1))))
    roll = Rotation.from_rotvec(UP * rng.uniform(-np.pi, np.pi, (n, 1)))
    rotations = (roll * tilt).as_matrix() @ HEAD_ON
    return rotations, away(rng, n, 0.5), np.broadcast_to(TARGET, (n, 3, 3))


def head_on(rng: np.random.Generator, n: int) -> Problem:
    """Zero tilt, on the boresight; every other one with a roll."""
    rolls = rng.uniform(-np.pi, np.pi, (n, 1)) * (np.arange(n)[:, None] % 2)
    rotations = Rotation.from_rotvec(UP * rolls).as_matrix() @ HEAD_ON
    places = np.zeros((n, 3))
    places[:, 2] = 10.0 ** rng.uniform(np.log10(0.5), 2.0, n)
    return rotations, places, np.broadcast_to(TARGET, (n, 3, 3))


def right_angles(rng: np.random.Generator, n: int) -> Problem:
    """Right-angled triangles, and the guidance target with a side square to the line of sight."""
    points = np.zeros((n, 3, 3))
    points[:, 1, 0], points[:, 2, 1] = rng.uniform(0.1, 1.0, (2, n))
    rotations, places = Rotation.random(n, rng=rng).as_matrix(), away(rng, n, 2.0)
    half = n // 2
    points[:half] = TARGET
    # Camera in the plane through the tip (first corner) square to the side tip–left.
    side = (TARGET[1] - TARGET[0]) / np.linalg.norm(TARGET[1] - TARGET[0])
    turn = rng.normal(size=(half, 3))
    sight = turn - (turn @ side)[:, None] * side
    sight /= np.linalg.norm(sight, axis=1)[:, None]
    rotations[:half] = look_along(rng, -sight)
    centres = TARGET[0] + places[:half, 2:] * sight
    places[:half] = -np.einsum("nij,nj->ni", rotations[:half], centres)
    return rotations, places, points


def triangles(rng: np.random.Generator, n: int) -> Problem:
    """Any triangle, any attitude."""
    points = rng.uniform(-1.0, 1.0, (n, 3, 3))
    return Rotation.random(n, rng=rng).as_matrix(), away(rng, n, 2.5), points


def double(rng: np.random.Generator, n: int) -> Problem:
    """Cameras near the danger cylinder of the guidance target, where two poses coincide."""
    ab, ac = TARGET[1] - TARGET[0], TARGET[2] - TARGET[0]
    normal = np.cross(ab, ac)
    middle = (np.cross(normal, ab) * (ac @ ac) + np.cross(ac, normal) * (ab @ ab)) / (
        2.0 * normal @ normal
    )
    axis, first = normal / np.linalg.norm(normal), ab / np.linalg.norm(ab)
    off = 10.0 ** rng.uniform(-6.0, -1.0, n) * rng.choice([-1.0, 1.0], n)
    phi = rng.uniform(0.0, 2.0 * np.pi, (n, 1))
    height = 10.0 ** rng.uniform(-0.3, 1.0, (n, 1)) * rng.choice([-1.0, 1.0], (n, 1))
    around = np.cos(phi) * first + np.sin(phi) * np.cross(axis, first)
    centres = TARGET[0] + middle + np.linalg.norm(middle) * (1.0 + off[:, None]) * around
    centres = centres + height * axis
    sight = TARGET.mean(axis=0) - centres
    rotations = look_along(rng, sight / np.linalg.norm(sight, axis=1)[:, None])
    places = -np.einsum("nij,nj->ni", rotations, centres)
    return rotations, places, np.broadcast_to(TARGET, (n, 3, 3))


def look_along(rng: np.random.Generator, z: Array) -> Array:
    """Camera rotations (N, 3, 3) with boresights z, any roll."""
    x = np.cross(rng.normal(size=z.shape), z)
    x /= np.linalg.norm(x, axis=1)[:, None]
    return np.stack([x, np.cross(z, x), z], axis=1)


def problems(
    rng: np.random.Generator, maker: Callable[..., Problem], wanted: int
) -> tuple[Array, ...]:
    """Rotations, translations, points and rays (z = 1) of a class, all in front of the camera."""
    rotations, places, points = maker(rng, round(1.02 * wanted))
    seen = np.einsum("nij,nkj->nki", rotations, points) + places[:, None]
    keep = np.flatnonzero((seen[..., 2] > 0.05).all(axis=1))[:wanted]
    assert len(keep) == wanted
    return rotations[keep], places[keep], points[keep], (seen / seen[..., 2:])[keep]


def solvers() -> dict[str, Solver]:
    """Name → function of (rays (3, 3), points (3, 3)) that gives a list of (R, t)."""

    def opencv(solve: Callable[..., tuple], flag: int) -> Solver:
        def ask(rays: Array, points: Array) -> list[tuple[Array, Array]]:
            pixels = np.ascontiguousarray(rays[:, :2] / rays[:, 2:])
            _, turns, moves, *_ = solve(points, pixels, np.eye(3), None, flags=flag)
            return [(cv2.Rodrigues(a)[0], b.ravel()) for a, b in zip(turns, moves, strict=True)]

        return ask

    def ours(rays: Array, points: Array) -> list[tuple[Array, Array]]:
        return [(p.rotation, p.translation_m) for p in solve_p3p(rays, points)]

    found: dict[str, Solver] = {"P3P": ours}
    if importlib.util.find_spec("poselib") is not None:
        import poselib

        def by_poselib(rays: Array, points: Array) -> list[tuple[Array, Array]]:
            units = list(rays / np.linalg.norm(rays, axis=1)[:, None])
            return [(np.asarray(p.R), np.asarray(p.t)) for p in poselib.p3p(units, list(points))]

        found["poselib p3p"] = by_poselib
    found["cv2.solveP3P P3P"] = opencv(cv2.solveP3P, cv2.SOLVEPNP_P3P)
    found["cv2.solveP3P AP3P"] = opencv(cv2.solveP3P, cv2.SOLVEPNP_AP3P)
    found["cv2 SQPNP"] = opencv(cv2.solvePnPGeneric, cv2.SOLVEPNP_SQPNP)
    return found


def missed(solve: Solver, sample: tuple[Array, ...]) -> int:
    """Problems of which no root is the true pose to 1e-6 rad, and of the range."""
    count = 0
    for rotation, place, points, rays in zip(*sample, strict=True):
        allowed, roots = NEAR * np.linalg.norm(place), list[tuple[Array, Array]]()
        with contextlib.suppress(cv2.error):
            roots = solve(rays.copy(), np.array(points))
        turned = (np.linalg.norm(r - rotation) <= NEAR * np.sqrt(2.0) for r, _ in roots)
        moved = (np.linalg.norm(t - place) <= allowed for _, t in roots)
        count += not any(map(all, zip(turned, moved, strict=True)))
    return count


def three_points(bench: Bench) -> Iterator[Row]:
    """P3P beside poselib's and OpenCV's: time a call, and true poses missed."""
    rng = np.random.default_rng(SEED)
    makers = (guidance, head_on, right_angles, triangles, double)
    samples = {maker: problems(rng, maker, bench.problems) for maker in makers}
    every = solvers()
    _, _, points, rays = samples[triangles]  # SQPNP refuses the small ones
    corners = [(rays[k].copy(), np.array(points[k])) for k in range(min(50, len(rays)))]
    ways = {
        name: Way(lambda s=solve: [s(ray, corner) for ray, corner in corners], len(corners))
        for name, solve in every.items()
    }
    ways["P3P in a batch"] = Way(lambda: solve_p3p_batch(rays, points), len(rays))
    peers = tuple(name for name in every if name != "P3P")
    spent = bench.race(ways)
    yield from times("benchmark", spent, {"P3P": peers, "P3P in a batch": peers})
    lost = {n: sum(missed(solve, s) for s in samples.values()) for n, solve in every.items()}
    for peer in peers:
        if lost[peer]:
            what = f"P3P, true pose missed, of {len(samples) * bench.problems}"
            yield Row(what, lost["P3P"], peer, lost[peer], "", "benchmark")
