"""All six numbers against the Cramér–Rao bound, from 12 m to 1 m, on simulated pictures."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Annotated

import numpy as np
from rendezview.sensors.reflectors import (
    Acquirer,
    ClosedFormCalibration,
    LitDark,
    SixNumbers,
    calibrate,
    closed_form,
    find_spots,
    patterns_of,
    pose_of,
    predict_spots,
    six_numbers,
)
from rendezview.sensors.reflectors.pattern import Face, ReflectorPattern
from rendezview.sensors.reflectors.refinement import refine
from rendezview.simulation.reflector_frames import (
    ReflectorFrameOptions,
    exposure,
    paint_reflector,
    render_pair,
)

from experiments.frame import show, table_of, two
from experiments.peers.pnp import PEERS, median_deg, one_camera
from experiments.reflectors.plain import Simulator, plain
from experiments.reflectors.run import CAMERA, CLIENT
from rendezview.geometry.pose import Pose, minimal_rotation
from rendezview.io.target import Target

RANGES_M = (12.0, 10.0, 8.0, 6.0, 5.0, 4.0, 3.0, 2.5, 2.0, 1.5, 1.25, 1.0)
NAMES = ("range", "azimuth", "elevation", "roll", "pitch", "yaw")
SOLVERS = ("this sensor", *PEERS)
OPTIONS = ReflectorFrameOptions()
PINHOLE = plain.Pinhole(CAMERA.width, CAMERA.height, CAMERA.fx, CAMERA.cx, CAMERA.cy)
LOOK = plain.Look()


def random_pose(
    rng: np.random.Generator, pattern: ReflectorPattern, range_m: float, tilt_deg: float = 30.0
) -> tuple[Pose, SixNumbers]:
    """A pose with all reflectors in the picture."""
    while True:
        tilt = math.radians(tilt_deg) * math.sqrt(rng.random())
        way = rng.uniform(0.0, 2.0 * math.pi)
        # The tilt is against the line of sight: made on the boresight, then turned off it.
        ahead = pose_of(
            SixNumbers(range_m, 0.0, 0.0, rng.uniform(-1.48, 1.48), tilt * math.sin(way),
                       tilt * math.cos(way)),
            pattern,
        )  # fmt: skip
        az, el = rng.uniform(-0.3, 0.3), rng.uniform(-0.22, 0.22)
        sight = (math.sin(az) * math.cos(el), -math.sin(el), math.cos(az) * math.cos(el))
        turn = minimal_rotation([0.0, 0.0, 1.0], sight)
        pose = Pose(turn, np.zeros(3)) @ ahead
        six = six_numbers(pose, pattern)
        spots = predict_spots(CAMERA, pattern, pose)
        margin = 6.0 + 0.5 * pattern.diameters_m.max() * CAMERA.fx / (0.85 * range_m)
        if (spots > margin).all() and (
            spots < (CAMERA.width - 1 - margin, CAMERA.height - 1 - margin)
        ).all():
            return pose, six


def values(six: SixNumbers) -> np.ndarray:
    return np.array(
        [six.range_m, six.azimuth_rad, six.elevation_rad, six.roll_rad, six.pitch_rad, six.yaw_rad]
    )


def six_by_spots(pattern: ReflectorPattern, pose: Pose) -> np.ndarray:
    """(6, 6) derivative of the six numbers by the spots' coordinates at a pose."""
    face = Face.of(pattern)
    spots_by_pose, six_by_pose = np.empty((6, 6)), np.empty((6, 6))
    far = float(np.linalg.norm(pose.apply(pattern.centre_m)))
    centre = pattern.centre_m
    for k in range(6):
        h = 1e-5 if k < 3 else 1e-5 * far
        ends = []
        for sign in (1.0, -1.0):
            step = np.zeros(6)
            step[k] = sign * h
            # turn about the reflectors' middle, not about the target's origin
            turned = pose.perturbed(step)
            shift = pose.apply(centre) + step[3:]
            moved = Pose(turned.rotation, shift - turned.rotation @ centre)
            ends.append(
                (predict_spots(CAMERA, pattern, moved).ravel(), values(face.six_numbers(moved)))
            )
        spots_by_pose[:, k] = (ends[0][0] - ends[1][0]) / (2.0 * h)
        six_by_pose[:, k] = (ends[0][1] - ends[1][1]) / (2.0 * h)
    return six_by_pose @ np.linalg.inv(spots_by_pose)


