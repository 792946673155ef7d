"""Boxes in a picture."""

from __future__ import annotations

from collections.abc import Sequence

from rendezview.geometry.pose import Array

# Sides of a box, of the picture's. Less than a quarter of a larger target shows along a side, and
# the time and memory of the search grow with its area. Source: by construction
_LARGEST = 4.0


def overlap(a: Sequence[float] | Array, b: Sequence[float] | Array) -> float:
    """Intersection over union of two boxes (4,): left, top, right, bottom, of any unit."""
    across = min(a[2], b[2]) - max(a[0], b[0])
    down = min(a[3], b[3]) - max(a[1], b[1])
    common = max(across, 0.0) * max(down, 0.0)
    areas = (a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1])
    return float(common / max(areas - common, 1e-9))


def fault_of(box: Sequence[float], width: int, height: int) -> str | None:
    """What is wrong with a box (4,) x, y, width, height, px, as the place of a target.

    ``None``: a picture of ``width`` × ``height`` px may show a target there.
    """
    x, y, across, down = box
    picture = f"the frame of {width} × {height} px"
    if not (across >= 1.0 <= down):
        return "is smaller than a pixel"
    if not (-across < x < width and -down < y < height):
        return f"lies outside {picture}"
    if across > _LARGEST * width or down > _LARGEST * height:
        return f"is more than {_LARGEST:g} times as large as {picture}"
    return None
