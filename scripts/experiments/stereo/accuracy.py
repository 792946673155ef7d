"""The stereo LED tracker in its simulated laboratory, as docs/stereo.md reports it."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from experiments.frame import MODELS_CAD, show, table_of, tests_module
from experiments.peers.pnp import rig as by_peers
from experiments.stereo.board import squared_error
from rendezview.calibration.laboratory import calibrate_laboratory
from rendezview.geometry.pose import Pose
from rendezview.io.target import Target
from rendezview.sensors.beacons import (
    MotionOptions,
    Normalisation,
    Rig,
    Sights,
    Spots,
    StereoTracker,
    TrackerOptions,
    yaw_pitch_roll,
)
from rendezview.sensors.beacons.detect.led_spots import find_spots
from rendezview.sensors.beacons.match.agreement import iterate
from rendezview_ground.simulate.led_laboratory import LaboratoryOptions
from rendezview_ground.simulate.led_pictures import PictureOptions

Simulator = Literal["own", "plain"]
PAPER = {2.0: 0.08, 0.5: 0.02}  # degrees about the line
POSITIONS = 41  # of the stage; the paper's figure does not give it
RATE_HZ, SIGNAL_TO_NOISE = 10.0, 200.0
AVERAGED = 60  # the paper: "several"; its calibration averages 60
_NO_POSE = np.full((3, 3), np.nan)


def line(set_deg: np.ndarray, read_deg: np.ndarray) -> tuple[float, float]:
    """Slope, and r.m.s. scatter about the fitted line; readings without a pose are NaN."""
    seen = np.isfinite(read_deg)
    set_deg, read_deg = set_deg[seen], read_deg[seen]
    slope, offset = np.polyfit(set_deg, read_deg, 1)
    left = read_deg - slope * set_deg - offset
    return float(slope), float(np.sqrt((left**2).sum() / (len(left) - 2)))


def turned_deg(rotations: np.ndarray) -> np.ndarray:
    """Turn of each about the stage's axis from their mean; the lights' plane does not matter."""
    seen = np.isfinite(rotations[:, 0, 0])
    turned = np.full(len(rotations), np.nan)
    u, _, vt = np.linalg.svd(rotations[seen].mean(axis=0))
    _x, _y, z, w = Rotation.from_matrix(rotations[seen] @ (u @ vt).T).as_quat().T
    turned[seen] = np.rad2deg(2.0 * np.arctan2(z, w))
    return turned


def quiet(rig: Rig) -> Rig:
    """As the rig file of a mean of so many scans, which has less noise."""
    cameras = []
    for one in rig.cameras:
        assert one.photodiode is not None
        diode = replace(one.photodiode, noise=one.photodiode.noise / np.sqrt(AVERAGED))
        cameras.append(replace(one, photodiode=diode))
    return replace(rig, cameras=tuple(cameras))


def bound_deg(covariances: Iterable[np.ndarray]) -> float:
    """Least r.m.s. error of the turn about z."""
    return float(np.rad2deg(np.sqrt(np.mean([one[2, 2] for one in covariances]))))


def cells(
    step: float, name: str, scans: int, lines: list[tuple[float, float]],
    bound: float | None, squares: list[float],
) -> list[str]:  # fmt: skip
    """One row of the table."""
    slopes, scatters = np.array(lines).T
    scatter = float(np.sqrt((scatters**2).mean()))
    against = ("", "") if bound is None else (f"{bound:.5f}°", f"{scatter / bound:.3f}")
    return [
        f"{step}°", name, f"{len(lines)} × {POSITIONS} of {scans} scan{'s' * (scans > 1)}",
        f"{slopes.mean():.4f}", f"{scatter:.5f}°", *against,
        f"{np.mean(squares):.1f}" if squares else "",
    ]  # fmt: skip


def leds_of(target: Target) -> np.ndarray:
    """(L, 3) places of the lights, target frame."""
    return np.array([led.position_m for led in target.leds])


def spots_of(rig: Rig, currents: np.ndarray) -> list[Spots]:
    """The spots of each camera of a reading (C, L, 4)."""
    return [c.photodiode.read(row) for c, row in zip(rig.cameras, currents, strict=True)]


def by_paper(rig: Rig, target: Target, currents: np.ndarray, first: Pose) -> np.ndarray:
    """One unweighted iteration from the last estimate; yaw of eq. 3, degrees."""
    leds, rotation, translation = leds_of(target), first.rotation, first.translation_m
    yaws = []
    for reading in currents:
        sights = rig.sights(spots_of(rig, reading), len(leds))
        even = np.where(sights.weight > 0.0, np.median(sights.weight), 0.0)
        fit = iterate(rig, leds, Sights(sights.xy, even), rotation, translation, iterations=1)
        rotation, translation = fit.rotation, fit.translation
        yaws.append(yaw_pitch_roll(rotation).yaw)
    return np.rad2deg(np.unwrap(yaws))


def by_tracker(
    rig: Rig, target: Target, currents: np.ndarray, motion: MotionOptions | None, poses: list[Pose]
) -> tuple[np.ndarray, list[float]]:
    """Rotations, and NEES of each pose, with the calibration's covariance."""
    options = TrackerOptions(motion=motion, calibration_error=True)
    tracker = StereoTracker.of_target(rig, target, options)
    first, rotations, squares = rig.cameras[0].camera_from_rig, [], []
    for k, reading in enumerate(currents):
        observation = tracker.update(k / RATE_HZ, spots_of(rig, reading))
        found = observation.estimate or observation.fit
        rotations.append(_NO_POSE if found is None else found.rotation)
        if observation.pose is not None:
            squares.append(squared_error(observation, first @ poses[k]))
    return np.stack(rotations), squares


