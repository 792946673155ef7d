"""The stereo LED tracker in its simulated laboratory, as docs/stereo.md reports it."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from rich.table import Table
from scipy.spatial.transform import Rotation

from experiments.frame import nees, show
from rendezview.geometry.pose import Pose
from rendezview.geometry.so3 import between
from rendezview.io.target import Target
from rendezview.sensors.stereo import (
    MotionOptions,
    Normalisation,
    Rig,
    Sights,
    Spots,
    StereoObservation,
    StereoTracker,
    TrackerOptions,
    yaw_pitch_roll,
)
from rendezview.sensors.stereo.agreement import Disagreement, LightsFit, distance, iterate
from rendezview.sensors.stereo.laboratory import calibrate_laboratory
from rendezview.sensors.stereo.spots import find_spots
from rendezview.simulation.led_laboratory import Laboratory, LaboratoryOptions
from rendezview.simulation.led_pictures import PictureOptions, draw, picture_bound, picture_rig

PAPER = {2.0: 0.08, 0.5: 0.02}  # degrees about the line
POSITIONS = 41  # of the stage; the paper's figure does not give it
RATE_HZ = 10.0
AVERAGED = 60  # the paper: "several"; its calibration averages 60


@dataclass(frozen=True)
class Job:
    """The options of the parts."""

    seed: int
    cases: int | None
    snr: float

    def laboratory(self, target: Target) -> Laboratory:
        """Cameras without distortion, which nobody has to calibrate."""
        options = LaboratoryOptions(signal_to_noise=self.snr, distorted=False)
        return Laboratory(leds_of(target), options, self.seed)


def run(
    *, part: Literal["figure8", "convergence", "recovery", "faults", "identity"],
    target: str = "models_cad/scole", seed: int = 11,
    cases: Annotated[int | None, "default: 10000; 100 runs; 2000; 500"] = None,
    snr: Annotated[float, "signal-to-noise ratio"] = 200.0,
) -> None:  # fmt: skip
    """Pose errors of the stereo LED tracker in its simulated laboratory.

    figure8: a stage turns by 2° or 0.5° a reading, as in figure 8 of Welch et al. (1991); measured
    angle against set angle, slope and scatter about the line, beside the Cramér–Rao bound. The
    photodiode rig is calibrated in the simulation first. NEES of poses, calibration included.
    convergence: one iteration from the last estimate after a step of 2°.
    recovery: the pose from one reading, without a prior.
    faults: lights missing, exchanged, or reflected; NEES of the right ones.
    identity: two picture cameras, all lights on at once, none named.
    """
    parts = {"figure8": figure8, "convergence": convergence, "recovery": recovery,
             "faults": faults, "identity": identity}  # fmt: skip
    print(f"seed {seed}, signal-to-noise {snr:g}, target {target}")
    start = time.perf_counter()
    parts[part](Job(seed, cases, snr), Target.load(target))
    print(f"{time.perf_counter() - start:.0f} s")


def leds_of(target: Target) -> np.ndarray:
    return np.array([led.position_m for led in target.leds])


def spots_of(rig: Rig, currents: np.ndarray) -> list[Spots]:
    return [c.photodiode.read(row) for c, row in zip(rig.cameras, currents, strict=True)]


def line(set_deg: np.ndarray, read_deg: np.ndarray) -> tuple[float, float]:
    """Slope, and r.m.s. scatter about the fitted line (two degrees of freedom fewer)."""
    slope, offset = np.polyfit(set_deg, read_deg, 1)
    left = read_deg - slope * set_deg - offset
    return float(slope), float(np.sqrt((left**2).sum() / (len(left) - 2)))


def turned_deg(rotations: np.ndarray) -> np.ndarray:
    """Turn of each about the stage's axis, the laboratory's z, from their mean, degrees.

    Unlike the yaw of eq. 3 it does not depend on the orientation of the lights' plane on the stage.
    """
    u, _, vt = np.linalg.svd(rotations.mean(axis=0))
    _x, _y, z, w = Rotation.from_matrix(rotations @ (u @ vt).T).as_quat().T
    return np.rad2deg(2.0 * np.arctan2(z, w))


def figure8(job: Job, target: Target) -> None:
    runs, seed = job.cases or 100, job.seed
    laboratory = Laboratory(leds_of(target), LaboratoryOptions(signal_to_noise=job.snr), seed)
    rng = np.random.default_rng(seed)
    record = laboratory.calibration(rng)
    rig = calibrate_laboratory(record).rig
    plain = calibrate_laboratory(record, Normalisation.PAIR, order=3).rig
    table = Table("step", "method", "readings", "slope", "scatter", "bound", "ratio", "NEES")
    quiet = []  # the mean of so many scans has less noise than the rig file says
    for one in rig.cameras:
        if (diode := one.photodiode) is not None:
            less = replace(diode, noise=diode.noise / np.sqrt(AVERAGED))
            quiet.append(replace(one, photodiode=less))
    averaged = replace(rig, cameras=tuple(quiet))
    for step in (2.0, 0.5):
        angles = step * (np.arange(POSITIONS) - POSITIONS // 2)
        poses = laboratory.stage(np.deg2rad(angles))
        bound = np.sqrt(np.mean([_about_z(laboratory.bound(pose)) for pose in poses]))
        rows: dict[str, list[tuple[float, float]]] = {}
        squares: dict[str, list[float]] = {}
        for _ in range(runs):
            currents = laboratory.currents(poses, rng)
            mean = laboratory.currents(poses, None) + rng.normal(
                0.0, laboratory.noise / np.sqrt(AVERAGED), currents.shape
            )
            for name, given in (("paper, one scan", currents), (f"paper, {AVERAGED} scans", mean)):
                rows.setdefault(name, []).append(
                    line(angles, by_paper(plain, target, given, poses[0]))
                )
            for name, cameras, given, motion in (
                ("ours, one scan", rig, currents, None),
                ("ours, filter", rig, currents, MotionOptions()),
                (f"ours, {AVERAGED} scans", averaged, mean, None),
            ):
                rotations, off = by_tracker(cameras, target, given, motion, poses)
                rows.setdefault(name, []).append(line(angles, turned_deg(rotations)))
                squares.setdefault(name, []).extend(off)
        table.add_row(f"{step}°", "paper, as printed", "several scans", "≠ 1", f"{PAPER[step]}°")
        for name, lines in rows.items():
            scans = AVERAGED if f"{AVERAGED}" in name else 1
            _row(table, step, name, scans, lines, None if "filter" in name else
                 float(np.rad2deg(bound)) / np.sqrt(scans), squares.get(name, []))  # fmt: skip
        options = PictureOptions(signal_to_noise=job.snr)
        cameras = picture_rig(laboratory, options)
        bound = np.sqrt(
            np.mean([_about_z(picture_bound(cameras, laboratory.leds, p, options)) for p in poses])
        )
        lines, off = [], []
        for _ in range(max(runs // 10, 1)):
            rotations, own = by_pictures(cameras, target, poses, options, rng)
            lines.append(line(angles, turned_deg(rotations)))
            off += own
        _row(table, step, "ours, two picture cameras", 1, lines, float(np.rad2deg(bound)), off)
    show(table, width=110)


def _row(
    table: Table, step: float, name: str, scans: int, lines: list[tuple[float, float]],
    bound: float | None, squares: list[float],
) -> None:  # fmt: skip
    slopes, scatters = np.array(lines).T
    scatter = float(np.sqrt((scatters**2).mean()))
    table.add_row(
        f"{step}°", name, f"{len(lines)} × {POSITIONS} of {scans} scan{'s' * (scans > 1)}",
        f"{slopes.mean():.4f}", f"{scatter:.5f}°",
        "" if bound is None else f"{bound:.5f}°", "" if bound is None else f"{scatter / bound:.3f}",
        f"{np.mean(squares):.1f}" if squares else "",
    )  # fmt: skip


def _about_z(covariance: np.ndarray) -> float:
    return float(covariance[2, 2])


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


def squared(rig: Rig, observation: StereoObservation, rig_from_target: Pose) -> float:
    """NEES of a pose; 6 is right."""
    truth, pose = rig.cameras[0].camera_from_rig @ rig_from_target, observation.pose
    turned, moved = between(pose.rotation, truth.rotation), pose.translation_m - truth.translation_m
    return nees(np.append(turned, moved), observation.covariance)


def by_tracker(
    rig: Rig, target: Target, currents: np.ndarray, motion: MotionOptions | None, poses: list[Pose]
) -> tuple[np.ndarray, list[float]]:
    """Rotations, and NEES of each pose, with the calibration's covariance."""
    tracker = StereoTracker.of_target(
        rig, target, TrackerOptions(motion=motion, calibration_error=True)
    )
    rotations, squares = [], []
    for k, reading in enumerate(currents):
        observation = tracker.update(k / RATE_HZ, spots_of(rig, reading))
        rotations.append((observation.estimate or observation.fit).rotation)
        squares.append(squared(rig, observation, poses[k]))
    return np.stack(rotations), squares


