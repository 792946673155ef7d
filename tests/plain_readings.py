"""Readings of a pattern of reflectors by the plain simulator, its cameras and the mirrored pose."""

from __future__ import annotations

import numpy as np
from tests.plain_pictures import Look, Pinhole, discs, pair

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.geometry.so3 import between
from rendezview.sensors.beacons import LitDark, ReflectorPattern
from rendezview.sensors.observation import Observation

PINHOLE, PAPER = Pinhole(), Pinhole(focal_px=651.975)  # PAPER is that of `paper_camera`
CAMERA = Camera(512, 384, 650.0, 650.0, 255.5, 191.5)  # PINHOLE
HALF_TURN = Pose(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
LOOK = Look()

Cover = dict[int, tuple[float, float]]


def light_of(
    pinhole: Pinhole, pattern: ReflectorPattern, pose: Pose, look: Look = LOOK,
    hidden: tuple[int, ...] = (), covers: Cover | None = None,
) -> np.ndarray:  # fmt: skip
    """`discs` of a pattern at a pose."""
    return discs(
        pinhole, pose.rotation, pose.translation_m, pattern.positions_m, pattern.normals,
        pattern.diameters_m, look, hidden, covers,
    )  # fmt: skip


def frames_of(
    pinhole: Pinhole, pattern: ReflectorPattern, pose: Pose, rng: np.random.Generator,
    look: Look = LOOK, *, hidden: tuple[int, ...] = (), covers: Cover | None = None,
    false: np.ndarray | None = None,
) -> LitDark:  # fmt: skip
    """The `pair` of that light."""
    light = light_of(pinhole, pattern, pose, look, hidden, covers)
    return LitDark(*pair(pinhole, light, look, rng, false=false))


def difference(one: Pose, other: Pose) -> np.ndarray:
    """(6,) perturbation that leads from the other pose to this one."""
    turn = between(one.rotation.copy(), other.rotation.copy())
    return np.append(turn, one.translation_m - other.translation_m)


def squared_error(found: Observation, *truths: Pose) -> float:
    """Of a pose, normalised by its covariance; from the nearest of poses that look the same."""
    off = difference(found.pose, min(truths, key=found.pose.angle_to))
    return float(off @ np.linalg.solve(found.covariance, off))
