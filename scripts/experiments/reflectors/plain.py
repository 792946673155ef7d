"""The plain simulator of the tests (tests/plain_pictures.py), and the product's view of it."""

from __future__ import annotations

import math
import sys

import numpy as np

from experiments.frame import ROOT
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.sensors.reflectors import ReflectorPattern

if str(ROOT) not in sys.path:
    sys.path.insert(0, str(ROOT))

from tests import plain_pictures as plain

__all__ = ["CAMERA", "FIVE", "PINHOLE", "THREE", "apart", "plain", "pose_of_plain"]

PINHOLE = plain.Pinhole()
CAMERA = Camera(
    PINHOLE.width, PINHOLE.height, PINHOLE.focal_px, PINHOLE.focal_px, PINHOLE.cx, PINHOLE.cy
)
_HALF, _POST = 0.5 * 14.5 * 0.0254, 4 * 0.0254  # m, of the paper's target
_PLACES = np.array(
    [
        [-_HALF, 0, 0],
        [0, 0, _POST],
        [_HALF, 0, 0],
        [0, 0.75 * _HALF, 0],
        [0, -0.75 * _HALF, 0],
    ]
)


def _pattern(count: int) -> ReflectorPattern:
    return ReflectorPattern(
        "five" if count == 5 else "three",
        ("left", "post", "right", "top", "bottom")[:count],
        _PLACES[:count], np.tile([0.0, 0.0, 1.0], (count, 1)), np.full(count, 0.025),
    )  # fmt: skip


THREE, FIVE = _pattern(3), _pattern(5)


def pose_of_plain(placed: tuple[np.ndarray, np.ndarray]) -> Pose:
    """Rotation and translation as a `Pose`."""
    return Pose(*placed)


def apart(pose: Pose, truth: Pose, half_turns: bool) -> tuple[float, float]:
    """Degrees and share of the range between two poses of these targets.

    ``half_turns``: half a turn about the face is no error.
    """
    degrees = pose.angle_to(truth)
    if half_turns:
        half = Pose(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
        degrees = min(degrees, pose.angle_to(truth @ half))
    off = np.linalg.norm(pose.translation_m - truth.translation_m)
    return math.degrees(degrees), float(off / np.linalg.norm(truth.translation_m))
