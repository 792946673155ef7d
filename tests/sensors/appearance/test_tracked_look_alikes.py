"""A tracked pose is no surer than the search that found it, until other views say more."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.sensors.appearance.test_tracker import (
    A_LITTLE_NEARER,
    FRAME,
    NEARER,
    TURNED,
    A,
    Restarting,
    Script,
)

from rendezview.geometry.pose import Pose
from rendezview.sensors.appearance import AppearanceObservation, Tracker
from rendezview.sensors.appearance.hypothesis import Hypothesis
from rendezview.sensors.appearance.judge.found import Found
from rendezview.sensors.observation import Status


class LookAlikes(Script):
    """Its first frame gives A a probability of 0.95 beside B turned; later views say more."""

    def __init__(self, *later: float) -> None:
        super().__init__()
        self.later, self.asked, self.turned = list(later), 0, 0.0

    @property
    def pose(self) -> Pose:
        return Pose(Rotation.from_rotvec([0.0, self.turned, 0.0]).as_matrix(), A.translation_m)

    def recognize(self, image, prior=None, *options, time_s, **others) -> AppearanceObservation:
        self.priors.append(prior)
        near = prior is not None
        shares = () if near else ((self.pose, 0.95), (A @ TURNED, 0.05))
        weighed = tuple(Hypothesis(pose, probability=share) for pose, share in shares)
        found = Found(Hypothesis(self.pose), 1.0, True, near, weighed=weighed)
        return AppearanceObservation(
            Status.OK, pose=self.pose, confidence=0.99, time_s=time_s, found=found
        )

    def posterior(self, image, pose, sun_camera=None) -> float:
        self.asked += 1
        return self.later.pop(0)


def followed(script: LookAlikes, turn_deg: float, frames: int) -> list[AppearanceObservation]:
    tracker, looks = Tracker(script), []
    for k in range(frames):
        looks.append(tracker.update(float(k), FRAME))
        script.turned += np.deg2rad(turn_deg)
    return looks


def test_a_tracked_pose_is_no_surer_than_the_first_one_beside_its_look_alikes():
    script = LookAlikes()
    looks = followed(script, 0.5, 6)  # one view: it says nothing new
    assert [look.confidence for look in looks] == [0.95] * 6
    assert script.asked == 0


def test_other_views_settle_which_of_two_look_alikes_is_tracked():
    script = LookAlikes(0.6, 0.6, 0.99)
    looks = followed(script, 4.0, 6)
    # Odds of 19 times 1.5, 1.5 and 99; the pose itself has 0.99.
    assert looks[1].confidence == pytest.approx(28.5 / 29.5)
    assert looks[2].confidence == pytest.approx(42.75 / 43.75)
    assert [look.confidence for look in looks[3:]] == [0.99] * 3
    assert script.asked == 3


def test_a_track_that_another_view_contradicts_begins_anew():
    script = LookAlikes(0.2, 0.95)
    looks = followed(script, 4.0, 3)
    # Odds of 19 times 1/4.
    assert looks[1].status is Status.AMBIGUOUS
    assert looks[1].pose is None
    assert looks[1].confidence == pytest.approx(4.75 / 5.75)
    assert "probability of 0.83 beside its look-alikes" in looks[1].reason
    assert script.priors[2] is None
    assert looks[2].confidence == 0.95


def test_a_prior_is_no_surer_than_it_is_said_to_be():
    """As after a restart of the service, which knows the last confidence."""
    script = LookAlikes(0.9)
    tracker, looks = Tracker(script, script.pose, prior_posterior=0.95), []
    for k, turn_deg in enumerate((0.5, 4.0)):
        looks.append(tracker.update(float(k), FRAME).confidence)
        script.turned += np.deg2rad(turn_deg)
    looks.append(tracker.update(2.0, FRAME).confidence)
    assert looks == pytest.approx([0.95, 0.95, 0.99])  # odds of 19, 19 and 171


class Doubtful(Restarting):
    """Finds nothing near a pose in two frames; each search gives a probability of 0.95."""

    def __init__(self, place: Pose) -> None:
        super().__init__()
        self.place = place

    def recognize(self, image, prior=None, *options, time_s, **others) -> AppearanceObservation:
        if prior is not None and not np.allclose(prior.translation_m, self.place.translation_m):
            return AppearanceObservation(Status.LOST, "nothing near", time_s=time_s)
        shares = (0.95, 0.05) if prior is None else ()
        weighed = tuple(Hypothesis(self.place, probability=share) for share in shares)
        found = Found(Hypothesis(self.place), 1.0, dark=True, prior=prior is not None,
                      weighed=weighed, probability=0.99)  # fmt: skip
        return AppearanceObservation(
            Status.OK, pose=self.place, confidence=0.99, time_s=time_s, found=found
        )


@pytest.mark.parametrize("place", [A_LITTLE_NEARER, NEARER], ids=["at once", "confirmed"])
def test_after_a_restart_a_pose_is_no_surer_than_the_search_that_found_it(place):
    """Also where the frame after it had to confirm it, next to it."""
    tracker = Tracker(Doubtful(place), A)
    looks = [tracker.update(float(k), FRAME) for k in range(6)]
    given = [look.confidence for look in looks if look.pose is not None]
    assert given == [0.95] * len(given)
    assert len(given) >= 3


@pytest.mark.parametrize("posterior", [-0.1, 1.1, float("nan")])
def test_a_probability_that_is_none_is_refused(posterior):
    with pytest.raises(ValueError, match="prior_posterior must be 0 to 1"):
        Tracker(LookAlikes(), A, prior_posterior=posterior)
