"""Poses by a camera pair that a few pictures of a board calibrated: errors against covariances."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from experiments.frame import MODELS_CAD, error_of, nees, show, table_of
from rendezview.calibration.board import BoardViews, Chessboard, calibrate_board
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.io.target import Target
from rendezview.sensors.beacons import RigCamera, Spots, StereoTracker
from rendezview.sensors.beacons.stereo_tracker import TrackerOptions

BOARD = Chessboard(9, 6, 0.025)
SIZE = (1280, 960)
RIGS, POSES, PAIRS, CORNER_PX = 20, 10, 12, 0.15
SPOTS_PX = (0.05, 0.15)


def pair_of(rng: np.random.Generator) -> list[RigCamera]:
    """Two cameras 0.4 m apart, each with its own lens."""
    found = []
    for name, place in (("left", 0.0), ("right", -0.4)):
        focal = 1200.0 * (1.0 + rng.normal(0.0, 0.01))
        centre = rng.normal((639.5, 479.5), 5.0)
        lens = (rng.normal(-0.1, 0.02), rng.normal(0.05, 0.02), *rng.normal(0.0, 5e-4, 2), 0.0)
        camera = Camera(*SIZE, focal, focal, float(centre[0]), float(centre[1]), lens)
        mount = Pose.identity()
        if place:
            mount = mount.perturbed([*rng.normal(0.0, 0.02, 3), place, *rng.normal(0.0, 0.01, 2)])
        found.append(RigCamera.from_camera(name, camera, mount))
    return found


def views_of(pair: list[RigCamera], rng: np.random.Generator) -> BoardViews:
    """Corners of a board before both cameras, tilted by up to 40°, half a metre to one away."""
    corners: list[list[np.ndarray | None]] = [[], []]
    while len(corners[0]) < PAIRS:
        turn = Rotation.from_euler("zxy", rng.uniform(-0.7, 0.7, 3)).as_matrix()
        place = np.array([*rng.uniform(-0.15, 0.15, 2), rng.uniform(0.5, 1.0)])
        middle = turn @ BOARD.points_m.mean(axis=0)
        points = BOARD.points_m @ turn.T + place - middle + (0.1, 0.0, 0.0)
        seen = [camera.project(points) for camera in pair]
        inside = [((s > 5.0) & (s < np.subtract(SIZE, 6.0))).all() for s in seen]
        if not any(inside):
            continue
        for k, (spots, there) in enumerate(zip(seen, inside, strict=True)):
            noisy = spots + rng.normal(0.0, CORNER_PX, spots.shape)
            corners[k].append(noisy if there else None)
    return BoardViews(BOARD, ("left", "right"), (SIZE, SIZE), tuple(map(tuple, corners)))


def errors(
    pair: list[RigCamera], tracker: StereoTracker, rng: np.random.Generator, spot_px: float
) -> list[float]:
    """Normalised squared errors of single poses, first camera's frame."""
    squares = []
    for k in range(POSES):
        angles = [*rng.uniform(-np.pi, np.pi, 1), *rng.uniform(-0.5, 0.5, 2)]
        facing = Rotation.from_euler("zxy", angles).as_matrix() @ np.diag([1.0, -1.0, -1.0])
        far = float(rng.uniform(1.5, 4.0))
        pose = Pose(facing, np.array([*(0.1 * far * rng.uniform(-1.0, 1.0, 2)), far]))
        spots = []
        for camera in pair:
            places = camera.project(pose.apply(tracker.leds))
            places = places + rng.normal(0.0, spot_px, places.shape)
            sigma = np.full(places.shape, spot_px)
            spots.append(Spots(places, sigma, np.arange(len(places))))
        reading = tracker.update(60.0 * k, spots)  # nothing is left of the pose before
        if reading.pose is not None:
            squares.append(nees(error_of(reading.pose, pose), reading.covariance))
    return squares


def run(*, seed: int = 17) -> None:
    """NEES (6 is right) of poses by 20 pairs, each calibrated from 12 simulated board pairs.

    SCOLE's lights a quarter as far apart, 1.5 to 4 m away, every roll, tilt to 40°; ten poses a
    pair. Corners have 0.15 px of noise. With the calibration's covariance, and with the residual's
    floor alone.
    """
    leds = 0.25 * np.array([led.position_m for led in Target.load(MODELS_CAD / "scole").leds])
    table = table_of(
        f"{RIGS} rigs of {PAIRS} board pairs, {POSES} poses each, seed {seed}",
        "spots σ px | poses | with the calibration: NEES | worst rig | without: NEES",
        left=0,
    )
    for spot_px in SPOTS_PX:
        rng = np.random.default_rng(seed)
        kept: dict[bool, list[list[float]]] = {True: [], False: []}
        for _ in range(RIGS):
            truth = pair_of(rng)
            made = calibrate_board(views_of(truth, rng)).rig
            state = rng.bit_generator.state
            for with_error, squares in kept.items():
                rng.bit_generator.state = state  # the same poses and noise
                options = TrackerOptions(calibration_error=with_error)
                tracker = StereoTracker(made, leds, options=options)
                squares.append(errors(truth, tracker, rng, spot_px))
        mine, without = (np.concatenate(kept[with_error]) for with_error in (True, False))
        table.add_row(
            f"{spot_px:g}", f"{len(mine)} of {RIGS * POSES}", f"{np.mean(mine):.1f}",
            f"{max(np.mean(ours) for ours in kept[True] if ours):.1f}", f"{np.mean(without):.0f}",
        )  # fmt: skip
    show(table)
