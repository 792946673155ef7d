"""Poses of grey edges that a pose on a sketch confirms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.geometry.symmetry import Symmetry
from rendezview.sensors.appearance import AppearanceObservation
from rendezview.sensors.appearance.hypothesis import Hypothesis
from rendezview.sensors.appearance.judge.found import Found, agree, one_answer
from rendezview.sensors.appearance.pose_finder import PoseFinder
from rendezview.sensors.observation import Status

SEEN = Pose(Rotation.from_euler("xyz", [20.0, 40.0, 60.0], degrees=True).as_matrix(),
            np.array([1.0, -2.0, 30.0]))  # fmt: skip
HALF_TURN = Symmetry("discrete", np.array([0.0, 0.0, 1.0]), np.pi)


def covariance(sigma_deg: float, sigma_m: float) -> np.ndarray:
    return np.diag([np.deg2rad(sigma_deg) ** 2] * 3 + [sigma_m**2] * 3)


def moved(degrees: float, metres: float) -> Pose:
    turn = Rotation.from_euler("x", degrees, degrees=True).as_matrix()
    return Pose(turn @ SEEN.rotation, SEEN.translation_m + np.array([0.0, 0.0, metres]))


def on_sketch() -> Found:
    best = Hypothesis(SEEN, covariance(2.0, 0.3))
    return Found(best, 4.0, dark=True, prior=False, probability=0.98)


def by_grey_edges(pose: Pose, sigma: np.ndarray | None) -> Found:
    return Found(Hypothesis(pose, sigma), 0.1, dark=True, prior=False)


def test_a_finer_pose_within_both_errors_is_taken_with_the_confidence_of_the_sketch() -> None:
    grey = by_grey_edges(moved(6.0, 0.5), covariance(0.1, 0.01))
    given = on_sketch().confirming(grey, [])
    assert given.best is grey.best
    assert given.confidence == 0.98


@pytest.mark.parametrize(
    ("degrees", "metres", "sigma"),
    [
        (9.0, 0.0, covariance(0.1, 0.01)),  # 4.5 σ apart in attitude
        (0.0, 1.5, covariance(0.1, 0.01)),  # 5 σ in range
        (1.0, 0.1, covariance(3.0, 0.5)),  # agrees, and is less sure
        (1.0, 0.1, None),
    ],
)
def test_another_pose_or_one_that_is_no_finer_is_not(
    degrees: float, metres: float, sigma: np.ndarray | None
) -> None:
    sketched = on_sketch()
    assert sketched.confirming(by_grey_edges(moved(degrees, metres), sigma), []) is sketched


def test_poses_alike_by_a_symmetry_agree() -> None:
    turned = Pose(SEEN.rotation @ np.diag([-1.0, -1.0, 1.0]), SEEN.translation_m)
    grey = by_grey_edges(turned, covariance(0.1, 0.01))
    assert on_sketch().confirming(grey, [HALF_TURN]).best is grey.best
    assert on_sketch().confirming(grey, []).best is not grey.best


@pytest.mark.parametrize(("degrees", "share"), [(1.0, 0.83), (20.0, 0.17), (60.0, 0.0)])
def test_a_pose_aligned_alone_is_no_surer_than_the_look_alike_that_it_is(degrees, share) -> None:
    """One that is none of those weighed was not drawn: nothing speaks for it."""
    weighed = [Hypothesis(moved(0.0, 0.0), probability=0.83),
               Hypothesis(moved(20.0, 0.0), probability=0.17)]  # fmt: skip
    alone = by_grey_edges(moved(degrees, 0.0), None)
    assert alone.posterior == 1.0
    assert alone.known_among(weighed, []).posterior == pytest.approx(share)


@pytest.mark.parametrize(
    "sigmas_deg", [(0.3, 0.3, 0.3), (3.0, 3.0, 3.0), (0.5, 1.0, 8.0), (7.3, 7.3, 7.3)]
)
def test_a_pose_is_right_to_5_degrees_as_far_as_its_covariance_allows(sigmas_deg) -> None:
    """Few edges fit a craft in shadow: its pose was 17° off, σ 7° an axis, and 0.86 sure."""
    turn = np.diag(np.deg2rad(sigmas_deg) ** 2)
    both = covariance(1.0, 0.1)
    both[:3, :3] = turn
    wide = Found(Hypothesis(SEEN, both), 1.0, dark=True, prior=True, probability=0.98)
    errors = np.random.default_rng(3).multivariate_normal(np.zeros(3), turn, 100_000)
    share = np.mean(np.linalg.norm(errors, axis=1) < np.deg2rad(5.0))
    assert wide.share_within(np.deg2rad(5.0)) == pytest.approx(share, abs=0.05)
    assert wide.right == pytest.approx(wide.certainty * share, abs=0.05)


@pytest.mark.parametrize(("sigma_deg", "given"), [(0.3, True), (3.0, True), (7.3, False)])
def test_a_pose_that_may_well_be_10_degrees_off_is_not_given(
    refining_model, sigma_deg, given
) -> None:
    finder = PoseFinder(refining_model, Camera.from_fov(640, 480, 0.9), None, None, refine=True,
                        trees=False, sketch=False, least_confidence=0.6)  # fmt: skip
    best = Hypothesis(SEEN, covariance(sigma_deg, 0.1))
    found = Found(best, 1.0, dark=True, prior=True, probability=0.98)
    judged = finder.judged(AppearanceObservation(Status.OK, found=found))
    assert (judged.pose is not None) == given
    assert judged.confidence == found.right


def test_an_answer_has_the_probability_and_the_spread_of_its_optima() -> None:
    near, far = moved(3.0, 0.1), moved(20.0, 0.0)
    weighed = [Hypothesis(SEEN, covariance(0.2, 0.01), probability=0.6),
               Hypothesis(near, covariance(0.4, 0.02), probability=0.2),
               Hypothesis(far, covariance(0.2, 0.01), probability=0.2)]  # fmt: skip
    answer, other = one_answer(weighed, [])
    assert answer.pose is SEEN
    assert other is weighed[2]
    assert answer.probability == pytest.approx(0.8)
    rng = np.random.default_rng(5)
    first = rng.multivariate_normal(np.zeros(6), weighed[0].covariance, 60_000)
    second = rng.multivariate_normal(near.delta_from(SEEN), weighed[1].covariance, 20_000)
    errors = np.concatenate([first, second])
    drawn = errors.T @ errors / len(errors)
    sigmas = np.sqrt(np.diag(answer.covariance))
    assert np.abs(answer.covariance - drawn).max() < 0.03 * np.outer(sigmas, sigmas).max()


def test_optima_of_no_probability_leave_an_answer_as_it_is() -> None:
    best = Hypothesis(SEEN, covariance(0.2, 0.01), probability=1.0)
    there = Hypothesis(moved(3.0, 0.1), covariance(0.4, 0.02), probability=0.0)
    answer = one_answer([best, there], [])[0]
    assert (answer.covariance == best.covariance).all()


@pytest.mark.parametrize(("sigma_deg", "agreed"), [(0.2, False), (2.0, True)])
def test_poses_agree_that_differ_by_no_more_than_their_covariances(sigma_deg, agreed) -> None:
    a = Hypothesis(SEEN, covariance(sigma_deg, 0.1))
    b = Hypothesis(moved(3.0, 0.0), covariance(0.2, 0.1))
    assert agree(a, b, []) is agreed
    assert agree(a, replace(b, covariance=None), [])
