"""The plain simulator of the tests (tests/plain_pictures.py), and the product's view of it."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np

from experiments.frame import tests_module
from rendezview import Camera, LitDark, Pose, Status
from rendezview.sensors.beacons import ReflectorPattern
from rendezview_ground.simulate.reflector_frames import Clutter, ReflectorFrameOptions, render_pair

plain = tests_module("plain_pictures")

Simulator = Literal["plain", "own"]

PINHOLE = plain.Pinhole()
_FOCAL_PX = (PINHOLE.focal_px, PINHOLE.focal_px)
CAMERA = Camera(PINHOLE.width, PINHOLE.height, *_FOCAL_PX, PINHOLE.cx, PINHOLE.cy)
_HALF, _POST = 0.5 * 14.5 * 0.0254, 4 * 0.0254  # m, of the paper's target
_PLACES = np.array(
    [[-_HALF, 0, 0], [0, 0, _POST], [_HALF, 0, 0], [0, 0.75 * _HALF, 0], [0, -0.75 * _HALF, 0]]
)
KINDS = ("right", "wrong", "ambiguous", "none")
WRONG_DEG, WRONG_SHARE = 5.0, 0.03
HALF_TURN = Pose(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))


def _pattern(name: str, count: int) -> ReflectorPattern:
    names = ("left", "post", "right", "top", "bottom")[:count]
    normals = np.tile([0.0, 0.0, 1.0], (count, 1))
    return ReflectorPattern(name, names, _PLACES[:count], normals, np.full(count, 0.025))


THREE, FIVE = _pattern("three", 3), _pattern("five", 5)


def pictures(
    simulator: Simulator, pattern: ReflectorPattern, placed: tuple[np.ndarray, np.ndarray],
    look, rng: np.random.Generator, *, hidden: tuple[int, ...] = (),
    false: np.ndarray | None = None, background: tuple[np.ndarray, np.ndarray] | None = None,
    covers: dict[int, tuple[float, float]] | None = None,
) -> LitDark:  # fmt: skip
    """One reading by the plain simulator or by the product's own, which share no code.

    ``covers`` are of the plain one alone.
    """
    if simulator == "plain":
        discs = (pattern.positions_m, pattern.normals, pattern.diameters_m)
        light = plain.discs(PINHOLE, *placed, *discs, look, hidden, covers)
        return LitDark(*plain.pair(PINHOLE, light, look, rng, false=false, background=background))
    options = ReflectorFrameOptions(
        peak_grey=look.peak, blur_sigma_px=look.blur, noise_sigma_grey=look.noise, leak=look.leak,
        black_level_grey=look.black, even_light=look.even,
    )  # fmt: skip
    spots = np.zeros((0 if false is None else len(false), 9))
    if false is not None:
        spots[:, [0, 1, 2, 5]], spots[:, 3] = false, false[:, 2]
    lit, dark = (
        render_pair(
            CAMERA, pattern, Pose(*placed), options, rng, hidden=hidden,
            clutter=(Clutter(spots, None if wall is None else wall.astype(np.float32)),),
        )[k]
        for k, wall in enumerate(background or (None, None))
    )  # fmt: skip
    return LitDark(lit, dark)


def apart(pose: Pose, *truths: Pose) -> tuple[float, float]:
    """Degrees and share of the range between a pose and the nearest of those that look alike."""
    return min(
        (
            math.degrees(pose.angle_to(one)),
            float(np.linalg.norm(pose.translation_m - one.translation_m))
            / float(np.linalg.norm(one.translation_m)),
        )
        for one in truths
    )


def kind(pose: Pose | None, status: Status | None, *truths: Pose) -> str:
    """What an answer is, one of ``KINDS``."""
    if pose is None:
        return "ambiguous" if status is Status.AMBIGUOUS else "none"
    degrees, share = apart(pose, *truths)
    return "wrong" if degrees > WRONG_DEG or share > WRONG_SHARE else "right"
