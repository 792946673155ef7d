"""The visible faces along a line of the picture, between pixel centres.

The pixels next to the line select the faces. Each face covers an interval of the line, on which its
nearness 1/z is linear, so a z-buffer of one dimension gives the nearest face at every place.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.geometry.pose import Array
from rendezview.geometry.zbuffer import Int32s
from rendezview_ground.render.crossings import depth_on

_ON_EDGE_PX = 1e-6  # px; a place that close to an edge lies on it
_SAME_DEPTH = 2e-6  # relative; closer depths are equal
_MOST_FACES = 1024  # beside one line; a longer list is cut. Source: by construction


Int64s = npt.NDArray[np.int64]


class Scratch(NamedTuple):
    """Arrays of ``faces_along``, for M places of a mesh of F faces."""

    visible: npt.NDArray[np.int64]  # (M,) face; −1: none
    nearness: Array  # (M,) 1/z of that face
    open: npt.NDArray[np.bool_]  # (M,) places that another face may take
    near: npt.NDArray[np.int64]  # faces beside the line
    stamp: npt.NDArray[np.int64]  # (F,) number of the last line that looked at the face
    line: npt.NDArray[np.int64]  # (1,) number of the line


@njit(cache=True, nogil=True, error_model="numpy")
def scratch_for(places: int, faces: int) -> Scratch:
    """Arrays for lines of so many places on a mesh of so many faces."""
    return Scratch(
        np.empty(places, dtype=np.int64),
        np.empty(places),
        np.empty(places, dtype=np.bool_),
        np.empty(_MOST_FACES, dtype=np.int64),
        np.zeros(faces, dtype=np.int64),
        np.zeros(1, dtype=np.int64),
    )


@njit(cache=True, nogil=True, error_model="numpy")
def faces_along(
    line: Array, places: Array, vertices: Array, corners: Array, faces: Int32s, beside: Int32s,
    focal: float, middle: float, owner: Int32s, normals: Array, scratch: Scratch,
) -> None:  # fmt: skip
    """Fill ``visible`` and ``nearness`` of the scratch arrays for places along a line.

    The faces that own the pixels around are tried first, then the faces beside those, which may
    own no pixel. Where none covers a place, it shows its pixel's face, or the sky if a pixel
    around shows it.

    Args:
        line: (4,) u, v, du, dv, px: a place s lies at (u, v) + s (du, dv).
        places: (M,) ascending, px.
        vertices: (V, 3), camera frame, and ``corners``: (V, 2) or more, their pixels.
        faces: (F, 3), with ``beside`` (F, 3) and ``normals`` (F, 3).
        focal: px, and ``middle``: px, of both axes.
        owner: (H, W) visible face, −1 for the sky.
    """
    count = len(places)
    visible, nearness, is_open = scratch.visible, scratch.nearness, scratch.open
    near, stamp, number = scratch.near, scratch.stamp, scratch.line
    number[0] += 1
    visible[:count], nearness[:count], is_open[:count] = -1, 0.0, True
    found = _faces_near(line, places[0], places[-1], owner, near, stamp, number[0])
    for k in range(found):
        _cover(
            near[k], line, places, places[0], places[-1], vertices, corners, faces, focal,
            middle, normals, visible, nearness, is_open,
        )  # fmt: skip
    first, last = np.inf, -np.inf  # of the open places
    for i in range(count):
        free = False
        if visible[i] < 0:
            rx, ry = line[0] + places[i] * line[2], line[1] + places[i] * line[3]
            face, free = _pixel_face(rx, ry, owner)
            if face >= 0:
                z = depth_on(vertices, faces, face, normals, (rx - middle) / focal,
                             (ry - middle) / focal)  # fmt: skip
                visible[i], nearness[i] = face, 1.0 / z if z > 0.0 else np.inf
        is_open[i] = free
        if free:
            first, last = min(first, places[i]), places[i]
    if first > last:
        return
    for k in range(found):
        for side in range(3):
            face = beside[near[k], side]
            if face >= 0 and stamp[face] != number[0]:
                stamp[face] = number[0]
                _cover(
                    face, line, places, first, last, vertices, corners, faces, focal, middle,
                    normals, visible, nearness, is_open,
                )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def _faces_near(
    line: Array, first: float, last: float, owner: Int32s, near: Int64s, stamp: Int64s,
    number: int,
) -> int:  # fmt: skip
    """List the faces that own the pixels within one of the line; how many."""
    height, width = owner.shape
    found = 0
    for i in range(int(np.ceil(last - first)) + 1):
        s = min(first + i, last)
        column, row = int(np.rint(line[0] + s * line[2])), int(np.rint(line[1] + s * line[3]))
        for y in range(max(row - 1, 0), min(row + 2, height)):
            for x in range(max(column - 1, 0), min(column + 2, width)):
                face = owner[y, x]
                new = face >= 0 and stamp[face] != number
                if new and found < len(near):
                    stamp[face] = number
                    near[found] = face
                    found += 1
    return found


@njit(cache=True, nogil=True, error_model="numpy")
def _pixel_face(u: float, v: float, owner: Int32s) -> tuple[int, bool]:
    """The face of a place's pixel, −1 if sky is around; and whether faces and sky are around."""
    height, width = owner.shape
    if not (0.0 <= u <= width - 1.0 and 0.0 <= v <= height - 1.0):
        return -1, False
    column, row = int(np.rint(u)), int(np.rint(v))
    some, sky = False, False
    for y in range(max(row - 1, 0), min(row + 2, height)):
        for x in range(max(column - 1, 0), min(column + 2, width)):
            if owner[y, x] < 0:
                sky = True
            else:
                some = True
    return -1 if sky else int(owner[row, column]), some and sky


