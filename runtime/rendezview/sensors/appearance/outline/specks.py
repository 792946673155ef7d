"""Speckled masks: a threshold inside the noise leaves tens of thousands of blobs."""

from __future__ import annotations

import cv2
import numpy as np
from numba import njit

from rendezview.io.grey_frame import Picture

# Blobs of a mask that are traced; all others are specks. Photographs of spacecraft under a useful
# threshold have 1 to 40. Source: the 20 photographs of docs/notes/refinement.md,
# "Time of any picture"
MOST_BLOBS = 300
# Starts of blobs in a mask; with more of them it is searched for specks. Tracing so many blobs
# takes 15 ms. Source: frames of even noise, docs/notes/refinement.md, "Time of any picture"
SPECKLED = 5000
_EVERY_ROW = 8  # rows; one in so many is a sample, 0.1 ms for 2.3 Mpx. Source: by construction


def without_specks(mask: Picture) -> Picture:
    """The mask itself; where it is speckled, a copy with only its ``MOST_BLOBS`` largest blobs.

    The time is linear in the number of pixels, however many blobs there are.

    Args:
        mask: (H, W) uint8, 255 or 0.
    """
    if blob_starts(mask) <= SPECKLED:
        return mask
    _, labels, statistics, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    areas = statistics[:, cv2.CC_STAT_AREA]
    areas[0] = 0  # the background
    kept = np.zeros(len(areas), dtype=np.uint8)
    kept[np.argsort(-areas, kind="stable")[:MOST_BLOBS]] = 255
    kept[0] = 0
    return np.asarray(kept[labels], dtype=np.uint8)


@njit(cache=True, nogil=True, error_model="numpy")
def blob_starts(mask: Picture) -> int:
    """About how many set pixels have no set neighbour to the left or in the row above.

    A blob has one or more of them. One row in ``_EVERY_ROW`` is looked at.
    """
    height, width = mask.shape
    starts = 0
    for y in range(_EVERY_ROW - 1, height, _EVERY_ROW):
        above, here = mask[y - 1], mask[y]
        for x in range(1, width - 1):
            met = above[x - 1] | above[x] | above[x + 1] | here[x - 1]
            starts += (here[x] & ~met) != 0
    return _EVERY_ROW * starts
