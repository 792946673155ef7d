"""The stereo LED tracker in its simulated laboratory, as docs/stereo.md reports it."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from experiments.frame import MODELS_CAD, nees, show, table_of, tests_module
from experiments.peers.pnp import rig as by_peers
from rendezview import Pose, Rig, StereoTracker, Target
from rendezview.calibration.laboratory import calibrate_laboratory
from rendezview.sensors.beacons import Spots, TrackerOptions
from rendezview.sensors.beacons.detect.led_spots import find_spots
from rendezview_ground.simulate.led_laboratory import LaboratoryOptions
from rendezview_ground.simulate.led_pictures import PictureOptions

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
    bound: float, squares: list[float],
) -> list[str]:  # fmt: skip
    """One row of the table."""
    slopes, scatters = np.array(lines).T
    scatter = float(np.sqrt((scatters**2).mean()))
    return [
        f"{step}°", name, f"{len(lines)} × {POSITIONS} of {scans} scan{'s' * (scans > 1)}",
        f"{slopes.mean():.4f}", f"{scatter:.5f}°", f"{bound:.5f}°", f"{scatter / bound:.3f}",
        f"{np.mean(squares):.1f}" if squares else "",
    ]  # fmt: skip


def leds_of(target: Target) -> np.ndarray:
    """(L, 3) places of the lights, target frame."""
    return np.array([led.position_m for led in target.leds])


def spots_of(rig: Rig, currents: np.ndarray) -> list[Spots]:
    """The spots of each camera of a reading (C, L, 4)."""
    return [c.photodiode.read(row) for c, row in zip(rig.cameras, currents, strict=True)]


def followed(
    tracker: StereoTracker, readings: Iterable[list[Spots]], poses: list[Pose]
) -> tuple[np.ndarray, list[float]]:
    """Rotations of single readings, and NEES of each pose."""
    first, rotations, squares = tracker.rig.cameras[0].camera_from_rig, [], []
    for k, (spots, pose) in enumerate(zip(readings, poses, strict=True)):
        seen = tracker.update(k / RATE_HZ, spots)
        rotations.append(_NO_POSE if seen.fit is None else seen.fit.rotation)
        if seen.pose is not None:
            squares.append(nees(seen.pose.delta_from(first @ pose), seen.covariance))
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


def run(*, seed: int = 11, runs: int = 100) -> None:
    """Pose errors of the stereo LED tracker in its simulated laboratory, signal-to-noise 200.

    A stage turns by 2° or 0.5° a reading, as in figure 8 of Welch et al. (1991): measured angle
    against set angle, slope and scatter about the line, beside the Cramér–Rao bound. The photodiode
    rig is calibrated in the simulation first. NEES of poses, calibration included.
    """
    target, rng = Target.load(MODELS_CAD / "scole"), np.random.default_rng(seed)
    options = LaboratoryOptions(signal_to_noise=SIGNAL_TO_NOISE, distorted=True)
    made = tests_module("plain_laboratory").OwnLaboratory
    laboratory = made(leds_of(target), options, seed)
    rig = calibrate_laboratory(laboratory.calibration(rng)).rig
    columns = "step | method | readings | slope | scatter | bound | ratio | NEES"
    table = table_of(f"figure 8, seed {seed}", columns, left=8)
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
            turned: dict[str, np.ndarray] = {}
            for name, cameras, given in (
                ("ours, one scan", rig, currents), (f"ours, {AVERAGED} scans", quiet(rig), mean),
            ):  # fmt: skip
                options = TrackerOptions(motion=None)
                tracker = StereoTracker.of_target(cameras, target, options)
                readings = (spots_of(cameras, reading) for reading in given)
                turned[name], off = followed(tracker, readings, poses)
                squares[name] += off
            for name, rotations in (turned | by_others(rig, target, currents)).items():
                none[name] += int(np.isnan(rotations[:, 0, 0]).sum())
                lines[name].append(line(angles, turned_deg(rotations)))
        table.add_row(f"{step}°", "paper, as printed", "several scans", "≠ 1", f"{PAPER[step]}°")
        bound = bound_deg(laboratory.bound(pose) for pose in poses)
        for name, found in lines.items():
            scans = AVERAGED if f"{AVERAGED}" in name else 1
            own = bound / np.sqrt(scans)
            table.add_row(*cells(step, name, scans, found, own, squares[name]))
        options = PictureOptions(signal_to_noise=SIGNAL_TO_NOISE)
        found, off = [], []
        for _ in range(max(runs // 10, 1)):
            tracker = StereoTracker.of_target(laboratory.picture_rig, target)
            shown = (laboratory.pictures(pose, options, rng) for pose in poses)
            readings = ([find_spots(picture) for picture in both] for both in shown)
            rotations, own = followed(tracker, readings, poses)
            found.append(line(angles, turned_deg(rotations)))
            off += own
        bound = bound_deg(laboratory.picture_bound(pose, options) for pose in poses)
        table.add_row(*cells(step, "ours, two picture cameras", 1, found, bound, off))
        print(f"{step}°, readings without a pose: {dict(none)}")
    show(table, width=110)
