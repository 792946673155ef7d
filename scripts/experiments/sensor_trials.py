"""Small simulated data of ring, reflectors and stereo, for `experiments.number_effects`."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from rendezview.sensors.reflectors import (
    Acquirer,
    LitDark,
    ReflectorSensor,
    find_spots,
    patterns_of,
    predict_spots,
)
from rendezview.sensors.stereo import MotionOptions, Spots, StereoTracker, TrackerOptions
from rendezview.sensors.stereo.agreement import Disagreement
from rendezview.sensors.stereo.spots import find_spots as find_lights
from rendezview.simulation.led_laboratory import Laboratory, LaboratoryOptions
from rendezview.simulation.led_pictures import PictureOptions, draw, picture_rig
from rendezview.simulation.reflector_frames import (
    ReflectorFrameOptions,
    foil,
    glints,
    render_pair,
)
from rendezview.simulation.ring_frames import RingSceneOptions
from scipy.spatial.transform import Rotation

from experiments.frame import CLIENT, MODELS_CAD, nees
from experiments.reflectors import acquisition, speed
from experiments.reflectors.accuracy import random_pose
from experiments.reflectors.run import CAMERA
from experiments.ring import accuracy as ring_accuracy
from experiments.stereo import cases as stereo_cases
from rendezview.geometry.pose import Pose
from rendezview.io.target import Target
from rendezview.sensors.ring import RingPrior, RingSensor

Figures = dict[str, float]
Trial = Callable[[], Figures]


def reflectors(seed: int) -> Trial:
    """90 pairs with foil and glints, a third with reflectors hidden; 10 runs of 12 readings."""
    rng = np.random.default_rng(seed)
    pattern = patterns_of(Target.load(CLIENT), ("far",))[0]
    options = ReflectorFrameOptions()
    single, runs = [], []
    for k in range(90):
        range_m = math.exp(rng.uniform(0.0, math.log(12.0)))
        pose, _ = random_pose(rng, pattern, range_m)
        clutter = (foil(CAMERA, rng, int(rng.integers(12, 41))), glints(CAMERA, rng, k % 7))
        hidden = ((0,), (1,), (0, 2))[k // 3 % 3] if k % 3 == 0 else ()
        pair = render_pair(CAMERA, pattern, pose, options, rng, hidden=hidden, clutter=clutter)
        places = predict_spots(CAMERA, pattern, pose)
        clear = not hidden and acquisition.clear_of(places, clutter, 0.0125 * CAMERA.fx / range_m)
        single.append((pose, LitDark(*pair), clear, bool(hidden)))
    for k in range(10):
        pose, _ = random_pose(rng, pattern, 2.0 + k)
        step = rng.normal(0.0, [0.02, 0.02, 0.02, 0.02, 0.02, 0.05])
        poses = [pose.perturbed(n * step) for n in range(12)]
        runs.append(
            [
                (one, LitDark(*render_pair(CAMERA, pattern, one, options, rng,
                                           hidden=(1,) if n in (7, 8) else ())))
                for n, one in enumerate(poses)
            ]
        )  # fmt: skip
    crowd = speed.many_spots(rng, 100, True)

    def trial() -> Figures:
        acquirer = Acquirer(CAMERA, [pattern])
        found = wrong = poses = lost = 0
        errors: list[float] = []
        squares: list[float] = []
        for truth, pair, clear, _ in single:
            answer = acquirer.acquire(find_spots(pair))
            if answer.refined is None:
                continue
            good = _near(answer.refined.camera_from_target, truth, pattern.centre_m)
            found, wrong = found + (clear and good), wrong + (not good)
        for readings in runs:
            sensor = ReflectorSensor(CAMERA, [pattern])
            for n, (truth, pair) in enumerate(readings):
                reading = sensor.update(0.1 * n, pair)
                if reading.pose is None or reading.covariance is None:
                    lost += 1
                    continue
                poses += 1
                wrong += not _near(reading.pose, truth, pattern.centre_m)
                far = float(np.linalg.norm(truth.translation_m))
                shift = reading.pose.apply(pattern.centre_m) - truth.apply(pattern.centre_m)
                errors.append(100.0 * float(np.linalg.norm(shift)) / far)
                squares.append(nees(shift, reading.covariance[3:, 3:]))
        many = acquirer.acquire(crowd)
        return {
            "found": found, "wrong": wrong, "tracked": poses, "not": lost,
            "error %": float(np.median(errors)), "NEES": float(np.median(squares)),
            "crowd": float(many.refined is not None),
        }  # fmt: skip

    return trial


def _near(pose: Pose, truth: Pose, middle: np.ndarray) -> bool:
    there = truth.apply(middle)
    return bool(np.linalg.norm(pose.apply(middle) - there) < 0.03 * np.linalg.norm(there))


def ring(seed: int) -> Trial:
    """60 frames: whole rings, arcs, rings cut by the border, among four other round objects."""
    scenes = []
    third = math.radians(120.0)
    kinds = (
        RingSceneOptions(), RingSceneOptions(arc_rad=(third, third)), RingSceneOptions(border=1.0),
        ring_accuracy.CLUTTERED, RingSceneOptions(contrast_grey=(15.0, 40.0)),
    )  # fmt: skip
    for number, options in enumerate(kinds):
        scenes += ring_accuracy.drawn(options, 12, [seed, number])

    def trial() -> Figures:
        found = wrong = signs = 0
        centre, axis, squares, edges = [], [], [], 0
        for scene, image in scenes:
            if scene.ring is None:
                continue
            far = float(np.linalg.norm(scene.ring.centre_m))
            sensor = RingSensor(ring_accuracy.CAMERA, scene.ring.radius_m)
            reading = sensor.update(0.0, image, RingPrior(range_m=far))
            edges += len(reading.edges)
            if reading.edge is None or not reading.circles:
                continue
            shape = reading.edges[reading.edge].ellipse.shape
            true = ring_accuracy.ring_edges(scene)
            if not any(ring_accuracy.right(shape, t) for _, t in true):
                wrong += 1
                continue
            found += 1
            errors = ring_accuracy.errors_of(reading.circles, scene.ring)
            assert errors is not None
            centre.append(errors[0])
            axis.append(errors[1])
            signs += reading.pose is not None
            best = ring_accuracy.nearer(reading.circles, scene.ring)
            shift = best.centre_m - scene.ring.centre_m
            squares.append(nees(shift, best.covariance[:3, :3]))
        return {
            "right": found, "wrong": wrong, "edges": edges, "chosen": signs,
            "centre %": float(np.median(centre)), "95 %": float(np.percentile(centre, 95)),
            "axis °": float(np.median(axis)), "NEES": float(np.median(squares)),
        }  # fmt: skip

    return trial


def stereo(seed: int) -> Trial:
    """Faults of photodiodes, unnamed spots of pictures, a run that turns, a drawn picture pair."""
    target = Target.load(MODELS_CAD / "scole")
    laboratory = stereo_cases.Job(seed, None, 200.0).laboratory(target)
    rng = np.random.default_rng(seed)
    leds, count = laboratory.leds, len(laboratory.leds)
    singles = []
    for k in range(50):
        pose = stereo_cases.random_pose(rng, 40.0)
        light = laboratory.currents([pose], rng)[0]
        a, b, c = rng.choice(count, 3, replace=False)
        if k % 5 == 1:
            light[:, [a, b]] = np.nan
        elif k % 5 == 2:
            light[0, [a, b, c]] = np.nan
        elif k % 5 == 3:
            light[0, [a, b]] = light[0, [b, a]]
        elif k % 5 == 4:
            light[1] = np.nan
        singles.append((pose, stereo_cases.spots_of(laboratory.rig, light)))
    full = Laboratory(leds, LaboratoryOptions(distorted=False), seed)
    rig = picture_rig(full, PictureOptions())
    unnamed = []
    for k in range(24):
        pose = stereo_cases.random_pose(rng, 30.0)
        views = []
        for camera in rig.cameras:
            seen = camera.project(pose.apply(leds))[rng.permutation(count)[k % 2 :]]
            seen = np.concatenate([seen, rng.uniform(0.0, 1023.0, (k % 3, 2))])
            seen = seen[rng.permutation(len(seen))] + rng.normal(0.0, 0.05, seen.shape)
            views.append(Spots(seen, np.full(seen.shape, 0.05), np.full(len(seen), -1)))
        unnamed.append((pose, views))
    swing = np.deg2rad(30.0) * np.sin(0.05 * np.arange(100))
    turning = laboratory.stage(swing)
    currents = laboratory.currents(turning, rng)
    currents[40:44] = np.nan
    pose = stereo_cases.random_pose(rng, 20.0)
    pictures = [draw(rig, c, pose.apply(leds), PictureOptions(), rng) for c in range(len(rig))]

    def trial() -> Figures:
        right = refused = wrong = 0
        for truth, spots in singles:
            tracker = StereoTracker.of_target(laboratory.rig, target)
            sights = tracker.rig.sights(spots, count)
            verdict = stereo_cases.judge(tracker, sights, tracker.locate(sights), truth)
            right, wrong = right + (verdict == "right"), wrong + (verdict == "wrong")
            refused += verdict == "refused"
        named = 0
        for truth, views in unnamed:
            tracker = StereoTracker.of_target(rig, target)
            answer = tracker.update(0.0, views)
            if answer.fit is not None and not isinstance(answer.fit, Disagreement):
                good = np.linalg.norm(answer.fit.translation - truth.translation_m) < 0.01
                named, wrong = named + good, wrong + (not good)
        off, smooth, poses = [], [], 0
        for motion in (None, MotionOptions()):
            options = TrackerOptions(motion=motion)
            tracker = StereoTracker.of_target(laboratory.rig, target, options)
            for k, reading in enumerate(currents):
                answer = tracker.update(0.1 * k, stereo_cases.spots_of(laboratory.rig, reading))
                given = answer.estimate or answer.fit
                if given is None:
                    continue
                poses += 1
                turn = Rotation.from_matrix(given.rotation @ turning[k].rotation.T).magnitude()
                (off if motion is None else smooth).append(np.rad2deg(turn))
        lights = sum(len(find_lights(picture).led) for picture in pictures)
        tracker = StereoTracker.of_target(rig, target)
        seen = tracker.update(0.0, [find_lights(picture) for picture in pictures])
        return {
            "right": right, "refused": refused, "wrong": wrong, "named": named, "poses": poses,
            "error °": float(np.median(off)), "filtered °": float(np.median(smooth)),
            "lights": lights, "seen": float(seen.fit is not None),
        }  # fmt: skip

    return trial
