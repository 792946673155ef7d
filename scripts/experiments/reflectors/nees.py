"""Normalised errors of poses against their covariances, by condition and range."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import cv2
import numpy as np

from experiments.frame import nees, show, table_of
from experiments.reflectors import lab
from experiments.reflectors.followed import followed
from experiments.reflectors.lab import plain
from rendezview import Camera, LitDark, Pose, ReflectorSensor
from rendezview.calibration.one_camera import camera_of_corners
from rendezview.sensors.beacons import ReflectorPattern, TrackingOptions
from rendezview.sensors.beacons.detect.registration import register

RANGES_M = (0.8, 1.5, 3.0, 6.0)
TILT_RAD, WRONG_RAD = (0.0, 0.5), np.deg2rad(5.0)
TILTS_RAD = {"tilt 50 to 60°": np.deg2rad((50, 60)), "tilt 60 to 75°": np.deg2rad((60, 75))}
KINDS = (
    "retro-reflected", "even light", "shade of 40 grey", "MJPEG", "JPEG 40", "texture",
    "texture, 0.3 px of motion", "texture, 0.3 px of motion, registered", "five reflectors",
    "clutter", "saturated", "saturated, bloomed", "focal length 0.1 %", "focal length 1 %",
    "centre 3 px", "camera of 12 boards", "post 1 mm off", "places 0.3 mm off", "20 % covered",
    "35 % covered", "five reflectors, 20 % covered", "five reflectors, 35 % covered",
    "tilt 50 to 60°", "tilt 60 to 75°",
    "tracked", "tracked, 35 % covered", "tracked, 50 % covered", "tracked, five, 50 % covered",
    "tracked, rolling shutter", "tracked, 30 % dropped", "tracked, swinging",
    "tracked, swinging, 30 % dropped",
)  # fmt: skip
# σ of fx fy cx cy, and m of each reflector's place, that the files state. The errors have them.
STATED = {
    "focal length 0.1 %": (np.full(2, 1e-3 * lab.PINHOLE.focal_px), np.zeros(2)),
    "focal length 1 %": (np.full(2, 1e-2 * lab.PINHOLE.focal_px), np.zeros(2)),
    "centre 3 px": (np.zeros(2), np.full(2, 3.0)),
}
# An edge so many radii from the middle of one disc hides so much of it.
COVERS = {"20 %": 0.492, "35 %": 0.238, "50 %": 0.0}
PLACES_M = {"post 1 mm off": (0.0, 1e-3, 0.0), "places 0.3 mm off": (3e-4,) * 3}


def off(pose: Pose, truth: Pose) -> np.ndarray:
    """(6,) error of a pose, the nearer of two that look alike."""
    half = truth @ lab.HALF_TURN
    near = truth if pose.angle_to(truth) < pose.angle_to(half) else half
    return pose.delta_from(near)


def jpeg(picture: np.ndarray, quality: int) -> np.ndarray:
    _, coded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE))


def edge_of(kind: str) -> float:
    """Radii from the middle of a disc to the edge that covers it; 1: none does."""
    return next((e for share, e in COVERS.items() if f"{share} covered" in kind), 1.0)


def frames_of(
    kind: str, pattern: ReflectorPattern, simulator: lab.Simulator,
    placed: tuple[np.ndarray, np.ndarray], rng: np.random.Generator,
) -> LitDark:  # fmt: skip
    """The pictures of one reading under a condition."""
    look = plain.Look(even=kind == "even light")
    if kind.startswith("shade"):
        look = replace(look, peak=40.0)
    if kind.startswith("saturated"):
        look = replace(look, peak=500.0, even=True)
    background = None
    if kind.startswith("texture"):
        wall = moved = plain.texture(lab.PINHOLE, rng, 3.0, 60.0)
        if "motion" in kind:
            shift, way = np.float32([[1, 0, 0.3], [0, 1, 0.0]]), cv2.BORDER_REFLECT
            size = wall.shape[::-1]
            moved = cv2.warpAffine(wall, shift, size, flags=cv2.INTER_CUBIC, borderMode=way)
        background = wall, moved
    false = clutter(rng) if kind == "clutter" else None
    edge, covers = edge_of(kind), None
    if edge < 1.0:
        covers = {int(rng.integers(len(pattern))): (rng.uniform(0.0, 2.0 * np.pi), edge)}
    frames = lab.pictures(
        simulator, pattern, placed, look, rng, background=background, false=false, covers=covers
    )
    if kind == "texture":
        return LitDark(frames.lit)
    if "bloomed" in kind:
        return LitDark(bloomed(frames.lit), frames.dark)
    if quality := {"MJPEG": 75, "JPEG 40": 40}.get(kind):
        return LitDark(jpeg(frames.lit, quality), jpeg(frames.dark, quality))
    return register(frames) if "registered" in kind else frames


def filed(
    kind: str, pattern: ReflectorPattern, rng: np.random.Generator
) -> tuple[Camera, ReflectorPattern]:
    """What the camera file and the target file say, with their errors and their σ."""
    if kind in PLACES_M:
        sigmas = np.array(PLACES_M[kind])
        off = rng.normal(0.0, 1.0, (len(pattern), 3)) * sigmas[:, None]
        moved = pattern.positions_m + off
        return lab.CAMERA, replace(pattern, positions_m=moved, sigmas_m=sigmas, sigmas_known=True)
    if kind == "camera of 12 boards":
        return of_boards(rng), pattern
    if kind not in STATED:
        return lab.CAMERA, pattern
    focal, centre = STATED[kind]
    off = np.concatenate([focal * rng.normal(), centre * rng.normal(0.0, 1.0, 2)])
    covariance = np.diag(np.concatenate([focal, centre]) ** 2)
    covariance[0, 1] = covariance[1, 0] = focal[0] * focal[1]  # one focal length
    numbers = np.array([lab.CAMERA.fx, lab.CAMERA.fy, lab.CAMERA.cx, lab.CAMERA.cy]) + off
    names = dict(zip(("fx", "fy", "cx", "cy"), numbers.tolist(), strict=True))
    return replace(lab.CAMERA, **names, covariance=covariance.tolist()), pattern


def of_boards(rng: np.random.Generator) -> Camera:
    """The camera, calibrated from corners of 12 boards with noise of 0.1 px."""
    grid = np.stack(np.meshgrid(np.arange(9), np.arange(6)), axis=-1).reshape(-1, 2)
    board = np.column_stack([0.025 * (grid - grid.mean(axis=0)), np.zeros(len(grid))])
    points, corners = [], []
    while len(points) < 12:
        turn = plain.turn(rng.normal(size=3), rng.uniform(0.2, 0.7))
        place = np.array([*rng.uniform((-0.1, -0.07), (0.1, 0.07)), rng.uniform(0.4, 0.6)])
        seen = lab.PINHOLE.project(board @ turn.T + place)
        if (seen > 5.0).all() and (seen < (lab.PINHOLE.width - 6, lab.PINHOLE.height - 6)).all():
            points.append(board)
            corners.append(seen + rng.normal(0.0, 0.1, seen.shape))
    return camera_of_corners(points, corners, (lab.PINHOLE.width, lab.PINHOLE.height))[0]


def bloomed(picture: np.ndarray) -> np.ndarray:
    """Charge of saturated pixels runs down their columns: a quarter of each run's length."""
    out = picture.copy()
    for column in np.flatnonzero((picture == 255).any(axis=0)):
        full = np.concatenate([[0], (picture[:, column] == 255).astype(int), [0]])
        starts, ends = np.flatnonzero(np.diff(full) == 1), np.flatnonzero(np.diff(full) == -1)
        for start, end in zip(starts, ends, strict=True):
            out[end : end + round(0.25 * (end - start)), column] = 255
    return out


