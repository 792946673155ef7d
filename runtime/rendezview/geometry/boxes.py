"""Boxes in a picture."""

from __future__ import annotations

from collections.abc import Sequence

from rendezview.geometry.pose import Array


def overlap(a: Sequence[float] | Array, b: Sequence[float] | Array) -> float:
    """Intersection over union of two boxes (4,): left, top, right, bottom, of any unit."""
    across = min(a[2], b[2]) - max(a[0], b[0])
    down = min(a[3], b[3]) - max(a[1], b[1])
    common = max(across, 0.0) * max(down, 0.0)
    areas = (a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1])
    return float(common / max(areas - common, 1e-9))
