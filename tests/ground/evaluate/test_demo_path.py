"""The path of the demo: one flight, that a tracker can follow from its first frame to its last."""

from __future__ import annotations

from itertools import pairwise
from types import SimpleNamespace

import numpy as np

from rendezview.io.bundled import find_target
from rendezview_ground.evaluate import demo_command


def test_the_camera_neither_jumps_nor_rolls_where_the_two_parts_of_the_path_meet() -> None:
    ring = find_target("client").docking_ring
    assert ring is not None
    model = SimpleNamespace(sphere_radius_m=20.0, centre_m=np.array([1.0, 0.0, 0.2]))
    path, last = demo_command._approach(model, ring, 60, seed=0)  # type: ignore[arg-type]
    assert len(path) == 60
    times = [time_s for time_s, _ in path]
    assert np.diff(times).tolist() == [demo_command._STEP_S] * 59
    poses = [pose for _, pose in path]
    turns = [np.rad2deg(a.angle_to(b)) for a, b in pairwise(poses)]
    # Twice around in 79 steps, and jitter.
    assert max(turns) < 8.0
    assert turns[last - 1] < 4.0
    at = poses[-1].apply(ring.centre_m)
    assert abs(np.linalg.norm(at) - demo_command._LAST_M) < 0.05
