"""Rows of the benchmark: readings of reflectors, rings and stereo lights."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from itertools import count

import cv2
import numpy as np

import rendezview as rv
from experiments.benchmark.check import Bench, Row, Way, times
from experiments.frame import CLIENT, MODELS_CAD
from experiments.reflectors.accuracy import CAMERA, OPTIONS, random_pose
from experiments.stereo.accuracy import leds_of, spots_of
from rendezview.calibration.laboratory import calibrate_laboratory
from rendezview.sensors.beacons import ReflectorPattern, TrackerOptions
from rendezview.sensors.ring import RingDetector
from rendezview_ground.simulate.led_laboratory import Laboratory, LaboratoryOptions
from rendezview_ground.simulate.reflector_frames import render_pair
from rendezview_ground.simulate.ring_frames import RingSceneOptions, random_scene, render_ring_frame

REFLECTOR_SEED, RING_SEED, STEREO_SEED = 41, 81, 21
REFLECTOR_RANGE_M = 6.0
WIDE = rv.Camera(3840, 2160, 3667.0, 3667.0, 1919.5, 1079.5)
RING_PX = (640, 480)
STEREO_READINGS = 100


def moments(lit: np.ndarray, dark: np.ndarray) -> list[tuple[float, float]]:
    """Difference, threshold, contours, moments of each: what OpenCV needs for three centroids."""
    difference = cv2.subtract(lit, dark)
    mask = cv2.threshold(difference, 20, 255, cv2.THRESH_BINARY)[1]
    centres = []
    for contour in cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]:
        x, y, w, h = cv2.boundingRect(contour)
        m = cv2.moments(difference[y : y + h, x : x + w])
        centres.append((x + m["m10"] / m["m00"], y + m["m01"] / m["m00"]))
    return centres


def reflectors(bench: Bench) -> Iterator[Row]:
    """A reading of the reflectors beside what OpenCV needs for three centroids."""
    rng = np.random.default_rng(REFLECTOR_SEED)
    pattern = rv.patterns_of(rv.Target.load(CLIENT), ("far",))[0]
    pose, _ = random_pose(rng, pattern, REFLECTOR_RANGE_M)
    for camera, where in ((CAMERA, ""), (WIDE, f", {WIDE.width} × {WIDE.height}")):
        pairs = [rv.LitDark(*render_pair(camera, pattern, pose, OPTIONS, rng)) for _ in range(5)]
        spent = bench.race(reflector_ways(camera, pattern, pairs, where))
        floor = f"difference, threshold, contours, moments{where}"
        yield from times("reflector-accuracy", spent, {n: (floor,) for n in spent if n != floor})


def reflector_ways(
    camera: rv.Camera, pattern: ReflectorPattern, pairs: list[rv.LitDark], where: str
) -> dict[str, Callable[[], object]]:
    """What a user calls at the first reading and at later ones, and the floor."""
    new, sensor = rv.ReflectorSensor(camera, [pattern]), rv.ReflectorSensor(camera, [pattern])
    readings = count(1)

    def acquire() -> None:
        new.forget()
        assert new.update(0.0, pairs[0]).status is rv.Status.UNCONFIRMED

    def track() -> None:
        k = next(readings)
        reading = sensor.update(0.1 * k, pairs[k % len(pairs)])
        assert k < 3 or (reading.tracked and reading.pose is not None)

    return {
        f"reflectors, acquisition{where}": acquire,
        f"reflectors, tracking{where}": track,
        f"difference, threshold, contours, moments{where}": (
            lambda: moments(pairs[0].lit, pairs[0].dark_or_nothing)
        ),
    }


def chain_ellipses(frame: np.ndarray) -> list[tuple[object, ...]]:
    """OpenCV's edges, and an ellipse through each that is long enough: nothing is asked of it."""
    edges = cv2.Canny(frame, 50, 100)
    chains = cv2.findContours(edges, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0]
    return [cv2.fitEllipseDirect(chain) for chain in chains if len(chain) >= 30]


def rings(bench: Bench) -> Iterator[Row]:
    """The ring detector beside OpenCV's edges with an ellipse through each."""
    width, height = RING_PX
    camera = rv.Camera.from_fov(width, height, math.radians(40.0))
    options = RingSceneOptions(clutter=2, width_px=(150.0, 380.0))
    many = max(3, bench.frames // 2)
    rngs = [np.random.default_rng([RING_SEED, width, k]) for k in range(many)]
    frames = [render_ring_frame(random_scene(camera, rng, options), rng) for rng in rngs]
    detector = RingDetector(camera)
    ours, floor = f"ring, {width} × {height}", "Canny, an ellipse through each chain"
    ways = {ours: Way(lambda: [detector.detect(f) for f in frames], many),
            floor: Way(lambda: [chain_ellipses(f) for f in frames], many)}  # fmt: skip
    yield from times("ring-accuracy", bench.race(ways), {ours: (floor,)})


def by_paper(rig: rv.Rig, leds: np.ndarray, currents: np.ndarray) -> None:
    """Eq. 4 linearised by numpy: 24 equations, one iteration from the last estimate."""
    rotation, translation = np.eye(3), np.zeros(3)
    for reading in currents:
        rows, right = [], []
        for camera, light in zip(rig.cameras, reading, strict=True):
            ideal, _ = camera.ideal(camera.photodiode.read(light))
            arm, c = leds @ rotation.T, camera.camera_from_rig
            p = (arm + translation) @ c.rotation.T + c.translation_m
            for axis in range(2):
                x = p[:, axis] / p[:, 2]
                g = (c.rotation[axis] - x[:, None] * c.rotation[2]) / p[:, 2:]
                rows.append(np.hstack([np.cross(arm, g), g]))
                right.append(ideal[:, axis] - x)
        step, *_ = np.linalg.lstsq(np.vstack(rows), np.concatenate(right), rcond=None)
        translation = translation + step[3:]
        x, y, z = step[:3]
        turn = np.eye(3) + np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        u, _, vt = np.linalg.svd(turn @ rotation)
        rotation = u @ vt


def stereo(bench: Bench) -> Iterator[Row]:
    """Readings of lights beside the paper's iteration in numpy."""
    target = rv.Target.load(MODELS_CAD / "scole")
    lights = leds_of(target)
    laboratory = Laboratory(lights, LaboratoryOptions(), STEREO_SEED)
    rng = np.random.default_rng(STEREO_SEED)
    angles = np.deg2rad(40.0) * np.sin(0.05 * np.arange(STEREO_READINGS))  # to and fro
    currents = laboratory.currents(laboratory.stage(angles), rng)
    rig = calibrate_laboratory(laboratory.calibration(rng)).rig
    one_by_one = rv.StereoTracker.of_target(rig, target, TrackerOptions(motion=None))
    clock = count()

    def follow() -> None:
        for reading in currents:
            one_by_one.update(0.1 * next(clock), spots_of(rig, reading))

    ours, plain = "stereo, a reading", "the paper's iteration in plain numpy"
    ways = {ours: Way(follow, len(currents)),
            plain: Way(lambda: by_paper(rig, lights, currents), len(currents))}  # fmt: skip
    yield from times("stereo-accuracy", bench.race(ways), {ours: (plain,)})
