"""ROS messages: bags of ROS 1 and ROS 2, read with the package ``rosbags``.

ROS is not needed. Message types come from the bag. ROS 2 bags without types (SQLite before Iron)
are read with those of ROS 2 Humble; pictures and calibrations are the same in all releases.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from rendezview.errors import RendezviewError, optional
from rendezview.io.sequences.message_images import Calibration, PackedPicture, RawPicture
from rendezview.io.sequences.message_video import VideoPart
from rendezview.io.sequences.recordings import Content, Message

BAG_SUFFIXES = frozenset({".bag", ".db3"})

# Type names without ``/msg``, which only ROS 2 has.
VIDEOS = ("ffmpeg_image_transport_msgs/FFMPEGPacket", "foxglove_msgs/CompressedVideo")
PICTURES = ("sensor_msgs/Image", "sensor_msgs/CompressedImage", *VIDEOS)
CALIBRATIONS = ("sensor_msgs/CameraInfo",)


def is_ros2_folder(folder: Path) -> bool:
    """Whether a folder is a ROS 2 bag."""
    return (folder / "metadata.yaml").is_file() and any(
        path.suffix in (".db3", ".mcap", ".zstd") for path in folder.iterdir()
    )


def short_name(type_name: str) -> str:
    """``sensor_msgs/Image`` of ``sensor_msgs/msg/Image`` and of ``sensor_msgs/Image``."""
    return type_name.replace("/msg/", "/")


def bag_messages(path: Path) -> Iterator[Message]:
    """Pictures and calibrations of a ROS 1 bag or a ROS 2 bag (folder or ``.db3``), in order.

    Raises:
        RendezviewError: rosbags is not installed, or the bag cannot be read.
    """
    with optional(f"{path}: ROS bags need", "ros"):
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    try:
        defaults = get_typestore(Stores.ROS2_HUMBLE)
        with AnyReader([path], default_typestore=defaults) as reader:
            wanted = [
                connection
                for connection in reader.connections
                if short_name(connection.msgtype) in PICTURES + CALIBRATIONS
            ]
            if not wanted:
                return  # an empty list would mean all connections
            for connection, logged_ns, data in reader.messages(connections=wanted):
                yield message(
                    connection.topic, connection.msgtype, logged_ns, data, reader.deserialize
                )
    except RendezviewError:
        raise
    except Exception as error:  # another package's reader, over any bytes
        raise RendezviewError(
            f"{path}: not a ROS bag that can be read ({type(error).__name__}: "
            f"{str(error).strip()[:200]}): check the file, or index or convert it again"
        ) from error


def message(
    topic: str,
    type_name: str,
    logged_ns: int,
    data: bytes,
    deserialize: Callable[[bytes, str], Any],
) -> Message:
    """A ROS message, decoded on demand."""
    calibrates = short_name(type_name) in CALIBRATIONS

    def decode() -> tuple[float, Content]:
        found = deserialize(data, type_name)
        stamp = found.timestamp if hasattr(found, "timestamp") else found.header.stamp
        return stamp.sec + 1e-9 * stamp.nanosec, _content(type_name, found)

    return Message(topic, calibrates, logged_ns, decode)


def _content(type_name: str, found: Any) -> Content:
    kind = short_name(type_name)
    if kind == "sensor_msgs/Image":
        return RawPicture(
            found.width,
            found.height,
            found.step,
            found.encoding,
            found.data,
            bool(found.is_bigendian),
        )
    if kind == "sensor_msgs/CompressedImage":
        return PackedPicture(found.data)
    if kind in VIDEOS:
        name = found.encoding if hasattr(found, "encoding") else found.format
        return VideoPart(name, found.data)
    ros1 = hasattr(found, "K")  # ROS 1 has capitals
    k, d, p = (found.K, found.D, found.P) if ros1 else (found.k, found.d, found.p)
    roi = found.roi
    return Calibration(
        width=int(found.width),
        height=int(found.height),
        model=found.distortion_model,
        distortion=tuple(map(float, d)),
        matrix=tuple(map(float, k)),
        projection=tuple(map(float, p)),
        region=(roi.x_offset, roi.y_offset, roi.width, roi.height),
        binning=(found.binning_x, found.binning_y),
    )
