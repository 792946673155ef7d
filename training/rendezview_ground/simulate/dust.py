"""Dust that drifts close to the camera and shines like stars."""

from __future__ import annotations

import cv2
import numpy as np

from rendezview.geometry.zbuffer import Float32s

# By construction of the training set of the sketch network:
_GREY = (3.0, 300.0)  # grey levels of a speck before the optics, uniform in the logarithm
_SMEAR_PX = (0.3, 0.3, 2.0)  # σ of the motion during the exposure, px: one speck of three is a dash
_SIZE_PX = (0.4, 1.0)  # σ of a speck, px
_WINDOW_PX = 8  # around a speck, to either side


def add_dust(picture: Float32s, count: int, rng: np.random.Generator) -> None:
    """Add specks to a picture (H, W) of grey levels, in place; they hide nothing."""
    height, width = picture.shape
    low, high = np.log(_GREY)
    for _ in range(count):
        start = rng.uniform(0.0, (width, height))
        end = start + rng.normal(0.0, rng.choice(_SMEAR_PX), 2)
        left, top = (max(int(x) - _WINDOW_PX, 0) for x in start)
        window = picture[top : int(start[1]) + _WINDOW_PX, left : int(start[0]) + _WINDOW_PX]
        speck = np.zeros(window.shape, np.float32)
        corner = np.array([left, top])
        first, last = ([int(x) for x in place - corner] for place in (start, end))
        cv2.line(speck, first, last, float(np.exp(rng.uniform(low, high))), 1)
        window += cv2.GaussianBlur(speck, (0, 0), rng.uniform(*_SIZE_PX))
