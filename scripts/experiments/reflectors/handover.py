"""Hand-over from the far to the near group, and an outer reflector that is larger."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from rendezview.sensors.reflectors import (
    ReflectorSensor,
    SixNumbers,
    TrackingOptions,
    patterns_of,
    pose_of,
)
from rendezview.sensors.reflectors.acquisition import merged

from experiments.frame import show, table_of
from experiments.peers.pnp import PEERS, of_reading
from experiments.reflectors.plain import CAMERA, PINHOLE, THREE, Simulator, pictures, plain
from experiments.reflectors.run import CLIENT
from rendezview.geometry.pose import Pose
from rendezview.io.target import Target

ROLLS_DEG = (0, 45, 90, 120, 160, 180, -160, -100)


def approach(roll_deg: float) -> list[Pose]:
    """8 m to 0.75 m; the boresight moves from the far group to the near one from 5 to 2 m."""
    far, near = patterns_of(Target.load(CLIENT))
    poses = []
    for range_m in np.geomspace(8.0, 0.75, 80):
        pose = pose_of(SixNumbers(range_m, 0.0, 0.0, math.radians(roll_deg), 0.05, -0.04), near)
        share = min(max((5.0 - range_m) / 3.0, 0.0), 1.0)
        aim = (1.0 - share) * pose.apply(far.centre_m) + share * pose.apply(near.centre_m)
        off = math.hypot(aim[0], aim[1])
        turn = np.eye(3)
        if off > 1e-9:
            turn = plain.turn(np.array([aim[1], -aim[0], 0.0]), math.atan2(off, aim[2]))
        poses.append(Pose(turn, np.zeros(3)) @ pose)
    return poses


def run(*, seed: int = 5, simulator: Simulator = "plain") -> None:
    """Range from which the roll is known, and readings with a roll half a turn off, by roll.

    The client's two targets, 8 m to 0.75 m in 80 readings, the far target on the boresight first.
    Tracked: one sensor; single: each reading on its own.
    """
    patterns = patterns_of(Target.load(CLIENT))
    all_ = merged(patterns)
    table = table_of(
        f"seed {seed}, {simulator} simulator",
        "roll ° | known from m, single | tracked | wrong as known, single | tracked"
        " | solvePnP, poselib wrong on the single ones' spots",
        left=0,
    )
    for roll in ROLLS_DEG:
        rng = np.random.default_rng(seed)
        sensor = ReflectorSensor(CAMERA, patterns)
        known, wrong = {"single": 0.0, "tracked": 0.0}, {"single": 0, "tracked": 0}
        others = dict.fromkeys(PEERS, 0)
        for n, truth in enumerate(approach(roll)):
            placed = truth.rotation, truth.translation_m
            frames = pictures(simulator, all_, placed, plain.Look(), rng)
            alone = ReflectorSensor(CAMERA, patterns, tracking=TrackingOptions(confirm=False))
            for name, reading in (
                ("single", alone.update(0.0, frames)), ("tracked", sensor.update(0.5 * n, frames))
            ):  # fmt: skip
                if reading.pose is None or reading.roll_ambiguous:
                    continue
                if name == "single":
                    for peer, pose in of_reading(reading, all_, CAMERA).items():
                        others[peer] += pose is None or pose.angle_to(truth) >= 0.1
                if reading.pose.angle_to(truth) < 0.1:
                    far_m = float(np.linalg.norm(truth.apply(patterns[1].centre_m)))
                    known[name] = max(known[name], far_m)
                else:
                    wrong[name] += 1
        table.add_row(
            str(roll), f"{known['single']:.1f}", f"{known['tracked']:.1f}", str(wrong["single"]),
            str(wrong["tracked"]), ", ".join(map(str, others.values())),
        )  # fmt: skip
    show(table)


def larger(*, readings: int = 100, seed: int = 6, simulator: Simulator = "plain") -> None:
    """Book's cure: one outer reflector larger by a ratio. Which way up is found, and how often.

    The paper's three reflectors, 1 to 5 m, tilt to 30°, every roll.
    """
    table = table_of(
        f"{readings} readings, seed {seed}, {simulator} simulator",
        "ratio | right | half a turn off | open | none"
        " | solvePnP, poselib wrong on the spots of the first two",
        left=0,
    )
    for ratio in (1.0, 1.25, 1.5, 2.0, 2.5, 3.0):
        rng = np.random.default_rng(seed)
        diameters = np.array([0.015, 0.015, 0.015 * ratio])
        pattern = replace(THREE, diameters_m=diameters)
        counts = dict.fromkeys(("right", "off", "open", "none"), 0)
        others = dict.fromkeys(PEERS, 0)
        for _ in range(readings):
            placed = plain.look_at(
                rng, PINHOLE, math.exp(rng.uniform(0.0, math.log(5.0))), 0.5, 150.0
            )
            sensor = ReflectorSensor(CAMERA, [pattern], tracking=TrackingOptions(confirm=False))
            reading = sensor.update(0.0, pictures(simulator, pattern, placed, plain.Look(), rng))
            if reading.pose is None:
                counts["none"] += 1
            elif reading.roll_ambiguous:
                counts["open"] += 1
            else:
                truth = Pose(*placed)
                counts["right" if reading.pose.angle_to(truth) < 0.1 else "off"] += 1
                for peer, pose in of_reading(reading, pattern, CAMERA).items():
                    others[peer] += pose is None or pose.angle_to(truth) >= 0.1
        wrong = ", ".join(map(str, others.values()))
        table.add_row(f"{ratio:g}", *(str(v) for v in counts.values()), wrong)
    show(table)
