"""Calibration of the stereo LED tracker, as docs/stereo.md reports it."""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path
from typing import Annotated, Literal

import cv2
import numpy as np
from rendezview.sensors.stereo import Rig, RigCamera, Spots, StereoTracker
from rendezview.sensors.stereo.agreement import LightsFit
from rendezview.sensors.stereo.board import (
    BoardViews,
    Chessboard,
    calibrate_board,
    picture_pairs,
    read_board_views,
)
from rendezview.sensors.stereo.bundle import INTRINSICS, POSE, intrinsics_of
from rendezview.sensors.stereo.laboratory import EVERYTHING, calibrate_laboratory
from rendezview.sensors.stereo.motion import difference
from rendezview.sensors.stereo.response import fit_response
from rendezview.sensors.stereo.start import intersect
from rendezview.simulation.led_laboratory import Laboratory, LaboratoryOptions
from rich.table import Table

from experiments.frame import show
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.io.target import Target

BOARD = Chessboard(9, 6, 0.025)


def run(
    *, part: Literal["laboratory", "pictures", "minerva"], seed: int = 31,
    cases: Annotated[int, "laboratories"] = 12, pin_cushion: float = 0.04,
) -> None:  # fmt: skip
    """Calibration of the stereo LED tracker.

    laboratory: photodiode rigs whose truth is known, calibrated from simulated measurements.
    pictures: OpenCV's thirteen real chessboard pairs, beside OpenCV's own calibration: residuals,
    and how planar and how far apart the triangulated corners are.
    minerva: the 300 poses of Synthetic-Minerva-II2, from the 16 points of one picture each.
    The last two need the data in the folder that RENDEZVIEW_TEST_DATA names.
    """
    start = time.perf_counter()
    if part == "laboratory":
        laboratory(seed, cases, pin_cushion)
    else:
        {"pictures": pictures, "minerva": minerva}[part]()
    print(f"{time.perf_counter() - start:.0f} s")


def data(name: str) -> Path:
    folder = os.environ.get("RENDEZVIEW_TEST_DATA")
    if not folder or not (Path(folder) / name).is_dir():
        sys.exit(f"set RENDEZVIEW_TEST_DATA to the folder that holds {name}")
    return Path(folder) / name


def laboratory(seed: int, cases: int, pin_cushion: float) -> None:
    target = Target.load("models_cad/scole")
    leds = np.array([led.position_m for led in target.leds])
    options = LaboratoryOptions(pin_cushion=pin_cushion)
    scores: dict[str, list[float]] = {}
    response, whole, chi2 = [], [], []
    for case in range(cases):
        truth = Laboratory(leds, options, seed + case)
        rng = np.random.default_rng(seed + case)
        record = truth.calibration(rng)
        made = calibrate_laboratory(record)
        for k, one in enumerate(record.cameras):
            cubic, quintic = fit_response(one.beam_m, one.scan), made.responses[k]
            noise = np.sqrt((made.rig.cameras[k].photodiode.read(one.scan[0]).sigma ** 2).mean())
            response.append([cubic.linear_rms_m, cubic.rms_m, quintic.rms_m,
                             noise / np.sqrt(len(one.scan)), noise])  # fmt: skip
        z = []
        for found, true in zip(made.rig.cameras, truth.rig.cameras, strict=True):
            error = dict(zip(INTRINSICS, intrinsics_of(found) - intrinsics_of(true), strict=True))
            error["f"] = error["fx"]
            a, b = found.camera_from_rig, true.camera_from_rig
            moved = difference(a.rotation, a.translation_m, b.rotation, b.translation_m)
            error |= dict(zip(POSE, moved, strict=True))
            for name in (*EVERYTHING, *POSE):
                scores.setdefault(name, []).append(error[name] / found.sigma[name])
                z.append(error[name])
        names = [f"{c.name}.{n}" for c in made.rig.cameras for n in (*EVERYTHING, *POSE)]
        index = [made.rig.covariance_names.index(name) for name in names]
        covariance = made.rig.covariance[np.ix_(index, index)]
        whole.append(np.array(z) @ np.linalg.solve(covariance, z) / len(z))
        chi2.append(made.together.chi2 / made.together.spare)
    print(f"{cases} laboratories, seeds {seed} …, pin-cushion "
          f"{pin_cushion:g}, signal-to-noise 200, 60 scans")  # fmt: skip
    table = Table("detector, r.m.s. µm", "value")
    for name, value in zip(
        ("best affine map leaves", "cubic (eq. 5) leaves", "quintic leaves",
         "noise of an averaged reading", "noise of one reading"),
        1e6 * np.sqrt(np.mean(np.square(response), axis=0)), strict=True,
    ):  # fmt: skip
        table.add_row(name, f"{value:.2f}")
    show(table, width=100)
    table = Table("parameter", "error / σ, r.m.s.", "worst", "above 3")
    for name, values in scores.items():
        sizes = np.abs(values)
        table.add_row(name, f"{np.sqrt(np.mean(sizes**2)):.2f}", f"{sizes.max():.2f}",
                      f"{(sizes > 3.0).sum()} of {len(sizes)}")  # fmt: skip
    every = np.abs(np.concatenate(list(scores.values())))
    table.add_row("all", f"{np.sqrt(np.mean(every**2)):.2f}", f"{every.max():.2f}",
                  f"{(every > 3.0).sum()} of {len(every)}")  # fmt: skip
    show(table, width=100)
    print(
        f"whole error in its covariance, χ²/n: mean {np.mean(whole):.2f}, "
        f"worst {max(whole):.2f}; residual χ²/dof {np.mean(chi2):.3f}"
    )


