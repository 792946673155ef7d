"""Questions what is legal but absurd in cameras, times and pictures.

Its counterpart for meshes is ``rendezview_ground/mesh/plausible.py``.

A doubt is a sentence with what is odd and what to do. It is a line in the output of a command and
a mark of ``doctor``. Where nothing good can follow, it is an error; the user can say that it is
meant (``checked: true`` in a camera file), which makes it a line.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from rendezview.geometry.camera import Camera, LensModel

_WIDEST_RAD = math.radians(170.0)  # Source: a lens without a fisheye model has at most 130°
# Narrower fields are asked about, and refused. Source: DART's camera had 0.29°, others 2° and more
_NARROW_RAD, _NARROWEST_RAD = math.radians(1.0), math.radians(0.1)
_MIDDLE = 0.5  # of half the picture: a principal point further out is asked about. Source: chosen
_SCALES = (0.0, 0.125, 0.25, 1.0 / 3.0, 0.5, 2.0, 3.0, 4.0)  # Source: cameras as sold bin 2 to 8
_SCALE_ERROR = 0.04  # of half the picture, on both axes. Source: principal points of real cameras
# Of a pixel; PAL and NTSC have 1.09, binning and anamorphic lenses up to 4. Source: ITU-R BT.601;
# chosen
_ASPECT, _MOST_ASPECT = 1.15, 8.0
# Of the pixels, which no direction reaches as the lens folds the picture: asked about, refused.
# Source: wide lenses calibrated without their corners have up to 0.28; chosen
_FOLDED, _MOST_FOLDED = 0.1, 0.75
_SMALLEST_PX = 16  # px; smaller pictures say nothing of their camera. Source: chosen
_OBLONG = 1.1  # pictures that are nearer to square cannot be told from turned ones. Source: chosen
_MILLISECONDS = 1e11  # s since 1970 are the year 5138. Source: by construction
# A row that differs from both beside it by so much, which differ less, is of another field.
_COMB_GREY, _LIKE_GREY = 30.0, 10.0  # of 255. Source: five times the noise of cameras
_COMB_TIMES = 15.0  # more often among rows than among columns. Source: 113 real pictures have 6
_COMB_LEAST, _COMB_LEAST_PX = 1e-4, 50  # of the pixels; pixels. Source: stars are a tenth of it
_COMB_PX = 1024  # px; the middle of the picture that is looked at. Source: chosen
CHECKED = "checked"  # key of a camera file


@dataclass(frozen=True, slots=True)
class Doubt:
    """One finding about a camera."""

    what: str  # what is odd, and what to do
    refused: bool = False  # nothing good can follow


def questioned(camera: Camera, unless: str | None) -> Camera:
    """A camera as its file has it, before region and binning, with the doubts about it.

    Args:
        camera: of the whole calibrated picture.
        unless: how a user says that the numbers are meant, for the message; None: it is said.

    Raises:
        ValueError: nothing good can follow.
    """
    doubts = camera_doubts(camera)
    for doubt in doubts:
        if doubt.refused and unless is not None:
            raise ValueError(f"{doubt.what} ({unless} if it is meant)")
    return replace(camera, doubts=tuple(doubt.what for doubt in doubts))


def camera_doubts(camera: Camera) -> list[Doubt]:
    """What is odd about a camera; its whole picture, not a region of it."""
    if min(camera.width, camera.height) < _SMALLEST_PX:
        return []
    if max(camera.fx, camera.fy) < _SMALLEST_PX and max(abs(camera.cx), abs(camera.cy)) <= 1.0:
        return [
            Doubt(
                f"fx {camera.fx:g}, fy {camera.fy:g}, cx {camera.cx:g} and cy {camera.cy:g} are in "
                "units of the picture: multiply fx and cx by its width, fy and cy by its height",
                True,
            )
        ]
    found = _field_doubts(camera)
    aspect = camera.fx / camera.fy
    oblong = max(aspect, 1.0 / aspect)
    if oblong > _ASPECT:
        found.append(
            Doubt(
                f"fx {camera.fx:g} and fy {camera.fy:g} differ: right for pixels that are "
                f"{aspect:.3g} times as high as wide, wrong for pictures that were resized after "
                "the calibration",
                oblong > _MOST_ASPECT,
            )
        )
    return [*found, *(_middle_doubts(camera) or _lens_doubts(camera))]


def _lens_doubts(camera: Camera) -> list[Doubt]:
    """A fisheye's picture is a circle: of its corners nothing is asked."""
    if camera.lens_model is LensModel.FISHEYE or not camera.is_distorted:
        return []
    across, down = np.linspace(0.0, camera.width, 16), np.linspace(0.0, camera.height, 16)
    rays = camera.rays(np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2))
    folded = float(np.isnan(rays[:, 0]).mean())
    if folded <= _FOLDED:
        return []
    words = (
        f"the distortion folds the picture, {100.0 * folded:.0f} % of it belong to no direction: "
        "the order is k1 k2 p1 p2 k3, and they are of tangents, not of pixels"
    )
    return [Doubt(words, folded > _MOST_FOLDED)]


