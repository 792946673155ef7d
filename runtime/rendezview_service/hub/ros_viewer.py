"""Live poses for ROS 2 over Zenoh, without a ROS installation: as its rmw_zenoh sends them.

A topic is the key ``DOMAIN/TOPIC/TYPE/HASH``, its messages are in CDR, with number, time and sender
attached. Source: rmw_zenoh, docs/design.md; attachment_helpers.cpp, ROS 2 Jazzy and later.
"""

from __future__ import annotations

import json
import os
import re
import struct
import time
from types import SimpleNamespace
from typing import Any

import numpy as np

from rendezview.errors import optional
from rendezview_service.messages.messages import SessionInfo
from rendezview_service.messages.ros import pose_with_covariance_stamped, transform_stamped

_POSE, _TREE = "geometry_msgs/msg/PoseWithCovarianceStamped", "tf2_msgs/msg/TFMessage"
_TEXT = "std_msgs/msg/String"

Json = dict[str, Any]


class RosViewer:
    """Publishes poses, ``/tf`` and flights to a Zenoh router, or to peers.

    ``/SESSION/target/pose`` and ``/SESSION/target/fused``; ``/SESSION/flight``, the JSON of a
    `Flight` in a string.
    """

    def __init__(self, endpoint: str) -> None:
        """Connect.

        Args:
            endpoint: of the router or a peer, as Zenoh has it: ``tcp/127.0.0.1:7447``.

        Raises:
            OSError: it is none, or nothing listens there.
            RendezviewError: a package is not installed.
        """
        with optional("a live stream needs", "zenoh"):
            import zenoh
            from rosbags.typesys import Stores, get_typestore

        settings = zenoh.Config()
        settings.insert_json5("mode", json.dumps("client"))
        settings.insert_json5("scouting/multicast/enabled", "false")
        self._types = get_typestore(Stores.ROS2_JAZZY)
        try:
            settings.insert_json5("connect/endpoints", json.dumps([endpoint]))
            self._session = zenoh.open(settings)
        except zenoh.ZError as error:
            raise OSError(f"no Zenoh router at {endpoint} ({error}): start rmw_zenohd") from None
        self._sender = os.urandom(16)
        self._domain = int(os.environ.get("ROS_DOMAIN_ID", "0"))
        self._sent: dict[str, int] = {}  # messages by key

    def show(self, info: SessionInfo, message: Json, picture: bytes) -> None:
        """A `WatchState`: its pose, if it has one."""
        name = re.sub(r"^(?=\d)|\W", "_", info.id, flags=re.ASCII)
        state = message["state"]
        pose, transform = pose_with_covariance_stamped(state), transform_stamped(state)
        if pose is not None:
            self._send(f"{name}/target/pose", _POSE, _framed(pose, name))
        fused = state.get("fused")
        told = fused and pose_with_covariance_stamped(fused)
        if told:
            self._send(f"{name}/target/fused", _POSE, _framed(told, name))
        if info.flight is not None:
            self._send(f"{name}/flight", _TEXT, {"data": info.flight.model_dump_json()})
        if transform is not None:
            self._send("tf", _TREE, {"transforms": [_framed(transform, name)]})

    def close(self) -> None:
        """End the connection."""
        self._session.close()  # type: ignore[no-untyped-call]

    def _send(self, topic: str, kind: str, content: Json) -> None:
        mangled = kind.replace("/msg/", "::msg::dds_::") + "_"
        key = f"{self._domain}/{topic}/{mangled}/{self._types.hash_rihs01(kind)}"
        number = self._sent[key] = self._sent.get(key, 0) + 1
        attached = struct.pack("<qqB", number, time.time_ns(), len(self._sender)) + self._sender
        data = self._types.serialize_cdr(_message(content), kind)
        self._session.put(key, bytes(data), attachment=attached)


def _message(content: Any) -> Any:
    """What rosbags takes for a message: the keys of dictionaries as attributes."""
    if isinstance(content, dict):
        return SimpleNamespace(**{name: _message(part) for name, part in content.items()})
    if isinstance(content, list) and not isinstance(content[0], dict):
        return np.array(content, np.float64)
    return [_message(part) for part in content] if isinstance(content, list) else content


def _framed(content: Json, name: str) -> Json:
    """A message in the frames of a session."""
    content["header"]["frame_id"] = f"{name}/camera"
    if "child_frame_id" in content:
        content["child_frame_id"] = f"{name}/target"
    return content
