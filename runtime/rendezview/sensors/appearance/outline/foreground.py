"""Which pixels show the target where the sky is bright: a small convolutional network.

It has learned from pictures of spacecraft that nobody built before skies of many kinds
(experiment foreground-network), so it knows no target in particular. Its shape is that of
U-Net (Ronneberger et al. 2015), with squares of 4 × 4 pixels as its first channels.
"""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from rendezview.io.grey_frame import Picture

NETWORK = Path(__file__).with_name("foreground.onnx")
AREA_PX = 320 * 240  # of the picture that the network is shown
SQUARE_PX = 4  # a side: pixels become channels
_MULTIPLE_PX = 32  # a side of the picture, for three halvings of the squares

Float32s = npt.NDArray[np.float32]


class Foreground:
    """The network, read when it is first asked."""

    def __init__(self) -> None:
        self._network: cv2.dnn.Net | None = None

    def log_odds(self, image: Picture) -> Float32s:
        """(H, W) of each pixel of an 8-bit frame: log of target to sky."""
        if self._network is None:
            self._network = cv2.dnn.readNetFromONNX(str(NETWORK))
        height, width = image.shape
        scale = math.sqrt(AREA_PX / (height * width))
        rows, columns = max(1, round(height * scale)), max(1, round(width * scale))
        small = cv2.resize(image, (columns, rows), interpolation=cv2.INTER_AREA)
        below, right = -rows % _MULTIPLE_PX, -columns % _MULTIPLE_PX
        top, left = below // 2, right // 2
        small = np.pad(small, ((top, below - top), (left, right - left)), mode="edge")
        self._network.setInput(to_squares(small.astype(np.float32) / np.float32(255.0))[None])
        odds = from_squares(self._network.forward()[0])[top : top + rows, left : left + columns]
        return np.asarray(
            cv2.resize(np.ascontiguousarray(odds), (width, height), interpolation=cv2.INTER_LINEAR),
            dtype=np.float32,
        )


def to_squares(picture: Float32s) -> Float32s:
    """(H, W) to (16, H/4, W/4): the pixels of each square, row by row."""
    height, width = picture.shape
    n = SQUARE_PX
    squares = picture.reshape(height // n, n, width // n, n).transpose(1, 3, 0, 2)
    return np.ascontiguousarray(squares.reshape(n * n, height // n, width // n))


def from_squares(channels: Float32s) -> Float32s:
    """(16, H/4, W/4) to (H, W): the inverse of ``to_squares``."""
    n = SQUARE_PX
    _, height, width = channels.shape
    picture = channels.reshape(n, n, height, width).transpose(2, 0, 3, 1)
    return np.ascontiguousarray(picture.reshape(n * height, n * width))
