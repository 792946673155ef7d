"""Scenes with a rival: two groups of one shape, a glint that sweeps by, mirrored pictures."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from experiments.frame import CLIENT, show, table_of
from experiments.reflectors.plain import CAMERA, FIVE, HALF_TURN, PINHOLE, THREE, apart, plain
from rendezview.geometry.pose import Pose
from rendezview.io.target import Target
from rendezview.sensors.beacons import (
    LitDark,
    ReflectorPattern,
    ReflectorSensor,
    TrackingOptions,
    patterns_of,
)
from rendezview.sensors.beacons.detect.discs import expected_size
from rendezview.sensors.beacons.match.acquisition import merged
from rendezview.sensors.beacons.observation import ReflectorObservation
from rendezview.sensors.observation import Status

WRONG_DEG, WRONG_SHARE = 5.0, 0.03
READINGS = 30  # of a tracked sequence
RATIO, NEAR_OFFSET_M = 0.22, (0.05, -0.3, 0.0)
KINDS = ("right", "wrong", "ambiguous", "none")


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
    rotation, translation = plain.look_at(rng, PINHOLE, range_m, math.radians(25.0), margin_px)
    drift = range_m * rng.normal(0.0, 0.003, 3) - rng.uniform(0.0, 0.03) * translation
    return Motion(rotation, translation, rng.normal(0.0, math.radians(0.8), 3), drift)


def group_of(scale: float, name: str, offset: tuple[float, float, float]) -> ReflectorPattern:
    """The paper's three reflectors, all lengths scaled."""
    return ReflectorPattern(
        name, tuple(f"{name}-{n}" for n in THREE.names), scale * THREE.positions_m + offset,
        THREE.normals, scale * THREE.diameters_m,
    )  # fmt: skip


def drawn(
    pattern: ReflectorPattern, pose: Pose, rng: np.random.Generator, look, hidden=(), false=None
) -> LitDark:
    light = plain.discs(
        PINHOLE, pose.rotation, pose.translation_m, pattern.positions_m, pattern.normals,
        pattern.diameters_m, look, hidden,
    )  # fmt: skip
    return LitDark(*plain.pair(PINHOLE, light, look, rng, false=false))


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
    sensor = ReflectorSensor(CAMERA, patterns, tracking=tracking)
    for k in range(readings):
        pose = motion(0.2 * k) @ aim
        yield kind(sensor.update(0.2 * k, drawn(both, pose, rng, look, covered)), pose, patterns)


def glint(rng: np.random.Generator, pattern: ReflectorPattern, hide: bool) -> Iterator[str]:
    """A light as large and bright as a disc crosses one of them; with ``hide`` that goes out."""
    motion, look = moving(rng, (1.5, 5.0), 130.0), look_of(rng)
    sensor = ReflectorSensor(CAMERA, [pattern])
    struck, when = int(rng.integers(len(pattern))), rng.uniform(8.0, 20.0)
    way = rng.uniform(0.0, 2.0 * math.pi)
    speed = math.exp(rng.uniform(math.log(0.5), math.log(8.0)))  # px a reading
    step = speed * np.array([math.cos(way), math.sin(way)])
    miss, bright = rng.normal(0.0, 1.0, 2), rng.uniform(120.0, 200.0)
    for k in range(READINGS):
        pose = motion(0.2 * k)
        places = pose.apply(pattern.positions_m)
        blur_px = math.hypot(look.blur, math.sqrt(1.0 / 12.0))
        size = expected_size(blur_px, 0.0125 * PINHOLE.focal_px / places[struck, 2])
        at = PINHOLE.project(places)[struck] + (k - when) * step + miss
        covered = (struck,) if hide and when <= k < when + 6 else ()
        frames = drawn(pattern, pose, rng, look, covered, np.array([[*at, size, bright]]))
        yield kind(sensor.update(0.2 * k, frames), pose, [pattern])


def kind(reading: ReflectorObservation, truth: Pose, patterns: list[ReflectorPattern]) -> str:
    """What an answer is, one of ``KINDS``; a half turn is no error where it is reported."""
    if reading.pose is None:
        return "ambiguous" if reading.status is Status.AMBIGUOUS else "none"
    truths = [truth]
    if reading.roll_ambiguous:
        faces = [pattern.target_from_face for pattern in patterns]
        truths += [truth @ face @ HALF_TURN @ face.inverse() for face in faces]
    off = min(apart(reading.pose, one, False) for one in truths)
    return "wrong" if off[0] > WRONG_DEG or off[1] > WRONG_SHARE else "right"


SHAPED = [group_of(1.0, "far", (0.0, 0.0, 0.0)), group_of(RATIO, "near", NEAR_OFFSET_M)]
SCENES: dict[str, Callable[[np.random.Generator], Iterator[str]]] = {
    "two groups of one shape, alone": lambda rng: groups(rng, SHAPED, (2.0, 12.0), 1),
    "two groups of one shape, tracked": lambda rng: groups(rng, SHAPED, (2.0, 12.0)),
    "client, alone": lambda rng: groups(rng, patterns_of(Target.load(CLIENT)), (2.0, 14.0), 1),
    "client, tracked": lambda rng: groups(rng, patterns_of(Target.load(CLIENT)), (2.0, 14.0)),
    "glint, three reflectors": lambda rng: glint(rng, THREE, False),
    "glint for a reflector, three": lambda rng: glint(rng, THREE, True),
    "glint, five reflectors": lambda rng: glint(rng, FIVE, False),
    "glint for a reflector, five": lambda rng: glint(rng, FIVE, True),
}


def compare(readings: int, seed: int, scene: str) -> None:
    """Readings beside a rival: right, wrong, ambiguous or none."""
    table = table_of(f"seed {seed}", ["scene", "readings", *KINDS], left=1)
    for number, (name, make) in enumerate(SCENES.items()):
        if scene not in name:
            continue
        counts: Counter[str] = Counter()
        n = 0
        while counts.total() < readings:
            counts.update(make(np.random.default_rng([seed, number, n])))
            n += 1
        table.add_row(name, str(counts.total()), *[str(counts[k]) for k in KINDS])
    show(table)
