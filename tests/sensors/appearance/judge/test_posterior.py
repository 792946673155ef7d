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
from rendezview.sensors.appearance.hypothesis import Hypothesis
from rendezview.sensors.appearance.judge.candidates import Candidates
from rendezview.sensors.appearance.model.view_model import ViewModel
from rendezview.sensors.appearance.sky import Sky
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


@pytest.mark.parametrize("sigma_deg", [0.1, 3.0])
def test_of_two_optima_next_to_each_other_the_picture_chooses(model, sigma_deg):
    """Edges that mislead may like the wrong one better; wide covariances make both one optimum."""
    sun = np.array([0.4, -0.5, -0.77])
    frame = render_frame(
        twelve_sides(), CAMERA, TRUTH, sun, SceneOptions(), np.random.default_rng(3)
    )
    search = Recognizer(model, CAMERA, sketch=False).search
    assert search is not None
    turn = Rotation.from_rotvec([0.0, np.deg2rad(3.5), 0.0]).as_matrix()
    beside = Pose(turn @ TRUTH.rotation, TRUTH.translation_m)
    covariance = np.diag([np.deg2rad(sigma_deg) ** 2] * 3 + [1e-4] * 3)

    def one(pose: Pose, outline: float) -> Hypothesis:
        return Hypothesis(pose, covariance, outline, outline, residual_px=0.2, shading=0.5)

    candidates = Candidates(search.levels.whole, None, frame, Sky.of(frame), None)
    candidates.add([one(beside, 0.5), one(TRUTH, 0.45)])
    found = candidates.weighed()
    assert found is not None
    assert found.best.pose is (TRUTH if sigma_deg < 1.0 else beside)
    assert found.posterior == 1.0