def plain_light(pattern: ReflectorPattern, pose: Pose, hidden: tuple[int, ...] = ()) -> np.ndarray:
    """(H, W) light of the tests' simulator; the brightest reflector that is not hidden is 180."""
    return plain.discs(
        PINHOLE, pose.rotation, pose.translation_m, pattern.positions_m, pattern.normals,
        pattern.diameters_m, LOOK, hidden,
    )  # fmt: skip


def lights(pattern: ReflectorPattern, pose: Pose, simulator: Simulator) -> Iterator[np.ndarray]:
    """(H, W) light of each reflector by itself."""
    gain = exposure(CAMERA, pattern, pose, OPTIONS)
    all_ = plain_light(pattern, pose)
    for k in range(len(pattern)):
        if simulator == "own":
            grey = np.zeros((CAMERA.height, CAMERA.width), np.float32)
            paint_reflector(grey, CAMERA, pattern, k, pose, gain, OPTIONS)
            yield grey
        else:
            one = plain_light(pattern, pose, tuple(n for n in range(len(pattern)) if n != k))
            top = np.unravel_index(np.argmax(one), one.shape)
            yield one * all_[top] / one[top]


def pictures(
    simulator: Simulator, pattern: ReflectorPattern, pose: Pose, rng: np.random.Generator
) -> LitDark:
    """The lit and the dark picture of a pose."""
    if simulator == "own":
        return LitDark(*render_pair(CAMERA, pattern, pose, OPTIONS, rng))
    return LitDark(*plain.pair(PINHOLE, plain_light(pattern, pose), LOOK, rng))


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
            waves = np.fft.fftfreq(grey.shape[axis])
            shape = [1, 1]
            shape[axis] = -1
            slope = np.fft.ifft(
                2j * np.pi * waves.reshape(shape) * np.fft.fft(grey, axis=axis), axis=axis
            ).real
            bounds[k, 1 - axis] = noise / math.sqrt(float(np.sum(slope**2)))
    return bounds


@cache
def acquirer() -> tuple[ReflectorPattern, Acquirer]:
    """The far target, and what finds it."""
    pattern = patterns_of(Target.load(CLIENT), ("far",))[0]
    return pattern, Acquirer(CAMERA, [pattern])


@dataclass(frozen=True)
class Reading:
    """A pair of pictures whose three spots are named as in truth."""

    pose: Pose
    six: np.ndarray  # true
    truth_px: np.ndarray  # (3, 2) where the spots are
    spots_px: np.ndarray  # (3, 2) measured
    sigma_px: np.ndarray  # (3,)
    refined: Pose  # from the spots


def read(rng: np.random.Generator, range_m: float, simulator: Simulator) -> Reading | None:
    """One random pair, read on its own; None where the acquirer finds no three spots."""
    pattern, finder = acquirer()
    pose, six = random_pose(rng, pattern, range_m)
    spots = find_spots(pictures(simulator, pattern, pose, rng))
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
        refined = refine(CAMERA, pattern, spots.centroids_px[where], [0, 1, 2], pose, sigma_px)
        assert refined is not None
    return Reading(
        pose, values(six), truth_px, spots.centroids_px[where], spots.sigma_px[where],
        refined.camera_from_target,
    )  # fmt: skip


