"""A million P3P problems through the default solver, and its peers on a sample."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Annotated

import cv2
import numpy as np
from rendezview.sensors.reflectors.judgement import facing_root
from rendezview.sensors.reflectors.p3p import solve_p3p, solve_p3p_batch
from rendezview.sensors.reflectors.triangulation import pose_from_distances, triangulate_batch
from rich.console import Console
from rich.table import Table
from scipy.spatial.transform import Rotation

from experiments.frame import table_of
from experiments.peers.opencv_contrib import least_ms

BASE, POST = 0.3683, 0.1016
TARGET = np.array([[0.0, 0.0, POST], [-0.5 * BASE, 0.0, 0.0], [0.5 * BASE, 0.0, 0.0]])
NORMALS = np.tile([0.0, 0.0, 1.0], (3, 1))
HEAD_ON = np.diag([1.0, -1.0, -1.0])
SHARES = {
    "guidance target, tilt to 40°": 0.35,
    "head-on": 0.30,
    "right angles": 0.15,
    "random triangles": 0.19,
    "near two equal poses": 0.01,
}


def guidance(rng: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rotations, translations and points: 0.5 to 100 m, anywhere in a 33° field."""
    axis = rng.normal(size=(n, 3)) * (1.0, 1.0, 0.0)
    axis /= np.linalg.norm(axis, axis=1)[:, None]
    tilt = Rotation.from_rotvec(axis * np.deg2rad(rng.uniform(0.0, 40.0, (n, 1))))
    roll = Rotation.from_rotvec(np.array([0.0, 0.0, 1.0]) * rng.uniform(-np.pi, np.pi, (n, 1)))
    rotations = (roll * tilt).as_matrix() @ HEAD_ON
    far = 10.0 ** rng.uniform(np.log10(0.5), 2.0, n)
    places = far[:, None] * np.column_stack([rng.uniform(-0.3, 0.3, (n, 2)), np.ones(n)])
    return rotations, places, np.broadcast_to(TARGET, (n, 3, 3))


