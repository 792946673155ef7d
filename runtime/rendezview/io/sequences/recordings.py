"""Recordings of messages as sequences of images: ROS 1 and ROS 2 bags, MCAP files.

The type of a message shows whether it is a picture. If several topics have pictures, the topic is
named after the path: ``flight.bag#/camera/image_raw``. The camera comes from the calibration
messages whose topic is most like that of the pictures, unless one is given.
"""

from __future__ import annotations

import contextlib
import itertools
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.io.sequences.frame import GreyImage, Sequence
from rendezview.io.sequences.images import camera_beside
from rendezview.io.sequences.message_images import Calibration, PackedPicture, RawPicture, grey
from rendezview.io.sequences.message_video import VideoPart, VideoTopic
from rendezview.io.sequences.order import in_order
from rendezview.io.sequences.video import VideoReader

Content = RawPicture | PackedPicture | VideoPart | Calibration
_KEPT = 8  # undecoded messages, for pictures that come late. Source: a chosen limit


class CutOff(RendezviewError):
    """The recording ends within a record; all before it was given."""


@dataclass(frozen=True, slots=True)
class Message:
    """A picture or a calibration, not decoded yet."""

    topic: str
    calibrates: bool
    logged_ns: int
    decode: Callable[[], tuple[float, Content]]  # stamp of its header, s (0: none), and content


Messages = Callable[[Path], Iterator[Message]]  # those of one pass through a file, in order


@dataclass(slots=True)
class _Found:
    """Results of the first pass."""

    # Of the pictures, by topic: stamp, time of recording, whether a video's is a key picture
    pictures: dict[str, list[tuple[float, float, bool | None]]]
    calibrations: dict[str, Calibration]  # the first, by topic
    cut_off: str | None = None


def split_topic(text: str) -> tuple[str, str | None]:
    """Path and topic of ``PATH#TOPIC``; the topic is None if none is named."""
    path, mark, topic = text.rpartition("#")
    return (path, topic) if mark and path and topic else (text, None)


def open_recording(
    path: Path, messages: Messages, topic: str | None = None, camera: Camera | None = None
) -> Sequence:
    """The pictures of one topic, numbered from 0 in the order of their times.

    Their times are the stamps of their headers, usually seconds since 1970; if none has a stamp,
    the times of recording. The recording is read once to find them. Pictures without a stamp, and
    all but the first of one stamp, are left out, which the notes count.

    Args:
        path: the recording.
        messages: the function that reads it.
        topic: of the pictures; optional if there is only one.
        camera: takes precedence over the recording's calibration.

    Raises:
        RendezviewError: cannot be read, no such topic or several, or no camera.
    """
    found = _first_pass(path, messages)
    chosen = _topic(path, found, topic)
    own = camera if camera is not None else _camera(path, found, chosen)
    stamps_s, logged_s, keys = zip(*found.pictures[chosen], strict=True)
    times_s = stamps_s if any(stamps_s) else logged_s
    reader: RecordingReader | VideoReader
    if None not in keys:
        lead = next((k for k, key in enumerate(keys) if key), len(times_s))
        reader = VideoReader(VideoTopic(path, partial(_parts, path, messages, chosen, lead)))
    else:
        lead, reader = 0, RecordingReader(path, messages, chosen, own.bit_depth)
    order, notes = in_order(times_s, lead)
    if found.cut_off is not None:
        notes.append(f"{found.cut_off}: {len(times_s)} pictures of {chosen} before it")
    if not order:
        raise RendezviewError(f"{path}: no picture of {chosen} can be read: {'; '.join(notes)}")
    pictures = (
        (f"{path.name}#{chosen}, frame {k}", times_s[k], partial(reader.read, k - lead))
        for k in order
    )
    return Sequence.of_pictures(path, own, pictures, notes)


