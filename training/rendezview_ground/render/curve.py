"""Places spread evenly along a space-filling curve."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rendezview.geometry.pose import Array
from rendezview.geometry.zbuffer import Int32s

_CELL_PX = 4  # px; cells of the space-filling curve
_PLACE_BITS = 32  # of a place's number, below the code of its cell. Source: by construction


def evenly_spread(u: Int32s, v: Int32s, length: Array, count: int) -> npt.NDArray[np.intp]:
    """``count`` places, at equal steps of length along a space-filling curve, in ascending order.

    A place longer than a step is hit twice, so more steps may be needed.

    Args:
        u, v: (N,) px, at least 0.
        length: (N,) that each place stands for.
        count: of the places; all of them if there are no more.
    """
    if len(u) <= count:
        return np.arange(len(u))
    order = _along_curve(u, v)
    ends = np.cumsum(length[order])
    chosen = order[:0]
    for steps in range(count, 4 * count, max(1, count // 20)):
        places = (np.arange(steps) + 0.5) / steps * ends[-1]
        at = np.minimum(np.searchsorted(ends, places), len(order) - 1)
        hits = order[at[np.flatnonzero(np.diff(at, prepend=-1))]]
        if len(hits) > count:
            break
        chosen = hits
    return np.sort(chosen)


def _along_curve(u: Int32s, v: Int32s) -> npt.NDArray[np.int64]:
    """The places in the order of the Z-order curve over square cells."""
    code = _apart(u // _CELL_PX) | _apart(v // _CELL_PX) << 1
    return np.sort(code << _PLACE_BITS | np.arange(len(u))) & ((1 << _PLACE_BITS) - 1)


def _apart(cells: Int32s) -> npt.NDArray[np.int64]:
    """The bits of numbers of 12 bits, with a zero before each."""
    number = cells.astype(np.int64)
    number = (number | number << 8) & 0x00FF00FF
    number = (number | number << 4) & 0x0F0F0F0F
    number = (number | number << 2) & 0x33333333
    return (number | number << 1) & 0x55555555
