"""Ways down the robust cost of a segment, beside scipy's: error, failures and time."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Annotated

import numpy as np
from scipy.optimize import least_squares, minimize
from scipy.spatial.transform import Rotation

from experiments.frame import Log, show, table_of, write_log
from rendezview.geometry.pose import Array
from rendezview.trajectory import FitOptions, Method, Nothing, PointCloud, Shape, fit_segment
from rendezview.trajectory.descent import CUT
from rendezview.trajectory.relative_orbit import transition
from rendezview.trajectory.scaling import typical_sizes
from rendezview.trajectory.shapes import HOPS, code_of, places
from rendezview.trajectory.simplex import RESIDUALS, cost, residuals
from rendezview.trajectory.start import first_guess, hops_of

SPAN_S, RANGE_M, NOISE = 200.0, 30.0, 0.001
MEAN_MOTION_RAD_S = 0.0011
FAILED = 0.003  # median distance from the true path, share of the range
POINTS = (10, 20, 40, 60)
OUTLIERS = (0.0, 0.1, 0.2, 0.4)
PATHS = ("circular", "spiral", "vbar, hops", "orbit")
SHAPES = {
    "circular": Shape.CIRCULAR, "spiral": Shape.SPIRAL, "vbar, hops": Shape.VBAR,
    "orbit": Shape.ORBIT,
}  # fmt: skip
Way = Callable[[PointCloud, str], Array | None]


def path(kind: str, rng: np.random.Generator) -> Callable[[Array], Array]:
    """Times (N,) to places (N, 3) of a random path."""
    axes = Rotation.random(random_state=rng).as_matrix()
    phase = rng.uniform(0.0, SPAN_S / 3.0)

    def flown(times_s: Array) -> Array:
        along = times_s[:, None] / SPAN_S
        if kind == "orbit":
            first = np.array([0.0, RANGE_M, 0.0, 0.01, -0.05, 0.01])
            return np.array([(transition(MEAN_MOTION_RAD_S, t) @ first)[:3] for t in times_s])
        if kind == "vbar, hops":
            distance = RANGE_M * (1.0 - 0.17 * along)
            hop = np.abs(np.sin(np.pi * (times_s[:, None] - phase) / (SPAN_S / 3.0)))
            return np.asarray(distance * axes[0] + 0.03 * distance * hop * axes[1])
        distance = RANGE_M * (1.0 - (0.11 * along if kind == "spiral" else 0.0))
        return np.asarray(distance * (np.cos(along) * axes[0] + np.sin(along) * axes[1]))

    return flown


def cloud_of(
    flown: Callable[[Array], Array], count: int, share: float, rng: np.random.Generator
) -> PointCloud:
    """Places with noise, and some a tenth of the range off (one σ each axis)."""
    times = np.linspace(0.0, SPAN_S, count)
    noisy = flown(times) + NOISE * RANGE_M * rng.standard_normal((count, 3))
    far = rng.choice(count, round(share * count), replace=False)
    noisy[far] += 0.1 * RANGE_M * rng.standard_normal((len(far), 3))
    spread = np.tile((NOISE * RANGE_M) ** 2 * np.eye(3), (count, 1, 1))
    return PointCloud.of_places(times, noisy, spread)


def by_us(cloud: PointCloud, kind: str, *, method: Method) -> Array | None:
    """Places at the cloud's times."""
    found = fit_segment(
        cloud, SHAPES[kind], mean_motion_rad_s=MEAN_MOTION_RAD_S,
        options=FitOptions(method=method),
    )  # fmt: skip
    return None if isinstance(found, Nothing) else found.places(cloud.times_s)


