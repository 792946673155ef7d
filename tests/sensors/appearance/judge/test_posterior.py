"""The probability of a pose among its look-alikes, by one frame of a body with twelve sides."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.made_once import made_once
from tests.quick_training import REFINING
from tests.sensors.appearance.judge.near_symmetric import twelve_sides

from rendezview.geometry.pose import Pose
from rendezview.sensors.appearance import Recognizer
from rendezview.sensors.appearance.model.view_model import ViewModel
from rendezview_ground.learn.job import train
from rendezview_ground.simulate.command import default_camera
from rendezview_ground.simulate.scene import SceneOptions, render_frame

CAMERA = default_camera()
TRUTH = Pose(
    Rotation.from_euler("xyz", [60.0, 15.0, 20.0], degrees=True).as_matrix(),
    np.array([0.1, -0.1, 9.0]),
)


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> ViewModel:
    def trained(path):
        train(twelve_sides(), path, name="drum", options=REFINING, jobs=1)

    return ViewModel.load(made_once(tmp_path_factory, "drum.rvm", trained))


def test_a_pose_and_its_look_alike_share_the_probability_of_a_frame(model):
    sun = np.array([0.4, -0.5, -0.77])
    rng = np.random.default_rng(3)
    frame = render_frame(twelve_sides(), CAMERA, TRUTH, sun, SceneOptions(), rng)
    recognizer = Recognizer(model, CAMERA, sketch=False)
    turn = Rotation.from_euler("z", 30.0, degrees=True).as_matrix()
    turned = Pose(TRUTH.rotation @ turn, TRUTH.translation_m)
    assert recognizer.posterior(frame, TRUTH) > 0.99
    assert recognizer.posterior(frame, turned) < 0.01
    seen = recognizer.recognize(frame)
    assert seen.pose.angle_to(TRUTH) < np.deg2rad(1.0)
    assert seen.found.weighed
    assert seen.confidence <= seen.found.posterior
