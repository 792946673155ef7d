"""A target that swings and comes nearer, and the errors of reflectors at 5 m."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from rendezview.geometry.pose import Pose

SIGMA = np.array([3e-3, 3e-3, 3e-4, 1e-3, 1e-3, 5e-3])  # rad and m
AXIS = np.array([0.3, 0.8, 0.5]) / np.linalg.norm([0.3, 0.8, 0.5])


def swinging(t: float, closing_m_s: float = 0.2) -> tuple[Pose, np.ndarray]:
    """Pose and rates (6,) of a target that swings at up to 10°/s and moves at up to 0.2 m/s."""
    angle, rate = 0.25 * np.sin(0.7 * t), 0.175 * np.cos(0.7 * t)
    place = np.array([0.3 * np.sin(0.6 * t), 0.1 * t, 5.0 - closing_m_s * t])
    speed = np.array([0.18 * np.cos(0.6 * t), 0.1, -closing_m_s])
    pose = Pose(Rotation.from_rotvec(angle * AXIS).as_matrix(), place)
    return pose, np.append(rate * AXIS, speed)