def by_scipy(cloud: PointCloud, kind: str, *, simplex: bool) -> Array | None:
    """scipy's Nelder–Mead or least squares from the closed-form start, with the true noise."""
    code, constants = code_of(SHAPES[kind]), np.array([MEAN_MOTION_RAD_S, 0.0])
    times = cloud.times_s - 0.5 * SPAN_S
    guess = first_guess(code, times, cloud.places_m, cloud.weights, MEAN_MOTION_RAD_S)
    if isinstance(guess, Nothing):
        return None
    base, start = guess
    if kind == "vbar, hops":
        closing = -float(start[:3] @ start[3:]) / float(start[:3] @ start[:3])
        hopping = hops_of(times, cloud.places_m, cloud.weights, closing)
        if hopping is not None:
            code, start, constants = HOPS, hopping, np.array([MEAN_MOTION_RAD_S, closing])
    data = (
        times, base, constants, np.zeros((len(times), 3)), cloud.points, cloud.whitening,
        cloud.by_node,
    )  # fmt: skip
    place, out = np.empty((len(times), 3)), np.empty((len(times), RESIDUALS))
    scales = typical_sizes(code, RANGE_M, 0.5 * SPAN_S)

    def asked(p: Array) -> float:
        return float(cost(code, p, data, cloud.weights, CUT, place, out))

    def misfits(p: Array) -> Array:
        residuals(code, p, data, place, out)
        return out[:, :3].ravel().copy()

    if simplex:
        corners = np.vstack([start, start + np.diag(0.02 * scales)])
        options = {"initial_simplex": corners, "fatol": 0.01, "xatol": np.inf}
        options |= {"adaptive": True, "maxfev": 5000}
        answer = minimize(asked, start, method="Nelder-Mead", options=options).x
    else:
        answer = least_squares(
            misfits, start, x_scale=scales, loss="cauchy", f_scale=2.0, max_nfev=200
        ).x
    places(code, answer, times, base, constants, place)
    return place.copy()


WAYS: dict[str, Way] = {
    "Gauss–Newton": partial(by_us, method=Method.GAUSS_NEWTON),
    "simplex": partial(by_us, method=Method.SIMPLEX),
    "both": partial(by_us, method=Method.BOTH),
    "best (default)": partial(by_us, method=Method.BEST),
    "scipy Nelder–Mead": partial(by_scipy, simplex=True),
    "scipy least_squares, Cauchy": partial(by_scipy, simplex=False),
}


def run(
    *, clouds: Annotated[int, "of each path, size and share"] = 20, seed: int = 77, log: Log = None
) -> None:
    """Ways down the robust cost of a segment, beside scipy's.

    Random paths of 200 s from 30 m: a circle of 1 rad, a spiral, a V-bar approach with three hops
    of 3 %, a free relative orbit. 10 to 60 points with noise of 0.1 % of the range (one σ each
    axis), 0 to 40 % of them outliers of 10 %. A fit has failed where there is none, or where its
    median distance from the true path is above 0.3 % of the range. Errors are medians over the fits
    that have not failed; times are processor time, median.
    """
    records = []
    for kind in PATHS:
        for count in POINTS:
            for share in OUTLIERS:
                for k in range(clouds):
                    place = [PATHS.index(kind), count, round(100 * share), k]
                    rng = np.random.default_rng([seed, *place])
                    flown = path(kind, rng)
                    cloud = cloud_of(flown, count, share, rng)
                    truth = flown(cloud.times_s)
                    for name, way in WAYS.items():
                        if not records or all(r["way"] != name for r in records[-200:]):
                            way(cloud, kind)  # compiles
                        began = time.process_time()
                        found = way(cloud, kind)
                        spent = time.process_time() - began
                        off = np.inf
                        if found is not None:
                            far = np.linalg.norm(truth, axis=1)
                            off = float(np.median(np.linalg.norm(found - truth, axis=1) / far))
                        records.append(
                            {"path": kind, "points": count, "outliers": share, "way": name,
                             "off": off, "ms": 1e3 * spent}
                        )  # fmt: skip
    write_log(log, records)
    for column, values in (("path", PATHS), ("points", POINTS), ("outliers", OUTLIERS)):
        heads = [f"{v:.0%}" if column == "outliers" else str(v) for v in values]
        title = f"failed, %; error, % of range; ms: by {column}, {clouds} clouds each, seed {seed}"
        rows = table_of(title, ["way", *heads, "all"])
        for name in WAYS:
            cells = []
            for value in (*values, None):
                some = [
                    r for r in records
                    if r["way"] == name and (value is None or r[column] == value)
                ]  # fmt: skip
                off = np.array([r["off"] for r in some])
                good = off[off <= FAILED]
                error = f"{100 * np.median(good):.3f}" if len(good) else "–"
                ms = np.median([r["ms"] for r in some])
                cells.append(f"{100 * np.mean(off > FAILED):.1f}; {error}; {ms:.1f}")
            rows.add_row(name, *cells)
        show(rows, width=150)
