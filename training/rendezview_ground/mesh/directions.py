"""Bases across a direction, for pictures and shadow maps."""

from __future__ import annotations

import numpy as np

from rendezview.geometry.pose import Array


def perpendicular(direction: Array) -> Array:
    """(3,) unit vector across a direction and the coordinate axis farthest from it."""
    across = np.cross(direction, np.eye(3)[int(np.argmin(np.abs(direction)))])
    across /= np.linalg.norm(across)
    return np.asarray(across)


def axes_towards(direction: Array) -> Array:
    """(3, 3) right-handed axes in rows; the third is the unit ``direction``."""
    across = perpendicular(direction)
    return np.stack([across, np.cross(direction, across), direction])
