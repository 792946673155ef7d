"""Recognition over a sequence: each pose predicts the next frame's."""

from __future__ import annotations

import threading
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import expit, logit

from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Array, Pose
from rendezview.geometry.symmetry import nearest_alike
from rendezview.sensors.appearance.integrity.monitor import IntegrityMonitor, IntegrityOptions
from rendezview.sensors.appearance.joints import JointFilter
from rendezview.sensors.appearance.observation import AppearanceObservation
from rendezview.sensors.appearance.recognizer import Recognizer
from rendezview.sensors.appearance.region import Region
from rendezview.sensors.appearance.tracked_motion import TrackedMotion, searched
from rendezview.sensors.appearance.verdict import LEAST_POSTERIOR, doubted, unconfirmed
from rendezview.sensors.arguments import check_prior, check_recognizer, check_time

# rad; poses nearer than this are the same answer. Source: by hand; pose-trials (0.1) sequences
_SAME_RAD = np.deg2rad(3.0)
# Of a track's pose among its look-alikes: then they are not asked again. Source: by construction,
# the risk of a protection level
_SETTLED = 0.999
_NOTHING = 1e-9  # a probability. Source: by construction, no infinity


@dataclass(frozen=True, kw_only=True)
class TrackerOptions:
    """When to let go of the last pose."""

    # rad, of the search, for each frame without a pose. Source: a chosen limit
    widening_rad: float = np.deg2rad(10.0)
    # rad; a view from the other side is farther off. Source: a chosen limit
    widest_rad: float = np.deg2rad(60.0)
    # s; after that all attitudes are searched. Source: a chosen limit
    longest_outage_s: float = 60.0
    # s; rates are held so long, then the pose is held. Source: a chosen limit
    longest_prediction_s: float = 10.0
    # frames without a pose; then all attitudes are searched too. Source: by hand;
    # pose-trials (0.1) sequences
    restart_after: int = 2
    # frames without a pose; where the target should overflow the picture, all attitudes are
    # searched so often, if a whole silhouette is there. Source: a chosen limit
    close_restart: int = 15
    # 0 … 1; a restart needs more than a pose near a prediction. Source: by hand;
    # pose-trials (0.1) sequences
    restart_confidence: float = 0.9
    # share of the range; a restart farther off than that, or than the search reached near the
    # prediction, waits for the next frame to confirm it. Source: a chosen limit
    restart_range: float = 0.25
    # frames; a pose that a search confirmed is accepted so long … Source: by hand;
    # pose-trials (0.1) sequences
    confirmed_frames: int = 15
    # … while it keeps this share of the confirmed inlier ratio. Source: by hand;
    # pose-trials (0.1) sequences
    confirmed_share: float = 0.9
    # σ of an expected attitude that are searched … Source: normal distribution, 99.7 %
    expected_sigmas: float = 3.0
    # rad; … and more beside them. Source: by construction, the reach of refinement
    expected_rad: float = np.deg2rad(3.0)


class _Frame(NamedTuple):
    """What `Tracker.update` is given; see there."""

    time_s: float
    image: npt.ArrayLike
    sun_camera: npt.ArrayLike | None
    roi: npt.ArrayLike | Region | None