def _field_doubts(camera: Camera) -> list[Doubt]:
    widest = narrowest = 0.0
    for pixels, focal in ((camera.width, camera.fx), (camera.height, camera.fy)):
        fisheye = camera.lens_model is LensModel.FISHEYE
        angle = pixels / focal if fisheye else 2.0 * math.atan(0.5 * pixels / focal)
        limit = 2.0 * math.pi if fisheye else _WIDEST_RAD
        widest, narrowest = max(widest, angle / limit), max(narrowest, angle)
    if widest > 1.0:
        return [
            Doubt(
                f"the field of view is {math.degrees(narrowest):.1f}°, as fx is {camera.fx:.4g} px "
                f"for {camera.width} px: give focal lengths in pixels, which is millimetres over "
                "the pixel pitch in millimetres",
                True,
            )
        ]
    if narrowest < _NARROW_RAD:
        return [
            Doubt(
                f"the field of view is {math.degrees(narrowest):.2g}°, as fx is {camera.fx:.4g} px "
                f"for {camera.width} px: check that focal length and pixel pitch have one unit",
                narrowest < _NARROWEST_RAD,
            )
        ]
    return []


def _middle_doubts(camera: Camera) -> list[Doubt]:
    width, height = camera.width, camera.height
    across, down = (2.0 * camera.cx + 1.0) / width, (2.0 * camera.cy + 1.0) / height  # 1: middle
    place = f"the principal point is ({camera.cx:g}, {camera.cy:g}) in a picture of "
    place += f"{width} × {height} px"
    turned = abs(across * width / height - 1.0), abs(down * height / width - 1.0)
    oblong = max(width, height) > _OBLONG * min(width, height)
    if oblong and max(turned) < 2.0 * _SCALE_ERROR:
        return [Doubt(f"{place}: width and height are swapped", True)]
    if max(abs(across - 1.0), abs(down - 1.0)) <= _MIDDLE:
        return []
    for scale in _SCALES:
        allowed = _SCALE_ERROR * max(scale, 0.5)
        if abs(across - scale) < allowed and abs(down - scale) < allowed:
            if scale == 0.0:
                return [
                    Doubt(
                        f"{place}: the corner; add half the size if it is given from the middle",
                        True,
                    )
                ]
            return [
                Doubt(
                    f"{place}: the matrix is of pictures of {width * scale:.0f} × "
                    f"{height * scale:.0f} px; scale it, or give that size and binning or roi",
                    True,
                )
            ]
    return [Doubt(f"{place}: if the pictures are a part of the calibrated one, give its roi")]


def time_doubts(times_s: Sequence[float | None]) -> list[str]:
    """What is odd about the times of frames."""
    known = [time_s for time_s in times_s if time_s is not None]
    if not known:
        return []
    found = []
    if max(map(abs, known)) > _MILLISECONDS:
        found.append(
            f"a time of {max(known):.0f} s is no date: times in milliseconds? Give seconds"
        )
    if len(known) < len(times_s):
        found.append(
            f"{len(times_s) - len(known)} of {len(times_s)} frames have no time: there the "
            "frame's number counts as seconds"
        )
    return found


def comb_doubts(pictures: Sequence[npt.NDArray[np.generic]]) -> list[str]:
    """Whether the odd rows of pictures (height, width) were taken at another time than the even."""
    shares = np.array([(_comb(picture), _comb(picture.T)) for picture in pictures])
    if not len(shares):
        return []
    rows, columns = np.median(shares, axis=0)
    looked_at = min(
        min(height, _COMB_PX) * min(width, _COMB_PX)
        for height, width in (picture.shape for picture in pictures)
    )
    if rows < max(_COMB_LEAST, _COMB_LEAST_PX / max(looked_at, 1)) or rows < _COMB_TIMES * columns:
        return []
    return [
        "odd and even rows of the pictures differ as those of interlaced video: store every "
        "second row, with binning_y: 2 in the camera file, or deinterlace them"
    ]


def _comb(picture: npt.NDArray[np.generic]) -> float:
    """Share of the pixels that differ from those above and below, which are alike."""
    height, width = picture.shape
    top, left = max(height - _COMB_PX, 0) // 2, max(width - _COMB_PX, 0) // 2
    grey = picture[top : top + _COMB_PX, left : left + _COMB_PX].astype(np.float32)
    if min(grey.shape) < 3:
        return 0.0
    grey *= 255.0 / max(float(np.max(picture)), 255.0)
    up, middle, down = grey[:-2], grey[1:-1], grey[2:]
    differs = np.abs(middle - up) > _COMB_GREY
    differs &= np.abs(middle - down) > _COMB_GREY
    return float((differs & (np.abs(up - down) < _LIKE_GREY)).mean())
