"""Chains of edge points cut into arcs that turn one way, and arcs that lie on one ellipse.

A chain becomes a polygon (Douglas & Peucker); an arc ends at a corner, at a straight
stretch or where the sense of turning changes. A conic through two arcs shows whether they belong
together: its normal equations are the sum of theirs, so a pair costs one solution of five.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.estimation.linear_algebra import copy_into, copy_matrix_into, descending
from rendezview.sensors.ring.conic import (
    MOMENTS,
    add_point,
    conic_of,
    distance,
    ellipse_of_conic,
    within,
)

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int32]
Bools = npt.NDArray[np.bool_]

# Columns of the table of arcs
FIRST, LAST, TURN, LENGTH = 0, 1, 2, 3
X0, Y0, XM, YM, X1, Y1, NX, NY = 4, 5, 6, 7, 8, 9, 10, 11  # ends, middle, inward normal there
COLUMNS = 12  # Source: by construction

_POLYGON_PX = 0.9  # how far a chain may leave its polygon. Source: by hand; see ring-accuracy
_CORNER_RAD = 1.15  # a sharper turn of the polygon is a corner. Source: by hand; see ring-accuracy
# A segment this much longer than its neighbour is a straight line. Source: by hand; see
# ring-accuracy
_UNEVEN = 4.0
_LEAST_TURN_RAD = 0.35  # of an arc. Source: by hand; see ring-accuracy
# Points of an arc that a joint conic is tested on. Source: by construction, a bound of time
_SAMPLED = 24


@njit(cache=True, nogil=True, error_model="numpy")
def _polygon(points: Array, first: int, last: int, keep: Bools) -> None:
    """Mark the corners of the polygon of points first … last."""
    keep[first] = True
    keep[last] = True
    stack = np.empty((64, 2), dtype=np.int64)
    stack[0, 0], stack[0, 1] = first, last
    depth = 1
    while depth > 0:
        depth -= 1
        a, b = stack[depth, 0], stack[depth, 1]
        if b - a < 2:
            continue
        dx, dy = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1]
        size = np.sqrt(dx * dx + dy * dy)
        far, at = 0.0, -1
        for i in range(a + 1, b):
            ex, ey = points[i, 0] - points[a, 0], points[i, 1] - points[a, 1]
            off = abs(dx * ey - dy * ex) / size if size > 1e-6 else np.sqrt(ex * ex + ey * ey)
            if off > far:
                far, at = off, i
        if far > _POLYGON_PX and depth + 2 <= 64:
            keep[at] = True
            stack[depth, 0], stack[depth, 1] = a, at
            stack[depth + 1, 0], stack[depth + 1, 1] = at, b
            depth += 2


@njit(cache=True, nogil=True, error_model="numpy")
def find_arcs(points: Array, starts: Ints, closed: Bools) -> Array:
    """Arcs of all chains, the longest first: (M, COLUMNS); FIRST … LAST - 1 are their points."""
    total = points.shape[0]
    keep = np.zeros(total, dtype=np.bool_)
    arcs = np.empty((total // 8 + 1, COLUMNS))
    count = 0
    corner = np.empty(total + 1, dtype=np.int64)
    for c in range(starts.shape[0] - 1):
        first, last = int(np.int64(starts[c])), int(np.int64(starts[c + 1])) - 1  # not int32
        middle = (first + last) // 2
        if closed[c]:  # an end of a closed chain is no place to start a chord
            _polygon(points, first, middle, keep)
            _polygon(points, middle, last, keep)
        else:
            _polygon(points, first, last, keep)
        corners = 0
        for i in range(first, last + 1):
            if keep[i]:
                corner[corners] = i
                corners += 1
        begin = 0  # number of the corner where the arc starts
        sense = 0.0
        for k in range(1, corners):
            ends = k == corners - 1
            sharp = False
            turn = 0.0
            if not ends:
                p, q, r = corner[k - 1], corner[k], corner[k + 1]
                ax, ay = points[q, 0] - points[p, 0], points[q, 1] - points[p, 1]
                bx, by = points[r, 0] - points[q, 0], points[r, 1] - points[q, 1]
                turn = np.arctan2(ax * by - ay * bx, ax * bx + ay * by)
                a2, b2 = ax * ax + ay * ay, bx * bx + by * by
                uneven = _UNEVEN * _UNEVEN
                long = max(a2, b2) > 400.0 and (a2 > uneven * b2 or b2 > uneven * a2)
                sharp = abs(turn) > _CORNER_RAD or long
            if not ends and not sharp and (sense == 0.0 or turn * sense > 0.0):
                if sense == 0.0:
                    sense = 1.0 if turn > 0.0 else -1.0
                continue
            count += _arc(points, corner[begin], corner[k] + 1, arcs[count])
            if sharp or ends:
                begin, sense = k, 0.0
            else:  # the segment before an inflexion belongs to both sides
                begin, sense = k - 1, 1.0 if turn > 0.0 else -1.0
            if count >= arcs.shape[0]:
                break
    order = descending(arcs[:count, LENGTH].copy())
    return arcs[:count][order]


@njit(cache=True, nogil=True, error_model="numpy")
def _arc(points: Array, first: int, end: int, row: Array) -> int:
    """Describe the points first … end - 1 in a row of the table; 0 where they do not bend."""
    n = end - first
    if n < 10:
        return 0
    middle = first + n // 2
    x0, y0 = points[first, 0], points[first, 1]
    xm, ym = points[middle, 0], points[middle, 1]
    x1, y1 = points[end - 1, 0], points[end - 1, 1]
    length = 0.0
    step = 4
    for i in range(first, end - step, step):
        dx, dy = points[i + step, 0] - points[i, 0], points[i + step, 1] - points[i, 1]
        length += np.sqrt(dx * dx + dy * dy)
    # Turn: summed over pieces of the arc, from mean gradients, so that noise cancels.
    pieces = max(3, min(16, n // 8))
    turn = 0.0
    before = 0.0
    for p in range(pieces):
        a, b = first + p * n // pieces, first + (p + 1) * n // pieces
        gx, gy = 0.0, 0.0
        for i in range(a, b):
            gx += points[i, 2]
            gy += points[i, 3]
        angle = np.arctan2(gy, gx)
        if p > 0:
            turn += (angle - before + np.pi) % (2.0 * np.pi) - np.pi
        before = angle
    turn *= pieces / (pieces - 1.0)
    if abs(turn) < _LEAST_TURN_RAD:
        return 0
    gx, gy = points[middle, 2], points[middle, 3]
    for i in range(max(first, middle - 3), min(end, middle + 4)):
        gx += points[i, 2]
        gy += points[i, 3]
    size = np.sqrt(gx * gx + gy * gy) + 1e-12
    # The chain runs along (-gy, gx); turning positive it bends towards -g.
    inward = -1.0 if turn > 0.0 else 1.0
    row[FIRST], row[LAST], row[TURN], row[LENGTH] = first, end, turn, length
    row[X0], row[Y0], row[XM], row[YM], row[X1], row[Y1] = x0, y0, xm, ym, x1, y1
    row[NX], row[NY] = inward * gx / size, inward * gy / size
    return 1


@njit(cache=True, nogil=True, error_model="numpy")
def _faces(a: Array, b: Array, slack: float) -> bool:
    """Whether arc b lies on the inner side of arc a's tangent at its middle."""
    for k in range(3):
        x, y = b[X0 + 2 * k] - a[XM], b[Y0 + 2 * k] - a[YM]
        if x * a[NX] + y * a[NY] < -slack:
            return False
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _misfit(ellipse: Array, points: Array, arc: Array) -> float:
    """Root mean square distance of an arc's points from an ellipse, px."""
    first, end = int(arc[FIRST]), int(arc[LAST])
    step = max(1, (end - first) // _SAMPLED)
    total, count = 0.0, 0
    for i in range(first, end, step):
        d = distance(ellipse, points[i, 0], points[i, 1])
        total += d * d
        count += 1
    return float(np.sqrt(total / count))


@njit(cache=True, nogil=True, error_model="numpy")
def group_arcs(
    points: Array, arcs: Array, scale: float, centre_x: float, centre_y: float,
    tolerance_px: float, most: int, limits: Array,
) -> tuple[Array, Array]:  # fmt: skip
    """Ellipses through arcs: shapes (K, 5), and the summed length of their arcs (K,).

    Every arc that is part of no ellipse yet starts a group, the longest first; the other arcs join
    it, best first, as long as one conic fits all to ``tolerance_px``.

    Args:
        limits: least semi-minor axis, largest semi-major axis, least ratio of the two.
        most: number of arcs used at most.
    """
    count = min(arcs.shape[0], most)
    frame = (scale, centre_x, centre_y)
    sums = _sums(points, arcs[:count], frame)
    found, length = np.empty((count, 5)), np.empty(count)
    filled = 0
    ellipse, conic, total = np.empty(5), np.empty(6), np.empty((MOMENTS, MOMENTS))
    member = np.zeros(count, dtype=np.bool_)
    tried = np.zeros(count, dtype=np.bool_)
    done = np.zeros(count, dtype=np.bool_)  # part of a group already
    for seed in range(count):
        if done[seed]:
            continue
        member[:] = False
        member[seed] = True
        tried[:] = False
        copy_matrix_into(sums[seed], total)
        reach = arcs[seed, LENGTH]
        good = False
        if conic_of(total, conic):
            good = _usable(conic, frame, ellipse, limits) and (
                _misfit(ellipse, points, arcs[seed]) < tolerance_px
            )
        joined = 1
        while True:
            at = _best_arc(
                points, arcs, sums, total, frame, limits, tolerance_px, seed, joined == 1 or good,
                member, tried,
            )  # fmt: skip
            if at < 0:
                break
            member[at] = True
            joined += 1
            total += sums[at]
            reach += arcs[at, LENGTH]
            conic_of(total, conic)
            good = _usable(conic, frame, ellipse, limits)
        if good:
            copy_into(ellipse, found[filled])
            length[filled] = reach
            filled += 1
            done |= member
    order = descending(length[:filled])
    return found[:filled][order], length[:filled][order]


@njit(cache=True, nogil=True, error_model="numpy")
def _sums(points: Array, arcs: Array, frame: tuple[float, float, float]) -> Array:
    """(K, 6, 6) of the points of each arc."""
    scale, x, y = frame
    sums = np.zeros((arcs.shape[0], MOMENTS, MOMENTS))
    for j in range(arcs.shape[0]):
        for i in range(int(arcs[j, FIRST]), int(arcs[j, LAST])):
            add_point(sums[j], (points[i, 0] - x) / scale, (points[i, 1] - y) / scale)
    return sums


@njit(cache=True, nogil=True, error_model="numpy")
def _best_arc(
    points: Array, arcs: Array, sums: Array, total: Array, frame: tuple[float, float, float],
    limits: Array, tolerance_px: float, seed: int, check_sides: bool, member: Bools, tried: Bools,
) -> int:  # fmt: skip
    """Number of the arc that fits a group best, -1 for none; marks those that never will."""
    count = sums.shape[0]
    conic, trial = np.empty(6), np.empty(5)
    best, at = tolerance_px, -1
    for j in range(count):
        if member[j] or tried[j]:
            continue
        if check_sides and not (
            _faces(arcs[seed], arcs[j], 2.0) and _faces(arcs[j], arcs[seed], 2.0)
        ):
            tried[j] = True
            continue
        total += sums[j]
        worst = 1e9
        if conic_of(total, conic) and _usable(conic, frame, trial, limits):
            worst = _misfit(trial, points, arcs[j])
            for k in range(count):
                if member[k] and worst < best:
                    worst = max(worst, _misfit(trial, points, arcs[k]))
        total -= sums[j]
        if worst < best:
            best, at = worst, j
        elif worst > 3.0 * tolerance_px:
            tried[j] = True
    return at


@njit(cache=True, nogil=True, error_model="numpy")
def _usable(conic: Array, frame: tuple[float, float, float], ellipse: Array, limits: Array) -> bool:
    scale, centre_x, centre_y = frame
    if not ellipse_of_conic(conic, ellipse):
        return False
    ellipse *= scale
    ellipse[0] += centre_x
    ellipse[1] += centre_y
    return within(ellipse, limits)
