"""The picture of a calibration: where on the surface the edges lay aside, before and after."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from rendezview.calibration.as_built.shape import AsBuilt, SurfaceResiduals
from rendezview.calibration.as_built.strain import strain_names
from rendezview.geometry.pose import Array

Picture = npt.NDArray[np.uint8]

# Sizes of the drawing, px. Source: by construction
_PANEL_PX, _MARGIN_PX, _HEAD_PX, _FOOT_PX, _DOT_PX = 380, 24, 66, 54, 2
_VIEWS = ((0, 1), (0, 2), (1, 2))  # axes to the right and up. Source: by construction
_INK, _PAPER, _FRAME = (40, 40, 40), (255, 255, 255), (215, 215, 215)
# Blue, grey, orange (blue, green, red): apart for colour-blind eyes. Source: Okabe and Ito
_INWARDS, _NONE, _OUTWARDS = (
    np.array(colour, dtype=np.float64)
    for colour in ((178.0, 114.0, 0.0), (225.0, 225.0, 225.0), (0.0, 94.0, 213.0))
)
_FULL_QUANTILE = 0.95  # of the residuals before; beyond, the colour is full. Source: chosen


def shape_picture(found: AsBuilt, title: str) -> Picture:
    """(H, W, 3) blue, green, red: residuals over the surface, before above and after below.

    A dot is an edge of some frame, at its place on the target; its colour tells how far the frame
    has it outwards or inwards of the model, as a share of the target's radius.
    """
    width = 3 * _PANEL_PX + 4 * _MARGIN_PX
    height = _HEAD_PX + 2 * (_PANEL_PX + _MARGIN_PX) + _FOOT_PX
    canvas: Picture = np.full((height, width, 3), 255, dtype=np.uint8)
    full = max(float(np.quantile(np.abs(found.before.share), _FULL_QUANTILE)), 1e-6)
    places = np.concatenate([found.before.place_m, found.after.place_m])
    reach_m = float(np.abs(places).max()) * 1.05
    sigma = np.sqrt(np.diag(found.covariance))
    words = zip(strain_names(), found.components, sigma, strict=True)
    strain = "  ".join(f"{n} {100 * v:+.2f} ± {100 * s:.2f} %" for n, v, s in words)
    _write(canvas, title, _MARGIN_PX, 26, 20)
    _write(canvas, strain, _MARGIN_PX, 52, 16)
    rows = (
        ("as modelled", found.before, found.rms_before),
        ("as built", found.after, found.rms_after),
    )
    for row, (name, residuals, rms) in enumerate(rows):
        top = _HEAD_PX + row * (_PANEL_PX + _MARGIN_PX)
        for column, (right, up) in enumerate(_VIEWS):
            left = _MARGIN_PX + column * (_PANEL_PX + _MARGIN_PX)
            panel = canvas[top : top + _PANEL_PX, left : left + _PANEL_PX]
            cv2.rectangle(panel, (0, 0), (_PANEL_PX - 1, _PANEL_PX - 1), _FRAME, 1)
            _dots(panel, residuals, right, up, reach_m, full)
            _write(panel, f"{'xyz'[right]} to the right, {'xyz'[up]} up", 8, _PANEL_PX - 10, 13)
            if column == 0:
                _write(panel, f"{name}: {100 * rms:.2f} % of the radius", 8, 20, 15)
    _legend(canvas, full)
    return canvas


def _dots(
    panel: Picture, residuals: SurfaceResiduals, right: int, up: int, reach_m: float, full: float
) -> None:
    """The edges as dots, the largest residuals on top."""
    middle, scale = 0.5 * _PANEL_PX, 0.5 * _PANEL_PX / reach_m
    for k in np.argsort(np.abs(residuals.share), kind="stable"):
        x = middle + scale * residuals.place_m[k, right]
        y = middle - scale * residuals.place_m[k, up]
        colour = _colour(float(residuals.share[k]) / full)
        cv2.circle(panel, (round(x), round(y)), _DOT_PX, colour, -1, cv2.LINE_AA)


def _colour(value: float) -> tuple[float, float, float]:
    """Of a residual, −1 … 1 of the full one."""
    share = min(abs(value), 1.0)
    end: Array = _OUTWARDS if value > 0.0 else _INWARDS
    blue, green, red = (1.0 - share) * _NONE + share * end
    return float(blue), float(green), float(red)


def _legend(canvas: Picture, full: float) -> None:
    height = len(canvas)
    left, wide = _MARGIN_PX, 240
    for x in range(wide):
        colour = _colour(2.0 * x / (wide - 1) - 1.0)
        cv2.line(canvas, (left + x, height - 46), (left + x, height - 34), colour, 1)
    _write(canvas, f"{-100 * full:.2f} % (inwards)", left, height - 14, 13)
    _write(canvas, f"{100 * full:+.2f} % (outwards)", left + wide - 20, height - 14, 13)
    note = "share of the target's radius; a dot is an edge that a frame shows"
    _write(canvas, note, left + wide + 150, height - 34, 13)


def _write(canvas: Picture, text: str, x: int, y: int, size: int) -> None:
    cv2.putText(canvas, text, (x, y), _INK, cv2.FontFace("sans"), size, 400)