def clutter(rng: np.random.Generator) -> np.ndarray:
    """(40, 4) false lights of every size and brightness, in the lit picture only."""
    places = rng.uniform((0.0, 0.0), (lab.PINHOLE.width, lab.PINHOLE.height), (40, 2))
    return np.column_stack([places, rng.uniform(0.6, 6.0, 40), rng.uniform(20.0, 240.0, 40)])


def run(
    *, readings: int = 60, seed: int = 7, ranges_m: list[float] = RANGES_M,
    kind: Annotated[str, "the beginning of a condition"] = "", simulator: lab.Simulator = "plain",
) -> None:  # fmt: skip
    """NEES of single poses (6 unknowns: 6 is right) under one condition each, by range.

    Pictures of the paper's three reflectors, tilt to 30°, every roll, blur 0.7 px, noise 2 grey, of
    the tests' plain simulator or of the product's own. 'texture' is a single picture; MJPEG has
    quality 75. 'saturated' discs have twice the light of a full pixel; 'bloomed', a quarter of the
    length of their columns runs over at one end. Rows from 'focal length' to 'places' have
    errors in the camera file or in the target file, drawn anew for each reading from the σ that the
    file states. 'covered': an edge hides so much of one disc.

    'tracked': the last of 12 readings at 10 Hz, and the rates' NEES; an edge creeps over a disc,
    a rolling shutter of 33 ms sees a turn of 20°/s, or the motion swings (30 readings at 5 Hz).
    """
    columns = ["condition", *(f"{r:g} m" for r in ranges_m)]
    title = f"mean NEES (; of rates) of {readings} readings (poses), seed {seed}, {simulator}"
    table = table_of(title, columns)
    for condition in (one for one in KINDS if one.startswith(kind)):
        rng, cells = np.random.default_rng(seed), []
        pattern = lab.FIVE if "five" in condition else lab.THREE
        tilt = TILTS_RAD.get(condition, TILT_RAD)
        for range_m in ranges_m:
            errors: list[float] = []
            of_rates: list[float] = []
            # All dots lie in the picture; near by the target stands in its middle.
            margin_px = 20.0 + 0.25 * lab.PINHOLE.focal_px / range_m
            margin_px = min(margin_px, 0.5 * min(lab.PINHOLE.width, lab.PINHOLE.height) - 5.0)
            for _ in range(readings):
                placed = plain.look_at(rng, lab.PINHOLE, range_m, tilt[1], margin_px, tilt[0])
                truth = Pose(*placed)
                if condition.startswith("tracked"):
                    reading, true_rates = followed(
                        condition, pattern, placed, edge_of(condition), rng
                    )
                    if (rates := reading.rates) is not None and reading.pose is not None:
                        rate = np.append(rates.turn_rad_s, rates.velocity_m_s)
                        of_rates.append(nees(rate - true_rates, rates.covariance))
                else:
                    camera, known = filed(condition, pattern, rng)
                    tracking = TrackingOptions(confirm=False)
                    frames = frames_of(condition, pattern, simulator, placed, rng)
                    reading = ReflectorSensor(camera, [known], tracking=tracking).update(0, frames)
                error = None if reading.pose is None else off(reading.pose, truth)
                if error is not None and np.linalg.norm(error[:3]) < WRONG_RAD:
                    errors.append(nees(error, reading.covariance))
            means = "; ".join(f"{np.mean(some):.1f}" for some in (errors, of_rates) if some)
            cells.append(f"{means or '–'} ({len(errors)})")
        table.add_row(condition, *cells)
    show(table)
