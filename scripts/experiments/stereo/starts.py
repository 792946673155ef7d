"""Steps, starts, faults and unnamed lights of the stereo tracker: right, refused or wrong."""

from __future__ import annotations

import time

import numpy as np
from rich.table import Table
from scipy.spatial.transform import Rotation

from experiments.frame import show
from experiments.peers.pnp import PEERS
from experiments.peers.pnp import rig as by_peers
from experiments.stereo.cases import Job, at_pose, judge, random_pose, spots_of
from experiments.stereo.plain import PlainLaboratory
from rendezview.geometry.pose import Pose
from rendezview.io.target import Target
from rendezview.sensors.beacons import Rig, Spots, StereoTracker
from rendezview.sensors.beacons.detect.led_spots import find_spots
from rendezview.sensors.beacons.match.agreement import Disagreement, LightsFit, distance, iterate
from rendezview_ground.simulate.led_pictures import PictureOptions


def far_off(answer: Pose | None, truth: Pose) -> bool:
    """More than 10° off, or no answer."""
    return answer is None or answer.angle_to(truth) > np.deg2rad(10.0)


def convergence(job: Job, target: Target) -> None:
    cases = job.cases or 10_000
    laboratory = job.laboratory(target)
    rng = np.random.default_rng(job.seed)
    rig, leds = laboratory.rig, laboratory.leds
    from_end, from_truth, end_truth, unsolved = [], [], [], 0
    squares: list[list[float]] = [[], []]
    beside: dict[str, list[float]] = {name: [] for name in PEERS}
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
        for k, fit in enumerate((once, end)):
            squares[k].append(distance(fit, at_pose(after, fit)))
        for name, pose in by_peers(leds, sights, rig).items():
            if pose is not None:
                beside[name].append(pose.angle_to(after))
    print(f"{cases} steps of 2° from the last estimate, tilt to 20°, any yaw; {unsolved} unsolved")
    print(
        f"NEES (6 is right): one iteration {np.mean(squares[0]):.2f}, all {np.mean(squares[1]):.2f}"
    )
    for name, turns in beside.items():
        print(f"{name}, the same spots: attitude r.m.s. "
              f"{np.rad2deg(np.sqrt(np.mean(np.square(turns)))):.3f}°")  # fmt: skip
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
    spent, yaws, squares = [], [], []
    wrong = dict.fromkeys(PEERS, 0)
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
            squares.append(distance(found, at_pose(pose, found)))
        for name, other in by_peers(tracker.leds, sights, tracker.rig).items():
            wrong[name] += far_off(other, pose)
    print(f"{cases} readings, any yaw, tilt to 60°, nothing known: {outcome}, "
          f"median {1e3 * np.median(spent):.1f} ms")  # fmt: skip
    print(f"NEES (6 is right) {np.mean(squares):.2f}; more than 10° off on the same spots: {wrong}")
    print(f"turn about the boresight against the truth: worst {np.rad2deg(max(yaws)):.2f}°")


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

    table = Table("fault", "start", "right", "refused", "wrong", "NEES", *PEERS)
    for fault in (missing, half_missing, exchanged, exchanged_once, reflected, one_camera):
        for known in (True, False):
            outcome, squares = dict.fromkeys(("right", "refused", "wrong"), 0), []
            beside = dict.fromkeys(PEERS, 0)
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
                for name, answer in by_peers(tracker.leds, sights, tracker.rig).items():
                    beside[name] += far_off(answer, pose)
            cells = [*map(str, outcome.values()), f"{np.mean(squares):.1f}"]
            cells += map(str, beside.values())
            start = "tracking" if known else "nothing"
            table.add_row(fault.__name__.replace("_", " "), start, *cells)
    show(table, width=100)
    print("solvePnP (first camera) and poselib (all) have the same lights: more than 10° off")


def scattered(
    rig: Rig, lights: np.ndarray, sigma_px: float, rng: np.random.Generator, hidden: int, false: int
) -> list[Spots]:
    """Spots of lights in no order, with noise; some hidden, some false."""
    spots = []
    for camera in rig.cameras:
        seen = camera.project(lights)
        seen = seen[rng.permutation(len(seen))[hidden:]]
        seen = np.concatenate([seen, rng.uniform(0.0, 1023.0, (false, 2))])
        seen = seen[rng.permutation(len(seen))]
        seen = seen + rng.normal(0.0, sigma_px, seen.shape)
        spots.append(Spots(seen, np.full(seen.shape, sigma_px), np.full(len(seen), -1)))
    return spots


def identity(job: Job, target: Target) -> None:
    cases = job.cases or 300
    laboratory = job.laboratory(target)
    rig = laboratory.picture_rig
    rng = np.random.default_rng(job.seed)
    sigma_px = 0.05
    # Of so much noise the places in a picture have that error: √(2/π) / 16 px.
    options = PictureOptions(signal_to_noise=16.0)
    table = Table("spots", "right", "refused", "wrong", "NEES", "median ms", *PEERS)
    for name, hidden, false in (("all six", 0, 0), ("one hidden", 1, 0), ("two false", 0, 2),
                                ("one hidden, two false", 1, 2)):  # fmt: skip
        outcome, spent = {"right": 0, "refused": 0, "wrong": 0}, []
        squares: list[float] = []
        beside = dict.fromkeys(PEERS, 0)
        for _ in range(cases):
            pose = random_pose(rng, 30.0)
            tracker = StereoTracker.of_target(rig, target)
            if isinstance(laboratory, PlainLaboratory):
                drawn = laboratory.pictures(pose, options, rng, hidden, false)
                spots = [find_spots(picture) for picture in drawn]
            else:
                spots = scattered(rig, pose.apply(tracker.leds), sigma_px, rng, hidden, false)
            start = time.perf_counter()
            observation = tracker.update(0.0, spots)
            spent.append(1e3 * (time.perf_counter() - start))
            if observation.fit is None:
                outcome["refused"] += 1
                continue
            sights = rig.sights(observation.spots, len(tracker.leds))
            verdict = judge(tracker, sights, observation.fit, pose)
            outcome[verdict] += 1
            if verdict == "right":
                squares.append(distance(observation.fit, at_pose(pose, observation.fit)))
            for peer, answer in by_peers(tracker.leds, observation.fit.sights, rig).items():
                beside[peer] += far_off(answer, pose)
        cells = [*map(str, outcome.values()), f"{np.mean(squares):.1f}"]
        table.add_row(name, *cells, f"{np.median(spent):.0f}", *map(str, beside.values()))
    show(table, width=100)
    print(
        "solvePnP (first camera) and poselib (all) have the lights that we named: more than 10° off"
    )
