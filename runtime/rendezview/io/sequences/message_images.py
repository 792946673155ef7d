"""Pictures and calibrations in the messages of ROS and Foxglove.

Both describe a raw picture by size, bytes per row (``step``) and an encoding with the names of
ROS's ``sensor_msgs/image_encodings.h``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from rendezview.errors import RendezviewError, explained
from rendezview.geometry.camera import Camera
from rendezview.io.camera_files import camera_from_keys
from rendezview.io.grey_frame import eight_bits
from rendezview.io.sequences.decoding import decode_levels
from rendezview.io.sequences.frame import GreyImage

# Channels, and the conversion to grey; None: already grey.
_EIGHT_BIT: dict[str, tuple[int, int | None]] = {
    "mono8": (1, None),
    "8UC1": (1, None),
    "rgb8": (3, cv2.COLOR_RGB2GRAY),
    "bgr8": (3, cv2.COLOR_BGR2GRAY),
    "8UC3": (3, cv2.COLOR_BGR2GRAY),
    "rgba8": (4, cv2.COLOR_RGBA2GRAY),
    "bgra8": (4, cv2.COLOR_BGRA2GRAY),
    "8UC4": (4, cv2.COLOR_BGRA2GRAY),
    "yuv422": (2, cv2.COLOR_YUV2GRAY_UYVY),
    "uyvy": (2, cv2.COLOR_YUV2GRAY_UYVY),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2GRAY_YUY2),
    "yuyv": (2, cv2.COLOR_YUV2GRAY_YUY2),
    # OpenCV names a pattern by its second row's second and third pixel.
    "bayer_rggb8": (1, cv2.COLOR_BayerBG2GRAY),
    "bayer_bggr8": (1, cv2.COLOR_BayerRG2GRAY),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGR2GRAY),
    "bayer_grbg8": (1, cv2.COLOR_BayerGB2GRAY),
}


_SIXTEEN_BIT = {
    name.replace("8", "16"): how
    for name, how in _EIGHT_BIT.items()
    if name in ("mono8", "8UC1", "rgb8", "bgr8") or name.startswith("bayer_")
}


@dataclass(frozen=True, slots=True)
class RawPicture:
    """Pixels row by row."""

    width: int
    height: int
    step: int  # bytes from a row to the next
    encoding: str
    data: bytes | bytearray | memoryview | npt.NDArray[np.uint8]
    big_endian: bool = False  # of 16-bit levels


@dataclass(frozen=True, slots=True)
class PackedPicture:
    """A PNG, JPEG or WebP file."""

    data: bytes | bytearray | memoryview | npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Calibration:
    """A ``CameraInfo`` or ``CameraCalibration``."""

    width: int
    height: int
    model: str
    distortion: tuple[float, ...]
    matrix: tuple[float, ...]  # K, 9, row-wise
    projection: tuple[float, ...]  # P, 12, row-wise: of rectified pictures
    region: tuple[int, int, int, int] = (0, 0, 0, 0)  # x y width height, calibrated px; 0: all
    binning: tuple[int, int] = (1, 1)  # across, down; 0: none

    def camera(self, where: str, *, rectified: bool = False) -> Camera:
        """The camera; for rectified pictures that of P, without distortion.

        Raises:
            RendezviewError: an unknown lens model, or impossible numbers.
        """
        matrix, distortion = list(self.matrix), list(self.distortion)
        if rectified:
            if len(self.projection) != 12:
                raise RendezviewError(f"{where}: no 3 × 4 projection in it: give a camera file")
            p = self.projection
            matrix, distortion = [*p[0:3], *p[4:7], *p[8:11]], []
        x_px, y_px, width, height = self.region
        return camera_from_keys(
            {
                "width": self.width,
                "height": self.height,
                "distortion_model": "" if rectified else self.model,
                "K": matrix,
                "D": distortion,
                "roi": {"x_offset": x_px, "y_offset": y_px, "width": width, "height": height},
                "binning_x": self.binning[0],
                "binning_y": self.binning[1],
            },
            where,
        )


def grey(picture: RawPicture | PackedPicture, where: str, bits: int | None = None) -> GreyImage:
    """The picture as grey uint8 (height, width).

    Args:
        picture: as recorded.
        where: it is, for messages.
        bits: in use of 16-bit levels; None: not known.

    Raises:
        RendezviewError: cut short, damaged, or of an unsupported encoding.
    """
    if isinstance(picture, PackedPicture):
        levels = decode_levels(picture.data)
        if levels is None:
            raise RendezviewError(
                f"{where}: not a PNG, JPEG or WebP picture that can be read (damaged or cut short)"
            )
        return _eight(levels, where, bits)
    content = np.frombuffer(picture.data, dtype=np.uint8)
    known = {**_EIGHT_BIT, **_SIXTEEN_BIT}
    if picture.encoding not in known:
        raise RendezviewError(
            f"{where}: encoding {picture.encoding!r} is not supported: record one of "
            f"{', '.join(known)}"
        )
    channels, to_grey = known[picture.encoding]
    wide = picture.encoding in _SIXTEEN_BIT
    width, height, step = picture.width, picture.height, picture.step
    row = width * channels * (2 if wide else 1)
    if not (width > 0 and height > 0 and step >= row and len(content) >= step * (height - 1) + row):
        raise RendezviewError(
            f"{where}: {len(content)} bytes for {width} × {height} pixels of {picture.encoding}, "
            f"{step} from row to row: the picture is cut short or damaged"
        )
    short = step * height - len(content)  # the last row may end with its last pixel
    whole = np.concatenate([content, np.zeros(short, np.uint8)]) if short > 0 else content
    rows = whole[: step * height].reshape(height, step)[:, :row]
    kind = np.dtype(">u2" if picture.big_endian else "<u2") if wide else np.dtype(np.uint8)
    pixels = np.ascontiguousarray(rows).view(kind).reshape(height, width, channels)
    pixels = pixels.astype(np.uint16 if wide else np.uint8)
    if to_grey is None:
        return _eight(pixels[:, :, 0], where, bits)
    try:
        return _eight(cv2.cvtColor(pixels, to_grey), where, bits)
    except cv2.error as error:
        raise RendezviewError(
            f"{where}: {width} × {height} pixels cannot be {picture.encoding}: {error.err}"
        ) from error


def _eight(levels: npt.NDArray[Any], where: str, bits: int | None) -> GreyImage:
    if levels.dtype == np.uint16 and bits is None:
        raise RendezviewError(
            f"{where}: the levels have 16 bits, and nothing gives how many of them are used: give "
            "a camera file with bit_depth (10, 12, 14 or 16)"
        )
    with explained(f"{where}: ", faults=RendezviewError):
        return np.array(eight_bits(levels, bits or 8))
