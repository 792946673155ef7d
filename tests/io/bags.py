"""Recordings made for tests: ROS 1 and ROS 2 bags, MCAP files."""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.timestamp_pb2 import Timestamp
from mcap.writer import Writer as McapWriter
from mcap_protobuf.writer import Writer as ProtobufWriter
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from rendezview.geometry.camera import Camera

START_S = 1_700_000_000


@dataclass(frozen=True)
class Shot:
    """A grey picture of a topic, with the encoding it is to have (png: packed)."""

    image: np.ndarray
    time_s: float  # after START_S
    topic: str = "/camera/image_raw"
    encoding: str = "mono8"


def packed(shot: Shot) -> bytes:
    """The bytes of a picture; rows of raw ones are 3 bytes longer than they need."""
    if shot.encoding == "png":
        return cv2.imencode(".png", shot.image)[1].tobytes()
    rows = shot.image
    if shot.encoding in ("rgb8", "bgr8"):
        rows = np.repeat(rows[:, :, None], 3, axis=2).reshape(len(rows), -1)
    return np.pad(rows, ((0, 0), (0, 3)), constant_values=99).tobytes()


def split_time(time_s: float) -> tuple[int, int]:
    return START_S + int(time_s), round((time_s % 1.0) * 1e9)


def numbers(camera: Camera) -> dict[str, list[float]]:
    k = camera.matrix.ravel().tolist()
    p = [*k[:3], 0.0, *k[3:6], 0.0, *k[6:], 0.0]
    p[0] = p[5] = 0.9 * camera.fx  # of rectified pictures
    return {
        "d": [*camera.distortion, *[0.0] * (5 - len(camera.distortion))],
        "k": k,
        "r": np.eye(3).ravel().tolist(),
        "p": p,
    }


def ros_messages(shots: Sequence[Shot], cameras: dict[str, Camera], ros1: bool):
    """Topic, type, time in ns and message of ROS's, calibrations first."""
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    t = store.types
    first = {"seq": 0} if ros1 else {}

    def header(time_s: float):
        stamp = t["builtin_interfaces/msg/Time"](*split_time(time_s))
        return t["std_msgs/msg/Header"](**first, stamp=stamp, frame_id="camera")

    for topic, camera in cameras.items():
        named = {name.upper() if ros1 else name: np.array(v) for name, v in numbers(camera).items()}
        info = t["sensor_msgs/msg/CameraInfo"](
            header=header(0.0), height=camera.height, width=camera.width,
            distortion_model="plumb_bob", **named, binning_x=0, binning_y=0,
            roi=t["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False),
        )  # fmt: skip
        yield store, topic, info, int(START_S * 1e9)
    for shot in shots:
        data = np.frombuffer(packed(shot), np.uint8)
        height, width = shot.image.shape
        if shot.encoding == "png":
            picture = t["sensor_msgs/msg/CompressedImage"](header(shot.time_s), "png", data)
        else:
            picture = t["sensor_msgs/msg/Image"](
                header(shot.time_s), height, width, shot.encoding, 0, len(data) // height, data
            )
        logged_s = START_S + shot.time_s + 0.1  # it arrives later than its stamp says
        yield store, shot.topic, picture, int(logged_s * 1e9)


def write_ros1(path: Path, shots: Sequence[Shot], cameras: dict[str, Camera]) -> Path:
    with Writer1(path) as bag:
        known = {}
        for store, topic, message, logged_ns in ros_messages(shots, cameras, True):
            kind = message.__msgtype__
            if topic not in known:
                known[topic] = bag.add_connection(topic, kind, typestore=store)
            bag.write(known[topic], logged_ns, store.serialize_ros1(message, kind))
    return path


def write_ros2(
    path: Path,
    shots: Sequence[Shot],
    cameras: dict[str, Camera],
    storage: StoragePlugin = StoragePlugin.SQLITE3,
) -> Path:
    with Writer2(path, version=9, storage_plugin=storage) as bag:
        known = {}
        for store, topic, message, logged_ns in ros_messages(shots, cameras, False):
            kind = message.__msgtype__
            if topic not in known:
                known[topic] = bag.add_connection(topic, kind, typestore=store)
            bag.write(known[topic], logged_ns, store.serialize_cdr(message, kind))
    return path


def write_foxglove(path: Path, shots: Sequence[Shot], cameras: dict[str, Camera]) -> Path:
    with open(path, "wb") as file, ProtobufWriter(file) as bag:
        for topic, camera in cameras.items():
            n = numbers(camera)
            info = CameraCalibration(
                width=camera.width, height=camera.height, distortion_model="plumb_bob",
                D=n["d"], K=n["k"], R=n["r"], P=n["p"],
            )  # fmt: skip
            bag.write_message(topic, info, START_S * 10**9, START_S * 10**9)
        for shot in shots:
            seconds, nanos = split_time(shot.time_s)
            stamp, data = Timestamp(seconds=seconds, nanos=nanos), packed(shot)
            height, width = shot.image.shape
            if shot.encoding == "png":
                picture = CompressedImage(timestamp=stamp, data=data, format="png")
            else:
                picture = RawImage(
                    timestamp=stamp, width=width, height=height, encoding=shot.encoding,
                    step=len(data) // height, data=data,
                )  # fmt: skip
            logged_ns = int((START_S + shot.time_s + 0.1) * 1e9)
            bag.write_message(shot.topic, picture, logged_ns, logged_ns)
    return path


def write_foxglove_json(path: Path, shots: Sequence[Shot], cameras: dict[str, Camera]) -> Path:
    with open(path, "wb") as file:
        bag = McapWriter(file)
        bag.start()
        channels = {}

        def write(topic: str, name: str, logged_ns: int, content: dict) -> None:
            if topic not in channels:
                schema = bag.register_schema(name, "jsonschema", b"{}")
                channels[topic] = bag.register_channel(topic, "json", schema)
            bag.add_message(channels[topic], logged_ns, json.dumps(content).encode(), logged_ns)

        for topic, camera in cameras.items():
            info = {name.upper(): value for name, value in numbers(camera).items()}
            info |= {"width": camera.width, "height": camera.height}
            write(topic, "foxglove.CameraCalibration", START_S * 10**9, info)
        for shot in shots:
            sec, nsec = split_time(shot.time_s)
            height, width = shot.image.shape
            data = packed(shot)
            content = {
                "timestamp": {"sec": sec, "nsec": nsec},
                "data": base64.b64encode(data).decode(),
            }
            kind = "foxglove.CompressedImage"
            if shot.encoding != "png":
                kind = "foxglove.RawImage"
                content |= {
                    "width": width, "height": height, "encoding": shot.encoding,
                    "step": len(data) // height,
                }  # fmt: skip
            write(shot.topic, kind, int((START_S + shot.time_s + 0.1) * 1e9), content)
        bag.finish()
    return path
