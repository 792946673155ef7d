"""Every subset of three to five of five reflectors: right, wrong, ambiguous or none."""

from __future__ import annotations

import itertools
import math
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from experiments.frame import CLIENT, show, table_of
from experiments.peers.pnp import PEERS, one_camera
from experiments.reflectors import lab
from experiments.reflectors.lab import plain
from rendezview import LitDark, Pose, ReflectorSensor, Target, patterns_of
from rendezview.sensors.beacons import ReflectorPattern, TrackingOptions, find_spots
from rendezview.sensors.beacons.detect.discs import expected_size
from rendezview.sensors.beacons.match.acquisition import merged
from rendezview.sensors.beacons.observation import ReflectorObservation

READINGS = 30  # of a tracked sequence
RATIO, NEAR_OFFSET_M = 0.22, (0.05, -0.3, 0.0)


@dataclass(frozen=True)
class Motion:
    """A face that drifts past the camera: place and attitude at a time, linear in it."""

    rotation: np.ndarray
    translation: np.ndarray
    turn_rad_s: np.ndarray
    velocity_m_s: np.ndarray

    def __call__(self, time_s: float) -> Pose:
        angle = float(np.linalg.norm(self.turn_rad_s)) * time_s
        turned = plain.turn(self.turn_rad_s, angle) if angle else np.eye(3)
        return Pose(turned @ self.rotation, self.translation + time_s * self.velocity_m_s)


def moving(rng: np.random.Generator, ranges_m: tuple[float, float], margin_px: float) -> Motion:
    """An approach at up to 0.03 of the range a second, turning at up to 1.5°/s about any axis."""
    range_m = math.exp(rng.uniform(*np.log(ranges_m)))
    rotation, translation = plain.look_at(rng, lab.PINHOLE, range_m, math.radians(25.0), margin_px)
    drift = range_m * rng.normal(0.0, 0.003, 3) - rng.uniform(0.0, 0.03) * translation
    return Motion(rotation, translation, rng.normal(0.0, math.radians(0.8), 3), drift)


def group_of(scale: float, name: str, offset: tuple[float, float, float]) -> ReflectorPattern:
    """The paper's three reflectors, all lengths scaled."""
    return ReflectorPattern(
        name, tuple(f"{name}-{n}" for n in lab.THREE.names), scale * lab.THREE.positions_m + offset,
        lab.THREE.normals, scale * lab.THREE.diameters_m,
    )  # fmt: skip


def look_of(rng: np.random.Generator):
    return plain.Look(blur=rng.uniform(0.6, 0.8), even=bool(rng.random() < 0.5))


def groups(
    rng: np.random.Generator, patterns: list[ReflectorPattern], ranges_m: tuple[float, float],
    readings: int = READINGS,
) -> Iterator[str]:  # fmt: skip
    """An approach to a target of two groups; in one of three one of the groups is covered."""
    both, look = merged(patterns), look_of(rng)
    motion = moving(rng, ranges_m, 90.0)
    aim = patterns[0].target_from_face.inverse()
    first = len(patterns[0])
    covered = ((), (), (), (), tuple(range(first)), tuple(range(first, len(both))))[rng.integers(6)]
    tracking = TrackingOptions(confirm=readings > 1)
    sensor = ReflectorSensor(lab.CAMERA, patterns, tracking=tracking)
    for k in range(readings):
        pose = motion(0.2 * k) @ aim
        placed = pose.rotation, pose.translation_m
        frames = lab.pictures("plain", both, placed, look, rng, hidden=covered)
        yield judged(sensor.update(0.2 * k, frames), pose, patterns)


