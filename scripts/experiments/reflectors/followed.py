"""The last reading of a tracked sequence: covered discs, rolling shutter, dropped pictures."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from experiments.frame import unit
from experiments.reflectors import lab
from experiments.reflectors.hidden import Motion
from experiments.reflectors.lab import plain
from rendezview import LitDark, Pose, ReflectorSensor
from rendezview.geometry.so3 import between
from rendezview.sensors.beacons import ReflectorPattern, TrackingOptions
from rendezview.sensors.beacons.observation import ReflectorObservation

READINGS, STEP_S, DROPPED = 12, 0.1, 0.3
READOUT_S, TURN_RAD_S = 0.033, np.deg2rad(20.0)
SWUNG, SWUNG_STEP_S = 30, 0.2


def swinging(rng: np.random.Generator, motion: Motion) -> Callable[[float], Pose]:
    """A motion that also swings, by 1 to 6° and 0.2 to 2 % of the range, periods of 3 to 40 s."""
    axis, way = unit(rng), unit(rng) * np.linalg.norm(motion.translation) * rng.uniform(0.002, 0.02)
    turn, phases = np.deg2rad(rng.uniform(1.0, 6.0)), rng.uniform(0.0, 2.0 * np.pi, 2)
    speed = 2.0 * np.pi / np.exp(rng.uniform(*np.log((3.0, 40.0))))

    def pose(time_s: float) -> Pose:
        swing = np.sin(speed * time_s + phases) - np.sin(phases)  # 0 at the last reading
        own = plain.turn(axis, turn * swing[0])
        steady = motion(time_s)
        return Pose(own @ steady.rotation, steady.translation_m + swing[1] * way)

    return pose


def rolled(
    pattern: ReflectorPattern, pose: Callable[[float], Pose], time_s: float,
    rng: np.random.Generator,
) -> LitDark:  # fmt: skip
    """Each disc where it is when its own row is exposed; ``time_s`` is the middle row's."""
    places, normals = np.empty((2, len(pattern), 3))
    for k in range(len(pattern)):
        late = 0.0
        for _ in range(5):
            there = pose(time_s + late)
            places[k] = there.apply(pattern.positions_m[k])
            normals[k] = there.rotation @ pattern.normals[k]
            row = lab.PINHOLE.project(places[k : k + 1])[0, 1]
            late = READOUT_S * (row / (lab.PINHOLE.height - 1) - 0.5)
    middle, look = pose(time_s).translation_m, plain.Look()
    discs = (places - middle, normals, pattern.diameters_m)
    light = plain.discs(lab.PINHOLE, np.eye(3), middle, *discs, look)
    return LitDark(*plain.pair(lab.PINHOLE, light, look, rng))


def followed(
    kind: str, pattern: ReflectorPattern, placed: tuple[np.ndarray, np.ndarray], edge: float,
    rng: np.random.Generator,
) -> tuple[ReflectorObservation, np.ndarray]:  # fmt: skip
    """The last reading of a sequence that ends at a place, and the true rates (6,) there.

    An ``edge`` below 1 creeps over one disc and stays there for the last three readings.
    """
    range_m, rolling = float(np.linalg.norm(placed[1])), "rolling" in kind
    turn = TURN_RAD_S * unit(rng) if rolling else rng.normal(0.0, np.deg2rad(0.8), 3)
    drift = range_m * rng.normal(0.0, 0.003, 3) - rng.uniform(0.0, 0.03) * placed[1]
    motion = Motion(*placed, turn, drift)
    pose = swinging(rng, motion) if "swinging" in kind else motion
    count, step_s = (SWUNG, SWUNG_STEP_S) if "swinging" in kind else (READINGS, STEP_S)
    gaps = rng.geometric(1.0 - DROPPED, count - 1) if "dropped" in kind else np.ones(count - 1)
    times = step_s * np.append(0.0, np.cumsum(gaps))[::-1]
    tracking = TrackingOptions(readout_s=READOUT_S if rolling else 0.0)
    sensor = ReflectorSensor(lab.CAMERA, [pattern], tracking=tracking)
    which, way = int(rng.integers(len(pattern))), rng.uniform(0.0, 2.0 * np.pi)
    for k, ago in enumerate(times):
        there, now = pose(-ago), 1.0 + (edge - 1.0) * min(k / (count - 3), 1.0)
        covers = {which: (way, now)} if edge < 1.0 else None
        frames = rolled(pattern, pose, -ago, rng) if rolling else lab.pictures(
            "plain", pattern, (there.rotation, there.translation_m), plain.Look(), rng,
            covers=covers,
        )  # fmt: skip
        reading = sensor.update(-ago, frames)
    before, after = pose(-1e-5), pose(1e-5)
    rates = between(after.rotation.copy(), before.rotation.copy())
    return reading, np.append(rates, after.translation_m - before.translation_m) / 2e-5
