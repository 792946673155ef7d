"""Boxes in a picture."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rendezview.geometry.pose import Array


def overlap(a: Sequence[float] | Array, b: Sequence[float] | Array) -> float:
    """Intersection over union of two boxes (4,): left, top, right, bottom, px."""
    return float(overlaps(np.asarray(a), np.asarray(b)))


def overlaps(a: Array, b: Array) -> Array:
    """(…) the same of boxes (…, 4), of any unit, each with its partner."""
    left, top, right, bottom = (a[..., k] for k in range(4))
    across = np.minimum(right, b[..., 2]) - np.maximum(left, b[..., 0])
    down = np.minimum(bottom, b[..., 3]) - np.maximum(top, b[..., 1])
    common = np.maximum(across, 0.0) * np.maximum(down, 0.0)
    areas = (right - left) * (bottom - top)
    areas = areas + (b[..., 2] - b[..., 0]) * (b[..., 3] - b[..., 1])
    return np.asarray(common / np.maximum(areas - common, 1e-9))
