"""Answers of ring, reflectors and lights, and of their trackers."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from experiments.frame import CLIENT, MODELS_CAD
from experiments.golden.answers import RIGHT_RAD, RIGHT_SHARE, Answers, pose_numbers
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose
from rendezview.io.target import Target
from rendezview.sensors.reflectors import (
    Acquirer,
    LitDark,
    ReflectorPattern,
    ReflectorSensor,
    SixNumbers,
    find_spots,
    patterns_of,
    pose_of,
)
from rendezview.sensors.ring import (
    Ellipse,
    RingObservation,
    RingPrior,
    RingSensor,
    shape_of_circle,
)
from rendezview.sensors.ring.ring_pass import ring_size_of_pass
from rendezview.sensors.ring.ring_size import RingSight, ring_size
from rendezview.sensors.stereo import MotionOptions, Rig, Spots, StereoTracker, TrackerOptions
from rendezview.sensors.stereo.spots import find_spots as find_lights
from rendezview.simulation.led_laboratory import Laboratory, LaboratoryOptions
from rendezview.simulation.led_pictures import PictureOptions, draw, picture_rig
from rendezview.simulation.reflector_frames import ReflectorFrameOptions, foil, glints, render_pair
from rendezview.simulation.ring_frames import (
    RingScene,
    RingSceneOptions,
    random_scene,
    render_ring_frame,
)

_RING = Camera.from_fov(640, 480, np.deg2rad(40.0))
_SCENES = {
    "whole": RingSceneOptions(),
    "arc": RingSceneOptions(arc_rad=(np.deg2rad(120.0), np.deg2rad(120.0))),
    "border": RingSceneOptions(border=1.0),
    "clutter": RingSceneOptions(clutter=4, without_ring=0.15),
    "faint": RingSceneOptions(contrast_grey=(15.0, 40.0)),
}
_GUIDANCE = Camera(512, 384, 651.975, 651.975, 255.5, 191.5)
_SIZE = Camera.from_fov(2048, 2048, np.deg2rad(50.0))
_PANEL_M, _RADIUS_M, _DISTANCE_M = (8.0, 2.4), 0.597, 1.68


def ring(answers: Answers, seed: int) -> None:
    """Drawn scenes, each without any prior, with its range, and with place and axis."""
    for number, (kind, options) in enumerate(_SCENES.items()):
        for k in range(26):
            rng = np.random.default_rng([seed, number, k])
            scene = random_scene(_RING, rng, options)
            image = render_ring_frame(scene, rng)
            priors = {"no prior": None}
            if scene.ring is not None:
                there = scene.ring.centre_m
                priors["range"] = RingPrior(range_m=1.01 * float(np.linalg.norm(there)))
                if kind in ("whole", "clutter"):
                    priors["attitude"] = RingPrior(centre_m=1.01 * there, axis=scene.ring.axis)
            for name, prior in priors.items():
                group, sensor = f"ring/{kind}/{name}", RingSensor(_RING, options.radius_m)
                seen = answers.timed(group, sensor.update, 0.0, image, prior)
                _add_ring(answers, group, seen, scene)


def _add_ring(answers: Answers, group: str, seen: RingObservation, scene: RingScene) -> None:
    """The best of the circles beside the truth; an open choice is no answer."""
    errors, right = None, None
    if seen.circles and not seen.is_open:
        right = False
        if scene.ring is not None:
            far = float(np.linalg.norm(scene.ring.centre_m))
            each = [
                (float(np.arccos(np.clip(abs(c.axis @ scene.ring.axis), 0.0, 1.0))),
                 float(np.linalg.norm(c.centre_m - scene.ring.centre_m)) / far)
                for c in seen.circles
            ]  # fmt: skip
            errors = min(each)
            right = errors[0] < RIGHT_RAD and errors[1] < RIGHT_SHARE
    best = seen.circles[0] if seen.circles else None
    numbers = {
        "circles": [np.append(c.centre_m, c.axis) for c in seen.circles],
        "covariance": None if best is None else best.covariance,
    }
    answers.add(group, str(seen.status), numbers, line=seen.record(), errors=errors, right=right)


def sizes(answers: Answers, seed: int) -> None:
    """A ring of unknown size from a fly-around: frame by frame, and the whole pass."""
    for turn in range(2):
        rng = np.random.default_rng([seed, turn])
        sights = [_sight(a, rng) for a in np.linspace(-1.0, 1.0, 24)]
        for sight in sights:
            size = answers.timed("ring size/frame", ring_size, _SIZE, sight)
            _add_size(answers, "ring size/frame", size)
        whole = answers.timed("ring size/pass", ring_size_of_pass, _SIZE, sights)
        _add_size(answers, "ring size/pass", whole)


def _add_size(answers: Answers, group: str, size: object | None) -> None:
    if size is None:
        answers.add(group, "none", {})
        return
    errors = (size.distance_m / _DISTANCE_M - 1.0, size.radius_m / _RADIUS_M - 1.0)
    numbers = {"size": [size.radius_m, size.distance_m], "covariance": size.covariance}
    right = abs(errors[1]) < RIGHT_SHARE
    answers.add(group, "ok", numbers, errors=(abs(errors[0]), abs(errors[1])), right=right)


def _sight(angle_rad: float, rng: np.random.Generator) -> RingSight:
    """A panel's corners, the ring's ellipse and a range from 12 m, with noise."""
    out = np.array([np.cos(angle_rad), np.sin(angle_rad), 0.0])
    down = np.array([0.0, 0.0, -1.0])
    rotation = np.vstack([np.cross(down, -out), down, -out])
    pose = Pose(rotation, rotation @ (-12.0 * out))
    y, z = 0.5 * _PANEL_M[0], 0.5 * _PANEL_M[1]
    corners = pose.apply(np.array([[0, y, z], [0, -y, z], [0, y, -z], [0, -y, -z]]))
    measured = _SIZE.project(corners) + rng.normal(0.0, 0.05, (4, 2))
    axis = pose.rotation[:, 0]
    shape = shape_of_circle(_SIZE, pose.apply([_DISTANCE_M, 0.0, 0.0]), axis, _RADIUS_M)
    points = Ellipse.from_shape(shape).points(300)
    ellipse = Ellipse.fit(points + rng.normal(0.0, 0.1, points.shape))
    range_m = float(axis @ pose.translation_m) / axis[2] + rng.normal(0.0, 0.005)
    return RingSight(measured, ellipse, range_m, 0.05, 0.005)


def reflectors(answers: Answers, seed: int) -> None:
    """Single pairs with foil, glints and hidden reflectors; then tracked runs."""
    pattern = patterns_of(Target.load(CLIENT), ("far",))[0]
    options, acquirer = ReflectorFrameOptions(), Acquirer(_GUIDANCE, [pattern])
    for k in range(100):
        rng = np.random.default_rng([seed, k])
        truth = _facing(rng, pattern, float(np.exp(rng.uniform(0.0, np.log(12.0)))))
        clutter = (foil(_GUIDANCE, rng, int(rng.integers(12, 41))), glints(_GUIDANCE, rng, k % 7))
        hidden = ((0,), (1,), (0, 2))[k // 3 % 3] if k % 3 == 0 else ()
        pair = LitDark(*render_pair(_GUIDANCE, pattern, truth, options, rng, hidden=hidden,
                                    clutter=clutter))  # fmt: skip
        group = "reflectors/acquisition" + ("/hidden" if hidden else "")
        found = answers.timed(group, acquirer.acquire, find_spots(pair))
        pose = None if found.refined is None else found.refined.camera_from_target
        errors = None if pose is None else _errors(pose, truth, pattern.centre_m)
        right = None if errors is None else errors[0] < RIGHT_RAD and errors[1] < RIGHT_SHARE
        numbers = {"pose": pose_numbers(pose), "score": found.score}
        answers.add(group, str(found.status), numbers, line=found.reason, errors=errors,
                    right=right)  # fmt: skip
    for run in range(12):
        rng = np.random.default_rng([seed, 100, run])
        start = _facing(rng, pattern, 1.5 + 0.8 * run)
        sensor = ReflectorSensor(_GUIDANCE, [pattern])
        step = rng.normal(0.0, [0.01, 0.01, 0.01, 0.01, 0.01, 0.03])
        for n in range(12):
            truth = start.perturbed(n * step)
            hidden = (1,) if n in (7, 8) else ()
            pair = render_pair(_GUIDANCE, pattern, truth, options, rng, hidden=hidden)
            seen = answers.timed("reflectors/tracked", sensor.update, 0.1 * n, LitDark(*pair))
            answers.pose("reflectors/tracked", seen, truth, middle_m=pattern.centre_m)


def _facing(rng: np.random.Generator, pattern: ReflectorPattern, range_m: float) -> Pose:
    """Tilted by up to 25°, a little off the boresight."""
    aside = rng.uniform(-0.12, 0.12, 2)
    tilt = np.deg2rad(25.0) * np.sqrt(rng.random())
    way = rng.uniform(0.0, 2.0 * np.pi)
    roll = rng.uniform(-1.4, 1.4)
    six = SixNumbers(range_m, *aside, roll, tilt * np.sin(way), tilt * np.cos(way))
    return pose_of(six, pattern)


def _errors(pose: Pose, truth: Pose, middle_m: Array) -> tuple[float, float]:
    there = truth.apply(middle_m)
    share = float(np.linalg.norm(pose.apply(middle_m) - there) / np.linalg.norm(there))
    return pose.angle_to(truth), share


def lights(answers: Answers, seed: int) -> None:
    """The laboratory's photodiodes with faults, unnamed spots of pictures, and a turning stage."""
    target = Target.load(MODELS_CAD / "scole")
    leds = np.array([led.position_m for led in target.leds])
    laboratory = Laboratory(leds, LaboratoryOptions(distorted=False), seed)
    rig, pictures = laboratory.rig, picture_rig(laboratory, PictureOptions())
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
        _add_lights(answers, "stereo/photodiodes", rig, target, _spots(rig, light), truth)
    for k in range(60):
        rng = np.random.default_rng([seed, 90, k])
        truth, views = _above(rng, 30.0), []
        for camera in pictures.cameras:
            seen = camera.project(truth.apply(leds))[rng.permutation(len(leds))[k % 2 :]]
            seen = np.concatenate([seen, rng.uniform(0.0, 1023.0, (k % 3, 2))])
            seen = seen[rng.permutation(len(seen))] + rng.normal(0.0, 0.05, seen.shape)
            views.append(Spots(seen, np.full(seen.shape, 0.05), np.full(len(seen), -1)))
        _add_lights(answers, "stereo/unnamed", pictures, target, views, truth)
    for k in range(6):
        rng = np.random.default_rng([seed, 150, k])
        truth = _above(rng, 20.0)
        drawn = [draw(pictures, c, truth.apply(leds), PictureOptions(), rng) for c in range(2)]
        _add_lights(answers, "stereo/pictures", pictures, target,
                    [find_lights(picture) for picture in drawn], truth)  # fmt: skip
    stage = laboratory.stage(np.deg2rad(30.0) * np.sin(0.05 * np.arange(70)))
    currents = laboratory.currents(stage, np.random.default_rng(seed))
    currents[40:44] = np.nan
    for name, motion in (("alone", None), ("filter", MotionOptions())):
        tracker = StereoTracker.of_target(rig, target, TrackerOptions(motion=motion))
        for k, reading in enumerate(currents):
            _add_lights(answers, f"stereo/stage/{name}", rig, target, _spots(rig, reading),
                        stage[k], tracker, 0.1 * k)  # fmt: skip


