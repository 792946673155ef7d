"""All six numbers against the Cramér–Rao bound, from 12 m to 1 m, on simulated pictures."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.optimize import approx_fprime

from experiments.frame import CLIENT, show, table_of
from experiments.peers.pnp import PEERS, one_camera
from experiments.reflectors.lab import Simulator, plain
from rendezview import Camera, LitDark, Pose, Target, patterns_of
from rendezview.geometry.pose import minimal_rotation
from rendezview.sensors.beacons import (
    Acquirer,
    SixNumbers,
    find_spots,
    pose_of,
    predict_spots,
    six_numbers,
)
from rendezview.sensors.beacons.constellation import Face, ReflectorPattern
from rendezview.sensors.beacons.pose.refinement import SpotFit
from rendezview_ground.simulate.reflector_frames import (
    ReflectorFrameOptions,
    exposure,
    paint_reflector,
    render_pair,
)

CAMERA = Camera(512, 384, 651.975, 651.975, 255.5, 191.5)  # the paper's
RANGES_M = (12.0, 10.0, 8.0, 6.0, 5.0, 4.0, 3.0, 2.5, 2.0, 1.5, 1.25, 1.0)
TILT_RAD, ROLL_RAD, WRONG_RAD = math.radians(30.0), 1.48, math.radians(5.0)
OPTIONS = ReflectorFrameOptions()
PINHOLE = plain.Pinhole(CAMERA.width, CAMERA.height, CAMERA.fx, CAMERA.cx, CAMERA.cy)
LOOK = plain.Look()
NAMES = ("range", "azimuth", "elevation", "roll", "pitch", "yaw")
SOLVERS = ("this sensor", *PEERS)


def random_pose(
    rng: np.random.Generator, pattern: ReflectorPattern, range_m: float
) -> tuple[Pose, SixNumbers]:
    """A pose with all reflectors in the picture."""
    while True:
        tilt = TILT_RAD * math.sqrt(rng.random())
        way = rng.uniform(0.0, 2.0 * math.pi)
        # The tilt is against the line of sight: made on the boresight, then turned off it.
        roll = rng.uniform(-ROLL_RAD, ROLL_RAD)
        tilted = SixNumbers(range_m, 0.0, 0.0, roll, tilt * math.sin(way), tilt * math.cos(way))
        az, el = rng.uniform(-0.3, 0.3), rng.uniform(-0.22, 0.22)
        sight = (math.sin(az) * math.cos(el), -math.sin(el), math.cos(az) * math.cos(el))
        turn = minimal_rotation([0.0, 0.0, 1.0], sight)
        pose = Pose(turn, np.zeros(3)) @ pose_of(tilted, pattern)
        spots = predict_spots(CAMERA, pattern, pose)
        margin = 6.0 + 0.5 * pattern.diameters_m.max() * CAMERA.fx / (0.85 * range_m)
        edge = (CAMERA.width - 1 - margin, CAMERA.height - 1 - margin)
        if (spots > margin).all() and (spots < edge).all():
            return pose, six_numbers(pose, pattern)


def values(six: SixNumbers) -> np.ndarray:
    """(6,) in the order of ``NAMES``."""
    return np.array([getattr(six, f"{n}_{'m' if n == 'range' else 'rad'}") for n in NAMES])


def six_by_spots(pattern: ReflectorPattern, pose: Pose) -> np.ndarray:
    """(6, 6) derivative of the six numbers by the spots' coordinates at a pose."""
    face, centre = Face.of(pattern), pattern.centre_m
    middle = pose.apply(centre)

    def spots_and_six(step: np.ndarray) -> np.ndarray:
        # turned about the reflectors' middle, not about the target's origin
        rotation = pose.perturbed(step).rotation
        moved = Pose(rotation, middle + step[3:] - rotation @ centre)
        return np.append(predict_spots(CAMERA, pattern, moved), values(face.six_numbers(moved)))

    steps = 1e-6 * np.array([1.0, 1.0, 1.0, *([np.linalg.norm(middle)] * 3)])
    slopes = approx_fprime(np.zeros(6), spots_and_six, steps)
    return slopes[6:] @ np.linalg.inv(slopes[:6])


