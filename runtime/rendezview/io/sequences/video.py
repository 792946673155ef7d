"""Video files, read with OpenCV."""

from __future__ import annotations

import math
import threading
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.io.sequences.decoding import quiet_opencv
from rendezview.io.sequences.fitting import check_sizes
from rendezview.io.sequences.frame import Frame, GreyImage, Sequence
from rendezview.io.sequences.images import required_camera

VIDEO_SUFFIXES = frozenset(
    {".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".ts", ".wmv", ".ogv"}
)


def open_video(path: Path, camera: Camera | None = None) -> Sequence:
    """The frames of a video, numbered from 0; their times are number / frame rate.

    Args:
        path: the video.
        camera: takes precedence over a camera file (``camera.json`` …) in the video's folder.

    Raises:
        RendezviewError: missing, not a video, empty, or no camera.
    """
    if not path.is_file():
        raise RendezviewError(f"{path}: no such file; expected a video: check the path")
    capture = _capture(path)
    count = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
    rate_hz = capture.get(cv2.CAP_PROP_FPS)
    if count <= 0:  # some containers do not have the count
        count = 0
        while capture.grab():
            count += 1
    capture.release()
    if count == 0:
        raise RendezviewError(f"{path}: this video has no frames: record or convert it again")
    found = required_camera(camera, path.parent, path)
    timed = math.isfinite(rate_hz) and rate_hz > 0.0
    reader = VideoReader(path)
    check_sizes(_first(VideoReader(path)), found, path.parent)
    frames = tuple(
        Frame(
            im_id=index,
            name=f"{path.name}, frame {index}",
            time_s=index / rate_hz if timed else None,
            camera=found,
            camera_from_target=None,
            obj_id=1,
            fetch=partial(reader.read, index),
        )
        for index in range(count)
    )
    return Sequence(scene_id=1, frames=frames, source=path)


class VideoReader:
    """Reads frames of a video in any order; in ascending order it decodes each only once.

    Frames are counted from the start, never found by a seek: the frame that a seek finds depends
    on the codec. Going back starts again from the first frame. Several threads may use one reader,
    and it can be sent to another process.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._capture: cv2.VideoCapture | None = None
        self._next = 0  # number of the next frame
        self._last: tuple[int, GreyImage] | None = None  # kept for the next call
        self._lock = threading.Lock()

    def __reduce__(self) -> tuple[type[VideoReader], tuple[Path]]:
        return VideoReader, (self._path,)

    def read(self, index: int) -> GreyImage:
        """Frame ``index`` from 0 as grey uint8 (height, width).

        Raises:
            RendezviewError: the video is gone, or ends or is damaged before that frame.
        """
        with self._lock:
            if self._last is None or self._last[0] != index:
                self._last = index, self._decode(index)
            return self._last[1].copy()

    def _decode(self, index: int) -> GreyImage:
        if self._capture is None or index < self._next:
            if self._capture is not None:
                self._capture.release()
            self._capture, self._next = _capture(self._path), 0
        while self._next <= index:
            if not self._capture.grab():
                at = self._next
                self._capture.release()
                self._capture = None
                raise RendezviewError(
                    f"{self._path}: frame {index} cannot be read, the video ends or is damaged "
                    f"at frame {at}: convert it again, or use its first {at} frames"
                )
            self._next += 1
        retrieved, image = self._capture.retrieve()
        if not retrieved:
            raise RendezviewError(
                f"{self._path}: frame {index} cannot be decoded: convert the video again"
            )
        grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        return np.asarray(grey, dtype=np.uint8)


def _first(reader: VideoReader) -> list[GreyImage]:
    """The first frame; none if it cannot be read, which the run reports."""
    try:
        return [reader.read(0)]
    except RendezviewError:
        return []


def _capture(path: Path) -> cv2.VideoCapture:
    # Other back ends accept files that are not videos, and print messages.
    has_ffmpeg = cv2.videoio_registry.hasBackend(cv2.CAP_FFMPEG)
    with quiet_opencv():
        capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG if has_ffmpeg else cv2.CAP_ANY)
    if not capture.isOpened():
        raise RendezviewError(
            f"{path}: not a video that can be read: check the file, or convert it "
            f"(for example to MP4 with H.264)"
        )
    # A picture rotated by its metadata does not fit its calibration.
    capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
    return capture
