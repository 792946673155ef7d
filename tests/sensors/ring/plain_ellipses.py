"""Ellipses of a vehicle's circles as a detector gives them: some missing, some of other things.

Circles are projected point by point; their ellipses have the errors that pictures of
`plain_rings` show. No picture is drawn, so that a test can read hundreds of frames.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from tests.plain_pictures import Pinhole
from tests.plain_rings import facing
from tests.sensors.ring.plain_fit import shape_through

from rendezview.sensors.ring import Ellipse
from rendezview.sensors.ring.detector import Detection, RingEdge

CAMERA = Pinhole(640, 480, 640.0, 319.5, 239.5)
_LEAST_PX = 8.0  # of the short semi-axis


def ellipse_of(
    rotation: np.ndarray, translation: np.ndarray, height_m: float, radius_m: float
) -> Ellipse | None:
    """The picture of a circle about the vehicle's axis; None where it is behind the camera."""
    round_it = np.linspace(0.0, math.tau, 60, endpoint=False)
    points = np.column_stack(
        [radius_m * np.cos(round_it), radius_m * np.sin(round_it), np.full(60, height_m)]
    )
    seen = points @ rotation.T + translation
    if not (seen[:, 2] > 0.05).all():
        return None
    return Ellipse.from_shape(shape_through(CAMERA.project(seen)))


def detected(
    rng: np.random.Generator, rotation: np.ndarray, translation: np.ndarray,
    circles: Sequence[tuple[float, float]], *, shown: float = 0.6, strange: float = 1.5,
) -> Detection:  # fmt: skip
    """A detection: each circle with the odds ``shown``, and ``strange`` other ellipses or so."""
    found: list[RingEdge] = []

    def add(ellipse: Ellipse | None) -> None:
        if ellipse is None or not _LEAST_PX < ellipse.semi_axes_px[1] < 320.0:
            return
        sigma = 0.05 + 1.5 / ellipse.semi_axes_px[1]
        shape = ellipse.shape + rng.normal(0.0, sigma, 5)
        if not ((shape[:2] > 0.0) & (shape[:2] < (CAMERA.width, CAMERA.height))).all():
            return
        own = Ellipse.from_shape(shape, sigma**2 * np.eye(5))
        score = float(rng.uniform(0.2, 0.9))
        found.append(RingEdge(own, math.tau * score, score, 50.0, len(found) % 2, 0.1))

    for height_m, radius_m in circles:
        if rng.random() < shown:
            add(ellipse_of(rotation, translation, height_m, radius_m))
    for _ in range(rng.poisson(strange)):  # a shadow, a shield: about the axis, of any size
        height_m, radius_m = rng.uniform(-0.4, 0.1), 0.15 * 6.0 ** rng.random()
        add(ellipse_of(rotation, translation, height_m, radius_m))
    found.sort(key=lambda edge: -edge.score)
    return Detection(tuple(found), 2.0, None if found else "no ellipse")


def approach(
    rng: np.random.Generator, count: int, far_m: float, near_m: float, step_s: float
) -> list[tuple[float, np.ndarray, np.ndarray]]:
    """Times, rotations and translations of an approach; the camera swings by 2°."""
    tilt, way, roll = math.radians(rng.uniform(2.0, 25.0)), *rng.uniform(0.0, math.tau, 2)
    poses = []
    for k in range(count):
        range_m = far_m * (near_m / far_m) ** (k / (count - 1))
        swing = 22.0 * np.array([math.sin(0.02 * k * step_s + way), math.cos(0.025 * k * step_s)])
        middle = np.array([CAMERA.cx, CAMERA.cy]) + swing
        rotation, translation = facing(CAMERA, range_m, tilt, way, roll, middle)
        poses.append((k * step_s, rotation, translation))
    return poses
