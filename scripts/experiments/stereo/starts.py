"""Starts and faults of the stereo tracker: right, refused or wrong."""

from __future__ import annotations

import time

import numpy as np
from scipy.spatial.transform import Rotation

from experiments.frame import show, table_of
from experiments.peers.pnp import PEERS
from experiments.peers.pnp import rig as by_peers
from experiments.stereo.cases import Job, spots_of
from rendezview.geometry.pose import Pose
from rendezview.io.target import Target
from rendezview.sensors.beacons import Sights, StereoTracker
from rendezview.sensors.beacons.match.agreement import Disagreement, LightsFit, distance, iterate

RECOVERY_CASES, TRACKED_CASES, START_CASES = 10_000, 2000, 500
FAR_RAD = np.deg2rad(10.0)
STEP_RAD = np.deg2rad(2.0)  # from the reading before, one σ each axis
SAME, INSIDE = 0.5, 60.0  # squared distance of two minima; of the truth from one


def random_pose(rng: np.random.Generator, tilt_deg: float) -> Pose:
    """Any yaw, tilted up to so much any way, lights towards the cameras."""
    tilt = np.deg2rad(tilt_deg) * np.sqrt(rng.uniform())
    around = rng.uniform(0.0, 2.0 * np.pi)
    tilted = Rotation.from_rotvec(tilt * np.array([np.cos(around), np.sin(around), 0.0]))
    turn = Rotation.from_rotvec([0.0, 0.0, rng.uniform(-np.pi, np.pi)])
    place = rng.uniform(-1.0, 1.0, 3) * (0.1, 0.1, 0.5)
    return Pose((tilted * turn).as_matrix(), place)


def squared(pose: Pose, found: LightsFit) -> float:
    """Distance of the truth from a fit, normalised: 6 is right in the mean."""
    truth = LightsFit(pose.rotation, pose.translation_m, found.information, 0.0, 0, 0, found.sights)
    return distance(found, truth)


def judge(tracker: StereoTracker, found: LightsFit | Disagreement, pose: Pose) -> str:
    """right: the minimum next to the truth, and the truth within its covariance."""
    if isinstance(found, Disagreement):
        return "refused"
    near = iterate(tracker.rig, tracker.leds, found.sights, pose.rotation, pose.translation_m)
    same = near is not None and distance(found, near) < SAME
    return "right" if same and squared(pose, found) < INSIDE else "wrong"


def far_off(tracker: StereoTracker, sights: Sights, truth: Pose) -> dict[str, bool]:
    """Whether a peer has no answer on the same lights, or one more than 10° off."""
    answers = by_peers(tracker.leds, sights, tracker.rig)
    return {n: p is None or p.angle_to(truth) > FAR_RAD for n, p in answers.items()}


def recovery(job: Job, target: Target) -> None:
    """The pose from one reading, any yaw, tilt to 60°, nothing known."""
    laboratory, rng = job.laboratory(target), np.random.default_rng(job.seed)
    tracker = StereoTracker.of_target(laboratory.rig, target)
    outcome, wrong = dict.fromkeys(("right", "refused", "wrong"), 0), dict.fromkeys(PEERS, 0)
    spent, squares = [], []
    for _ in range(job.cases or RECOVERY_CASES):
        pose = random_pose(rng, 60.0)
        sights = tracker.rig.sights(spots_of(tracker.rig, laboratory.currents([pose], rng)[0]), 6)
        start = time.perf_counter()
        found = tracker.locate(sights)
        spent.append(time.perf_counter() - start)
        outcome[judge(tracker, found, pose)] += 1
        if isinstance(found, LightsFit):
            squares.append(squared(pose, found))
        for name, far in far_off(tracker, sights, pose).items():
            wrong[name] += far
    print(f"{len(spent)} readings: {outcome}, median {1e3 * np.median(spent):.1f} ms")
    print(f"NEES (6 is right) {np.mean(squares):.2f}; more than 10° off on the same spots: {wrong}")


def faults(job: Job, target: Target) -> None:
    """Lights missing, exchanged, or reflected, while tracking and from nothing."""
    laboratory, rng = job.laboratory(target), np.random.default_rng(job.seed)
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

    title = "the peers have the same lights, solvePnP of the first camera: more than 10° off"
    table = table_of(title, ["fault", "start", "right", "refused", "wrong", "NEES", *PEERS], left=2)
    for fault in (missing, half_missing, exchanged, exchanged_once, reflected, one_camera):
        for known in (True, False):
            outcome, squares = dict.fromkeys(("right", "refused", "wrong"), 0), []
            beside = dict.fromkeys(PEERS, 0)
            cases = job.cases or TRACKED_CASES
            for _ in range(cases if known else cases * START_CASES // TRACKED_CASES):
                pose = random_pose(rng, 20.0)
                light = laboratory.currents([pose], rng)[0]
                fault(light)
                sights = tracker.rig.sights(spots_of(tracker.rig, light), count)
                found: LightsFit | Disagreement
                if known:
                    last = pose.perturbed(np.append(rng.normal(0.0, STEP_RAD, 3), [0, 0, 0]))
                    other = StereoTracker.of_target(tracker.rig, target)
                    other.update(0.0, spots_of(tracker.rig, laboratory.currents([last], rng)[0]))
                    observation = other.update(0.1, spots_of(tracker.rig, light))
                    found = observation.fit or Disagreement(observation.reason or "")
                else:
                    found = tracker.locate(sights)
                verdict = judge(tracker, found, pose)
                outcome[verdict] += 1
                if verdict == "right":
                    squares.append(squared(pose, found))
                for name, far in far_off(tracker, sights, pose).items():
                    beside[name] += far
            cells = [*map(str, outcome.values()), f"{np.mean(squares):.1f}"]
            start, name = "tracking" if known else "nothing", fault.__name__.replace("_", " ")
            table.add_row(name, start, *cells, *map(str, beside.values()))
    show(table, width=100)
