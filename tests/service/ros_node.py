"""A process that stands for a ROS 2 node, and hands on what it receives."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
import threading
from collections.abc import Iterator
from typing import Any

from tests.waiting import MOST_S, ends_in_time

# Stands for a ROS 2 node with rmw_zenoh: it knows topics, types and their hashes, not rendezview.
_NODE = """
import json, struct, sys, zenoh
from rosbags.typesys import Stores, get_typestore
types = get_typestore(Stores.ROS2_JAZZY)
config = zenoh.Config()
config.insert_json5("mode", '"router"')
config.insert_json5("listen/endpoints", json.dumps([sys.argv[1]]))
config.insert_json5("scouting/multicast/enabled", "false")
with zenoh.open(config) as session:
    def received(sample):
        domain, *topic, mangled, hashed = str(sample.key_expr).split("/")
        kind = mangled.removesuffix("_").replace("::msg::dds_::", "/msg/")
        attached = bytes(sample.attachment)
        number, stamp, length = struct.unpack_from("<qqB", attached)
        message = types.deserialize_cdr(bytes(sample.payload), kind)
        if kind.endswith("String"):
            known = types.hash_rihs01(kind) == hashed
            told = {"topic": "/".join(topic), "known": known, "text": message.data}
            print(json.dumps(told), flush=True)
            return
        last = message.transforms[0] if hasattr(message, "transforms") else message
        moving = hasattr(last, "transform")
        moved = last.transform.translation if moving else last.pose.pose.position
        print(json.dumps({
            "topic": "/".join(topic), "domain": domain, "known": types.hash_rihs01(kind) == hashed,
            "number": number, "stamp": stamp, "sender": len(attached) - 17 == length == 16,
            "frame": last.header.frame_id, "sec": last.header.stamp.sec,
            "nanosec": last.header.stamp.nanosec, "child": getattr(last, "child_frame_id", None),
            "xyz": [moved.x, moved.y, moved.z],
            "covariance": last.pose.covariance.tolist() if hasattr(last, "pose") else None,
        }), flush=True)
    with session.declare_subscriber("**", received):
        print("ready", flush=True)
        sys.stdin.read()
"""


@contextlib.contextmanager
def node(endpoint: str) -> Iterator[list[Any]]:
    """What a node receives, as it comes."""
    with subprocess.Popen(
        [sys.executable, "-c", _NODE, endpoint], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        text=True,
    ) as process:  # fmt: skip
        assert process.stdout is not None
        assert process.stdin is not None
        with ends_in_time(process):
            assert process.stdout.readline() == "ready\n"
        lines: list[Any] = []
        output = process.stdout
        reader = threading.Thread(target=lambda: lines.extend(map(json.loads, output)))
        reader.start()
        try:
            yield lines
        finally:
            process.stdin.close()
            reader.join(MOST_S)
