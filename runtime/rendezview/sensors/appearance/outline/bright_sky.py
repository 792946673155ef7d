"""The target's silhouette before a bright sky such as the Earth, where no threshold works."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import numpy.typing as npt

from rendezview.geometry.pose import Array
from rendezview.sensors.appearance.outline.silhouette import (
    Missing,
    Silhouette,
    box_around,
    box_of,
    gap_between,
    outer_borders,
    outlines_of_mask,
)
from rendezview.sensors.appearance.outline.specks import without_specks
from rendezview.sensors.observation import Status

# log odds that count as target, tried in this order. Source: seed 1, docs/notes/refinement.md
_LEAST_LOG_ODDS = (0.0, -1.5, 1.5)
_LEAST_AREA_PX = 120  # px; a smaller body is missing. Source: seed 1, docs/notes/refinement.md
# Of the largest piece's area; shade cuts off pieces this small. Source: seed 1,
# docs/notes/refinement.md
_PIECE_SHARE = 0.02
# Of the largest piece's size; pieces this near belong to it. Source: seed 1,
# docs/notes/refinement.md
_PIECE_GAP = 0.6
# px; bodies whose boxes differ by less … Source: by construction, two pictures of one body
_SAME_PX = 4
# … and whose areas differ by a smaller share are the same. Source: by construction, 2 % of the size
_SAME_AREA = 0.04


def find_bodies(odds: npt.NDArray[np.float32], times: int) -> list[Silhouette] | Missing:
    """The target as a sketch shows it at several odds, the likeliest first.

    Low odds close the outline around dim panels. High odds separate the target from clouds that
    touch it. Only a comparison with the model shows which is right.

    Args:
        odds: (H, W) log of target to sky; see ``Sketch.odds``.
        times: pixels of the frame along a side of one of its own.
    """
    bodies: list[Silhouette] = []
    missing = None
    for least in _LEAST_LOG_ODDS:
        found = _body(odds, least)
        if not isinstance(found, Missing):
            if all(_different(found, other) for other in bodies):
                bodies.append(found)
        elif found.status is Status.BORDER and missing is None and not bodies:
            return found  # higher odds may end before the border, but would cut the target
        else:
            missing = missing or found
    if missing is not None and not bodies:
        return missing
    return [_enlarged(body, times) for body in bodies]


def _enlarged(body: Silhouette, times: int) -> Silhouette:
    """A silhouette of a shrunk picture in the pixels of the whole one."""
    if times == 1:
        return body

    def whole(places: Array) -> Array:
        return np.asarray((places + 0.5) * times - 0.5)

    left, top, right, bottom = body.box_px
    box = (left * times, top * times, (right + 1) * times - 1, (bottom + 1) * times - 1)
    outlines = tuple(map(whole, body.outlines_px))
    return replace(body, outlines_px=outlines, area_px=body.area_px * times**2, box_px=box)


def _body(odds: npt.NDArray[np.float32], least: float) -> Silhouette | Missing:
    """The largest piece that is likely target, and the pieces near it."""
    mask = np.where(odds > least, 255, 0).astype(np.uint8)
    borders = outer_borders(without_specks(mask))
    areas = [cv2.contourArea(border) for border in borders]
    if not areas or max(areas) < _LEAST_AREA_PX:
        return Missing(Status.EMPTY, "nothing that looks like a spacecraft stands out")
    main = int(np.argmax(areas))
    box = box_of(borders[main])
    reach = _PIECE_GAP * max(box[2] - box[0], box[3] - box[1])
    pieces = [
        border
        for border, area in zip(borders, areas, strict=True)
        if area >= _PIECE_SHARE * areas[main] and gap_between(box, box_of(border)) <= reach
    ]
    body = np.zeros_like(mask)
    cv2.drawContours(body, pieces, -1, 255, cv2.FILLED)
    box = box_around([box_of(border) for border in pieces])
    left, top, right, bottom = box
    height, width = odds.shape
    if left <= 0 or top <= 0 or right >= width - 1 or bottom >= height - 1:
        return Missing(Status.BORDER, "the body before the bright sky touches the border")
    area_px = float(np.count_nonzero(body))
    return Silhouette(tuple(outlines_of_mask(body)), area_px, box, float("nan"), least)


def _different(a: Silhouette, b: Silhouette) -> bool:
    """Whether two silhouettes differ in size or place: not the same body again."""
    apart = max(abs(p - q) for p, q in zip(a.box_px, b.box_px, strict=True))
    return apart > _SAME_PX or abs(a.area_px - b.area_px) > _SAME_AREA * b.area_px
