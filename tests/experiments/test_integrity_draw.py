"""Wrong poses that look alike, at which tracks are begun on purpose."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from experiments.integrity.draw import CAMERA, CONDITIONS, OFF, alike, is_off, looks
from rendezview.geometry.pose import Pose
from rendezview.geometry.so3 import exp
from rendezview.sensors.appearance import Recognizer

SHORT = replace(CONDITIONS["low Sun"], frames=6)


def test_poses_that_look_alike_have_the_targets_place(refining_model, bumpy_mesh, draw):
    recognizer = Recognizer(refining_model, CAMERA)
    rotation, centre = exp(np.array([0.4, -0.3, 0.2])), np.array([0.0, 0.0, 9.0])
    truth = Pose(rotation, centre - rotation @ refining_model.centre_m)
    picture = draw(bumpy_mesh, truth, CAMERA, np.random.default_rng(1))
    poses = list(alike(recognizer, picture, truth, bumpy_mesh))
    assert not is_off(poses[0], truth, refining_model)  # the recognizer's own is right
    turned = poses[-4:]
    for pose in turned:
        assert np.allclose(pose.apply(refining_model.centre_m), centre)
    halves = [pose.angle_to(truth) for pose in turned[:3]]
    assert np.allclose(halves, np.pi)
    # Depth reversed: the flat side's normal is as much on the other side of the view.
    assert sum(is_off(pose, truth, refining_model) for pose in poses) >= 3
    assert not is_off(None, truth, refining_model)


def test_a_misled_track_ends_where_it_is_no_longer_wrong(refining_model, bumpy_mesh):
    recognizer = Recognizer(refining_model, CAMERA)
    plain = looks(recognizer, bumpy_mesh, SHORT, np.random.default_rng(3))
    assert plain[0]["error"] is not None
    misled = looks(recognizer, bumpy_mesh, SHORT, np.random.default_rng(3), True)
    assert all(np.linalg.norm(line["error"][:3]) > OFF for line in misled)
    assert len(misled) < len(plain)
