"""Triangulation of planar polygons."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rendezview.geometry.pose import Array
from rendezview_ground.mesh.notes import counted

Triangle = tuple[int, int, int]


def cut_polygons(
    points: Array, sizes: NDArray[np.int64], corners: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], int]:
    """Triangles of polygons, in their order.

    Args:
        points: (V, 3).
        sizes: (P,) corners of each polygon; negative: it is a hole, and left out.
        corners: (C,) their points, one polygon after the other.

    Returns:
        (T, 3) places in ``corners``, (T,) the polygon of each, and how many are concave.
    """
    starts = np.cumsum(np.abs(sizes)) - np.abs(sizes)
    simple = np.flatnonzero(sizes == 3)
    cuts, owners = [starts[simple][:, None] + np.arange(3)], [simple]
    concave = 0
    for k in np.flatnonzero(sizes > 3):
        own = np.arange(starts[k], starts[k] + sizes[k])
        cut, hollow = triangulate(points[corners[own]])
        concave += hollow
        cuts.append(own[np.array(cut)])
        owners.append(np.full(len(cut), k))
    polygon = np.concatenate(owners)
    order = np.argsort(polygon, kind="stable")
    return np.concatenate(cuts)[order], polygon[order], concave


def cut_note(polygons: int, concave: int) -> str:
    """What became of polygons with more than three corners."""
    return (
        f"{counted(polygons, 'polygon')} with more than three corners cut into triangles, "
        f"{concave} of them concave."
    )


def triangulate(corners: Array) -> tuple[list[Triangle], bool]:
    """Triangles of a simple polygon without holes, and whether it is concave.

    A convex polygon becomes a fan. A concave one is triangulated by ear clipping, because a fan
    would cover area outside. A polygon that is not finite or not simple becomes a fan.

    Args:
        corners: (N, 3), in order around the polygon, N >= 3, nearly planar.

    Returns:
        N - 2 triples of corner indices with the same winding, and whether the polygon is concave.
    """
    count = len(corners)
    fan: list[Triangle] = [(0, k, k + 1) for k in range(1, count - 1)]
    if not np.isfinite(corners).all():
        return fan, False
    corners = corners - corners.mean(axis=0)
    normal = np.cross(corners, np.roll(corners, -1, axis=0)).sum(axis=0)  # Newell
    drop = int(np.argmax(np.abs(normal)))
    axes = [(1, 2), (2, 0), (0, 1)][drop]
    flat = corners[:, axes] * (1.0 if normal[drop] >= 0 else np.array([1.0, -1.0]))
    turns = _cross(np.roll(flat, 1, axis=0), flat, np.roll(flat, -1, axis=0))
    tolerance = 1e-12 * float(np.ptp(flat, axis=0).max()) ** 2
    if np.all(turns >= -tolerance):
        return fan, False
    remaining, ears = list(range(count)), list[Triangle]()
    while len(remaining) > 3:
        ear = _find_ear(flat, remaining, tolerance)
        if ear is None:
            return fan, True
        size = len(remaining)
        ears.append((remaining[ear - 1], remaining[ear], remaining[(ear + 1) % size]))
        del remaining[ear]
    return [*ears, (remaining[0], remaining[1], remaining[2])], True


def _find_ear(flat: Array, remaining: list[int], tolerance: float) -> int | None:
    """Position of a corner whose triangle turns left and contains no other corner."""
    size = len(remaining)
    for place in range(size):
        before, here, after = remaining[place - 1], remaining[place], remaining[(place + 1) % size]
        a, b, c = flat[before], flat[here], flat[after]
        if _cross(a, b, c) < -tolerance:
            continue
        others = flat[[k for k in remaining if k not in (before, here, after)]]
        # Corners at the same place as the triangle's own (bridges) do not block it.
        apart = ~((others == a).all(1) | (others == b).all(1) | (others == c).all(1))
        others = others[apart]
        sides = [_cross(a, b, others), _cross(b, c, others), _cross(c, a, others)]
        if not np.any(np.min(sides, axis=0, initial=np.inf) >= -tolerance):
            return place
    return None


def _cross(a: Array, b: Array, c: Array) -> Array:
    """Twice the signed area of triangle a b c, in the plane."""
    ab, ac = b - a, c - a
    area: Array = ab[..., 0] * ac[..., 1] - ab[..., 1] * ac[..., 0]
    return area