def plain_light(pattern: ReflectorPattern, pose: Pose, hidden: tuple[int, ...] = ()) -> np.ndarray:
    """(H, W) light of the tests' simulator; the brightest reflector that is not hidden is 180."""
    discs = (pattern.positions_m, pattern.normals, pattern.diameters_m)
    return plain.discs(PINHOLE, pose.rotation, pose.translation_m, *discs, LOOK, hidden)


def lights(pattern: ReflectorPattern, pose: Pose, simulator: Simulator) -> Iterator[np.ndarray]:
    """(H, W) light of each reflector by itself."""
    gain, together = exposure(CAMERA, pattern, pose, OPTIONS), plain_light(pattern, pose)
    for k in range(len(pattern)):
        if simulator == "own":
            grey = np.zeros((CAMERA.height, CAMERA.width), np.float32)
            paint_reflector(grey, CAMERA, pattern, k, pose, gain, OPTIONS)
            yield grey
        else:
            one = plain_light(pattern, pose, tuple(n for n in range(len(pattern)) if n != k))
            top = np.unravel_index(np.argmax(one), one.shape)
            yield one * together[top] / one[top]


def pixel_bound(pattern: ReflectorPattern, pose: Pose, simulator: Simulator) -> np.ndarray:
    """(N, 2) least centroid errors (px) of the reflectors, under the simulator's noise."""
    noise = math.sqrt(2.0 * (OPTIONS.noise_sigma_grey**2 + 1.0 / 12.0))  # of the difference
    bounds = np.empty((len(pattern), 2))
    for k, light in enumerate(lights(pattern, pose, simulator)):
        lit = np.nonzero(light > 1e-4)
        rows, columns = (slice(max(i.min() - 8, 0), i.max() + 9) for i in lit)
        grey = light[rows, columns]
        for axis in (0, 1):
            # Spots are few pixels wide: the slope of the sampled spot, not of neighbouring pixels.
            waves = 2j * np.pi * np.fft.fftfreq(grey.shape[axis])
            waves = waves[:, None] if axis == 0 else waves
            slope = np.fft.ifft(waves * np.fft.fft(grey, axis=axis), axis=axis).real
            bounds[k, 1 - axis] = noise / math.sqrt(float(np.sum(slope**2)))
    return bounds


@dataclass(frozen=True)
class Reading:
    """A pair of pictures whose three spots are named as in truth."""

    pose: Pose
    six: np.ndarray  # true
    truth_px: np.ndarray  # (3, 2) where the spots are
    spots_px: np.ndarray  # (3, 2) measured
    refined: Pose  # from the spots


def read(
    rng: np.random.Generator, finder: Acquirer, pattern: ReflectorPattern, range_m: float,
    simulator: Simulator,
) -> Reading | None:  # fmt: skip
    """One random pair, read on its own; None where the acquirer finds no three spots."""
    pose, six = random_pose(rng, pattern, range_m)
    if simulator == "own":
        frames = LitDark(*render_pair(CAMERA, pattern, pose, OPTIONS, rng))
    else:
        frames = LitDark(*plain.pair(PINHOLE, plain_light(pattern, pose), LOOK, rng))
    spots = find_spots(frames)
    found = finder.acquire(spots)
    if found.refined is None or found.reflectors is None or len(found.reflectors) < 3:
        return None
    where = np.empty(3, np.int64)
    where[found.reflectors] = found.spot_indices
    refined = found.refined
    truth_px = predict_spots(CAMERA, pattern, pose)
    if np.linalg.norm(spots.centroids_px[where[0]] - truth_px[0]) > 2.0:
        # The target looks the same half a turn away: name left and right as in truth.
        where = where[[2, 1, 0]]
        sigma_px = np.maximum(spots.sigma_px[where], 1e-3)
        refined = SpotFit(CAMERA, pattern).fit(
            spots.centroids_px[where], np.arange(3), pose, sigma_px
        )
        assert refined is not None
    spots_px = spots.centroids_px[where]
    return Reading(pose, values(six), truth_px, spots_px, refined.camera_from_target)


