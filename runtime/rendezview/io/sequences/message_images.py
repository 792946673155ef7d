"""Pictures and calibrations in the messages of ROS and Foxglove.

Both describe a raw picture by size, bytes per row (``step``) and an encoding with the names of
ROS's ``sensor_msgs/image_encodings.h``.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.io.camera_files import intrinsics_of
from rendezview.io.sequences.decoding import decode_grey
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


@dataclass(frozen=True, slots=True)
class RawPicture:
    """Pixels row by row."""

    width: int
    height: int
    step: int  # bytes from a row to the next
    encoding: str
    data: bytes | bytearray | memoryview | npt.NDArray[np.uint8]


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
        found = intrinsics_of(
            {
                "width": self.width,
                "height": self.height,
                "distortion_model": self.model,
                "K": matrix,
                "D": distortion,
            },
            where,
        )
        try:
            return Camera(*found)
        except ValueError as error:
            raise RendezviewError(f"{where}: {error}: give a camera file") from error


def grey(picture: RawPicture | PackedPicture, where: str) -> GreyImage:
    """The picture as grey uint8 (height, width).

    Raises:
        RendezviewError: cut short, damaged, or of an unsupported encoding.
    """
    if isinstance(picture, PackedPicture):
        image = decode_grey(picture.data)
        if image is None:
            raise RendezviewError(
                f"{where}: not a PNG, JPEG or WebP picture that can be read (damaged or cut short)"
            )
        return image
    content = np.frombuffer(picture.data, dtype=np.uint8)
    if picture.encoding not in _EIGHT_BIT:
        raise RendezviewError(
            f"{where}: encoding {picture.encoding!r} is not supported (it does not give which bits "
            f"count): record one of {', '.join(_EIGHT_BIT)}"
        )
    channels, to_grey = _EIGHT_BIT[picture.encoding]
    width, height, step = picture.width, picture.height, picture.step
    row = width * channels
    if not (width > 0 and height > 0 and step >= row and len(content) >= step * (height - 1) + row):
        raise RendezviewError(
            f"{where}: {len(content)} bytes for {width} × {height} pixels of {picture.encoding}, "
            f"{step} from row to row: the picture is cut short or damaged"
        )
    short = step * height - len(content)  # the last row may end with its last pixel
    whole = np.concatenate([content, np.zeros(short, np.uint8)]) if short > 0 else content
    rows = whole[: step * height].reshape(height, step)[:, :row]
    pixels = np.ascontiguousarray(rows.reshape(height, width, channels))
    if to_grey is None:
        return np.array(pixels[:, :, 0])
    try:
        return np.asarray(cv2.cvtColor(pixels, to_grey), dtype=np.uint8)
    except cv2.error as error:
        raise RendezviewError(
            f"{where}: {width} × {height} pixels cannot be {picture.encoding}: {error.err}"
        ) from error
