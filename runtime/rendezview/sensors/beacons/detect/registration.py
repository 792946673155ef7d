"""The motion of the background between the lit and the dark picture of a pair in turn."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from rendezview.geometry.pose import Array
from rendezview.sensors.beacons.detect.difference import LitDark, registered

Float32s = npt.NDArray[np.float32]

_ROUNDS = 4  # of Gauss–Newton. Source: by construction, two do
_FAR_SIGMAS = 3.0  # of the residual: reflectors and glints. Source: by construction, normal tail
_WELL_PX = 0.05  # error of the motion at which it is used. Source: by construction, a sixth of 0.3
_TEXTURE = 1.5  # slopes over those of noise alone. Source: by construction, 1 is noise
_SMOOTH_PX = 1.0  # σ before slopes are taken. Source: by construction, that of the optics and pixel
_HALF_RESPONSE = 0.03  # of phase correlation. Source: OpenCV, noise alone gives less


def background_motion(frames: LitDark) -> Array | None:
    """(2,) px by which the background of the lit picture lies right of and below the dark one's.

    Phase correlation, then robust least squares on the whole picture. ``None``: there is no dark
    picture, or too little texture to tell the motion.
    """
    if frames.dark is None:
        return None
    lit, dark = (
        np.asarray(cv2.GaussianBlur(picture, (0, 0), _SMOOTH_PX), dtype=np.float32)
        for picture in (frames.lit, frames.dark)
    )
    window = cv2.createHanningWindow(lit.shape[::-1], cv2.CV_32F)
    (x, y), response = cv2.phaseCorrelate(dark, lit, window)
    shift = np.array([x, y]) if response > _HALF_RESPONSE else np.zeros(2)
    for _ in range(_ROUNDS):
        moved = _shifted(dark, shift)
        across, down = (
            cv2.Sobel(moved, cv2.CV_32F, *axis, scale=0.125) for axis in ((1, 0), (0, 1))
        )
        residual = lit - moved
        residual -= np.median(residual)
        spread = 1.4826 * float(np.median(np.abs(residual))) + 0.1
        kept = np.abs(residual) < _FAR_SIGMAS * spread
        slopes = np.column_stack([across[kept], down[kept]]).astype(np.float64)
        normal = slopes.T @ slopes
        # Smoothed white noise has slopes too: spread² / 4 of a picture's own.
        least = max((spread / _WELL_PX) ** 2, _TEXTURE * len(slopes) * spread**2 / 4.0)
        if not np.linalg.eigvalsh(normal)[0] > least:
            return None
        step = np.linalg.solve(normal, slopes.T @ residual[kept])
        shift -= step
        if np.abs(step).max() < 0.1 * _WELL_PX:
            break
    return np.asarray(shift)


def register(frames: LitDark) -> LitDark:
    """The pictures with the dark one moved onto the lit one's background, where that is known."""
    shift = background_motion(frames)
    if shift is None or frames.dark is None:
        return frames
    return LitDark(frames.lit, registered(frames.dark, np.column_stack([np.eye(2), shift])))


def _shifted(picture: Float32s, shift: Array) -> Float32s:
    height, width = picture.shape
    affine = np.column_stack([np.eye(2), shift])
    return np.asarray(
        cv2.warpAffine(
            picture, affine, (width, height), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
        ),
        dtype=np.float32,
    )
