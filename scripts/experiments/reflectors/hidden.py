"""Every subset of three to five of five reflectors: right, wrong, ambiguous or none."""

from __future__ import annotations

import itertools
import math
from collections import Counter, defaultdict
from typing import Annotated, Any

import numpy as np

from experiments.frame import show, table_of
from experiments.peers.pnp import PEERS, one_camera
from experiments.reflectors import lab
from experiments.reflectors.lab import plain
from experiments.reflectors.rivals import compare
from rendezview import LitDark, Pose, ReflectorSensor
from rendezview.sensors.beacons import TrackingOptions, find_spots

RANGES_M, TILT_RAD = (1.0, 8.0), math.radians(35.0)
BLUR_PX, MOST_FALSE = (0.6, 0.9), 3
SUBSETS = [s for n in (3, 4, 5) for s in itertools.combinations(range(5), n)]


def picture(
    rng: np.random.Generator, visible: tuple[int, ...], placed: tuple[np.ndarray, np.ndarray]
) -> LitDark:
    """One reading with up to three false spots as large and bright as a disc."""
    look = plain.Look(blur=rng.uniform(*BLUR_PX), even=bool(rng.random() < 0.5))
    hidden = tuple(k for k in range(5) if k not in visible)
    count = int(rng.integers(0, MOST_FALSE + 1))
    size = math.hypot(0.7, 0.5 * 0.0125 * lab.PINHOLE.focal_px / placed[1][2])
    places = [rng.uniform(5, side - 6, count) for side in (lab.CAMERA.width, lab.CAMERA.height)]
    sizes, peaks = size * rng.uniform(0.9, 1.1, count), rng.uniform(100.0, 200.0, count)
    false = np.column_stack([*places, sizes, peaks])
    return lab.pictures("plain", lab.FIVE, placed, look, rng, hidden=hidden, false=false)


def place(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A pose with all reflectors in the picture, every roll."""
    while True:
        range_m = math.exp(rng.uniform(*np.log(RANGES_M)))
        placed = plain.look_at(rng, lab.PINHOLE, range_m, TILT_RAD, 20.0)
        spots = lab.PINHOLE.project(lab.FIVE.positions_m @ placed[0].T + placed[1])
        margin = 6.0 + 0.0125 * lab.PINHOLE.focal_px / range_m
        edge = (lab.PINHOLE.width - 1 - margin, lab.PINHOLE.height - 1 - margin)
        if (spots > margin).all() and (spots < edge).all():
            return placed


def by_peers(frames: LitDark, visible: tuple[int, ...], truth: Pose) -> dict[str, str]:
    """OpenCV's and poselib's answers on our spots, which they are given with their names."""
    points, spots = lab.FIVE.positions_m[list(visible)], find_spots(frames).centroids_px
    apart_px = np.linalg.norm(
        spots[None] - lab.PINHOLE.project(truth.apply(points))[:, None], axis=2
    )
    if not len(spots) or apart_px.min(axis=1).max() > 2.0:
        return dict.fromkeys(PEERS, "none")
    answers = one_camera(points, spots[apart_px.argmin(axis=1)], lab.CAMERA)
    return {name: lab.kind(pose, None, truth) for name, pose in answers.items()}


def one(n: int, seed: int, sensor: ReflectorSensor) -> dict[str, Any]:
    """Reading n, which depends on its number and the seed only: group, answers, degrees off."""
    rng = np.random.default_rng([seed, n])
    visible = SUBSETS[n % len(SUBSETS)]
    placed = place(rng)
    truth = Pose(*placed)
    frames = picture(rng, visible, placed)
    sensor.forget()
    reading = sensor.update(0.0, frames)
    truths = [truth, truth @ lab.HALF_TURN] if reading.roll_ambiguous else [truth]
    answers = {"this sensor": lab.kind(reading.pose, reading.status, *truths)}
    error = 0.0 if reading.pose is None else lab.apart(reading.pose, *truths)[0]
    answers |= by_peers(frames, visible, truth)
    return {"group": f"{len(visible)} visible", "error_deg": error, "answers": answers}


def run(
    *, readings: int = 10_000, seed: int = 1,
    scene: Annotated[str, "group, client or glint: scenes with a rival, tracked"] = "",
) -> None:  # fmt: skip
    """Every subset of three to five of Bales' five reflectors: right, wrong, ambiguous or none.

    Pictures of the tests' plain simulator: 1 to 8 m, tilt to 35°, every roll, blur of 0.6 to 0.9
    px, retro-reflected and even light, up to three false spots as large and bright as the discs.
    Each reading on its own. Wrong: more than 5° or 3 % of the range off (half a turn of roll is no
    error where it is reported). OpenCV's SQPNP and poselib's RANSAC have our centroids with the
    right names, and no false spots.
    """
    if scene:
        compare(readings, seed, scene)
        return
    sensor = ReflectorSensor(lab.CAMERA, [lab.FIVE], tracking=TrackingOptions(confirm=False))
    done = [one(n, seed, sensor) for n in range(readings)]
    counts: dict[tuple[str, str], Counter[str]] = defaultdict(Counter)
    for line in done:
        for name, answer in line["answers"].items():
            for group in (line["group"], "all"):
                counts[name, group][answer] += 1
    table = table_of(f"{len(done)} readings, seed {seed}", ["solver", "spots", *lab.KINDS], left=2)
    for (name, group), own in sorted(counts.items()):
        table.add_row(name, group, *[f"{100.0 * own[k] / own.total():.2f} %" for k in lab.KINDS])
    show(table)
    wrong = [x["error_deg"] for x in done if x["answers"]["this sensor"] == "wrong"]
    print(f"largest error of a wrong pose: {max(wrong, default=0.0):.0f}°")