def head_on(rng: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Zero tilt, on the boresight; every other one with a roll."""
    rolls = rng.uniform(-np.pi, np.pi, (n, 1)) * (np.arange(n)[:, None] % 2)
    rotations = Rotation.from_rotvec(np.array([0.0, 0.0, 1.0]) * rolls).as_matrix() @ HEAD_ON
    places = np.zeros((n, 3))
    places[:, 2] = 10.0 ** rng.uniform(np.log10(0.5), 2.0, n)
    return rotations, places, np.broadcast_to(TARGET, (n, 3, 3))


def right_angles(rng: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Right-angled triangles, and the guidance target with a side square to the line of sight."""
    points = np.zeros((n, 3, 3))
    points[:, 1, 0], points[:, 2, 1] = rng.uniform(0.1, 1.0, (2, n))
    rotations = Rotation.random(n, rng=rng).as_matrix()
    far = 10.0 ** rng.uniform(np.log10(2.0), 2.0, n)
    places = far[:, None] * np.column_stack([rng.uniform(-0.3, 0.3, (n, 2)), np.ones(n)])
    half = n // 2
    points[:half] = TARGET
    # Camera in the plane through the tip (first corner) square to the side tip–left.
    side = (TARGET[1] - TARGET[0]) / np.linalg.norm(TARGET[1] - TARGET[0])
    turn = rng.normal(size=(half, 3))
    sight = turn - (turn @ side)[:, None] * side
    sight /= np.linalg.norm(sight, axis=1)[:, None]
    rotations[:half] = look_along(rng, -sight)
    centres = TARGET[0] + far[:half, None] * sight
    places[:half] = -np.einsum("nij,nj->ni", rotations[:half], centres)
    return rotations, places, points


def triangles(rng: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Any triangle, any attitude."""
    points = rng.uniform(-1.0, 1.0, (n, 3, 3))
    rotations = Rotation.random(n, rng=rng).as_matrix()
    far = 10.0 ** rng.uniform(np.log10(2.5), 2.0, n)
    places = far[:, None] * np.column_stack([rng.uniform(-0.3, 0.3, (n, 2)), np.ones(n)])
    return rotations, places, points


def double(
    rng: np.random.Generator, n: int, off: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cameras near the danger cylinder of the guidance target."""
    ab, ac = TARGET[1] - TARGET[0], TARGET[2] - TARGET[0]
    n_axis = np.cross(ab, ac)
    middle = TARGET[0] + (np.cross(n_axis, ab) * (ac @ ac) + np.cross(ac, n_axis) * (ab @ ab)) / (
        2.0 * n_axis @ n_axis
    )
    radius = np.linalg.norm(middle - TARGET[0])
    axis = n_axis / np.linalg.norm(n_axis)
    first = ab / np.linalg.norm(ab)
    second = np.cross(axis, first)
    if off is None:
        off = 10.0 ** rng.uniform(-6.0, -1.0, n) * rng.choice([-1.0, 1.0], n)
    phi = rng.uniform(0.0, 2.0 * np.pi, (n, 1))
    height = 10.0 ** rng.uniform(-0.3, 1.0, (n, 1)) * rng.choice([-1.0, 1.0], (n, 1))
    around = np.cos(phi) * first + np.sin(phi) * second
    centres = middle + radius * (1.0 + off[:, None]) * around + height * axis
    sight = TARGET.mean(axis=0) - centres
    rotations = look_along(rng, sight / np.linalg.norm(sight, axis=1)[:, None])
    return rotations, -np.einsum("nij,nj->ni", rotations, centres), np.broadcast_to(
        TARGET, (n, 3, 3)
    )  # fmt: skip


def look_along(rng: np.random.Generator, z: np.ndarray) -> np.ndarray:
    """Camera rotations (N, 3, 3) with boresights z, any roll."""
    x = np.cross(rng.normal(size=z.shape), z)
    x /= np.linalg.norm(x, axis=1)[:, None]
    return np.stack([x, np.cross(z, x), z], axis=1)


MAKERS = dict(zip(SHARES, (guidance, head_on, right_angles, triangles, double), strict=True))


def in_front(problem: tuple[np.ndarray, ...]) -> tuple[np.ndarray, ...]:
    """Only problems whose points are all in front of the camera."""
    rotations, places, points = problem
    seen = np.einsum("nij,nkj->nki", rotations, points) + places[:, None]
    keep = (seen[..., 2] > 0.05).all(axis=1)
    return rotations[keep], places[keep], points[keep], seen[keep]


def problems(rng: np.random.Generator, name: str, wanted: int) -> tuple[np.ndarray, ...]:
    """Rotations, translations, points and rays (z = 1) of a class."""
    rotations, places, points, seen = in_front(MAKERS[name](rng, round(1.02 * wanted)))
    assert len(rotations) >= wanted
    return rotations[:wanted], places[:wanted], points[:wanted], (seen / seen[..., 2:])[:wanted]


def pose_errors(found_r: np.ndarray, found_t: np.ndarray, r: np.ndarray, t: np.ndarray):
    """Errors (..., ) of poses: the larger of rotation (rad, small) and position over range."""
    turn = np.linalg.norm(found_r - r, axis=(-1, -2)) / np.sqrt(2.0)
    move = np.linalg.norm(found_t - t, axis=-1) / np.linalg.norm(t, axis=-1)
    return np.nan_to_num(np.maximum(turn, move), nan=np.inf)


def this_one(rays: np.ndarray, points: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    return [(p.rotation, p.translation_m) for p in solve_p3p(rays, points)]


def peers() -> dict[str, object]:
    """Name → function of (rays (3, 3), points (3, 3)) that gives a list of (R, t)."""
    eye = np.eye(3)
    found: dict[str, object] = {}

    def opencv(flag: int):
        def solve(rays: np.ndarray, points: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
            pixels = np.ascontiguousarray(rays[:, :2] / rays[:, 2:])
            _, turns, moves = cv2.solveP3P(points, pixels, eye, None, flags=flag)
            return [(cv2.Rodrigues(a)[0], b.ravel()) for a, b in zip(turns, moves, strict=True)]

        return solve

    def sqpnp(rays: np.ndarray, points: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        pixels = np.ascontiguousarray(rays[:, :2] / rays[:, 2:])
        _, turns, moves, _ = cv2.solvePnPGeneric(
            points, pixels, eye, None, flags=cv2.SOLVEPNP_SQPNP
        )
        return [(cv2.Rodrigues(a)[0], b.ravel()) for a, b in zip(turns, moves, strict=True)]

    try:
        import poselib

        def pl(rays: np.ndarray, points: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
            units = rays / np.linalg.norm(rays, axis=1)[:, None]
            return [
                (np.asarray(p.R), np.asarray(p.t)) for p in poselib.p3p(list(units), list(points))
            ]

        found["poselib p3p"] = pl
    except ImportError:
        print("poselib is not installed: left out")
    found["cv2.solveP3P P3P"] = opencv(cv2.SOLVEPNP_P3P)
    found["cv2.solveP3P AP3P"] = opencv(cv2.SOLVEPNP_AP3P)
    found["cv2 SQPNP"] = sqpnp
    return found


def run(
    *, count: int = 1000000, peers: Annotated[int, "problems of each class for peers"] = 1000,
    seed: int = 11,
) -> None:  # fmt: skip
    """A million P3P problems through the default solver, and its peers on a sample.

    Classes: the guidance target at any tilt up to 40°, exactly head-on (any roll), at right angles
    (post, or a side, square to the line of sight; right-angled triangles), random triangles, and
    near the cylinder over the reflectors' circle where two poses coincide (distance from it
    log-uniform from 1e-6 to 1e-1 of its radius). The error of a pose is the larger of its rotation
    error (rad) and its position error over range; that of a problem is the least over its roots.
    """
    rng = np.random.default_rng(seed)
    cv2.setNumThreads(1)
    console = Console(width=120)
    table = table_of(
        f"default solver, {count} problems, seed {seed}",
        ("class", "problems", "median", "99.9 %", "worst", "> 1e-9", "> 1e-6", "µs each"),
    )
    everything, samples = [], {}
    for name, share in SHARES.items():
        wanted = round(share * count)
        rotations, places, points, rays = problems(rng, name, wanted)
        errors = []
        for part in np.array_split(np.arange(wanted), max(1, wanted // 50_000)):
            r, t, _ = solve_p3p_batch(rays[part], points[part])
            errors.append(pose_errors(r, t, rotations[part, None], places[part, None]).min(axis=1))
        some = slice(0, min(wanted, 20_000))
        solve = partial(solve_p3p_batch, rays[some], points[some])
        us = 1e3 * least_ms(solve, 5) / some.stop
        error = np.concatenate(errors)
        everything.append(error)
        samples[name] = (rotations, places, points, rays)
        row(table, name, error, f"{us:.2f}")
    total = np.concatenate(everything)
    row(table, "all", total, "")
    console.print(table)
    print(
        f"true pose among the roots to 1e-6: {np.mean(total <= 1e-6):.7f}, "
        f"to 1e-9: {np.mean(total <= 1e-9):.6f}"
    )
    exact = in_front(double(rng, 2000, np.zeros(2000)))
    r, t, _ = solve_p3p_batch(exact[3] / exact[3][..., 2:], np.ascontiguousarray(exact[2]))
    error = pose_errors(r, t, exact[0][:, None], exact[1][:, None]).min(axis=1)
    print(f"exactly two equal poses (2000, beside the million): worst {error.max():.1e}")
    chosen(rng, samples)
    compare(console, samples, peers)
    iterations(console, rng)


def row(table: Table, name: str, error: np.ndarray, us: str) -> None:
    table.add_row(
        name, str(len(error)), f"{np.median(error):.1e}", f"{np.quantile(error, 0.999):.1e}",
        f"{error.max():.1e}", str(int(np.sum(error > 1e-9))), str(int(np.sum(error > 1e-6))), us,
    )  # fmt: skip


def chosen(rng: np.random.Generator, samples: dict[str, tuple[np.ndarray, ...]]) -> None:
    """Whether the root chosen, the post towards the camera, is the truth."""
    for name in ("guidance target, tilt to 40°", "head-on"):
        rotations, places, _, rays = (a[:100_000] for a in samples[name])
        r, t, counts = solve_p3p_batch(rays, TARGET)
        right = several = 0
        for n in range(len(rays)):
            k = facing_root(r[n], t[n], counts[n], TARGET, NORMALS)
            right += k >= 0 and pose_errors(r[n, k], t[n, k], rotations[n], places[n]) < 1e-6
            facing = [
                j
                for j in range(counts[n])
                if facing_root(r[n, j : j + 1], t[n, j : j + 1], 1, TARGET, NORMALS) == 0
            ]  # fmt: skip
            several += len(facing) > 1
        print(
            f"chosen root, {name}: right in {right} of {len(rays)}; "
            f"several roots face the camera in {several}"
        )


def compare(console: Console, samples: dict[str, tuple[np.ndarray, ...]], count: int) -> None:
    """Peers on the first problems of every class: truth among their roots to 1e-6, and time."""
    table = Table(
        title=f"truth found to 1e-6 of range, {count} problems of each class; one call each"
    )
    table.add_column("solver")
    for name in samples:
        table.add_column(name, justify="right")
    table.add_column("µs a call", justify="right")

    for solver, solve in {"this one": this_one, **peers()}.items():
        cells = []
        spent = []
        for sample in samples.values():
            hits, times = ask(solve, sample, count)
            spent += times
            cells.append(f"{hits}")
        table.add_row(solver, *cells, f"{1e6 * np.median(spent):.1f}")
    console.print(table)


def ask(
    solve: Callable[..., list[tuple[np.ndarray, np.ndarray]]],
    sample: tuple[np.ndarray, ...],
    count: int,
) -> tuple[int, list[float]]:
    """How often the truth is among the roots to 1e-6, and seconds of every call."""
    rotations, places, points, rays = sample
    hits, spent = 0, []
    for n in range(min(count, len(rays))):
        ray, corner = rays[n].copy(), np.array(points[n])
        start = time.perf_counter()
        try:
            roots = solve(ray, corner)
        except cv2.error:
            roots = []
        spent.append(time.perf_counter() - start)
        hits += any(pose_errors(r, t, rotations[n], places[n]) <= 1e-6 for r, t in roots)
    return hits, spent


def iterations(console: Console, rng: np.random.Generator) -> None:
    """Newton–Raphson and the alternate iteration by tilt: converged, and to the truth."""
    table = table_of(
        "Bales' iterations, guidance target, 1 to 12 m, 20,000 each",
        "tilt | method | converged | to the truth (1e-6) | median steps | µs a solve",
        left=0,
    )
    for degrees in (0.0, 5.0, 30.0):
        n = 20_000
        axis = rng.normal(size=(n, 3)) * (1.0, 1.0, 0.0)
        axis /= np.linalg.norm(axis, axis=1)[:, None]
        tilt = Rotation.from_rotvec(axis * np.deg2rad(degrees) * np.sqrt(rng.random((n, 1))))
        rotations = tilt.as_matrix() @ HEAD_ON
        places = np.column_stack([np.zeros((n, 2)), np.exp(rng.uniform(0.0, np.log(12.0), n))])
        seen = np.einsum("nij,kj->nki", rotations, TARGET) + places[:, None]
        rays = seen / seen[..., 2:]
        truth = np.linalg.norm(seen, axis=-1)
        for name, alternate in (("Newton–Raphson", False), ("alternate", True)):
            distances, steps, converged = triangulate_batch(rays, BASE, POST, alternate=alternate)
            right = (np.abs(distances / truth - 1.0) < 1e-6).all(axis=1)
            solve = partial(triangulate_batch, rays[:2000], BASE, POST, alternate=alternate)
            us = 1e3 * least_ms(solve, 3) / 2000.0
            table.add_row(
                f"{degrees:.0f}°", name, f"{100 * converged.mean():.2f} %",
                f"{100 * (converged & right).mean():.2f} %", f"{np.median(steps):.0f}", f"{us:.2f}",
            )  # fmt: skip
        pose = pose_from_distances(rays[0], truth[0], TARGET)
        assert pose_errors(pose.rotation, pose.translation_m, rotations[0], places[0]) < 1e-9
    console.print(table)
