"""Video files, read with OpenCV."""

from __future__ import annotations

import itertools
import math
import threading
from functools import partial
from pathlib import Path

import cv2

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.io.sequences.fitting import check_sizes
from rendezview.io.sequences.frame import GreyImage, Sequence, grey_of
from rendezview.io.sequences.images import required_camera
from rendezview.io.sequences.message_video import VideoTopic
from rendezview.io.sequences.quiet import quiet_opencv

VIDEO_SUFFIXES = frozenset(
    {
        ".mp4",
        ".m4v",
        ".mov",
        ".avi",
        ".mkv",
        ".webm",
        ".mpg",
        ".mpeg",
        ".ts",
        ".wmv",
        ".ogv",
        ".flv",
    }
)

_ROUNDING_S = 2e-3  # s; Matroska and FLV count milliseconds. Source: their standards


def open_video(path: Path, camera: Camera | None = None) -> Sequence:
    """The frames of a video, numbered from 0, with the times at which they are shown.

    Args:
        path: the video.
        camera: takes precedence over a camera file (``camera.json`` …) in the video's folder.

    Raises:
        RendezviewError: missing, not a video, empty, or no camera.
    """
    if not path.is_file():
        raise RendezviewError(f"{path}: no such file; expected a video: check the path")
    times_s, even = _times(path)
    if not times_s:
        raise RendezviewError(f"{path}: this video has no frames: record or convert it again")
    found = required_camera(camera, path.parent, path)
    reader = VideoReader(path)
    check_sizes(_first(VideoReader(path)), found, path.parent)
    pictures = (
        (f"{path.name}, frame {index}", time_s, partial(reader.read, index))
        for index, time_s in enumerate(times_s)
    )
    steps = [b - a for a, b in itertools.pairwise(times_s) if a is not None and b is not None]
    uneven = f"the frames come {min(steps):.3g} to {max(steps):.3g} s apart" if not even else ""
    return Sequence.of_pictures(path, found, pictures, (uneven,) if uneven else ())


def _times(path: Path) -> tuple[list[float | None], bool]:
    """When each frame is shown, s, or None where the file does not say; whether they are even.

    The packets say it, without decoding. They are trusted if there are as many as the file
    announces, at its rate. If not, all frames are decoded once: some formats have packets that show
    nothing, and edits hide frames.
    """
    capture = _capture(path)
    count, rate_hz = int(capture.get(cv2.CAP_PROP_FRAME_COUNT)), capture.get(cv2.CAP_PROP_FPS)
    step_s = 1.0 / rate_hz if math.isfinite(rate_hz) and rate_hz > 0.0 else None
    capture.set(cv2.CAP_PROP_FORMAT, -1)  # packets
    packets = sorted(_stamps(capture))
    if len(packets) != count or not _is_even(packets, step_s):
        shown = _stamps(_capture(path))
        rising = all(a < b for a, b in itertools.pairwise(shown))
        if shown and not rising and len(packets) == len(shown):
            shown, rising = packets, all(a < b for a, b in itertools.pairwise(packets))
        if rising and len(shown) > 1 and not _is_even(shown, step_s):
            return [time_s - shown[0] for time_s in shown], False
        count = len(shown)
    return [None if step_s is None else index * step_s for index in range(count)], True


def _stamps(capture: cv2.VideoCapture) -> list[float]:
    stamps = []
    while capture.grab():
        stamps.append(1e-3 * capture.get(cv2.CAP_PROP_POS_MSEC))
    capture.release()
    return stamps


def _is_even(stamps_s: list[float], step_s: float | None) -> bool:
    """Whether frames come at a rate, to the rounding of a container's clock."""
    if step_s is None or not stamps_s:
        return False
    return all(
        abs(stamp_s - stamps_s[0] - index * step_s) < _ROUNDING_S
        for index, stamp_s in enumerate(stamps_s)
    )


class VideoReader:
    """Reads frames of a video in any order; in ascending order it decodes each only once.

    Frames are counted from the start, never found by a seek: the frame that a seek finds depends
    on the codec. Going back starts again from the first frame. Several threads may use one reader,
    and it can be sent to another process.
    """

    def __init__(self, path: Path | VideoTopic) -> None:
        self._path = path
        self._capture: cv2.VideoCapture | None = None
        self._next = 0  # number of the next frame
        self._last: tuple[int, GreyImage] | None = None  # kept for the next call
        self._lock = threading.Lock()

    def __reduce__(self) -> tuple[type[VideoReader], tuple[Path | VideoTopic]]:
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
        return grey_of(image)


def _first(reader: VideoReader) -> list[GreyImage]:
    """The first frame; none if it cannot be read, which the run reports."""
    try:
        return [reader.read(0)]
    except RendezviewError:
        return []


def _capture(path: Path | VideoTopic) -> cv2.VideoCapture:
    # Other back ends accept files that are not videos, and print messages.
    has_ffmpeg = cv2.videoio_registry.hasBackend(cv2.CAP_FFMPEG)
    if isinstance(path, Path):
        with quiet_opencv():
            capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG if has_ffmpeg else cv2.CAP_ANY)
    else:
        capture = path.open()
    if not capture.isOpened():
        raise RendezviewError(
            f"{path}: not a video that can be read: check the file, or convert it "
            f"(for example to MP4 with H.264)"
        )
    # A picture rotated by its metadata does not fit its calibration.
    capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
    return capture
