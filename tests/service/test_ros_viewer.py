"""Poses for ROS 2 over Zenoh: another process receives them and decodes them as ROS's types."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from tests.waiting import free_port, wait_until

from rendezview.errors import RendezviewError
from rendezview_service.hub.viewers import Viewers
from rendezview_service.settings import Settings


def test_a_node_receives_poses_and_frames(watched, camera, tour) -> None:
    states: dict[int, Any] = {}
    frames = itertools.count()

    def of(topic: str) -> list[Any]:
        lines = [line for line in watched.received if line.get("frame") == "_7_live/camera"]
        return [line for line in lines if line["topic"] == topic]

    def poses_and_trees() -> tuple[list[Any], list[Any]]:
        return of("_7_live/target/pose"), of("tf")

    with (
        watched.served.client() as client,
        client.open(camera, name="7-live", prior=tour[0][1]) as session,
    ):

        def several() -> bool:
            k = next(frames)
            picture, later_s = tour[min(k, len(tour) - 1)], max(0, k - len(tour) + 1)
            state = session.track(picture[2], 1_790_000_000 + picture[0] + later_s)
            states[round(1e3 * state["time_s"])] = state
            return all(len(lines) >= 3 for lines in poses_and_trees())

        wait_until(several, poses_and_trees)
    wait_until(lambda: len({*map(len, poses_and_trees())}) == 1, poses_and_trees)
    assert not [line for line in watched.served.lines if "live stream failed" in line]
    poses, trees = poses_and_trees()
    assert [line["number"] for line in poses] == list(range(1, len(poses) + 1))
    assert {line["child"] for line in trees} == {"_7_live/target"}
    order = [3, 4, 5, 0, 1, 2]  # ROS has the translation first
    for line in poses + trees:
        assert line["known"]
        assert line["sender"]
        assert line["domain"] == "0"
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
