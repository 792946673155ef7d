"""MCAP files: Foxglove's messages (protobuf or JSON) and ROS's (CDR or ROS 1).

They are read record by record, so a file that was cut off is read up to its last complete record.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

from rendezview.errors import RendezviewError, optional
from rendezview.io.sequences.message_images import Calibration, PackedPicture, RawPicture
from rendezview.io.sequences.message_video import VideoPart
from rendezview.io.sequences.recordings import Content, CutOff, Message
from rendezview.io.sequences.ros_messages import CALIBRATIONS, PICTURES, message, short_name

_FOXGLOVE = (
    "foxglove.RawImage", "foxglove.CompressedImage", "foxglove.CompressedVideo",
    "foxglove.CameraCalibration",
)  # fmt: skip
MOST_RECORD = 4_000_000_000  # bytes; a longer record is damage. Source: a chosen limit
_Decoder = Callable[[str, int, bytes], Message]


def mcap_messages(path: Path) -> Iterator[Message]:
    """Pictures and calibrations, in the order of the file.

    Raises:
        CutOff: at the end of a file that was cut off.
        RendezviewError: a package is not installed, or this is no MCAP file.
    """
    with optional(f"{path}: MCAP files need", "service"):
        from mcap.exceptions import EndOfFile
        from mcap.records import Channel, Schema
        from mcap.records import Message as Record
        from mcap.stream_reader import StreamReader
    schemas: dict[int, Any] = {}
    topics: dict[int, str] = {}
    decoders: dict[int, _Decoder | None] = {}
    try:
        with open(path, "rb") as file:
            reader = StreamReader(file, validate_crcs=True, record_size_limit=MOST_RECORD)
            for record in reader.records:
                if isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel):
                    if record.id not in decoders:
                        schema = schemas.get(record.schema_id)
                        decoders[record.id] = _decoder(path, record.message_encoding, schema)
                        topics[record.id] = record.topic
                elif isinstance(record, Record):
                    decoder = decoders.get(record.channel_id)
                    if decoder is not None:
                        yield decoder(topics[record.channel_id], record.log_time, record.data)
    except EndOfFile:
        raise CutOff(f"cut off at byte {path.stat().st_size}") from None
    except RendezviewError:
        raise
    except OSError as error:
        raise RendezviewError(f"{path}: cannot be read ({error.strerror})") from error
    except Exception as error:  # another package's reader, over any bytes
        raise RendezviewError(
            f"{path}: not an MCAP file that can be read ({type(error).__name__}: "
            f"{str(error)[:200]}): check the file, or recover it with the mcap tool"
        ) from error


def _decoder(path: Path, encoding: str, schema: Any) -> _Decoder | None:
    """The decoder of a channel's messages; None if they are not needed."""
    if schema is None:
        return None
    if schema.name in _FOXGLOVE and encoding in ("protobuf", "json"):
        return _foxglove(path, schema.name, encoding)
    if short_name(schema.name) in PICTURES + CALIBRATIONS and encoding in ("cdr", "ros1"):
        return _ros(path, schema, encoding)
    return None


def _ros(path: Path, schema: Any, encoding: str) -> _Decoder:
    with optional(f"{path}: ROS's messages need", "ros"):
        from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
    package, name = short_name(schema.name).split("/")
    full = f"{package}/msg/{name}"
    store = get_typestore(Stores.EMPTY)
    text = schema.data.decode("utf-8")
    if "idl" in schema.encoding:
        for part in text.split("=" * 80 + "\n"):
            body = part.split("\n", 1)[1] if part.startswith("IDL: ") else part
            if body.strip():
                store.register(get_types_from_idl(body))
    else:
        store.register(get_types_from_msg(text, full))
    deserialize = store.deserialize_cdr if encoding == "cdr" else store.deserialize_ros1
    return lambda topic, logged_ns, data: message(topic, full, logged_ns, data, deserialize)


def _foxglove(path: Path, name: str, encoding: str) -> _Decoder:
    if encoding == "json":
        parse: Callable[[bytes], Any] = json.loads
        read = _json_content
    else:
        with optional(f"{path}: Foxglove's messages need", "service"):
            from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
            from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
            from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo
            from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
        kinds: tuple[Any, ...] = (RawImage, CompressedImage, CompressedVideo, CameraCalibration)
        parse = kinds[_FOXGLOVE.index(name)].FromString
        read = _protobuf_content

    def decoder(topic: str, logged_ns: int, data: bytes) -> Message:
        return Message(
            topic, name.endswith("Calibration"), logged_ns, lambda: read(name, parse(data))
        )

    return decoder


def _content(name: str, field: Callable[[str], Any], data: Callable[[], Any]) -> Content:
    """What a message holds, by its fields and its packed data."""
    if name == "foxglove.RawImage":
        size = field("width"), field("height"), field("step")
        return RawPicture(*size, field("encoding"), data())
    if name == "foxglove.CompressedImage":
        return PackedPicture(data())
    if name == "foxglove.CompressedVideo":
        return VideoPart(field("format"), data())
    lists = (tuple(field(key)) for key in ("D", "K", "P"))
    return Calibration(field("width"), field("height"), field("distortion_model"), *lists)


def _protobuf_content(name: str, found: Any) -> tuple[float, Content]:
    stamp_s = found.timestamp.seconds + 1e-9 * found.timestamp.nanos
    return stamp_s, _content(name, partial(getattr, found), lambda: found.data)


def _json_content(name: str, found: Any) -> tuple[float, Content]:
    stamp = found.get("timestamp") or {}
    fields = {"distortion_model": "", "D": (), "P": (), **found}
    content = _content(name, fields.__getitem__, lambda: base64.b64decode(found["data"]))
    return stamp.get("sec", 0) + 1e-9 * stamp.get("nsec", 0), content