def beside_peers(readings: list[Reading], pattern: ReflectorPattern) -> list[str]:
    """Cells: median turn off the truth of the right ones, and how many are wrong, by solver."""
    turns: dict[str, list[float]] = {name: [] for name in SOLVERS}
    for reading in readings:
        answers = one_camera(pattern.positions_m, reading.spots_px, CAMERA)
        for name, pose in ({"this sensor": reading.refined} | answers).items():
            turns[name].append(math.pi if pose is None else pose.angle_to(reading.pose))
    right = {name: [t for t in own if t < WRONG_RAD] for name, own in turns.items()}
    medians = [np.rad2deg(np.median(good or [np.nan])) for good in right.values()]
    wrong = [len(readings) - len(good) for good in right.values()]
    return [f"{turn:.3f}° ({count})" for turn, count in zip(medians, wrong, strict=True)]


def run(*, frames: int = 400, seed: int = 21, simulator: Simulator = "own") -> None:
    """All six numbers against the Cramér–Rao bound, from 12 m to 1 m, on simulated pictures.

    The paper's camera (512 × 384, 652 px a radian, 8 bit) and target (far target of
    models_cad/client), tilt up to 30° in any direction, any roll within ±85°, the target anywhere
    in the picture. --frames pairs at each range, each read on its own.

    *Bound of the pixels*: the least error of a centroid of a spot of known shape under the
    simulator's noise, σ² = σ_n² / Σ (∂I/∂x)². *Bound*: what these errors force on any unbiased
    estimate of the six numbers (three spots, six numbers: J Σ Jᵀ). OpenCV's SQPNP and poselib have
    the same spots with the right names. Wrong: more than 5° off.
    """
    pattern = patterns_of(Target.load(CLIENT), ("far",))[0]
    finder, rng = Acquirer(CAMERA, [pattern]), np.random.default_rng(seed)
    title = f"RMS error over the bound of the pixels, {frames} pairs, seed {seed}, {simulator}"
    columns = ("range m", "no pose", "spot RMS px", *NAMES, "range, median %")
    ratios = table_of(title, columns, left=0)
    title = "median turn off the truth, right readings (wrong ones), the same spots"
    beside = table_of(title, ("range m", *SOLVERS), left=0)
    for range_m in RANGES_M:
        tried = [read(rng, finder, pattern, range_m, simulator) for _ in range(frames)]
        readings = [reading for reading in tried if reading is not None]
        spot_error = np.array([r.spots_px - r.truth_px for r in readings])
        least = np.array([pixel_bound(pattern, r.pose, simulator) for r in readings])
        squared = [
            six_by_spots(pattern, r.pose) ** 2 @ own.ravel() ** 2
            for r, own in zip(readings, least, strict=True)
        ]
        error = np.array([values(six_numbers(r.refined, pattern)) - r.six for r in readings])
        ratio = np.sqrt(np.mean((error / np.sqrt(squared)) ** 2, axis=0))
        rms = math.sqrt(float(np.mean(spot_error**2)))
        ratios.add_row(
            f"{range_m:g}", str(frames - len(readings)), f"{rms:.4f}", *[f"{r:.2f}" for r in ratio],
            f"{100.0 * np.median(np.abs(error[:, 0])) / range_m:.4f}",
        )  # fmt: skip
        beside.add_row(f"{range_m:g}", *beside_peers(readings, pattern))
    show(ratios, beside, width=150)
