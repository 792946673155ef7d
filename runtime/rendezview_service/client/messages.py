"""Frames and states as they go over the wire, and the service's refusals."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from rendezview.errors import RendezviewError

Frame = npt.NDArray[np.uint8] | bytes  # (H, W) grey levels, or the bytes of a PNG or JPEG file
StateDict = dict[str, Any]


class ServiceError(RendezviewError):
    """The service refused a request; ``status`` is the HTTP status."""

    def __init__(self, message: str, status: int) -> None:
        super().__init__(message)
        self.status = status


class ServiceTimeout(RendezviewError, TimeoutError):
    """No answer in time."""


def frame_content(frame: Frame) -> tuple[bytes | memoryview, str]:
    """The bytes to send, and their media type."""
    if isinstance(frame, bytes):
        kind = "image/png" if frame[:4] == b"\x89PNG" else "image/jpeg"
        return frame, kind
    image = np.asarray(frame)
    if image.dtype != np.uint8 or image.ndim != 2:
        raise RendezviewError(
            f"a frame must be (height, width) grey levels of 8 bit, not {image.shape} {image.dtype}"
        )
    return np.ascontiguousarray(image).reshape(-1).data, "application/octet-stream"
