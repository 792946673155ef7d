"""What is given of what was found: near its prior, and likely beside its look-alikes."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rendezview.geometry.pose import Pose
from rendezview.geometry.symmetry import Symmetry
from rendezview.sensors.appearance.hypothesis import Hypothesis
from rendezview.sensors.appearance.judge.found import Found
from rendezview.sensors.appearance.judge.near import Near
from rendezview.sensors.appearance.observation import AppearanceObservation
from rendezview.sensors.appearance.verdict import contradiction, refused
from rendezview.sensors.observation import Status


def turned(angle_deg: float) -> Pose:
    rotation = Rotation.from_euler("y", angle_deg, degrees=True).as_matrix()
    return Pose(rotation, np.array([0.0, 0.0, 9.0]))


def found(pose: Pose, sigma_deg: float = 0.1, probability: float | None = None) -> Found:
    covariance = np.diag([np.deg2rad(sigma_deg) ** 2] * 3 + [1e-4] * 3)
    refined = Hypothesis(
        pose, covariance, outline=0.8, inner=0.6, visible=1.0, residual_px=0.3, light=0.5
    )
    return Found(refined, 0.5, dark=True, prior=False, probability=probability)


def beside(
    pose: Pose, probability: float, on_sketch: Pose | None = None, distinct: float = 1.0
) -> Hypothesis:
    led = None if on_sketch is None else Hypothesis(on_sketch)
    return Hypothesis(pose, probability=probability, on_sketch=led, distinct=distinct)


@pytest.mark.parametrize(
    ("apart_deg", "sigma_deg", "kept"), [(7.9, 0.1, True), (8.4, 0.1, False), (12.0, 2.0, True)]
)
def test_an_answer_is_as_near_to_its_prior_as_both_errors_allow(apart_deg, sigma_deg, kept):
    near = Near(turned(20.0), np.deg2rad(8.0), np.zeros(3))
    answer = found(turned(20.0 + apart_deg), sigma_deg)
    assert near.bounded(answer) is (answer if kept else None)
    assert near.bounded(None) is None


@pytest.mark.parametrize(
    ("share", "error_deg", "near"),
    [(1.2, 20.0, True), (0.8, 20.0, True), (1.3, 20.0, False), (0.7, 60.0, False),
     (1.1, 8.0, True), (1.2, 8.0, False)],
)  # fmt: skip
def test_the_range_of_a_prior_is_as_right_as_its_attitude_a_quarter_at_most(share, error_deg, near):
    prior, centre_m = turned(20.0), np.array([0.5, 0.0, 0.2])
    arm = prior.rotation @ centre_m
    moved = Pose(prior.rotation, share * (prior.translation_m + arm) - arm)
    assert Near(prior, np.deg2rad(error_deg), centre_m).holds(moved) == near


def test_an_ambiguous_pose_is_as_likely_as_it_is_among_its_look_alikes():
    weighed = (beside(turned(0.0), 0.55), beside(turned(90.0), 0.45))
    choice = dataclasses.replace(found(turned(0.0)), weighed=weighed)
    seen = refused(AppearanceObservation(Status.OK), choice)
    assert seen.status is Status.AMBIGUOUS
    assert choice.confidence > 0.9
    assert seen.confidence == 0.55
    unlikely = dataclasses.replace(choice, probability=0.2)  # a sketch counts them already
    assert refused(AppearanceObservation(Status.OK), unlikely).confidence == 0.2


def sketched(pose: Pose, probability: float) -> Found:
    return found(pose, probability=probability)


def odds(probability: float) -> float:
    return probability / (1.0 - probability)


def test_the_odds_of_a_sketch_and_of_its_look_alikes_are_multiplied():
    weighed = (beside(turned(0.0), 0.6), beside(turned(6.0), 0.2), beside(turned(90.0), 0.2))
    together = sketched(turned(3.0), 0.8).beside(weighed, ())
    assert odds(together.posterior) == pytest.approx(odds(0.8) ** 2)
    assert together.confidence == 0.8  # the pictures say nothing of poses that nobody drew
    assert sketched(turned(90.0), 0.8).beside(weighed, ()).confidence == pytest.approx(0.5)
    assert sketched(turned(45.0), 0.99).beside(weighed, ()).confidence == 0.0


def test_a_sure_search_does_not_choose_between_poses_whose_pictures_are_the_same():
    weighed = (beside(turned(0.0), 0.6), beside(turned(90.0), 0.4, distinct=0.0))
    assert sketched(turned(0.0), 0.999).beside(weighed, ()).confidence == pytest.approx(0.6)
    half = (beside(turned(0.0), 0.6), beside(turned(90.0), 0.4, distinct=0.5))
    together = sketched(turned(0.0), 0.9).beside(half, ())
    assert odds(together.posterior) == pytest.approx(odds(0.6) * math.sqrt(odds(0.9)))
    # The likeliest differs from the pose as the pose does from it.
    other = (beside(turned(90.0), 0.6, distinct=0.0), beside(turned(0.0), 0.4, distinct=0.0))
    assert sketched(turned(0.0), 0.999).beside(other, ()).confidence == pytest.approx(0.4)
    assert sketched(turned(0.0), 1.0).beside(other, ()).confidence == pytest.approx(0.4)


def test_look_alikes_that_are_unlikely_do_not_save_a_bad_pose():
    weighed = (beside(turned(0.0), 0.99), beside(turned(90.0), 0.01))
    assert sketched(turned(0.0), 0.4).beside(weighed, ()).confidence == 0.4
    together = sketched(turned(0.0), 0.6).beside(weighed, ())
    assert odds(together.posterior) == pytest.approx(odds(0.6) * odds(0.95))
    assert together.confidence == 0.6


def test_a_pose_without_rivals_keeps_its_confidence():
    alone = sketched(turned(2.0), 0.7)
    assert alone.beside((beside(turned(0.0), 1.0),), ()) is alone
    assert alone.beside((beside(turned(90.0), 1.0),), ()).confidence == 0.0


def test_a_pose_that_the_sketch_leads_to_the_same_one_is_the_same_answer():
    rival = beside(turned(90.0), 0.05)
    led = (beside(turned(11.0), 0.95, on_sketch=turned(1.0)), rival)
    assert sketched(turned(0.0), 0.7).beside(led, ()).posterior > 0.95
    away = (beside(turned(11.0), 0.95, on_sketch=turned(12.0)), rival)
    assert sketched(turned(0.0), 0.7).beside(away, ()).confidence == 0.0


def test_poses_that_a_symmetry_makes_one_agree():
    half = Symmetry("discrete", np.array([0.0, 1.0, 0.0]), math.pi)
    weighed = (beside(turned(180.0), 0.9), beside(turned(90.0), 0.1))
    assert sketched(turned(0.0), 0.7).beside(weighed, (half,)).posterior > 0.9
    assert sketched(turned(0.0), 0.7).beside(weighed, ()).confidence == 0.0


def test_a_sketch_that_shows_another_pose_speaks_against_one_of_grey_edges():
    given = found(turned(20.0))
    assert contradiction(given, sketched(turned(27.0), 0.9), ()) is None
    assert "40° apart" in contradiction(given, sketched(turned(60.0), 0.9), ())
    half = Symmetry("discrete", np.array([0.0, 1.0, 0.0]), math.pi)
    assert contradiction(given, sketched(turned(200.0), 0.9), (half,)) is None
