"""The target's silhouette before the Earth, where no threshold parts it from what is behind."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from rendezview.io.grey_frame import Picture
from rendezview.sensors.appearance.outline.foreground import Foreground
from rendezview.sensors.appearance.outline.silhouette import (
    Missing,
    Silhouette,
    box_of,
    gap_between,
    outer_borders,
    outlines_of_mask,
)
from rendezview.sensors.observation import Status

_LEAST_LOG_ODDS = (0.0, -1.5, 1.5)  # what counts as target: as likely as not, more, less
_LEAST_AREA_PX = 120
_PIECE_SHARE = 0.02  # of the largest piece's area: one that shade has cut off
_PIECE_GAP = 0.6  # of the largest piece's size
_SAME_PX = 4
_SAME_AREA = 0.04


def find_bodies(image: Picture, foreground: Foreground) -> list[Silhouette] | Missing:
    """The target as told by the network, at several odds, the likeliest first.

    Low odds close the outline around dim panels, high ones part the target from clouds that
    touch it; which is right only a comparison with the model can tell.

    Args:
        image: (H, W) 8-bit grey frame.
    """
    odds = foreground.log_odds(image)
    bodies: list[Silhouette] = []
    missing = None
    for least in _LEAST_LOG_ODDS:
        found = _body(odds, least)
        if isinstance(found, Missing):
            if found.status is Status.BORDER and missing is None and not bodies:
                return found  # what is surest of it alone may end before the border
            missing = missing or found
        elif all(_different(found, other) for other in bodies):
            bodies.append(found)
    if not bodies and missing is not None:
        return missing
    return bodies


def _different(a: Silhouette, b: Silhouette) -> bool:
    """Of other size or at another place: not the same body again."""
    apart = max(abs(p - q) for p, q in zip(a.box_px, b.box_px, strict=True))
    return apart > _SAME_PX or abs(a.area_px - b.area_px) > _SAME_AREA * b.area_px


def _body(odds: npt.NDArray[np.float32], least: float) -> Silhouette | Missing:
    """The largest piece that is likely target, and those near it."""
    mask = np.where(odds > least, 255, 0).astype(np.uint8)
    borders = outer_borders(mask)
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
    corners = np.array([box_of(border) for border in pieces])
    left, top = (int(x) for x in corners[:, :2].min(axis=0))
    right, bottom = (int(x) for x in corners[:, 2:].max(axis=0))
    height, width = odds.shape
    if left <= 0 or top <= 0 or right >= width - 1 or bottom >= height - 1:
        return Missing(Status.BORDER, "the body before the bright sky touches the border")
    area_px = float(np.count_nonzero(body))
    outlines = tuple(outlines_of_mask(body))
    return Silhouette(outlines, area_px, (left, top, right, bottom), float("nan"), least)