class RecordingReader:
    """Reads pictures of a topic in any order; in ascending order it reads the file only once.

    Several threads may use one reader, and it can be sent to another process.
    """

    def __init__(self, path: Path, messages: Messages, topic: str, bits: int | None = None) -> None:
        self._source = path, messages, topic, bits
        self._pass: Iterator[Message] | None = None
        self._next = 0  # number of the picture that comes next
        self._kept: dict[int, Message] = {}  # the last ones, undecoded, by number
        self._lock = threading.Lock()

    def __reduce__(self) -> tuple[type[RecordingReader], tuple[Path, Messages, str, int | None]]:
        return RecordingReader, self._source

    def read(self, index: int) -> GreyImage:
        """Picture ``index`` from 0 as grey uint8 (height, width).

        Raises:
            RendezviewError: the recording has changed, or the picture is damaged.
        """
        path, messages, topic, bits = self._source
        where = f"{path}#{topic}, frame {index}"
        with self._lock:
            if index not in self._kept and (self._pass is None or index < self._next):
                self._pass, self._next = _of_topic(path, messages, topic), 0
                self._kept.clear()
            while index not in self._kept and self._pass is not None:
                message = next(self._pass, None)
                if message is None:
                    self._pass = None
                    break
                self._kept[self._next] = message
                self._kept.pop(self._next - _KEPT, None)
                self._next += 1
            kept = self._kept.get(index)
        content = None if kept is None else _decoded(path, kept)[1]
        if isinstance(content, RawPicture | PackedPicture):
            return grey(content, where, bits)
        raise RendezviewError(f"{where}: is no longer there: the recording has changed")


def _first_pass(path: Path, messages: Messages) -> _Found:
    found = _Found({}, {})
    try:
        for message in messages(path):
            if message.calibrates:
                if message.topic not in found.calibrations:
                    content = _decoded(path, message)[1]
                    if isinstance(content, Calibration):
                        found.calibrations[message.topic] = content
                continue
            stamp_s, content = _decoded(path, message)
            key = content.is_key if isinstance(content, VideoPart) else None
            seen = (stamp_s, 1e-9 * message.logged_ns, key)
            found.pictures.setdefault(message.topic, []).append(seen)
    except CutOff as cut:
        found.cut_off = str(cut)
    return found


def _of_topic(path: Path, messages: Messages, topic: str) -> Iterator[Message]:
    with contextlib.suppress(CutOff):
        for message in messages(path):
            if message.topic == topic and not message.calibrates:
                yield message


def _parts(path: Path, messages: Messages, topic: str, lead: int) -> Iterator[VideoPart]:
    """The video of a topic, from its first key picture."""
    for message in itertools.islice(_of_topic(path, messages, topic), lead, None):
        content = _decoded(path, message)[1]
        if isinstance(content, VideoPart):
            yield content


def _decoded(path: Path, message: Message) -> tuple[float, Content]:
    try:
        return message.decode()
    except RendezviewError:
        raise
    except Exception as error:  # another package's decoder, over any bytes
        raise RendezviewError(
            f"{path}#{message.topic}: a message cannot be read ({type(error).__name__}: {error}): "
            "the recording is damaged, or its types do not match their names"
        ) from error


def _topic(path: Path, found: _Found, topic: str | None) -> str:
    topics = sorted(found.pictures)
    if not topics:
        raise RendezviewError(
            f"{path}: holds no pictures (sensor_msgs Image or CompressedImage, foxglove RawImage, "
            "CompressedImage or CompressedVideo)"
            + (f": it is {found.cut_off}, before the first one" if found.cut_off else "")
            + ": record a camera's topic"
        )
    listed = ", ".join(f"{name} ({len(found.pictures[name])})" for name in topics)
    if topic is not None:
        if topic not in found.pictures:
            raise RendezviewError(f"{path}: has no pictures of {topic}; it has {listed}")
        return topic
    if len(topics) > 1:
        raise RendezviewError(
            f"{path}: has pictures of several topics ({listed}): name one as {path}#{topics[0]}"
        )
    return topics[0]


def _camera(path: Path, found: _Found, topic: str) -> Camera:
    """Camera of the calibration topic that shares the most leading words with the picture topic."""
    shared = {name: _shared(name, topic) for name in found.calibrations}
    nearest = [name for name, count in shared.items() if count == max(shared.values())]
    if not nearest:
        beside = camera_beside(path if path.is_dir() else path.parent)
        if beside is None:
            raise RendezviewError(
                f"{path}: no camera: it holds no calibration (sensor_msgs CameraInfo, foxglove "
                "CameraCalibration): give a camera file"
            )
        return beside
    if len(nearest) > 1:
        raise RendezviewError(
            f"{path}: which of the calibrations {', '.join(sorted(nearest))} is that of "
            f"{topic}? Give a camera file"
        )
    rectified = any(part.startswith("image_rect") for part in topic.split("/"))
    return found.calibrations[nearest[0]].camera(f"{path}#{nearest[0]}", rectified=rectified)


def _shared(a: str, b: str) -> int:
    count = 0
    for x, y in zip(a.split("/"), b.split("/"), strict=False):
        if x != y:
            break
        count += 1
    return count