def _add_lights(
    answers: Answers, group: str, rig: Rig, target: Target, spots: list[Spots], truth: Pose,
    tracker: StereoTracker | None = None, time_s: float = 0.0,
) -> None:  # fmt: skip
    """One reading; by a tracker of its own where none is given."""
    one = tracker or StereoTracker.of_target(rig, target)
    seen = answers.timed(group, one.update, time_s, spots)
    answers.pose(group, seen, rig.cameras[0].camera_from_rig @ truth)


def _spots(rig: Rig, currents: Array) -> list[Spots]:
    return [c.photodiode.read(row) for c, row in zip(rig.cameras, currents, strict=True)]


def _above(rng: np.random.Generator, tilt_deg: float) -> Pose:
    """Any yaw, tilted any way, lights towards the cameras."""
    tilt, way = np.deg2rad(tilt_deg) * np.sqrt(rng.random()), rng.uniform(0.0, 2.0 * np.pi)
    tilted = Rotation.from_rotvec([tilt * np.cos(way), tilt * np.sin(way), 0.0])
    turn = Rotation.from_rotvec([0.0, 0.0, rng.uniform(-np.pi, np.pi)])
    return Pose((tilted * turn).as_matrix(), rng.uniform(-1.0, 1.0, 3) * (0.1, 0.1, 0.5))