def by_pictures(
    rig: Rig, target: Target, poses: list[Pose], options: PictureOptions, rng: np.random.Generator
) -> tuple[np.ndarray, list[float]]:
    """Single readings of two pictures; the lights are not named. Rotations, and NEES."""
    tracker = StereoTracker.of_target(rig, target)
    rotations, squares = [], []
    for k, pose in enumerate(poses):
        spots = [
            find_spots(draw(rig, c, pose.apply(tracker.leds), options, rng))
            for c in range(len(rig))
        ]
        observation = tracker.update(k / RATE_HZ, spots)
        rotations.append(observation.fit.rotation)
        squares.append(squared(rig, observation, pose))
    return np.stack(rotations), squares


def random_pose(rng: np.random.Generator, tilt_deg: float) -> Pose:
    """Any yaw, tilted up to so much any way, lights towards the cameras."""
    tilt = np.deg2rad(tilt_deg) * np.sqrt(rng.uniform())
    around = rng.uniform(0.0, 2.0 * np.pi)
    tilted = Rotation.from_rotvec(tilt * np.array([np.cos(around), np.sin(around), 0.0]))
    turn = Rotation.from_rotvec([0.0, 0.0, rng.uniform(-np.pi, np.pi)])
    place = rng.uniform(-1.0, 1.0, 3) * (0.1, 0.1, 0.5)
    return Pose((tilted * turn).as_matrix(), place)


