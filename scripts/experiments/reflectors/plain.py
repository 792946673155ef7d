"""The plain simulator of the tests (tests/plain_pictures.py), and the product's view of it."""

from __future__ import annotations

import math
import sys
from typing import Literal

import numpy as np
from rendezview.sensors.reflectors import LitDark, ReflectorPattern
from rendezview.simulation.reflector_frames import Clutter, ReflectorFrameOptions, render_pair

from experiments.frame import ROOT
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose

if str(ROOT) not in sys.path:
    sys.path.insert(0, str(ROOT))

from tests import plain_pictures as plain

__all__ = [
    "CAMERA",
    "FIVE",
    "PINHOLE",
    "THREE",
    "Simulator",
    "apart",
    "pictures",
    "plain",
    "pose_of_plain",
]

Simulator = Literal["plain", "own"]

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


def pictures(
    simulator: Simulator, pattern: ReflectorPattern, placed: tuple[np.ndarray, np.ndarray],
    look: plain.Look, rng: np.random.Generator, *, hidden: tuple[int, ...] = (),
    false: np.ndarray | None = None, background: tuple[np.ndarray, np.ndarray] | None = None,
) -> LitDark:  # fmt: skip
    """One reading by the plain simulator or by the product's own, which share no code."""
    if simulator == "plain":
        light = plain.discs(
            PINHOLE,
            *placed,
            pattern.positions_m,
            pattern.normals,
            pattern.diameters_m,
            look,
            hidden,
        )
        return LitDark(*plain.pair(PINHOLE, light, look, rng, false=false, background=background))
    options = ReflectorFrameOptions(
        peak_grey=look.peak, blur_sigma_px=look.blur, noise_sigma_grey=look.noise, leak=look.leak,
        black_level_grey=look.black, even_light=look.even,
    )  # fmt: skip
    spots = np.empty((0, 9))
    if false is not None:
        x, y, sigma, peak = false.T
        none = np.zeros(len(false))
        spots = np.column_stack([x, y, sigma, sigma, none, peak, none, none, none])
    both = background or (None, None)
    lit, dark = (
        render_pair(
            CAMERA, pattern, Pose(*placed), options, rng, hidden=hidden,
            clutter=(Clutter(spots, None if wall is None else wall.astype(np.float32)),),
        )[k]
        for k, wall in enumerate(both)
    )  # fmt: skip
    return LitDark(lit, dark)


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