def pictures() -> None:
    views = read_board_views(picture_pairs(data("opencv_stereo")), BOARD)
    made = calibrate_board(views)
    boards = [BOARD.points_m.astype(np.float32)] * len(views.corners[0])
    corners = [[found.astype(np.float32) for found in one] for one in views.corners]
    table = Table("r.m.s., px", "OpenCV", "ours", "difference")
    apart = []
    for k, name in enumerate(views.names):
        rms, matrix, lens, *_rest = cv2.calibrateCamera(
            boards, corners[k], views.sizes[k], None, None
        )
        apart.append((matrix, lens))
        ours = made.separate[k].rms
        table.add_row(name, f"{rms:.6f}", f"{ours:.6f}", f"{ours - rms:+.1e}")
    stereo = {}
    for name, flags in (("OpenCV, intrinsics fixed (its default)", cv2.CALIB_FIX_INTRINSIC),
                        ("OpenCV, everything free", cv2.CALIB_USE_INTRINSIC_GUESS)):  # fmt: skip
        stereo[name] = cv2.stereoCalibrate(
            boards, *corners, *(part.copy() for pair in apart for part in pair), views.sizes[0],
            flags=flags,
        )  # fmt: skip
    best = min(one[0] for one in stereo.values())
    table.add_row("together", f"{best:.6f}", f"{made.together.rms:.6f}",
                  f"{made.together.rms - best:+.1e}")  # fmt: skip
    show(table, width=100)
    table = Table(
        "corners triangulated by", "off their plane, mm", "pitch − 25 mm, mm", "mean pitch"
    )
    for name, one in stereo.items():
        _, m1, d1, m2, d2, rotation, translation, *_rest = one
        points = [_opencv_points(m1, d1, m2, d2, rotation, translation, a, b)
                  for a, b in zip(*corners, strict=True)]  # fmt: skip
        table.add_row(name, *_board_errors(points))
    for name, rig in (
        ("ours, OpenCV's lens", made.rig),
        ("ours, eq. 6 whole", calibrate_board(views, free=INTRINSICS, corrects=True).rig),
    ):
        table.add_row(name, *_board_errors(_our_points(rig, views)))
    show(table, width=110)


def _opencv_points(m1, d1, m2, d2, rotation, translation, left, right) -> np.ndarray:
    a = cv2.undistortPoints(left[:, None], m1, d1).reshape(-1, 2).T
    b = cv2.undistortPoints(right[:, None], m2, d2).reshape(-1, 2).T
    found = cv2.triangulatePoints(np.eye(3, 4), np.hstack([rotation, translation]), a, b)
    return (found[:3] / found[3]).T


def _our_points(rig: Rig, views: BoardViews) -> list[np.ndarray]:
    points = []
    for both in zip(*views.corners, strict=True):
        count = len(both[0])
        spots = [Spots(c, np.full(c.shape, 0.2), np.arange(count)) for c in both]
        found, ok = intersect(rig, rig.sights(spots, count))
        assert ok.all()
        points.append(found)
    return points


def _board_errors(boards: list[np.ndarray]) -> tuple[str, str, str]:
    off, pitch = [], []
    for points in boards:
        centred = points - points.mean(axis=0)
        off.append(centred @ np.linalg.svd(centred, full_matrices=False)[2][2])
        grid = points.reshape(BOARD.rows, BOARD.columns, 3)
        for axis in (0, 1):
            pitch.append(np.linalg.norm(np.diff(grid, axis=axis), axis=2).ravel())
    steps = 1e3 * np.concatenate(pitch)
    return (
        f"{1e3 * np.sqrt(np.mean(np.square(off))):.4f}",
        f"{np.sqrt(np.mean((steps - 1e3 * BOARD.pitch_m) ** 2)):.4f}", f"{steps.mean():.4f}",
    )  # fmt: skip


def minerva() -> None:
    folder = data("minerva2")
    points = np.loadtxt(folder / "MinervaII2_Vertices.txt", delimiter=",")
    frames = json.loads((folder / "Tumble_annotations.json").read_text())
    focal = 512.0 / np.tan(0.5 * np.deg2rad(68.89))
    camera = Camera(1024, 1024, focal, focal, 512.0, 512.0)
    rig = Rig((RigCamera.from_camera("camera", camera, Pose.identity()),))
    tracker = StereoTracker(rig, points)
    residuals, angles, places, refused = [], [], [], 0
    for frame in frames:
        seen = np.array(frame["joints"])
        spots = Spots(seen, np.full(seen.shape, 0.02), np.arange(len(seen)))
        found = tracker.locate(rig.sights([spots], len(points)))
        if not isinstance(found, LightsFit) or found.left_out:
            refused += 1
            continue
        pose = Pose(found.rotation, found.translation)
        truth = Pose.from_quat_wxyz(frame["pose"][:4], frame["pose"][4:])
        residuals.append(np.linalg.norm(camera.project(pose.apply(points)) - seen, axis=1))
        angles.append(np.rad2deg(pose.angle_to(truth)))
        places.append(np.linalg.norm(pose.translation_m - truth.translation_m))
    each = np.sqrt(np.mean(np.square(residuals), axis=1))
    print(
        f"{len(frames)} poses, 16 points of one picture, nothing known: {len(residuals)} "
        f"recovered, {refused} refused; {(each <= 0.02).sum()} at or below 0.02 px r.m.s."
    )
    print(f"reprojection r.m.s. {np.sqrt(np.mean(np.square(residuals))):.5f} px, worst frame "
          f"{each.max():.5f} px")  # fmt: skip
    print(f"attitude to the given pose: median {np.median(angles):.5f}°, worst {max(angles):.5f}°; "
          f"place: worst {1e6 * max(places):.1f} µm")  # fmt: skip
