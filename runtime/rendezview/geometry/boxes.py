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
    common = np.maximum(
        np.minimum(a[..., 2:], b[..., 2:]) - np.maximum(a[..., :2], b[..., :2]), 0.0
    ).prod(-1)
    areas = sum((box[..., 2:] - box[..., :2]).prod(-1) for box in (a, b))
    return np.asarray(common / np.maximum(areas - common, 1e-9))
