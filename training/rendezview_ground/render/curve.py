"""Places spread evenly along a space-filling curve."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.geometry.pose import Array
from rendezview.geometry.zbuffer import Int32s

_CELL_PX = 4  # px; cells of the space-filling curve
# Source: by construction, a code of two digits of 12 bits holds 4096 × 4096 cells
_DIGIT = 12
_BUCKETS = 1 << _DIGIT  # Source: by construction


def evenly_spread(u: Int32s, v: Int32s, length: Array, count: int) -> npt.NDArray[np.intp]:
    """``count`` places, at equal steps of length along a space-filling curve, in ascending order.

    Args:
        u, v: (N,) px, at least 0.
        length: (N,) that each place stands for.
        count: of the places; all of them if there are no more.
    """
    if len(u) <= count:
        return np.arange(len(u))
    return np.sort(_at_steps(_along_curve(u, v), length, count))


@njit(cache=True, nogil=True, error_model="numpy")
def _along_curve(u: Int32s, v: Int32s) -> npt.NDArray[np.int64]:
    """The places in the order of the Z-order curve over square cells: a radix sort."""
    count = len(u)
    code = np.empty(count, np.int64)
    for i in range(count):
        code[i] = _apart(u[i] // _CELL_PX) | _apart(v[i] // _CELL_PX) << 1
    order, sorted_ones = np.arange(count), np.empty(count, np.int64)
    for shift in (0, _DIGIT):
        first = np.zeros(_BUCKETS + 1, np.int64)
        for i in range(count):
            first[((code[i] >> shift) & (_BUCKETS - 1)) + 1] += 1
        for k in range(_BUCKETS):
            first[k + 1] += first[k]
        for k in range(count):
            i = order[k]
            digit = (code[i] >> shift) & (_BUCKETS - 1)
            sorted_ones[first[digit]] = i
            first[digit] += 1
        order, sorted_ones = sorted_ones, order
    return order


@njit(cache=True, nogil=True, error_model="numpy")
def _apart(number: int) -> int:
    """The bits of a number of 12 bits, with a zero before each."""
    number = (number | number << 8) & 0x00FF00FF
    number = (number | number << 4) & 0x0F0F0F0F
    number = (number | number << 2) & 0x33333333
    return (number | number << 1) & 0x55555555


@njit(cache=True, nogil=True, error_model="numpy")
def _at_steps(order: npt.NDArray[np.int64], length: Array, count: int) -> npt.NDArray[np.int64]:
    """The places in which equal steps of length end; ``count`` of them at most.

    A place longer than a step is hit twice, so more steps may be needed.
    """
    ends = np.empty(len(order))
    total = 0.0
    for k in range(len(order)):
        total += length[order[k]]
        ends[k] = total
    chosen, hits = np.empty(count, np.int64), np.empty(count, np.int64)
    kept = 0
    for steps in range(count, 4 * count, max(1, count // 20)):
        found, at, last = 0, 0, -1
        for k in range(steps):
            place = (k + 0.5) / steps * total
            while at < len(order) - 1 and ends[at] < place:
                at += 1
            if at != last:
                if found == count:
                    return chosen[:kept]
                hits[found], last = order[at], at
                found += 1
        chosen, hits, kept = hits, chosen, found
    return chosen[:kept]
