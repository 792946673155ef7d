"""The target's silhouette before the Earth, where no threshold parts it from what is behind.

A spacecraft has sharp edges, clouds and coasts have soft ones: what a closed line of steep
slopes encloses is a body, and the body with the most of them is the target.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from rendezview.appearance.outline import crack_outline
from rendezview.appearance.silhouette import Missing, Silhouette
from rendezview.appearance.status import Status
from rendezview.grey_frame import Picture

_BLUR_PX = 1.0
_LEAST_SLOPE = 4.0  # grey levels a pixel, after the blur
_SLOPE_SIGMAS = 1.4  # of the noise of a pixel
_FACTORS = (1.0, 2.0, 3.5, 6.0)  # times the least slope
_SHARP = 8.0  # clouds are softer
_STEEP = 40.0  # slopes count up to here: one glint is no body
_CLOSING_PX = 5  # gaps in the line that are bridged
_LEAST_AREA_PX = 120
_PIECE_SHARE = 0.15  # of the target's own sum of slopes: a piece that shade has cut off
_PIECE_GAP = 0.3  # of its size


def find_bodies(image: Picture, noise_grey: float) -> list[Silhouette] | Missing:
    """The body with the most sharp edges, as told by several least slopes, the lowest first.

    A low one closes the line around dim panels, a high one parts the target from the clouds
    behind it; which is right only a comparison with the model can tell.

    Args:
        image: (H, W) 8-bit grey frame.
        noise_grey: of neighbouring pixels, one σ.
    """
    smooth = cv2.GaussianBlur(image, (0, 0), _BLUR_PX)
    across = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, ksize=3, scale=0.125)
    down = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, ksize=3, scale=0.125)
    slope = np.asarray(cv2.magnitude(across, down), dtype=np.float32)
    bodies: list[Silhouette] = []
    missing = None
    for factor in _FACTORS:
        found = _body(image, slope, factor * max(_LEAST_SLOPE, _SLOPE_SIGMAS * noise_grey))
        if isinstance(found, Missing):
            missing = missing or found
        elif all(_different(found, other) for other in bodies):
            bodies.append(found)
    if not bodies and missing is not None:
        return missing
    return bodies


def _different(a: Silhouette, b: Silhouette) -> bool:
    """Of other size or at another place: not the same body again."""
    apart = max(abs(p - q) for p, q in zip(a.box_px, b.box_px, strict=True))
    return apart > 4 or abs(a.area_px - b.area_px) > 0.04 * b.area_px


def _body(image: Picture, slope: npt.NDArray[np.float32], least: float) -> Silhouette | Missing:
    """The body that slopes above ``least`` enclose, its outline half a pixel wide of them."""
    steep = np.where(slope > least, 255, 0).astype(np.uint8)
    closing = np.ones((_CLOSING_PX, _CLOSING_PX), np.uint8)
    mask = cv2.morphologyEx(steep, cv2.MORPH_CLOSE, closing)
    borders = [
        b
        for b in cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
        if len(b) > 20
    ]
    height, width = image.shape
    whole: list[tuple[float, int, tuple[int, int, int, int]]] = []
    cut = 0
    for k, border in enumerate(borders):
        left, top, w, h = cv2.boundingRect(border)
        if cv2.contourArea(border) < _LEAST_AREA_PX:
            continue
        if left <= 0 or top <= 0 or left + w >= width or top + h >= height:
            cut += 1
            continue
        filled = np.zeros((h, w), np.uint8)
        cv2.drawContours(filled, [border - np.array([left, top])], 0, 1, cv2.FILLED)
        part = np.minimum(slope[top : top + h, left : left + w], _STEEP) - _SHARP
        whole.append((float(np.maximum(part, 0.0)[filled > 0].sum()), k, (left, top, w, h)))
    if not whole:
        if cut:
            return Missing(Status.BORDER, "every body with sharp edges touches the border")
        return Missing(Status.EMPTY, "nothing with sharp edges stands out")
    whole.sort(reverse=True)
    strength, main, box = whole[0]
    chosen = [main]
    for other, k, near in whole[1:]:
        if other > _PIECE_SHARE * strength and _gap(box, near) < _PIECE_GAP * max(box[2:]):
            chosen.append(k)
    body = np.zeros_like(image)
    cv2.drawContours(body, [borders[k] for k in chosen], -1, 255, cv2.FILLED)
    # The slope is steep to both sides of an edge.
    body = cv2.erode(body, np.ones((3, 3), np.uint8)).astype(np.uint8, copy=False)
    pieces = cv2.findContours(body, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
    outlines = [np.asarray(p, dtype=np.int32)[:, 0] for p in pieces if len(p) > 8]
    if not outlines:
        return Missing(Status.SMALL, "the body with sharp edges is too small")
    left, top, w, h = cv2.boundingRect(body)
    return Silhouette(
        tuple(crack_outline(border, _NO_GREY, 0.0, 0.0, 0) for border in outlines),
        float(np.count_nonzero(body)),
        (left, top, left + w - 1, top + h - 1),
        float("nan"),
        least,
    )


_NO_GREY = np.zeros((0, 0), dtype=np.uint8)


def _gap(a: tuple[int, int, int, int], b: tuple[int, int, int, int]) -> float:
    dx = max(a[0] - b[0] - b[2], b[0] - a[0] - a[2], 0)
    dy = max(a[1] - b[1] - b[3], b[1] - a[1] - a[3], 0)
    return float(np.hypot(dx, dy))
