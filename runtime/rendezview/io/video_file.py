"""Writes videos: WebM (VP8), MP4 (VP9), AVI (Motion JPEG), and animated GIF."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, Self

import cv2
import numpy as np
import numpy.typing as npt

from rendezview.errors import RendezviewError
from rendezview.io.file_lock import give_name, opened_alone
from rendezview.io.files import check_place, write_error
from rendezview.io.sequences.quiet import quiet_opencv

Picture = npt.NDArray[np.uint8]

# Browsers play VP8 and VP9; OpenCV's own FFmpeg has no encoder for H.264. VP9 takes seven times as
# long, 0.3 s a frame of 640 × 554, and no option of it can be set; MP4 cannot hold VP8.
_CODECS = {".webm": "VP80", ".mp4": "vp09", ".avi": "MJPG"}
_GIF = ".gif"
_GIF_WIDTH_PX = 480  # Source: a few megabytes for a minute
_MOST_GIF_FRAMES = 600  # all are in memory until the end: 0.3 GB. Source: a chosen limit
_RATE_HZ = 10.0  # of frames without useful times. Source: chosen to be watchable
_SLOWEST_HZ, _FASTEST_HZ = 5.0, 60.0  # Source: slower looks like stills, faster is not shown


def playing_rate_hz(times_s: list[float | None]) -> float:
    """Frames a second: real time where that is 5 to 60 a second, else 10."""
    known = np.array([time for time in times_s if time is not None])
    steps = np.diff(known) if len(known) == len(times_s) else np.zeros(0)
    step_s = float(np.median(steps)) if len(steps) else 0.0
    rate_hz = 1.0 / step_s if step_s > 0.0 else _RATE_HZ
    return rate_hz if _SLOWEST_HZ <= rate_hz <= _FASTEST_HZ else _RATE_HZ


@contextlib.contextmanager
def _without_standard_error() -> Iterator[None]:
    """FFmpeg prints there that WebM needs no tag of the codec, whatever OpenCV's log level."""
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


class VideoWriter:
    """A video that is written frame by frame, and gets its name when it is closed.

    The first frame decides the size; others are resized to it. An exception or Ctrl-C leaves a
    video of the frames so far; no frames leave no file. What a full disk cut short keeps a name
    with ``.partial``.

    Args:
        path: ending in .webm (fast), .mp4, .avi or .gif.
        rate_hz: frames a second.

    Raises:
        RendezviewError: another ending, or no such folder.
    """

    def __init__(self, path: Path, rate_hz: float) -> None:
        suffix = path.suffix.lower()
        if suffix not in (*_CODECS, _GIF):
            raise RendezviewError(
                f"{path}: a video's name must end in {', '.join(_CODECS)} or {_GIF}"
            )
        check_place(path, "the video")
        self._path, self._rate_hz, self._suffix = path, rate_hz, suffix
        self._part = path.with_name(f".{path.stem}.partial{suffix}")
        self._locked: BinaryIO | None = None
        self._writer: cv2.VideoWriter | None = None
        self._frames: list[Picture] = []
        self._size = (0, 0)
        self._written = 0  # frames

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def add(self, picture: Picture) -> None:
        """The next frame, (H, W, 3) blue, green, red.

        Raises:
            RendezviewError: no encoder, no space, another run writes it, or too many frames for a
                GIF.
        """
        if self._locked is None:
            try:
                self._locked = opened_alone(self._part, self._path)
            except OSError as error:
                raise write_error(self._path, error) from error
        if self._size == (0, 0):
            self._size = picture.shape[1], picture.shape[0]
            if self._suffix == _GIF and self._size[0] > _GIF_WIDTH_PX:
                self._size = _GIF_WIDTH_PX, round(self._size[1] * _GIF_WIDTH_PX / self._size[0])
        if (picture.shape[1], picture.shape[0]) != self._size:
            resized = cv2.resize(picture, self._size, interpolation=cv2.INTER_AREA)
            picture = np.asarray(resized, dtype=np.uint8)
        if self._suffix == _GIF:
            if len(self._frames) >= _MOST_GIF_FRAMES:
                raise RendezviewError(
                    f"{self._path}: a GIF takes {_MOST_GIF_FRAMES} frames: write a .webm"
                )
            self._frames.append(picture)
            return
        if self._writer is None:
            with quiet_opencv(), _without_standard_error():
                code = cv2.VideoWriter.fourcc(*_CODECS[self._suffix])
                self._writer = cv2.VideoWriter(
                    str(self._part), cv2.CAP_ANY, code, self._rate_hz, self._size
                )
            if not self._writer.isOpened():
                self._part.unlink(missing_ok=True)
                raise RendezviewError(
                    f"{self._path}: this OpenCV cannot encode {self._suffix}: write an .avi or .gif"
                )
        with quiet_opencv():
            written = self._writer.write(picture)
        if not written:
            raise self._unwritten()
        self._written += 1

    def _ends(self) -> bool:
        """Whether the last frame is in the file; FFmpeg says nothing of what it could not write."""
        with quiet_opencv(), _without_standard_error():
            capture = cv2.VideoCapture(str(self._part))
            capture.set(cv2.CAP_PROP_POS_FRAMES, self._written - 1)
            return capture.read()[0]

    def _unwritten(self) -> RendezviewError:
        return RendezviewError(
            f"{self._path}: the video cannot be written: check the free space there, or choose "
            "another place"
        )

    def close(self) -> None:
        """Finish the file and give it its name.

        Raises:
            RendezviewError: the file is not complete.
        """
        try:
            self._finish()
            if self._locked is not None:
                give_name(self._locked, self._part, self._path)
        except OSError as error:
            raise write_error(self._path, error) from error
        finally:
            if self._locked is not None:
                self._locked.close()
                self._locked = None

    def _finish(self) -> None:
        if self._frames:
            animation = cv2.Animation()
            animation.frames = self._frames
            animation.durations = [round(1e3 / self._rate_hz)] * len(self._frames)
            if not cv2.imwriteanimation(str(self._part), animation):
                raise RendezviewError(f"{self._path}: the GIF cannot be written")
            self._frames = []
        if self._writer is not None:
            self._writer.release()
            self._writer = None
            if not self._ends():
                raise self._unwritten()
