"""The tracker's memory: what it expects of the next frame, and when it forgets."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rendezview.errors import RendezviewError
from rendezview.geometry.geodesic import angle_between
from rendezview.geometry.pose import Pose
from rendezview.geometry.symmetry import Symmetry
from rendezview.sensors.appearance import (
    AppearanceObservation,
    Recognizer,
    Tracker,
    TrackerOptions,
)
from rendezview.sensors.appearance.outline.votes import MatchOptions
from rendezview.sensors.observation import Status


class Script:
    """A recognizer that gives prepared answers and keeps the priors it gets."""

    def __init__(self) -> None:
        self.priors: list[Pose | None] = []
        self.reach_deg: list[float] = []
        self.answer: Pose | None = None
        self.prior_error_rad = MatchOptions().prior_error_rad
        self.model = SimpleNamespace(centre_m=np.zeros(3), target_radius_m=1.0, symmetries=())
        self.search = None
        self.overflows = lambda pose: False
        self.place_of = lambda image, pose: None

    def recognize(
        self,
        image,
        prior=None,
        prior_error_rad=None,
        sun_camera=None,
        enough_inliers=1.0,
        *,
        angles_rad=None,
        time_s,
        roi=None,
        thorough=True,
    ) -> AppearanceObservation:
        self.priors.append(prior)
        self.reach_deg.append(round(np.rad2deg(prior_error_rad), 6))
        if self.answer is None:
            return AppearanceObservation(Status.EMPTY, "nothing", time_s=time_s)
        return AppearanceObservation(Status.OK, pose=self.answer, time_s=time_s)


A, B = (Pose(np.eye(3), [0.0, 0.0, z]) for z in (5.0, 6.0))
FRAME = np.zeros((4, 4), np.uint8)


@pytest.fixture
def script() -> Script:
    return Script()


@pytest.mark.requirement("RV-TRACK-1")
def test_each_pose_is_the_prior_of_the_next_frame(script):
    tracker = Tracker(script)
    for time_s, answer in enumerate([A, A, A]):
        script.answer = answer
        assert tracker.update(time_s, FRAME).pose is answer
        assert tracker.prior is answer
    assert script.priors == [None, A, A]


def test_the_next_pose_is_predicted_by_constant_velocity(script):
    """Turning at 0.1 rad/s about the boresight and receding at 1 m/s, looked at after 2 s."""
    tracker = Tracker(script)
    start = Rotation.from_rotvec([0.2, -0.4, 0.1])
    for time_s in (0.0, 1.0):
        spin = Rotation.from_rotvec([0.0, 0.0, 0.1 * time_s]) * start
        script.answer = Pose(spin.as_matrix(), [0.1, 0.0, 5.0 + time_s])
        tracker.update(time_s, FRAME)
    tracker.update(3.0, FRAME)
    expected = Rotation.from_rotvec([0.0, 0.0, 0.3]) * start
    assert script.priors[2].rotation == pytest.approx(expected.as_matrix())
    assert script.priors[2].translation_m == pytest.approx([0.1, 0.0, 8.0])


def test_the_prior_is_kept_over_misses_and_the_search_widens(script):
    options = TrackerOptions(widening_rad=np.deg2rad(10.0), widest_rad=np.deg2rad(45.0))
    tracker = Tracker(script, options=options)
    script.answer = A
    tracker.update(0.0, FRAME)
    script.answer = None
    for k in range(5):
        assert tracker.update(1.0 + k, FRAME).status is Status.EMPTY
        assert tracker.prior is A
    assert script.priors == [None, A, A, A, A, A]
    assert script.reach_deg == [20.0, 20.0, 30.0, 40.0, 45.0, 45.0]


def test_a_hit_after_misses_narrows_the_search_again(script):
    tracker = Tracker(script)
    for time_s, answer in enumerate([A, None, A, None, A]):
        script.answer = answer
        tracker.update(time_s, FRAME)
    assert script.priors == [None, A, A, A, A]
    assert script.reach_deg == [20.0, 20.0, 30.0, 20.0, 30.0]


def test_a_lost_target_is_searched_where_it_is_expected(script):
    """Once, only while it is lost, and only where the expected attitude is known well enough."""
    sure, unsure = (np.diag([sigma**2] * 3 + [0.01] * 3) for sigma in (0.05, 0.5))
    tracker = Tracker(script)
    tracker.expect(B, sure)
    script.answer = A
    assert tracker.update(0.0, FRAME).pose is A
    tracker.expect(B, sure)  # not lost
    tracker.update(1.0, FRAME)
    script.answer = None
    tracker.update(2.0, FRAME)
    assert tracker.lost
    tracker.expect(B, unsure)
    tracker.update(3.0, FRAME)
    tracker.expect(B, sure)
    tracker.update(4.0, FRAME)
    tracker.update(5.0, FRAME)
    assert [p if p is None else p.translation_m[2] for p in script.priors] == [
        6.0, 5.0, 5.0, 5.0, 6.0, 5.0, 5.0,
    ]  # fmt: skip
    assert script.reach_deg[4] == pytest.approx(np.rad2deg(0.15) + 3.0)
    script.answer = B
    tracker.expect(B, sure)
    assert tracker.update(6.0, FRAME).pose is B
    assert tracker.rates is None  # of the poses before it was lost
    for wrong in (np.eye(3), np.full((6, 6), np.nan)):
        with pytest.raises(ValueError, match="covariance"):
            tracker.expect(B, wrong)


def test_a_first_prior_that_is_never_met_is_forgotten_too(script):
    tracker = Tracker(script, A, TrackerOptions(longest_outage_s=10.0))
    for time_s in (100.0, 105.0, 110.0, 110.1):
        tracker.update(time_s, FRAME)
    assert script.priors == [A, A, A, None]


@pytest.mark.requirement("RV-TRACK-1")
def test_the_prior_is_forgotten_after_an_outage(script):
    tracker = Tracker(script, options=TrackerOptions(longest_outage_s=10.0))
    script.answer = A
    tracker.update(0.0, FRAME)
    tracker.update(10.0, FRAME)
    tracker.update(20.5, FRAME)
    assert script.priors == [None, A, None]


@pytest.mark.parametrize("time_s", [4.9, 5.0, float("nan"), float("inf"), -1.0])
def test_time_that_does_not_go_forward_is_refused_and_changes_nothing(script, time_s):
    tracker = Tracker(script)
    script.answer = A
    tracker.update(5.0, FRAME)
    script.answer = B
    with pytest.raises(ValueError, match="order of time"):
        tracker.update(time_s, FRAME)
    assert tracker.prior is A
    assert len(script.priors) == 1
    tracker.update(5.1, FRAME)


def test_a_tumbling_target_is_followed_from_frame_to_frame(tiny_model, camera, bumpy_mesh, draw):
    rng = np.random.default_rng(0)
    rate = np.deg2rad([4.0, -3.0, 2.0])  # per frame
    start = Rotation.from_rotvec([0.4, 1.0, 0.2])
    recognizer = Recognizer(tiny_model, camera)
    tracker: Tracker | None = None
    worst = 0.0
    for k in range(12):
        rotation = (Rotation.from_rotvec(k * rate) * start).as_matrix()
        centre = np.array([0.5 - 0.1 * k, 0.05 * k, 9.0 + 0.3 * k])
        truth = Pose(rotation, centre - rotation @ tiny_model.centre_m)
        tracker = tracker or Tracker(recognizer, truth)
        observation = tracker.update(0.1 * k, draw(bumpy_mesh, truth, camera, rng))
        assert observation.status is Status.OK, observation.reason
        worst = max(worst, observation.pose.angle_to(truth))
        assert observation.pose.apply(tiny_model.centre_m) == pytest.approx(
            centre, rel=0.1, abs=0.2
        )
    assert np.rad2deg(worst) < 20.0


def test_a_frame_of_the_wrong_size_leaves_the_prior(tiny_model, camera):
    tracker = Tracker(Recognizer(tiny_model, camera), A)
    with pytest.raises(RendezviewError, match="camera is"):
        tracker.update(0.0, FRAME)
    assert tracker.prior is A
    line = tracker.prior.rotation[2]
    assert float(angle_between(line, [0.0, 0.0, 1.0])) == 0.0


class TwoPoses(Script):
    """A recognizer whose frames leave two poses, until one tells them apart."""

    def __init__(self) -> None:
        super().__init__()
        self.told = False

    def recognize(self, image, prior=None, *options, time_s, **others) -> AppearanceObservation:
        self.priors.append(prior)
        if not self.told:
            return AppearanceObservation(Status.AMBIGUOUS, "two", time_s=time_s)
        return AppearanceObservation(Status.OK, pose=A, time_s=time_s)


def test_a_frame_after_an_ambiguous_one_is_searched_as_the_first_was():
    """Followed, one of two poses leads by the chance of its edges."""
    script = TwoPoses()
    tracker = Tracker(script)
    for k in range(4):
        assert tracker.update(float(k), FRAME).status is Status.AMBIGUOUS
    script.told = True
    assert tracker.update(4.0, FRAME).pose is A
    assert tracker.update(5.0, FRAME).pose is A
    assert script.priors == [*5 * [None], A]


# Half a turn about an axis through (0.5, 0, 0), beside the origin.
HALF_TURN = Symmetry("discrete", np.array([0.0, 0.0, 1.0]), np.pi, np.array([0.5, 0.0, 0.0]))
TURNED = Pose(np.diag([-1.0, -1.0, 1.0]), np.array([1.0, 0.0, 0.0]))


class Restarting(Script):
    """Sees nothing near a prior for two frames; then everywhere finds the pose turned by half."""

    def __init__(self) -> None:
        super().__init__()
        self.search = object()
        self.blind = self.restarted = False

    def recognize(self, image, prior=None, *options, time_s, **others) -> AppearanceObservation:
        if prior is None:
            self.restarted = self.blind
            pose = A @ TURNED if self.blind else A
            return AppearanceObservation(Status.OK, pose=pose, confidence=0.95, time_s=time_s)
        near = prior.angle_to(A) < 0.1 and np.allclose(prior.translation_m, A.translation_m)
        if near and self.blind is self.restarted:
            return AppearanceObservation(Status.OK, pose=A, confidence=0.95, time_s=time_s)
        return AppearanceObservation(Status.LOST, "nothing near", time_s=time_s)


def test_a_restart_gives_the_pose_that_was_tracked_of_those_that_look_alike():
    script = Restarting()
    script.model.symmetries = (HALF_TURN,)
    tracker = Tracker(script)
    assert tracker.update(0.0, FRAME).pose is A
    script.blind = True
    looks = [tracker.update(float(k), FRAME) for k in (1, 2, 3)]
    assert [look.pose for look in looks[:2]] == [None, None]
    assert looks[2].pose.angle_to(A) == pytest.approx(0.0, abs=1e-9)


class Reappearing(Script):
    """Sees nothing near A; everywhere finds a pose, which may be there in the next frame, too."""

    def __init__(self, pose: Pose, *, stays: bool) -> None:
        super().__init__()
        self.search, self.pose, self.stays, self.blind = object(), pose, stays, False

    def recognize(self, image, prior=None, *options, time_s, **others) -> AppearanceObservation:
        if not self.blind:
            return AppearanceObservation(Status.OK, pose=A, confidence=0.95, time_s=time_s)
        there = prior is not None and prior.angle_to(self.pose) < 0.1
        there &= prior is not None and np.allclose(prior.translation_m, self.pose.translation_m)
        if prior is None or (there and self.stays):
            return AppearanceObservation(Status.OK, pose=self.pose, confidence=0.95, time_s=time_s)
        return AppearanceObservation(Status.LOST, "nothing near", time_s=time_s)


NEARER = Pose(A.rotation, 0.4 * np.asarray(A.translation_m))
A_LITTLE_NEARER = Pose(A.rotation, 0.9 * np.asarray(A.translation_m))


def after_it_was_lost(script: Reappearing, frames: int) -> list[AppearanceObservation]:
    """The frames after one with a pose, from which on nothing is seen near it."""
    tracker = Tracker(script)
    tracker.update(0.0, FRAME)
    script.blind = True
    return [tracker.update(float(k), FRAME) for k in range(1, 1 + frames)]


@pytest.mark.parametrize("pose", [NEARER, A @ TURNED], ids=["range", "attitude"])
def test_a_restart_far_from_where_the_target_was_lost_waits_for_the_next_frame(pose):
    looks = after_it_was_lost(Reappearing(pose, stays=True), 4)
    assert [look.pose for look in looks] == [None, None, None, pose]
    assert looks[2].status is Status.AMBIGUOUS
    assert "next frame" in looks[2].reason


def test_a_restart_that_the_next_frame_does_not_confirm_is_never_given():
    looks = after_it_was_lost(Reappearing(NEARER, stays=False), 11)
    assert all(look.pose is None for look in looks)


def test_a_restart_near_the_last_pose_is_given_at_once():
    looks = after_it_was_lost(Reappearing(A_LITTLE_NEARER, stays=True), 3)
    assert [look.pose for look in looks] == [None, None, A_LITTLE_NEARER]
