"""Which pixels show the target before a bright sky: a small convolutional network.

It is trained on pictures of random spacecraft before skies of many kinds (experiment
foreground-network), so it is specific to no target. It is a U-Net (Ronneberger et al. 2015)
whose first channels are the pixels of squares of 4 × 4.
"""

from __future__ import annotations

import math
import threading
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from rendezview.io.grey_frame import Picture

NETWORK = Path(__file__).with_name("foreground.onnx")
# The network is trained at this size. Source: experiment foreground-network
AREA_PX = 320 * 240  # px, of the scaled frame
# Px a side: the pixels of a square become channels. Source: experiment foreground-network
SQUARE_PX = 4
_MULTIPLE_PX = 32  # px; a side must allow three halvings of the squares. Source: by construction

Float32s = npt.NDArray[np.float32]


class Foreground:
    """The network. It is read at its first use, and one thread uses it at a time."""

    def __init__(self) -> None:
        self._network: cv2.dnn.Net | None = None
        self._lock = threading.Lock()

    def log_odds(self, image: Picture) -> Float32s:
        """(H, W) of each pixel of an 8-bit frame: log of target to sky."""
        height, width = image.shape
        scale = math.sqrt(AREA_PX / (height * width))
        rows, columns = max(1, round(height * scale)), max(1, round(width * scale))
        small = cv2.resize(image, (columns, rows), interpolation=cv2.INTER_AREA)
        below, right = -rows % _MULTIPLE_PX, -columns % _MULTIPLE_PX
        top, left = below // 2, right // 2
        small = np.pad(small, ((top, below - top), (left, right - left)), mode="edge")
        squares = to_squares(small.astype(np.float32) / np.float32(255.0))[None]
        with self._lock:
            if self._network is None:
                self._network = cv2.dnn.readNetFromONNX(str(NETWORK))
            self._network.setInput(squares)
            channels = self._network.forward()[0].copy()
        odds = from_squares(channels)[top : top + rows, left : left + columns]
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
