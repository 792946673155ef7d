"""Every subset of three to five of five reflectors: right, wrong, ambiguous or none."""

from __future__ import annotations

import itertools
import json
import math
from collections import Counter, defaultdict
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import poselib
from rendezview.sensors.reflectors import (
    LitDark,
    ReflectorSensor,
    TrackingOptions,
    find_spots,
)

from experiments.frame import show, table_of
from experiments.reflectors.plain import CAMERA, FIVE, PINHOLE, Simulator, apart, pictures, plain
from rendezview.geometry.pose import Pose
from rendezview.io.results import read_json_lines
from rendezview.sensors.observation import Status

WRONG_DEG, WRONG_SHARE = 5.0, 0.03
SUBSETS = [s for n in (3, 4, 5) for s in itertools.combinations(range(5), n)]
KINDS = ("right", "wrong", "ambiguous", "none")


def picture(
    rng: np.random.Generator, visible: tuple[int, ...], placed: tuple[np.ndarray, np.ndarray],
    simulator: Simulator = "plain",
) -> LitDark:  # fmt: skip
    """One reading: blur of 0.6 to 0.9 px, up to three false spots as large and bright as a disc."""
    look = plain.Look(blur=rng.uniform(0.6, 0.9), even=bool(rng.random() < 0.5))
    hidden = tuple(k for k in range(5) if k not in visible)
    count = int(rng.integers(0, 4))
    radius = 0.0125 * PINHOLE.focal_px / placed[1][2]
    size = math.hypot(0.7, 0.5 * radius)
    false = np.column_stack(
        [
            rng.uniform(5, PINHOLE.width - 6, count), rng.uniform(5, PINHOLE.height - 6, count),
            size * rng.uniform(0.9, 1.1, count), rng.uniform(100.0, 200.0, count),
        ]
    )  # fmt: skip
    return pictures(simulator, FIVE, placed, look, rng, hidden=hidden, false=false)


