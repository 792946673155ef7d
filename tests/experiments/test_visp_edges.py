"""A mesh as ViSP reads it, and its edge tracker where it is installed."""

from __future__ import annotations

import numpy as np
import pytest
from tests.ground.mesh.mesh_samples import boxes, grey_mesh

from experiments.peers.visp_edges import cao_of, poses
from experiments.pose.photo_accuracy import off
from rendezview import Camera, Pose

BOX = grey_mesh(boxes([((2.0, 1.2, 0.8), (0.3, 0.0, 0.0))]))


def test_flat_faces_of_triangles_become_one_outline_each():
    lines = cao_of(BOX).splitlines()
    assert lines[:2] == ["V1", "8"]
    places = np.array([line.split() for line in lines[2:10]], dtype=np.float64)
    assert lines[10:13] == ["0", "0", "6"]
    for line in lines[13:19]:
        count, *loop = map(int, line.split())
        assert count == len(set(loop)) == 4
        sides = np.diff(places[[*loop, loop[0]]], axis=0)
        assert np.count_nonzero(np.abs(sides) > 1e-9) == 4  # each along one axis, round the face
    assert lines[19:] == ["0", "0"]


def test_its_pose_from_a_start_beside_is_near_the_truth(draw):
    camera = Camera.from_fov(400, 400, np.deg2rad(40.0))
    truth = Pose.from_quat_wxyz([0.1, 0.9, 0.4, -0.2], [0.1, -0.1, 6.0])
    picture = draw(BOX, truth, camera, np.random.default_rng(1))
    start = truth.perturbed([0.03, -0.02, 0.03, 0.03, -0.03, 0.1])
    found = poses(BOX, camera, [(picture, start), (np.zeros_like(picture), start)])
    if found is None:
        pytest.skip("ViSP is not installed")
    assert off(found[0], truth)["rotation_deg"] < 1.5 < off(start, truth)["rotation_deg"]
    assert len(found) == 2
