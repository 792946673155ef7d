"""Cases of the stereo tracker in its simulated laboratory, and whether an answer is right."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from experiments.frame import nees
from experiments.stereo.plain import Simulator, Truth, laboratory
from rendezview.geometry.pose import Pose
from rendezview.geometry.so3 import between
from rendezview.io.target import Target
from rendezview.sensors.beacons import Rig, Sights, Spots, StereoObservation, StereoTracker
from rendezview.sensors.beacons.match.agreement import Disagreement, LightsFit, distance, iterate
from rendezview_ground.simulate.led_laboratory import LaboratoryOptions


@dataclass(frozen=True)
class Job:
    """The options of the parts."""

    seed: int
    cases: int | None
    snr: float
    simulator: Simulator = "own"

    def laboratory(self, target: Target, *, distorted: bool = False) -> Truth:
        """By default cameras without distortion, which nobody has to calibrate."""
        options = LaboratoryOptions(signal_to_noise=self.snr, distorted=distorted)
        return laboratory(self.simulator, leds_of(target), options, self.seed)


def leds_of(target: Target) -> np.ndarray:
    return np.array([led.position_m for led in target.leds])


def spots_of(rig: Rig, currents: np.ndarray) -> list[Spots]:
    return [c.photodiode.read(row) for c, row in zip(rig.cameras, currents, strict=True)]


def squared(rig: Rig, observation: StereoObservation, rig_from_target: Pose) -> float:
    """NEES of a pose; 6 is right."""
    truth, pose = rig.cameras[0].camera_from_rig @ rig_from_target, observation.pose
    turned, moved = between(pose.rotation, truth.rotation), pose.translation_m - truth.translation_m
    return nees(np.append(turned, moved), observation.covariance)


def random_pose(rng: np.random.Generator, tilt_deg: float) -> Pose:
    """Any yaw, tilted up to so much any way, lights towards the cameras."""
    tilt = np.deg2rad(tilt_deg) * np.sqrt(rng.uniform())
    around = rng.uniform(0.0, 2.0 * np.pi)
    tilted = Rotation.from_rotvec(tilt * np.array([np.cos(around), np.sin(around), 0.0]))
    turn = Rotation.from_rotvec([0.0, 0.0, rng.uniform(-np.pi, np.pi)])
    place = rng.uniform(-1.0, 1.0, 3) * (0.1, 0.1, 0.5)
    return Pose((tilted * turn).as_matrix(), place)


def at_pose(pose: Pose, found: LightsFit) -> LightsFit:
    """A pose in the place of that of a fit."""
    return LightsFit(pose.rotation, pose.translation_m, found.information, 0.0, 0, 0, found.sights)


def judge(
    tracker: StereoTracker, sights: Sights, found: LightsFit | Disagreement, pose: Pose
) -> str:
    """right: the minimum next to the truth, and the truth within its covariance."""
    if isinstance(found, Disagreement):
        return "refused"
    near = iterate(tracker.rig, tracker.leds, found.sights, pose.rotation, pose.translation_m)
    same = near is not None and distance(found, near) < 0.5
    if same and distance(found, at_pose(pose, found)) < 60.0:
        return "right"
    return "wrong"