class Tracker:
    """Tracks one target through the frames of one camera, in order of time.

    The prediction is of constant velocity: attitude and view centre keep their rates. Where a
    first frame leaves two poses, the next is searched as the first was: only a frame that tells
    them apart gives a pose. Threads may share an instance: their frames are processed one after
    the other.
    """

    def __init__(
        self,
        recognizer: Recognizer,
        prior: Pose | None = None,
        options: TrackerOptions | None = None,
        integrity: IntegrityOptions | None = None,
        prior_posterior: float = 1.0,
    ) -> None:
        """A tracker before its first frame.

        Args:
            recognizer: of the target, in the frames of the camera.
            prior: camera_from_target of the first frame; ``None``: all attitudes are searched.
            options: when to let go of the last pose.
            integrity: each pose gets a protection level and alarms; ``None``: it gets none.
            prior_posterior: probability of the prior among its look-alikes.

        Raises:
            ValueError: the probability is none.
        """
        if not 0.0 <= prior_posterior <= 1.0:
            raise ValueError(f"prior_posterior must be 0 to 1: {prior_posterior}")
        check_recognizer(recognizer)
        check_prior(prior)
        self.recognizer = recognizer
        self.options = options or TrackerOptions()
        self._motion = None if prior is None else TrackedMotion(prior, prior_posterior, prior)
        self._last_time_s = -np.inf
        self._misses = 0
        self._jump: TrackedMotion | None = None  # of the frame before, to be confirmed
        self._confirmed = (0.0, 0)  # inlier ratio in the last search, frames since
        self._expected: tuple[Pose, float] | None = None  # at the next frame, and how far off, rad
        self._joints: JointFilter | None = None  # of a target with joints, after its first pose
        self._monitor = None if integrity is None else IntegrityMonitor(integrity)
        self._lock = threading.Lock()

    @property
    def prior(self) -> Pose | None:
        """camera_from_target of the last frame with a pose, or the one given at the start."""
        return None if self._motion is None else self._motion.pose

    @property
    def lost(self) -> bool:
        """Whether the last frame gave no pose, or there was none yet."""
        return self._motion is None or self._misses > 0

    def expect(self, pose: Pose, covariance: npt.ArrayLike) -> None:
        """Tell where other sensors expect the target in the next frame.

        The search starts there where the target is lost; the pose found is the frame's alone.

        Args:
            pose: camera_from_target at the time of the next frame.
            covariance: (6, 6) of it, rotation vector rad, translation m; camera frame, left. One
                whose attitude is not known to a third of the widest search is not used.

        Raises:
            ValueError: not (6, 6), or not finite.
        """
        known = np.asarray(covariance, dtype=np.float64)
        if known.shape != (6, 6) or not np.isfinite(known).all():
            raise ValueError("covariance must be (6, 6) and finite")
        options = self.options
        sigma_rad = float(np.sqrt(max(np.linalg.eigvalsh(known[:3, :3])[-1], 0.0)))
        error_rad = options.expected_sigmas * sigma_rad + options.expected_rad
        with self._lock:
            self._expected = (pose, error_rad) if error_rad <= options.widest_rad else None

    @property
    def rates(self) -> tuple[Array, Array] | None:
        """Turn (3,) rad/s and velocity (3,) m/s of the view centre, camera frame, of two poses."""
        motion = self._motion
        if motion is None or not motion.moves:
            return None
        return motion.turn_rad_s, motion.move_m_s

    def predicted(self, time_s: float) -> Pose | None:
        """camera_from_target expected at a time."""
        if self._motion is None:
            return None
        return self._motion.at(time_s, self.options.longest_prediction_s, self.recognizer.model)

    def _predicted_angles(self, time_s: float) -> Array | None:
        """(J,) angles of the joints expected at a time; None where they are not known."""
        if self._motion is None or self._joints is None:
            return None
        return self._joints.predicted(time_s, self.options.longest_prediction_s)

    def update(
        self, time_s: float, image: npt.ArrayLike, sun_camera: npt.ArrayLike | None = None,
        roi: npt.ArrayLike | None = None,
    ) -> AppearanceObservation:  # fmt: skip
        """Look at the next frame.

        Args:
            time_s: when the frame was taken.
            image: as for `Recognizer.recognize`.
            sun_camera: (3,) towards the Sun, camera frame, if it is known.
            roi: where the target is, as for `Recognizer.recognize`.

        Raises:
            ValueError: the time is not finite, or not later than that of the frame before.
            RendezviewError: the image does not fit the camera.
        """
        with self._lock:
            check_time(time_s, self._last_time_s)
            before = self._motion, self._jump
            self._age(time_s)
            frame, expected = _Frame(time_s, image, sun_camera, roi), self._expected
            predicted = self.predicted(time_s) if self._monitor is not None else None
            try:
                if expected is not None and self.lost:
                    observation = self._look_at(expected, frame)
                else:
                    observation = self._look(frame)
            except (ValueError, RendezviewError):  # the frame is refused
                self._motion, self._jump = before
                raise
            self._last_time_s, self._expected = time_s, None
            observation = self._with_joints(observation, time_s)
            if observation.pose is not None:
                self._follow(observation, observation.pose, time_s)
                observation = self._beside_look_alikes(observation, frame)
            if observation.pose is None:
                self._misses += 1
            if self._monitor is None:
                return observation
            look = partial(self.recognizer.second_estimate, image)
            centre_m = self.recognizer.model.centre_m
            return self._monitor.protected(observation, time_s, predicted, centre_m, look)

    def _seen(
        self, frame: _Frame, prior: Pose | None = None, error_rad: float | None = None,
        enough_inliers: float = 1.0, *, angles_rad: Array | None = None, thorough: bool = True,
    ) -> AppearanceObservation:  # fmt: skip
        """What the recognizer observes."""
        return self.recognizer.recognize(
            frame.image, prior, error_rad, frame.sun_camera, enough_inliers,
            angles_rad=angles_rad, time_s=frame.time_s, roi=frame.roi, thorough=thorough,
        )  # fmt: skip

    def _with_joints(
        self, observation: AppearanceObservation, time_s: float
    ) -> AppearanceObservation:
        """The observation improved by what earlier frames tell of the joints' angles."""
        if observation.joints is None:
            return observation
        if self._joints is None or self._motion is None:
            self._joints = JointFilter(observation.joints, time_s)
            return observation
        return self._joints.followed(observation, self.options.longest_outage_s)

    def _age(self, time_s: float) -> None:
        """Date a first prior by the first frame, and forget a pose that is too old."""
        if self._motion is None:
            return
        since_s = self._motion.time_s
        if since_s is None:
            self._motion = replace(self._motion, time_s=time_s)
        elif time_s - since_s > self.options.longest_outage_s:
            self._motion = None

    def _look_at(self, expected: tuple[Pose, float], frame: _Frame) -> AppearanceObservation:
        """Near an expected pose, and as without it where the target is not there."""
        observation = self._seen(frame, *expected)
        if observation.pose is not None:
            if (last := self._motion) is not None:  # its rates are those before it was lost
                self._motion = TrackedMotion(last.pose, last.posterior, last.weighed)
            return observation
        return self._look(frame)

    def _look(self, frame: _Frame) -> AppearanceObservation:
        """Near the prediction, and everywhere after a few frames without a pose."""
        options = self.options
        prior = self.predicted(frame.time_s)
        if self._jump is not None:
            confirmed = self._confirm(self._jump, frame)
            if confirmed is not None:
                return confirmed
        error_rad = min(
            self.recognizer.prior_error_rad + self._misses * options.widening_rad,
            options.widest_rad,
        )
        observation = self._seen(
            frame, prior, error_rad, self._enough_inliers(),
            angles_rad=self._predicted_angles(frame.time_s),
        )  # fmt: skip
        late = prior is not None and self._misses >= options.restart_after
        if prior is not None and self.recognizer.overflows(prior):
            due = self._misses % options.close_restart == options.close_restart - 1
            late = due and observation.silhouette is not None
        if late and observation.pose is None and self.recognizer.search is not None:
            again = self._restarted(frame, prior)
            if again is not None:
                restarted = self._as_before(again, prior, frame)
                assert restarted.pose is not None
                jump = TrackedMotion(restarted.pose, *searched(again.found, restarted.pose))
                if prior is None or self._may_follow(prior, restarted, error_rad):
                    self._motion = jump
                    return restarted
                self._jump = jump
                return unconfirmed(restarted)
        return observation

    def _restarted(self, frame: _Frame, prior: Pose | None) -> AppearanceObservation | None:
        """A confident pose of any attitude: next to the expected place, or else anywhere."""
        place = None
        if frame.roi is None and prior is not None:
            place = self.recognizer.place_of(frame.image, prior)
        for roi in (frame.roi,) if place is None else (place, None):
            again = self._seen(frame._replace(roi=roi), thorough=self._motion is None)
            sure = again.certainty >= self.options.restart_confidence
            if again.pose is not None and sure:
                return again
        return None

    def _may_follow(self, prior: Pose, seen: AppearanceObservation, error_rad: float) -> bool:
        """Whether a restart lies where the target may have moved to since the last pose."""
        assert seen.pose is not None
        centre_m = self.recognizer.model.centre_m
        before_m, now_m = (float(np.linalg.norm(p.apply(centre_m))) for p in (prior, seen.pose))
        near = abs(np.log(now_m / max(before_m, 1e-9))) <= np.log1p(self.options.restart_range)
        return bool(near) and seen.pose.angle_to(prior) <= error_rad

    def _confirm(self, jump: TrackedMotion, frame: _Frame) -> AppearanceObservation | None:
        """The pose next to the one of the frame before; None where it is not there again."""
        self._jump = None
        seen, reach_rad = self._seen(frame, jump.pose), self.recognizer.prior_error_rad
        if seen.pose is None or not self._may_follow(jump.pose, seen, reach_rad):
            return None
        self._motion = jump
        return seen

    def _as_before(
        self, again: AppearanceObservation, prior: Pose | None, frame: _Frame
    ) -> AppearanceObservation:
        """Of the poses that look alike after a restart, the one that was tracked before."""
        if again.pose is None or prior is None:
            return again
        same = nearest_alike(again.pose, prior, self.recognizer.model.symmetries)
        if same.angle_to(again.pose) < _SAME_RAD:
            return again
        there = self._seen(frame, same)
        return again if there.pose is None else there

    def _beside_look_alikes(
        self, observation: AppearanceObservation, frame: _Frame
    ) -> AppearanceObservation:
        """The observation with what all frames of the track say of its look-alikes.

        A search near a prediction sees none of them: its pose is no surer than the first one. As
        long as look-alikes of that are possible, new views are asked: odds of frames multiply.
        """
        motion, pose = self._motion, observation.pose
        if motion is None or motion.weighed is None or pose is None:
            return observation
        if motion.posterior >= _SETTLED:
            return observation
        posterior = motion.posterior
        if motion.weighed.angle_to(pose) > _SAME_RAD:
            share = self.recognizer.posterior(frame.image, pose, frame.sun_camera)
            odds = logit(np.clip([posterior, share], _NOTHING, 1.0 - _NOTHING)).sum()
            posterior = float(expit(odds))
            self._motion = replace(motion, posterior=posterior, weighed=pose)
        if posterior < LEAST_POSTERIOR:
            self._motion = None  # the next frame is searched as the first one was
            return doubted(observation, posterior)
        confidence = min(observation.confidence or 0.0, posterior)
        return replace(observation, confidence=confidence)

    def _enough_inliers(self) -> float:
        """Inlier ratio that the pose next to the prediction needs: less after a confirmation."""
        inliers, frames = self._confirmed
        if self._misses or inliers == 0.0 or frames >= self.options.confirmed_frames:
            return 1.0
        return self.options.confirmed_share * inliers

    def _follow(self, observation: AppearanceObservation, pose: Pose, time_s: float) -> None:
        """Take a pose over, the rates since the last one, and how well it is confirmed."""
        found, centre_m = observation.found, self.recognizer.model.centre_m
        self._motion = TrackedMotion.followed(self._motion, pose, time_s, found, centre_m)
        self._misses, self._jump = 0, None
        if found is None or found.on_sketch:  # its inlier ratio is another
            self._confirmed = (0.0, 0)
        elif found.single:  # no search: the confirmation grows older
            self._confirmed = (self._confirmed[0], self._confirmed[1] + 1)
        else:
            self._confirmed = (found.best.inlier_ratio, 0)