def convergence(job: Job, target: Target) -> None:
    cases = job.cases or 10_000
    laboratory = job.laboratory(target)
    rng = np.random.default_rng(job.seed)
    rig, leds = laboratory.rig, laboratory.leds
    from_end, from_truth, end_truth, unsolved = [], [], [], 0
    for _ in range(cases):
        before = random_pose(rng, 20.0)
        after = Pose(Rotation.from_rotvec([0.0, 0.0, np.deg2rad(2.0)]).as_matrix(), np.zeros(3))
        after = after @ before
        first, second = laboratory.currents([before, after], rng)
        last = iterate(rig, leds, rig.sights(spots_of(rig, first), len(leds)),
                       before.rotation, before.translation_m)  # fmt: skip
        sights = rig.sights(spots_of(rig, second), len(leds))
        if last is None:
            unsolved += 1
            continue
        once = iterate(rig, leds, sights, last.rotation, last.translation, iterations=1)
        end = iterate(rig, leds, sights, last.rotation, last.translation)
        if once is None or end is None:
            unsolved += 1
            continue
        from_end.append(Rotation.from_matrix(once.rotation @ end.rotation.T).as_rotvec())
        from_truth.append(Rotation.from_matrix(once.rotation @ after.rotation.T).as_rotvec())
        end_truth.append(Rotation.from_matrix(end.rotation @ after.rotation.T).as_rotvec())
    print(f"{cases} steps of 2° from the last estimate, tilt to 20°, any yaw; {unsolved} unsolved")
    for name, vectors in (("one iteration, from where iteration ends", from_end),
                          ("one iteration, from the truth", from_truth),
                          ("all iterations, from the truth", end_truth)):  # fmt: skip
        turn = np.rad2deg(np.abs(vectors))
        for what, angle in (("yaw", turn[:, 2]), ("attitude", np.linalg.norm(turn, axis=1))):
            print(f"{name}, {what}: below 1° in {(angle < 1.0).sum()}, r.m.s. "
                  f"{np.sqrt((angle**2).mean()):.3f}°, worst {angle.max():.3f}°")  # fmt: skip


def recovery(job: Job, target: Target) -> None:
    cases = job.cases or 10_000
    laboratory = job.laboratory(target)
    rng = np.random.default_rng(job.seed)
    tracker = StereoTracker.of_target(laboratory.rig, target)
    outcome = {"right": 0, "refused": 0, "wrong": 0}
    spent, yaws = [], []
    for _ in range(cases):
        pose = random_pose(rng, 60.0)
        sights = tracker.rig.sights(spots_of(tracker.rig, laboratory.currents([pose], rng)[0]), 6)
        start = time.perf_counter()
        found = tracker.locate(sights)
        spent.append(time.perf_counter() - start)
        verdict = judge(tracker, sights, found, pose)
        outcome[verdict] += 1
        if isinstance(found, LightsFit):
            yaws.append(abs(Rotation.from_matrix(found.rotation @ pose.rotation.T).as_rotvec()[2]))
    print(f"{cases} readings, any yaw, tilt to 60°, nothing known: {outcome}, "
          f"median {1e3 * np.median(spent):.1f} ms")  # fmt: skip
    print(f"turn about the boresight against the truth: worst {np.rad2deg(max(yaws)):.2f}°")


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


