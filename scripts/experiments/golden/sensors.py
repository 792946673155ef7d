"""Answers of ring, reflectors and lights, and of their trackers."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from experiments.frame import CLIENT, MODELS_CAD
from experiments.golden.answers import Answers
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose
from rendezview.io.target import Target
from rendezview.sensors.beacons import (
    Acquirer,
    LitDark,
    MotionOptions,
    ReflectorPattern,
    ReflectorSensor,
    Rig,
    SixNumbers,
    Spots,
    StereoTracker,
    TrackerOptions,
    find_spots,
    patterns_of,
    pose_of,
)
from rendezview.sensors.beacons.detect.led_spots import find_spots as find_lights
from rendezview.sensors.ring import Ellipse, RingPrior, RingSensor, shape_of_circle
from rendezview.sensors.ring.ring_pass import ring_size_of_pass
from rendezview.sensors.ring.ring_size import RingSight, ring_size
from rendezview_ground.simulate.led_laboratory import Laboratory, LaboratoryOptions
from rendezview_ground.simulate.led_pictures import PictureOptions, draw, picture_rig
from rendezview_ground.simulate.reflector_frames import (
    ReflectorFrameOptions,
    foil,
    glints,
    render_pair,
)
from rendezview_ground.simulate.ring_frames import (
    Circle,
    RingSceneOptions,
    random_scene,
    render_ring_frame,
)

_RING = Camera.from_fov(640, 480, np.deg2rad(40.0))
_ARC_RAD = np.deg2rad(120.0)
_SCENES = {
    "whole": RingSceneOptions(),
    "arc": RingSceneOptions(arc_rad=(_ARC_RAD, _ARC_RAD)),
    "border": RingSceneOptions(border=1.0),
    "clutter": RingSceneOptions(clutter=4, without_ring=0.15),
    "faint": RingSceneOptions(contrast_grey=(15.0, 40.0)),
}
_GUIDANCE = Camera(512, 384, 651.975, 651.975, 255.5, 191.5)
_SIZE = Camera.from_fov(2048, 2048, np.deg2rad(50.0))
_RADIUS_M, _DISTANCE_M = 0.597, 1.68
_PANEL_M = np.array([[0.0, 4.0, 1.2], [0.0, -4.0, 1.2], [0.0, 4.0, -1.2], [0.0, -4.0, -1.2]])


def ring(answers: Answers, seed: int) -> None:
    """Drawn scenes, each without any prior, with its range, and with place and axis."""
    for number, (kind, options) in enumerate(_SCENES.items()):
        for k in range(26):
            rng = np.random.default_rng([seed, number, k])
            scene = random_scene(_RING, rng, options)
            image = render_ring_frame(scene, rng)
            priors: dict[str, RingPrior | None] = {"no prior": None}
            if scene.ring is not None:
                there = scene.ring.centre_m
                priors["range"] = RingPrior(range_m=1.01 * float(np.linalg.norm(there)))
                if kind in ("whole", "clutter"):
                    priors["attitude"] = RingPrior(centre_m=1.01 * there, axis=scene.ring.axis)
            for name, prior in priors.items():
                group, sensor = f"ring/{kind}/{name}", RingSensor(_RING, options.radius_m)
                seen = answers.timed(group, sensor.update, 0.0, image, prior)
                add_ring(answers, group, seen, scene.ring)


def add_ring(answers: Answers, group: str, seen: Any, ring: Circle | None) -> None:
    """The nearer of the circles beside the true one; an open choice is no answer."""
    errors, right = None, None
    circles = () if seen.is_open else seen.circles
    if circles:
        right = False
    if circles and ring is not None:
        far = float(np.linalg.norm(ring.centre_m))
        errors = min(
            (float(np.arccos(np.clip(abs(c.axis @ ring.axis), 0.0, 1.0))),
             float(np.linalg.norm(c.centre_m - ring.centre_m)) / far)
            for c in circles
        )  # fmt: skip
    both = [np.append(c.centre_m, c.axis) for c in seen.circles]
    spread = seen.circles[0].covariance if seen.circles else None
    answers.add(group, str(seen.status), line=seen.record(), errors=errors, right=right,
                circles=both, covariance=spread)  # fmt: skip


def sizes(answers: Answers, seed: int) -> None:
    """A ring of unknown size from a fly-around: frame by frame, and the whole pass."""
    for turn in range(2):
        rng = np.random.default_rng([seed, turn])
        sights = [_sight(a, rng) for a in np.linspace(-1.0, 1.0, 24)]
        found = [answers.timed("ring size/frame", ring_size, _SIZE, sight) for sight in sights]
        whole = answers.timed("ring size/pass", ring_size_of_pass, _SIZE, sights)
        for group, size in [
            *(("ring size/frame", one) for one in found),
            ("ring size/pass", whole),
        ]:
            if size is None:
                answers.add(group, "none")
                continue
            errors = (abs(size.distance_m / _DISTANCE_M - 1), abs(size.radius_m / _RADIUS_M - 1))
            both = (size.radius_m, size.distance_m)
            answers.add(group, "ok", errors=errors, limits=(np.inf, 0.05), size=both,
                        covariance=size.covariance)  # fmt: skip


def _sight(angle_rad: float, rng: np.random.Generator) -> RingSight:
    """A panel's corners, the ring's ellipse and a range from 12 m, with noise."""
    out, down = np.array([np.cos(angle_rad), np.sin(angle_rad), 0.0]), np.array([0.0, 0.0, -1.0])
    pose = Pose(np.vstack([np.cross(down, -out), down, -out]), [0.0, 0.0, 12.0])
    corners = _SIZE.project(pose.apply(_PANEL_M)) + rng.normal(0.0, 0.05, (4, 2))
    axis = pose.rotation[:, 0]
    shape = shape_of_circle(_SIZE, pose.apply([_DISTANCE_M, 0.0, 0.0]), axis, _RADIUS_M)
    points = Ellipse.from_shape(shape).points(300)
    ellipse = Ellipse.fit(points + rng.normal(0.0, 0.1, points.shape))
    range_m = float(axis @ pose.translation_m) / axis[2] + rng.normal(0.0, 0.005)
    return RingSight(corners, ellipse, range_m, 0.05, 0.005)


def reflectors(answers: Answers, seed: int) -> None:
    """Single pairs with foil, glints and hidden reflectors; then tracked runs."""
    pattern = patterns_of(Target.load(CLIENT), ("far",))[0]
    options, acquirer = ReflectorFrameOptions(), Acquirer(_GUIDANCE, [pattern])
    for k in range(100):
        rng = np.random.default_rng([seed, k])
        truth = _facing(rng, pattern, float(np.exp(rng.uniform(0.0, np.log(12.0)))))
        clutter = (foil(_GUIDANCE, rng, int(rng.integers(12, 41))), glints(_GUIDANCE, rng, k % 7))
        hidden = ((0,), (1,), (0, 2))[k // 3 % 3] if k % 3 == 0 else ()
        pair = render_pair(_GUIDANCE, pattern, truth, options, rng, hidden=hidden, clutter=clutter)
        group = "reflectors/acquisition" + ("/hidden" if hidden else "")
        found = answers.timed(group, acquirer.acquire, find_spots(LitDark(*pair)))
        pose = None if found.refined is None else found.refined.camera_from_target
        answers.pose(group, found.status, pose, truth, middle_m=pattern.centre_m,
                     line=found.reason, score=found.score)  # fmt: skip
    for run in range(12):
        rng = np.random.default_rng([seed, 100, run])
        start = _facing(rng, pattern, 1.5 + 0.8 * run)
        sensor = ReflectorSensor(_GUIDANCE, [pattern])
        step = rng.normal(0.0, [0.01, 0.01, 0.01, 0.01, 0.01, 0.03])
        for n in range(12):
            truth, hidden = start.perturbed(n * step), (1,) if n in (7, 8) else ()
            pair = render_pair(_GUIDANCE, pattern, truth, options, rng, hidden=hidden)
            seen = answers.timed("reflectors/tracked", sensor.update, 0.1 * n, LitDark(*pair))
            answers.seen("reflectors/tracked", seen, truth, middle_m=pattern.centre_m)


def _facing(rng: np.random.Generator, pattern: ReflectorPattern, range_m: float) -> Pose:
    """Tilted by up to 25°, a little off the boresight."""
    aside = rng.uniform(-0.12, 0.12, 2)
    tilt, way = np.deg2rad(25.0) * np.sqrt(rng.random()), rng.uniform(0.0, 2.0 * np.pi)
    roll = rng.uniform(-1.4, 1.4)
    six = SixNumbers(range_m, aside[0], aside[1], roll, tilt * np.sin(way), tilt * np.cos(way))
    return pose_of(six, pattern)


def lights(answers: Answers, seed: int) -> None:
    """The laboratory's photodiodes with faults, unnamed spots of pictures, and a turning stage."""
    target = Target.load(MODELS_CAD / "scole")
    leds = np.array([led.position_m for led in target.leds])
    laboratory = Laboratory(leds, LaboratoryOptions(distorted=False), seed)
    rig, pictures = laboratory.rig, picture_rig(laboratory, PictureOptions())

    def add(
        group: str, rig: Rig, spots: list[Spots], truth: Pose,
        tracker: StereoTracker | None = None, time_s: float = 0.0,
    ) -> None:  # fmt: skip
        one = tracker or StereoTracker.of_target(rig, target)
        seen = answers.timed(group, one.update, time_s, spots)
        answers.seen(group, seen, rig.cameras[0].camera_from_rig @ truth)

    for k in range(90):
        rng = np.random.default_rng([seed, k])
        truth = _above(rng, 40.0)
        light = laboratory.currents([truth], rng)[0]
        a, b, c = rng.choice(len(leds), 3, replace=False)
        if k % 5 == 1:
            light[:, [a, b]] = np.nan
        elif k % 5 == 2:
            light[0, [a, b, c]] = np.nan
        elif k % 5 == 3:
            light[0, [a, b]] = light[0, [b, a]]
        elif k % 5 == 4:
            light[1] = np.nan
        add("stereo/photodiodes", rig, _spots(rig, light), truth)
    for k in range(60):
        rng = np.random.default_rng([seed, 90, k])
        truth, views = _above(rng, 30.0), []
        for camera in pictures.cameras:
            seen = camera.project(truth.apply(leds))[rng.permutation(len(leds))[k % 2 :]]
            seen = np.concatenate([seen, rng.uniform(0.0, 1023.0, (k % 3, 2))])
            seen = seen[rng.permutation(len(seen))] + rng.normal(0.0, 0.05, seen.shape)
            views.append(Spots(seen, np.full(seen.shape, 0.05), np.full(len(seen), -1)))
        add("stereo/unnamed", pictures, views, truth)
    for k in range(6):
        rng = np.random.default_rng([seed, 150, k])
        truth = _above(rng, 20.0)
        drawn = [draw(pictures, c, truth.apply(leds), PictureOptions(), rng) for c in range(2)]
        add("stereo/pictures", pictures, [find_lights(picture) for picture in drawn], truth)
    stage = laboratory.stage(np.deg2rad(30.0) * np.sin(0.05 * np.arange(70)))
    currents = laboratory.currents(stage, np.random.default_rng(seed))
    currents[40:44] = np.nan
    for name, motion in (("alone", None), ("filter", MotionOptions())):
        tracker = StereoTracker.of_target(rig, target, TrackerOptions(motion=motion))
        for k, reading in enumerate(currents):
            add(f"stereo/stage/{name}", rig, _spots(rig, reading), stage[k], tracker, 0.1 * k)


def _spots(rig: Rig, currents: Array) -> list[Spots]:
    return [c.photodiode.read(row) for c, row in zip(rig.cameras, currents, strict=True)]


def _above(rng: np.random.Generator, tilt_deg: float) -> Pose:
    """Any yaw, tilted any way, lights towards the cameras."""
    tilt, way = np.deg2rad(tilt_deg) * np.sqrt(rng.random()), rng.uniform(0.0, 2.0 * np.pi)
    tilted = Rotation.from_rotvec([tilt * np.cos(way), tilt * np.sin(way), 0.0])
    turn = Rotation.from_rotvec([0.0, 0.0, rng.uniform(-np.pi, np.pi)])
    return Pose((tilted * turn).as_matrix(), rng.uniform(-1.0, 1.0, 3) * (0.1, 0.1, 0.5))
