"""The simulated laboratory of the stereo experiments, and what they ask of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from experiments.frame import nees, tests_module
from rendezview.geometry.pose import Pose
from rendezview.geometry.so3 import between
from rendezview.io.target import Target
from rendezview.sensors.beacons import Rig, Spots, StereoObservation
from rendezview_ground.simulate.led_laboratory import LaboratoryOptions

Simulator = Literal["own", "plain"]
SIGNAL_TO_NOISE = 200.0

both = tests_module("plain_laboratory")


@dataclass(frozen=True)
class Job:
    """The options of the parts."""

    seed: int
    cases: int | None
    simulator: Simulator = "own"

    def laboratory(self, target: Target, *, distorted: bool = False) -> Any:
        """Of one of the two simulators, which share no code.

        By default its cameras are without distortion, and nobody has to calibrate them.
        """
        options = LaboratoryOptions(signal_to_noise=SIGNAL_TO_NOISE, distorted=distorted)
        made = both.PlainLaboratory if self.simulator == "plain" else both.OwnLaboratory
        return made(leds_of(target), options, self.seed)


def leds_of(target: Target) -> np.ndarray:
    """(L, 3) places of the lights, target frame."""
    return np.array([led.position_m for led in target.leds])


def spots_of(rig: Rig, currents: np.ndarray) -> list[Spots]:
    """The spots of each camera of a reading (C, L, 4)."""
    return [c.photodiode.read(row) for c, row in zip(rig.cameras, currents, strict=True)]


def squared_error(observation: StereoObservation, truth: Pose) -> float:
    """NEES of a pose in the first camera's frame; 6 is right."""
    pose = observation.pose
    turned, moved = between(pose.rotation, truth.rotation), pose.translation_m - truth.translation_m
    return nees(np.append(turned, moved), observation.covariance)