def faults(job: Job, target: Target) -> None:
    cases = job.cases or 2000
    laboratory = job.laboratory(target)
    rng = np.random.default_rng(job.seed)
    tracker = StereoTracker.of_target(laboratory.rig, target)
    count = len(tracker.leds)

    def missing(light: np.ndarray) -> None:
        light[:, rng.choice(count, 2, replace=False)] = np.nan

    def half_missing(light: np.ndarray) -> None:
        light[0, rng.choice(count, 3, replace=False)] = np.nan

    def exchanged(light: np.ndarray) -> None:
        a, b = rng.choice(count, 2, replace=False)
        light[:, [a, b]] = light[:, [b, a]]

    def exchanged_once(light: np.ndarray) -> None:
        a, b = rng.choice(count, 2, replace=False)
        light[0, [a, b]] = light[0, [b, a]]

    def reflected(light: np.ndarray) -> None:
        place = rng.uniform(-0.8, 0.8, 2) * laboratory.options.half_width_m
        light[rng.integers(2), rng.integers(count)] = laboratory.light(0, place)

    def one_camera(light: np.ndarray) -> None:
        light[1] = np.nan

    table = Table("fault", "start", "right", "refused", "wrong", "NEES")
    for fault in (missing, half_missing, exchanged, exchanged_once, reflected, one_camera):
        for known in (True, False):
            outcome, squares = dict.fromkeys(("right", "refused", "wrong"), 0), []
            for _ in range(cases if known else cases // 4):
                pose = random_pose(rng, 20.0)
                light = laboratory.currents([pose], rng)[0]
                fault(light)
                sights = tracker.rig.sights(spots_of(tracker.rig, light), count)
                found: LightsFit | Disagreement
                if known:
                    last = pose.perturbed(np.append(rng.normal(0.0, np.deg2rad(2.0), 3), [0, 0, 0]))
                    other = StereoTracker.of_target(tracker.rig, target)
                    other.update(0.0, spots_of(tracker.rig, laboratory.currents([last], rng)[0]))
                    observation = other.update(0.1, spots_of(tracker.rig, light))
                    found = observation.fit or Disagreement(observation.reason or "")
                else:
                    found = tracker.locate(sights)
                verdict = judge(tracker, sights, found, pose)
                outcome[verdict] += 1
                if verdict == "right":
                    squares.append(distance(found, at_pose(pose, found)))
            cells = [*map(str, outcome.values()), f"{np.mean(squares):.1f}"]
            start = "tracking" if known else "nothing"
            table.add_row(fault.__name__.replace("_", " "), start, *cells)
    show(table, width=100)


def identity(job: Job, target: Target) -> None:
    cases = job.cases or 300
    laboratory = Laboratory(leds_of(target), LaboratoryOptions(distorted=False), job.seed)
    rig = picture_rig(laboratory, PictureOptions())
    rng = np.random.default_rng(job.seed)
    sigma_px = 0.05
    table = Table("spots", "right", "refused", "wrong", "median ms")
    for name, hidden, false in (("all six", 0, 0), ("one hidden", 1, 0), ("two false", 0, 2),
                                ("one hidden, two false", 1, 2)):  # fmt: skip
        outcome, spent = {"right": 0, "refused": 0, "wrong": 0}, []
        for _ in range(cases):
            pose = random_pose(rng, 30.0)
            tracker = StereoTracker.of_target(rig, target)
            spots = []
            for camera in rig.cameras:
                seen = camera.project(pose.apply(tracker.leds))
                seen = seen[rng.permutation(len(seen))[hidden:]]
                seen = np.concatenate([seen, rng.uniform(0.0, 1023.0, (false, 2))])
                seen = seen[rng.permutation(len(seen))]
                seen = seen + rng.normal(0.0, sigma_px, seen.shape)
                spots.append(Spots(seen, np.full(seen.shape, sigma_px), np.full(len(seen), -1)))
            start = time.perf_counter()
            observation = tracker.update(0.0, spots)
            spent.append(1e3 * (time.perf_counter() - start))
            if observation.fit is None:
                outcome["refused"] += 1
                continue
            sights = rig.sights(observation.spots, len(tracker.leds))
            outcome[judge(tracker, sights, observation.fit, pose)] += 1
        table.add_row(name, *(str(n) for n in outcome.values()), f"{np.median(spent):.0f}")
    show(table, width=100)