def place(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A pose with all reflectors in the picture, 1 to 8 m, tilt to 35°, every roll."""
    while True:
        range_m = math.exp(rng.uniform(0.0, math.log(8.0)))
        placed = plain.look_at(rng, PINHOLE, range_m, math.radians(35.0), 20.0)
        spots = PINHOLE.project(FIVE.positions_m @ placed[0].T + placed[1])
        margin = 6.0 + 0.0125 * PINHOLE.focal_px / range_m
        edge = (PINHOLE.width - 1 - margin, PINHOLE.height - 1 - margin)
        if (spots > margin).all() and (spots < edge).all():
            return placed


def kind(pose: Pose | None, status: Status | None, truth: Pose, half_turns: bool) -> str:
    if pose is None:
        return "ambiguous" if status is Status.AMBIGUOUS else "none"
    degrees, share = apart(pose, truth, half_turns)
    return "wrong" if degrees > WRONG_DEG or share > WRONG_SHARE else "right"


def peers(frames: LitDark, visible: tuple[int, ...], truth: Pose) -> dict[str, str]:
    """OpenCV's and poselib's answers on our spots, which they are given with their names."""
    spots = find_spots(frames).centroids_px
    expected = PINHOLE.project(truth.apply(FIVE.positions_m[list(visible)]))
    apart_px = np.linalg.norm(spots[None] - expected[:, None], axis=2) if len(spots) else None
    if apart_px is None or apart_px.min(axis=1).max() > 2.0:
        return {"solvePnP": "none", "poselib": "none"}
    seen = spots[apart_px.argmin(axis=1)]
    points = FIVE.positions_m[list(visible)]
    found, turn, shift = cv2.solvePnP(points, seen, CAMERA.matrix, None, flags=cv2.SOLVEPNP_SQPNP)
    theirs = Pose(cv2.Rodrigues(turn)[0], shift.ravel()) if found else None
    model = {
        "model": "PINHOLE", "width": CAMERA.width, "height": CAMERA.height,
        "params": [CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy],
    }  # fmt: skip
    pose, info = poselib.estimate_absolute_pose(seen, points, model, {"max_reproj_error": 1.0}, {})
    other = Pose(pose.R, pose.t) if info["num_inliers"] >= 3 else None
    return {
        "solvePnP": kind(theirs, None, truth, False),
        "poselib": kind(other, None, truth, False),
    }


def in_picture(pose: Pose) -> bool:
    spots = PINHOLE.project(pose.apply(FIVE.positions_m))
    edge = (PINHOLE.width - 21, PINHOLE.height - 21)
    return bool((spots > 20).all() and (spots < edge).all())


def tracked_run(rng: np.random.Generator) -> tuple[list[str], int]:
    """Kinds of the readings of one run, and readings from all five visible to a right pose.

    30 readings, 5 a second: 8 with the post and an outer reflector hidden, 10 with two subsets at
    random, then all five. The target turns at up to 4°/s and comes 2 % nearer a reading.
    """
    while True:
        start = Pose(*place(rng))
        turn = rng.normal(0.0, math.radians(2.0), 3) * 0.2
        poses = [start]
        for _ in range(29):
            last = poses[-1]
            step = Pose(cv2.Rodrigues(turn)[0], np.zeros(3))
            poses.append(Pose((step @ last).rotation, 0.98 * last.translation_m))
        facing = min(-(p.rotation[:, 2] @ p.translation_m) / p.translation_m[2] for p in poses)
        if all(in_picture(p) for p in poses) and facing > 0.8:
            break
    first = ((0, 3, 4), (2, 3, 4), (0, 2, 3), (0, 2, 4))[int(rng.integers(4))]
    plans = [first, *(SUBSETS[int(rng.integers(16))] for _ in range(2)), (0, 1, 2, 3, 4)]
    sensor, kinds, recovered = ReflectorSensor(CAMERA, [FIVE]), [], 99
    for n, truth in enumerate(poses):
        visible = plans[0 if n < 8 else 1 if n < 13 else 2 if n < 18 else 3]
        frames = picture(rng, visible, (truth.rotation, truth.translation_m))
        reading = sensor.update(0.2 * n, frames)
        kinds.append(kind(reading.pose, reading.status, truth, reading.roll_ambiguous))
        if n >= 18 and kinds[-1] == "right":
            recovered = min(recovered, n - 18)
    return kinds, recovered


def tracked(*, runs: int = 200, seed: int = 2) -> None:
    """Tracked runs that begin with the post and an outer reflector hidden; all five at the end.

    Plain pictures as those of reflector-hidden: 30 readings a run, 5 a second, turning at up to
    4°/s. What is hidden changes at readings 8, 13 and 18; from there all five are visible.
    """
    rng = np.random.default_rng(seed)
    counts: Counter[str] = Counter()
    locked, late = 0, []
    for _ in range(runs):
        kinds, recovered = tracked_run(rng)
        counts.update(kinds)
        locked += "wrong" in kinds
        late.append(recovered)
    table = table_of(f"{runs} tracked runs, seed {seed}", ["", "readings"])
    for name in KINDS:
        table.add_row(name, str(counts[name]))
    show(table)
    print(
        f"runs with a wrong pose as ok: {locked}; readings from all five visible to the right "
        f"pose: {Counter(late)}"
    )


def one(n: int, seed: int, sensor: ReflectorSensor, simulator: Simulator) -> dict[str, Any]:
    """Reading n, which depends on its number and the seed only: group, answers, degrees off."""
    rng = np.random.default_rng([seed, n])
    visible = SUBSETS[n % len(SUBSETS)]
    placed = place(rng)
    truth = Pose(*placed)
    frames = picture(rng, visible, placed, simulator)
    sensor.forget()
    reading = sensor.update(0.0, frames)
    answers = {"this sensor": kind(reading.pose, reading.status, truth, reading.roll_ambiguous)}
    error = 0.0
    if reading.pose is not None:
        error = apart(reading.pose, truth, reading.roll_ambiguous)[0]
    group = f"{len(visible)} visible"
    if len(visible) < 5:
        group += ", with post" if 1 in visible else ", without post"
    answers |= peers(frames, visible, truth)
    return {
        "n": n, "seed": seed, "simulator": simulator, "group": group, "error_deg": error,
        "answers": answers,
    }  # fmt: skip


def run(
    *, readings: int = 10_000, seed: int = 1,
    simulator: Simulator = "plain",
    log: Annotated[Path | None, "what is there is kept; the rest is added (JSON lines)"] = None,
) -> None:  # fmt: skip
    """Every subset of three to five of Bales' five reflectors: right, wrong, ambiguous or none.

    Plain pictures of the tests' simulator, which shares no code with the product, or of the
    product's own: 1 to 8 m, tilt to 35°, every roll, blur of 0.6 to 0.9 px, retro-reflected and
    even light, no to three false spots as large and bright as the discs. Each reading on its own.
    Wrong: more than 5° or 3 % of the range off (half a turn of roll is no error where it is
    reported). OpenCV's SQPNP and poselib's RANSAC have our centroids with the right names of the
    reflectors, and no false spots.
    With --log a run that was stopped goes on where it was.
    """
    done: list[dict[str, Any]] = []
    if log is not None and log.exists():
        same = {"seed": seed, "simulator": simulator}
        done = [line for line in read_json_lines(log) if same.items() <= line.items()][:readings]
    sensor = ReflectorSensor(CAMERA, [FIVE], tracking=TrackingOptions(confirm=False))
    with nullcontext() if log is None else log.open("a", encoding="utf-8") as file:
        for n in range(len(done), readings):
            done.append(one(n, seed, sensor, simulator))
            if file is not None:
                file.write(json.dumps(done[-1]) + "\n")
                file.flush()
    _show(done, seed)


def _show(done: list[dict[str, Any]], seed: int) -> None:
    counts: dict[str, Counter[str]] = defaultdict(Counter)
    for line in done:
        for name, answer in line["answers"].items():
            counts[f"{name} | {line['group']}"][answer] += 1
    table = table_of(f"{len(done)} readings, seed {seed}", ["solver", "spots", *KINDS], left=2)
    for name in ("this sensor", "solvePnP", "poselib"):
        whole: Counter[str] = Counter()
        for key in sorted(counts):
            if key.startswith(name):
                table.add_row(*key.split(" | "), *[str(counts[key][k]) for k in KINDS])
                whole += counts[key]
        table.add_row(name, "all", *[f"{100.0 * whole[k] / len(done):.2f} %" for k in KINDS])
    show(table)
    wrong = [line for line in done if line["answers"]["this sensor"] == "wrong"]
    print(
        f"largest error of a wrong pose: {max((x['error_deg'] for x in wrong), default=0.0):.0f}°"
    )
