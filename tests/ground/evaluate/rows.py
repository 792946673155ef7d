"""Results of a scene whose target stands still 10 m ahead, for tests that evaluate them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.io.results import ResultRow
from rendezview.io.sequences import Frame, Sequence

RANGE_M = 10.0
TRUTH = Pose(np.eye(3), np.array([0.0, 0.0, RANGE_M]))


def sequence(count: int = 4, without_truth: tuple[int, ...] = ()) -> Sequence:
    def no_image() -> np.ndarray:
        raise AssertionError("an evaluation reads no images")

    camera = Camera.from_fov(640, 480, 1.0)
    frames = tuple(
        Frame(k, f"{k}.png", float(k), camera, None if k in without_truth else TRUTH, 1, no_image)
        for k in range(count)
    )
    return Sequence(5, frames, Path("scene"))


def row(
    im_id: int,
    angle_deg: float = 0.0,
    off_m: float = 0.0,
    score: float = 1.0,
    time_s: float | None = None,
    *,
    scene_id: int = 5,
    obj_id: int = 1,
) -> ResultRow:
    turn = Rotation.from_euler("z", angle_deg, degrees=True).as_matrix()
    pose = Pose(turn, TRUTH.translation_m + np.array([off_m, 0.0, 0.0]))
    return ResultRow(scene_id, im_id, obj_id, score, pose, time_s)