def glint(rng: np.random.Generator, pattern: ReflectorPattern, hide: bool) -> Iterator[str]:
    """A light as large and bright as a disc crosses one of them; with ``hide`` that goes out."""
    motion, look = moving(rng, (1.5, 5.0), 130.0), look_of(rng)
    sensor = ReflectorSensor(lab.CAMERA, [pattern])
    struck, when = int(rng.integers(len(pattern))), rng.uniform(8.0, 20.0)
    way = rng.uniform(0.0, 2.0 * math.pi)
    speed = math.exp(rng.uniform(math.log(0.5), math.log(8.0)))  # px a reading
    step = speed * np.array([math.cos(way), math.sin(way)])
    miss, bright = rng.normal(0.0, 1.0, 2), rng.uniform(120.0, 200.0)
    for k in range(READINGS):
        pose = motion(0.2 * k)
        places = pose.apply(pattern.positions_m)
        blur_px = math.hypot(look.blur, math.sqrt(1.0 / 12.0))
        size = expected_size(blur_px, 0.0125 * lab.PINHOLE.focal_px / places[struck, 2])
        at = lab.PINHOLE.project(places)[struck] + (k - when) * step + miss
        covered = (struck,) if hide and when <= k < when + 6 else ()
        placed, false = (pose.rotation, pose.translation_m), np.array([[*at, size, bright]])
        frames = lab.pictures("plain", pattern, placed, look, rng, hidden=covered, false=false)
        yield judged(sensor.update(0.2 * k, frames), pose, [pattern])


def judged(reading: ReflectorObservation, truth: Pose, patterns: list[ReflectorPattern]) -> str:
    """What an answer is; a half turn is no error where it is reported."""
    truths = [truth]
    if reading.roll_ambiguous:
        faces = [pattern.target_from_face for pattern in patterns]
        truths += [truth @ face @ lab.HALF_TURN @ face.inverse() for face in faces]
    return lab.kind(reading.pose, reading.status, *truths)


SHAPED = [group_of(1.0, "far", (0.0, 0.0, 0.0)), group_of(RATIO, "near", NEAR_OFFSET_M)]
SCENES: dict[str, Callable[[np.random.Generator], Iterator[str]]] = {
    "two groups of one shape, alone": lambda rng: groups(rng, SHAPED, (2.0, 12.0), 1),
    "two groups of one shape, tracked": lambda rng: groups(rng, SHAPED, (2.0, 12.0)),
    "client, alone": lambda rng: groups(rng, patterns_of(Target.load(CLIENT)), (2.0, 14.0), 1),
    "client, tracked": lambda rng: groups(rng, patterns_of(Target.load(CLIENT)), (2.0, 14.0)),
    "glint, three reflectors": lambda rng: glint(rng, lab.THREE, False),
    "glint for a reflector, three": lambda rng: glint(rng, lab.THREE, True),
    "glint, five reflectors": lambda rng: glint(rng, lab.FIVE, False),
    "glint for a reflector, five": lambda rng: glint(rng, lab.FIVE, True),
}


def compare(readings: int, seed: int, scene: str) -> None:
    """Readings beside a rival: right, wrong, ambiguous or none."""
    table = table_of(f"seed {seed}", ["scene", "readings", *lab.KINDS], left=1)
    for number, (name, make) in enumerate(SCENES.items()):
        if scene not in name:
            continue
        counts: Counter[str] = Counter()
        n = 0
        while counts.total() < readings:
            counts.update(make(np.random.default_rng([seed, number, n])))
            n += 1
        table.add_row(name, str(counts.total()), *[str(counts[k]) for k in lab.KINDS])
    show(table)


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
    counts: dict[tuple[str, str], Counter[str]] = defaultdict(Counter)
    worst_deg = 0.0
    for n in range(readings):  # each depends on its number and the seed only
        rng, visible = np.random.default_rng([seed, n]), SUBSETS[n % len(SUBSETS)]
        placed = place(rng)
        frames, truth = picture(rng, visible, placed), Pose(*placed)
        sensor.forget()
        reading = sensor.update(0.0, frames)
        truths = [truth, truth @ lab.HALF_TURN] if reading.roll_ambiguous else [truth]
        answer = lab.kind(reading.pose, reading.status, *truths)
        if answer == "wrong":
            worst_deg = max(worst_deg, lab.apart(reading.pose, *truths)[0])
        for name, what in {"this sensor": answer, **by_peers(frames, visible, truth)}.items():
            for group in (f"{len(visible)} visible", "all"):
                counts[name, group][what] += 1
    table = table_of(f"{readings} readings, seed {seed}", ["solver", "spots", *lab.KINDS], left=2)
    for (name, group), own in sorted(counts.items()):
        table.add_row(name, group, *[f"{100.0 * own[k] / own.total():.2f} %" for k in lab.KINDS])
    show(table)
    print(f"largest error of a wrong pose: {worst_deg:.0f}°")