@njit(cache=True, nogil=True, error_model="numpy")
def _cover(
    face: int, line: Array, places: Array, enter: float, leave: float, vertices: Array,
    corners: Array, faces: Int32s, focal: float, middle: float, normals: Array, visible: Int64s,
    nearness: Array, is_open: npt.NDArray[np.bool_],
) -> None:  # fmt: skip
    """Enter a face at the open places that it covers nearer than others; of equals, the first.

    Only places from ``enter`` to ``leave`` are looked at.
    """
    a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
    nx, ny, nz = normals[face, 0], normals[face, 1], normals[face, 2]
    plane = nx * vertices[a, 0] + ny * vertices[a, 1] + nz * vertices[a, 2]
    ax, ay, bx, by = corners[a, 0], corners[a, 1], corners[b, 0], corners[b, 1]
    cx, cy = corners[c, 0], corners[c, 1]
    area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
    if abs(area) < 1e-9 or abs(plane) < 1e-30:  # seen edge-on
        return
    u, v, du, dv = line[0], line[1], line[2], line[3]
    side = 1.0 if area > 0.0 else -1.0
    for _ in range(3):
        ex, ey = bx - ax, by - ay
        inside = side * (ex * (v - ay) - ey * (u - ax))
        inside += _ON_EDGE_PX * (abs(ex) + abs(ey))
        slope = side * (ex * dv - ey * du)
        ax, ay, bx, by, cx, cy = bx, by, cx, cy, ax, ay
        if abs(slope) < 1e-12:
            if inside < 0.0:
                return
        elif slope > 0.0:
            enter = max(enter, -inside / slope)
        else:
            leave = min(leave, -inside / slope)
        if enter > leave:
            return
    # 1/z = n · ray / n · p
    start = (nx * (u - middle) + ny * (v - middle) + nz * focal) / (focal * plane)
    slope = (nx * du + ny * dv) / (focal * plane)
    for i in range(np.searchsorted(places, enter), len(places)):
        if places[i] > leave:
            break
        near, best = start + slope * places[i], nearness[i]
        if near <= 0.0 or not is_open[i]:
            continue
        if near > best * (1.0 + _SAME_DEPTH):
            visible[i], nearness[i] = face, near
        elif near > best * (1.0 - _SAME_DEPTH) and face < visible[i]:
            visible[i], nearness[i] = face, max(near, best)