def by_others(rig: Rig, target: Target, currents: np.ndarray) -> dict[str, np.ndarray]:
    """Rotations by OpenCV in one camera and by poselib in both, from the same places."""
    rotations: dict[str, list[np.ndarray]] = {"solvePnP, one camera": [], "poselib, both": []}
    for reading in currents:
        sights = rig.sights(spots_of(rig, reading), len(target.leds))
        answers = by_peers(leds_of(target), sights, rig).values()
        for own, pose in zip(rotations.values(), answers, strict=True):
            own.append(_NO_POSE if pose is None else pose.rotation)
    return {name: np.stack(own) for name, own in rotations.items() if own}


def by_pictures(
    laboratory: Any, target: Target, poses: list[Pose], options: PictureOptions,
    rng: np.random.Generator,
) -> tuple[np.ndarray, list[float]]:  # fmt: skip
    """Single readings of two pictures; the lights are not named. Rotations, and NEES."""
    rig, rotations, squares = laboratory.picture_rig, [], []
    tracker, first = StereoTracker.of_target(rig, target), rig.cameras[0].camera_from_rig
    for k, pose in enumerate(poses):
        spots = [find_spots(picture) for picture in laboratory.pictures(pose, options, rng)]
        observation = tracker.update(k / RATE_HZ, spots)
        rotations.append(_NO_POSE if observation.fit is None else observation.fit.rotation)
        if observation.pose is not None:
            squares.append(squared_error(observation, first @ pose))
    return np.stack(rotations), squares


def run(*, seed: int = 11, runs: int = 100, simulator: Simulator = "own") -> None:
    """Pose errors of the stereo LED tracker in its simulated laboratory, signal-to-noise 200.

    A stage turns by 2° or 0.5° a reading, as in figure 8 of Welch et al. (1991): measured angle
    against set angle, slope and scatter about the line, beside the Cramér–Rao bound. The photodiode
    rig is calibrated in the simulation first. NEES of poses, calibration included. --simulator: the
    product's own, or the tests' plain one, which shares no code with it.
    """
    target, rng = Target.load(MODELS_CAD / "scole"), np.random.default_rng(seed)
    both = tests_module("plain_laboratory")
    made = both.PlainLaboratory if simulator == "plain" else both.OwnLaboratory
    options = LaboratoryOptions(signal_to_noise=SIGNAL_TO_NOISE, distorted=True)
    laboratory = made(leds_of(target), options, seed)
    record = laboratory.calibration(rng)
    rig = calibrate_laboratory(record).rig
    plain = calibrate_laboratory(record, Normalisation.PAIR, order=3).rig
    columns = "step | method | readings | slope | scatter | bound | ratio | NEES"
    table = table_of(f"figure 8, seed {seed}, {simulator} simulator", columns, left=8)
    for step in PAPER:
        angles = step * (np.arange(POSITIONS) - POSITIONS // 2)
        poses = laboratory.stage(np.deg2rad(angles))
        lines: dict[str, list[tuple[float, float]]] = defaultdict(list)
        squares: dict[str, list[float]] = defaultdict(list)
        none: Counter[str] = Counter()  # readings without a pose
        for _ in range(runs):
            currents = laboratory.currents(poses, rng)
            noise = rng.normal(0.0, laboratory.noise / np.sqrt(AVERAGED), currents.shape)
            mean = laboratory.currents(poses, None) + noise
            for name, given in (("paper, one scan", currents), (f"paper, {AVERAGED} scans", mean)):
                lines[name].append(line(angles, by_paper(plain, target, given, poses[0])))
            turned: dict[str, np.ndarray] = {}
            for name, cameras, given, motion in (
                ("ours, one scan", rig, currents, None),
                ("ours, filter", rig, currents, MotionOptions()),
                (f"ours, {AVERAGED} scans", quiet(rig), mean, None),
            ):
                turned[name], off = by_tracker(cameras, target, given, motion, poses)
                squares[name] += off
            for name, rotations in (turned | by_others(rig, target, currents)).items():
                none[name] += int(np.isnan(rotations[:, 0, 0]).sum())
                lines[name].append(line(angles, turned_deg(rotations)))
        table.add_row(f"{step}°", "paper, as printed", "several scans", "≠ 1", f"{PAPER[step]}°")
        bound = bound_deg(laboratory.bound(pose) for pose in poses)
        for name, found in lines.items():
            scans = AVERAGED if f"{AVERAGED}" in name else 1
            own = None if "filter" in name else bound / np.sqrt(scans)
            table.add_row(*cells(step, name, scans, found, own, squares[name]))
        options = PictureOptions(signal_to_noise=SIGNAL_TO_NOISE)
        found, off = [], []
        for _ in range(max(runs // 10, 1)):
            rotations, own = by_pictures(laboratory, target, poses, options, rng)
            found.append(line(angles, turned_deg(rotations)))
            off += own
        bound = bound_deg(laboratory.picture_bound(pose, options) for pose in poses)
        table.add_row(*cells(step, "ours, two picture cameras", 1, found, bound, off))
        print(f"{step}°, readings without a pose: {dict(none)}")
    show(table, width=110)