def run(
    *, frames: Annotated[int, "pairs at each range"] = 400, seed: int = 21,
    simulator: Simulator = "own",
) -> None:  # fmt: skip
    """All six numbers against the Cramér–Rao bound, from 12 m to 1 m, on simulated pictures.

    The paper's camera (512 × 384, 652 px a radian, 8 bit) and target (far target of
    models_cad/client), tilt up to 30° in any direction, any roll within ±85°, the target anywhere
    in the picture. Every pair of pictures is read on its own.

    *Bound of the pixels*: the least error of a centroid of a spot of known shape under the
    simulator's noise, σ² = σ_n² / Σ (∂I/∂x)². *Bound*: what these errors force on any unbiased
    estimate of the six numbers (three spots, six numbers: J Σ Jᵀ). OpenCV's SQPNP and poselib have
    the same spots with the right names. Wrong: more than 5° off.
    """
    pattern, _ = acquirer()
    rng = np.random.default_rng(seed)
    title = f"RMS error over the bound of the pixels, {frames} pairs, seed {seed}, {simulator}"
    columns = ("range m", "no pose", "spot RMS px", "spot bias px", "/ pixel bound", *NAMES)
    ratios = table_of(title, columns, left=0)
    columns = ("range m", "range %", *(f"{name} °" for name in NAMES[1:]))
    title = "median bound → median error (bound's σ × 0.674 would be the median)"
    sizes = table_of(title, columns, left=0)
    closed_form_table = table_of("closed form with calibration: median / 95 %", columns, left=0)
    beside = table_of(
        "median turn off the truth, right readings (wrong ones), the same spots",
        ("range m", *SOLVERS),
        left=0,
    )
    constants = learn(seed + 1000, simulator)
    for range_m in RANGES_M:
        tried = [read(rng, range_m, simulator) for _ in range(frames)]
        readings = [reading for reading in tried if reading is not None]
        spot_error = np.array([r.spots_px - r.truth_px for r in readings])
        least = np.array([pixel_bound(pattern, r.pose, simulator) for r in readings])
        bound = np.array(
            [
                np.sqrt(six_by_spots(pattern, r.pose) ** 2 @ own.ravel() ** 2)
                for r, own in zip(readings, least, strict=True)
            ]
        )
        error = np.array([values(six_numbers(r.refined, pattern)) - r.six for r in readings])
        ratio = np.sqrt(np.mean((error / bound) ** 2, axis=0))
        rms = math.sqrt(float(np.mean(spot_error**2)))
        bias = np.abs(spot_error.mean((0, 1))).max()
        ratios.add_row(
            f"{range_m:g}", str(frames - len(readings)), f"{rms:.4f}", f"{bias:.4f}",
            f"{rms / math.sqrt(float(np.mean(least**2))):.2f}", *[f"{r:.2f}" for r in ratio],
        )  # fmt: skip
        units = np.array([100.0 / range_m, *([180.0 / math.pi] * 5)])
        medians = zip(*(np.median(np.abs(v), axis=0) * units for v in (bound, error)), strict=True)
        sizes.add_row(f"{range_m:g}", *[f"{b:.4f} → {e:.4f}" for b, e in medians])
        answers = [(closed_form(CAMERA, pattern, r.spots_px, constants), r.six) for r in readings]
        rough = np.abs([values(six) - true for six, true in answers if six is not None]) * units
        closed_form_table.add_row(f"{range_m:g}", *[two(column) for column in rough.T])
        beside.add_row(f"{range_m:g}", *against_peers(readings, pattern))
    show(ratios, sizes, closed_form_table, beside, width=150)


def against_peers(readings: list[Reading], pattern: ReflectorPattern) -> list[str]:
    """Cells: median turn off the truth of the right ones, and how many are wrong, by solver."""
    turns: dict[str, list[float]] = {name: [] for name in SOLVERS}
    for reading in readings:
        answers = one_camera(pattern.positions_m, reading.spots_px, CAMERA)
        for name, pose in ({"this sensor": reading.refined} | answers).items():
            turns[name].append(math.pi if pose is None else pose.angle_to(reading.pose))
    right = {name: [t for t in own if t < math.radians(5.0)] for name, own in turns.items()}
    return [
        f"{median_deg(right[name])}° ({len(own) - len(right[name])})" for name, own in turns.items()
    ]


def learn(seed: int, simulator: Simulator) -> ClosedFormCalibration:
    """Constants of the closed form, of 300 other pairs, 1 to 12 m."""
    rng = np.random.default_rng(seed)
    tried = [read(rng, math.exp(rng.uniform(0.0, math.log(12.0))), simulator) for _ in range(300)]
    readings = [(r.spots_px, SixNumbers(*r.six)) for r in tried if r is not None]
    print(f"closed form calibrated on {len(readings)} of 300 pairs, seed {seed}")
    return calibrate(CAMERA, acquirer()[0], readings)
