"""Poses for ROS 2 over Zenoh: another process receives them and decodes them as ROS's types."""

from __future__ import annotations

import contextlib
import itertools
import json
import subprocess
import sys
import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from tests.waiting import MOST_S, ends_in_time, free_port, wait_until

from rendezview.errors import RendezviewError
from rendezview_service.hub.viewers import Viewers
from rendezview_service.settings import Settings

zenoh = pytest.importorskip("zenoh")

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
            print(json.dumps({"topic": "/".join(topic), "known": known, "text": message.data}))
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


def test_a_node_receives_poses_and_frames(start_service, camera, tour) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    states: dict[int, Any] = {}
    with node(endpoint) as received:
        served = start_service("--ros", endpoint)
        frames = itertools.count()
        with (
            served.client() as client,
            client.open(camera, name="7-live", prior=tour[0][1]) as session,
        ):

            def several() -> bool:
                k = next(frames)
                picture, later_s = tour[min(k, len(tour) - 1)], max(0, k - len(tour) + 1)
                state = session.track(picture[2], 1_790_000_000 + picture[0] + later_s)
                states[round(1e3 * state["time_s"])] = state
                return len(received) >= 6

            wait_until(several, lambda: received)
        served.stop()
    assert not [line for line in served.lines if "live stream failed" in line]
    poses = [line for line in received if line["topic"] == "_7_live/target/pose"]
    trees = [line for line in received if line["topic"] == "tf"]
    assert [line["number"] for line in poses] == list(range(1, len(poses) + 1))
    assert len(poses) == len(trees) >= 3
    assert {line["child"] for line in trees} == {"_7_live/target"}
    order = [3, 4, 5, 0, 1, 2]  # ROS has the translation first
    for line in received:
        assert line["known"]
        assert line["sender"]
        assert line["domain"] == "0"
        assert line["frame"] == "_7_live/camera"
        state = states[round(1e3 * line["sec"] + 1e-6 * line["nanosec"])]
        np.testing.assert_allclose(line["xyz"], state["pose"]["translation_m"])
        if line["covariance"] is not None:
            ours = np.array(state["covariance"])[np.ix_(order, order)]
            np.testing.assert_allclose(np.reshape(line["covariance"], (6, 6)), ours)


def test_a_router_that_is_not_there_is_named() -> None:
    live = Viewers(Settings(ros_endpoint=f"tcp/127.0.0.1:{free_port()}"))
    with pytest.raises(
        RendezviewError, match=r"does not start: no Zenoh router at tcp/127\.0\.0\.1"
    ):
        live.start()
