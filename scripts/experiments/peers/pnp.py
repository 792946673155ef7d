"""Poses of named points by OpenCV's solvePnP and by poselib, on the same spots."""

from __future__ import annotations

import cv2
import numpy as np

from rendezview import Camera, Pose, Rig
from rendezview.sensors.beacons import Sights

try:
    import poselib
except ImportError:  # a development tool
    poselib = None

PEERS = ("solvePnP", "poselib")
Poses = dict[str, Pose | None]


def by_opencv(
    points_m: np.ndarray, spots_px: np.ndarray, camera: Camera, *, refine: bool = False
) -> Pose | None:
    """SQPNP, and least squares after it if asked for, of more than three spots; no distortion."""
    given = (points_m, np.ascontiguousarray(spots_px), camera.matrix, None)
    found, turn, shift = cv2.solvePnP(*given, flags=cv2.SOLVEPNP_SQPNP)
    if not found:
        return None
    if refine and len(points_m) > 3:
        turn, shift = cv2.solvePnPRefineLM(*given, turn, shift)
    return Pose(cv2.Rodrigues(turn)[0], shift.ravel())


def by_poselib(points_m: np.ndarray, spots_px: np.ndarray, camera: Camera) -> Pose | None:
    """Its RANSAC and least squares; a camera without distortion."""
    if poselib is None:
        return None
    params = [camera.fx, camera.fy, camera.cx, camera.cy]
    model = {"model": "PINHOLE", "width": camera.width, "height": camera.height, "params": params}
    options = {"max_reproj_error": 1.0}
    pose, info = poselib.estimate_absolute_pose(spots_px, points_m, model, options, {})
    return Pose(pose.R, pose.t) if info["num_inliers"] >= 3 else None


def one_camera(points_m: np.ndarray, spots_px: np.ndarray, camera: Camera) -> Poses:
    """Both answers, by name."""
    answers = by_opencv(points_m, spots_px, camera), by_poselib(points_m, spots_px, camera)
    return dict(zip(PEERS, answers, strict=True))


def rig(points_m: np.ndarray, sights: Sights, cameras: Rig) -> Poses:
    """Rig from target: OpenCV's solvePnP in the first camera, poselib's with all of them.

    Both have the same directions as this project, without the lens's distortion.
    """
    seen = [np.flatnonzero(lights) for lights in sights.visible]
    first, alone = cameras.cameras[0].camera_from_rig, None
    if len(seen[0]) >= 3:
        plane = Camera(1, 1, 1.0, 1.0, 0.0, 0.0)
        alone = by_opencv(points_m[seen[0]], sights.xy[0][seen[0]], plane, refine=True)
    answers: Poses = dict.fromkeys(PEERS)
    answers["solvePnP"] = None if alone is None else first.inverse() @ alone
    if poselib is not None:
        mounts = []
        for camera in cameras.cameras:
            mount = poselib.CameraPose()
            mount.R, mount.t = camera.camera_from_rig.rotation, camera.camera_from_rig.translation_m
            mounts.append(mount)
        scale = 1000.0  # of its camera: thresholds are pixels
        model = {"model": "SIMPLE_PINHOLE", "width": 2, "height": 2, "params": [scale, 0.0, 0.0]}
        pose, _ = poselib.estimate_generalized_absolute_pose(
            [scale * sights.xy[c][k] for c, k in enumerate(seen)], [points_m[k] for k in seen],
            mounts, [model] * len(mounts), {"max_reproj_error": 20.0}, {},
        )  # fmt: skip
        answers["poselib"] = Pose(pose.R, pose.t)
    return answers
