"""What is given of what was found: near its prior, and likely beside its look-alikes."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rendezview.geometry.pose import Pose
from rendezview.geometry.symmetry import Symmetry
from rendezview.sensors.appearance.edges.refinement import Refined
from rendezview.sensors.appearance.judge.confidence import Found
from rendezview.sensors.appearance.judge.rivals import Weighed
from rendezview.sensors.appearance.verdict import Near, agree

SUN = np.array([0.0, 0.0, -1.0])


def turned(angle_deg: float) -> Pose:
    rotation = Rotation.from_euler("y", angle_deg, degrees=True).as_matrix()
    return Pose(rotation, np.array([0.0, 0.0, 9.0]))


def found(pose: Pose, sigma_deg: float = 0.1, weighed: tuple[Weighed, ...] = ()) -> Found:
    covariance = np.diag([np.deg2rad(sigma_deg) ** 2] * 3 + [1e-4] * 3)
    refined = Refined(
        pose, covariance, outline=0.8, inner=0.6, visible=1.0, residual_px=0.3, light=0.5
    )
    return Found(refined, 0.0, 0.5, dark=True, prior=False, weighed=weighed)


def beside(pose: Pose, probability: float, on_sketch: Pose | None = None) -> Weighed:
    return Weighed(pose, 10.0, 0.1, SUN, probability, on_sketch)


@pytest.mark.parametrize(
    ("apart_deg", "sigma_deg", "kept"), [(7.9, 0.1, True), (8.4, 0.1, False), (12.0, 2.0, True)]
)
def test_an_answer_is_as_near_to_its_prior_as_both_errors_allow(apart_deg, sigma_deg, kept):
    near = Near(turned(20.0), np.deg2rad(8.0))
    answer = found(turned(20.0 + apart_deg), sigma_deg)
    assert near.bounds(answer) is (answer if kept else None)
    assert near.bounds(None) is None


def test_a_pose_agrees_with_those_near_it_that_are_likely_together():
    weighed = found(
        turned(0.0), weighed=(beside(turned(0.0), 0.6), beside(turned(6.0), 0.35),
                              beside(turned(90.0), 0.05)),
    )  # fmt: skip
    assert agree(weighed, found(turned(3.0)), ())
    assert not agree(weighed, found(turned(-4.0)), ())
    assert not agree(weighed, found(turned(90.0)), ())


def test_a_pose_that_the_sketch_leads_to_the_same_one_is_the_same_answer():
    weighed = found(turned(11.0), weighed=(beside(turned(11.0), 0.97, on_sketch=turned(1.0)),))
    assert agree(weighed, found(turned(0.0)), ())
    away = found(turned(11.0), weighed=(beside(turned(11.0), 0.97, on_sketch=turned(12.0)),))
    assert not agree(away, found(turned(0.0)), ())


def test_poses_that_a_symmetry_makes_one_agree():
    half = Symmetry("discrete", np.array([0.0, 1.0, 0.0]), math.pi)
    weighed = found(turned(180.0), weighed=(beside(turned(180.0), 1.0),))
    assert agree(weighed, found(turned(0.0)), (half,))
    assert not agree(weighed, found(turned(0.0)), ())


def test_what_was_not_weighed_contradicts_nothing():
    assert agree(None, found(turned(0.0)), ())
    assert agree(found(turned(90.0)), found(turned(0.0)), ())
