"""Time of a reading beside threshold, contours and moments of the same pictures."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from rendezview.sensors.reflectors import (
    Acquirer,
    LitDark,
    ReflectorPattern,
    ReflectorSensor,
    find_spots,
    patterns_of,
    solve_p3p_batch,
)
from rendezview.sensors.reflectors.spots import (
    AMPLITUDE,
    BOTTOM,
    COLUMNS,
    LEFT,
    RIGHT,
    SHAPE,
    SIZE,
    TOP,
    SpotTable,
)
from rendezview.simulation.reflector_frames import render_pair

from experiments.frame import show, table_of
from experiments.reflectors.accuracy import OPTIONS, random_pose
from experiments.reflectors.run import CAMERA, CLIENT
from experiments.timing import median_ms
from rendezview.io.target import Target


def floor(lit: np.ndarray, dark: np.ndarray) -> list[tuple[float, float]]:
    """Difference, threshold, contours, moments of each: what OpenCV needs for three centroids."""
    difference = cv2.subtract(lit, dark)
    mask = cv2.threshold(difference, 20, 255, cv2.THRESH_BINARY)[1]
    centres = []
    for contour in cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]:
        x, y, w, h = cv2.boundingRect(contour)
        moments = cv2.moments(difference[y : y + h, x : x + w])
        centres.append((x + moments["m10"] / moments["m00"], y + moments["m01"] / moments["m00"]))
    return centres


def many_spots(rng: np.random.Generator, count: int, alike: bool) -> SpotTable:
    """False spots all over the picture; ``alike``: all of one size and brightness."""
    table = np.zeros((count, COLUMNS))
    table[:, 0], table[:, 1] = rng.uniform(10, 500, count), rng.uniform(10, 370, count)
    table[:, SIZE] = 1.6 if alike else np.exp(rng.uniform(np.log(0.8), np.log(5.0), count))
    table[:, AMPLITUDE] = 150.0 if alike else rng.uniform(40.0, 250.0, count)
    table[:, SHAPE] = 0.95
    table[:, LEFT], table[:, RIGHT] = table[:, 0] - 3, table[:, 0] + 3
    table[:, TOP], table[:, BOTTOM] = table[:, 1] - 3, table[:, 1] + 3
    table[:, 7] = 0.02
    return SpotTable(table)


def pairs_at(rng: np.random.Generator, pattern: ReflectorPattern, range_m: float) -> list[LitDark]:
    """Five pairs of one pose."""
    pose, _ = random_pose(rng, pattern, range_m)
    return [LitDark(*render_pair(CAMERA, pattern, pose, OPTIONS, rng)) for _ in range(5)]


def tracking(pattern: ReflectorPattern, pairs: list[LitDark]) -> Callable[[], None]:
    """One reading of a sensor that follows the target, checked to be one."""
    sensor = ReflectorSensor(CAMERA, [pattern])
    count = 0

    def track() -> None:
        nonlocal count
        count += 1
        reading = sensor.update(0.1 * count, pairs[count % len(pairs)])
        assert count < 3 or (reading.tracked and reading.pose is not None)

    return track


def run(*, seed: int = 41) -> None:
    """Time of a reading beside threshold, contours and moments of the same pictures.

    512 × 384 pairs of the paper's target at 12, 6, 3 and 1.5 m; 200 false spots for the triplets; a
    batch of P3P. One thread; the least of repeated medians. Compare the ratios, not the
    milliseconds.
    """
    cv2.setNumThreads(1)
    rng = np.random.default_rng(seed)
    pattern = patterns_of(Target.load(CLIENT), ("far",))[0]
    acquirer = Acquirer(CAMERA, [pattern])
    table = table_of(
        f"512 × 384, seed {seed}, one thread, ms",
        "range m | threshold + contours + moments | spots | triplets and pose | "
        "acquisition | × floor | tracking | × floor",
        left=0,
    )
    for range_m in (12.0, 6.0, 3.0, 1.5):
        pairs = pairs_at(rng, pattern, range_m)
        first = pairs[0]
        base = median_ms(lambda f=first: floor(f.lit, f.dark), rounds=7)
        spots = find_spots(first)
        spots_ms = median_ms(lambda f=first: find_spots(f), rounds=7)
        triplets_ms = median_ms(lambda s=spots: acquirer.acquire(s), rounds=7)
        both_ms = median_ms(lambda f=first: acquirer.acquire(find_spots(f)), rounds=7)
        track_ms = median_ms(tracking(pattern, pairs), rounds=7)
        table.add_row(
            f"{range_m:g}", f"{base:.3f}", f"{spots_ms:.3f}", f"{triplets_ms:.3f}",
            f"{both_ms:.3f}", f"{both_ms / base:.1f}", f"{track_ms:.3f}", f"{track_ms / base:.1f}",
        )  # fmt: skip
    show(table, width=120)
    for alike in (False, True):
        crowd = many_spots(rng, 200, alike)
        found = acquirer.acquire(crowd)
        ms = median_ms(lambda c=crowd: acquirer.acquire(c), 20, rounds=5)
        kind = "all alike, the worst" if alike else "of any size and brightness"
        print(f"200 false spots {kind}: {ms:.3f} ms ({found.status})")
    points = pattern.positions_m[[1, 0, 2]]
    rays = np.stack(
        [random_pose(rng, pattern, rng.uniform(1.0, 12.0))[0].apply(points) for _ in range(2000)]
    )
    ms = median_ms(lambda: solve_p3p_batch(rays, points), 10, rounds=7)
    print(f"P3P, all poses, batch of {len(rays)}: {1e3 * ms / len(rays):.3f} µs a solve")
