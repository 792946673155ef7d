"""Recognition over a sequence: each pose predicts the next frame's."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from rendezview.geometry.pose import Array, Pose
from rendezview.sensors.appearance.recognizer import AppearanceObservation, Recognizer
from rendezview.sensors.observation import Status

_SAME_RAD = np.deg2rad(3.0)  # attitudes nearer than this are the same answer


@dataclass(frozen=True, kw_only=True)
class TrackerOptions:
    """When to let go of the last pose."""

    widening_rad: float = np.deg2rad(10.0)  # of the search, each frame without a pose
    widest_rad: float = np.deg2rad(60.0)  # a view from the other side is farther off
    longest_outage_s: float = 60.0  # after that the last pose says nothing: look everywhere
    longest_prediction_s: float = 10.0  # rates are held for so long, then the pose stands still
    anew_after: int = 2  # frames without a pose, then all attitudes are searched too
    anew_confidence: float = 0.9  # of a pose found anew: more than one near a prediction needs
    vouched_frames: int = 15  # for which a pose stands that was the best of a search around it …
    vouched_share: float = 0.9  # … with so much of the support that it had there
    decided_by: float = 0.1  # merit by which one of two rivals must lead, summed over frames


class Tracker:
    """Follows one target through the frames of one camera, in order of time.

    The prediction is of constant velocity on SE(3): the attitude turns on at its rate and
    the view centre moves on. Where a first frame leaves two poses, both are followed until
    one leads.
    """

    def __init__(
        self,
        recognizer: Recognizer,
        prior: Pose | None = None,
        options: TrackerOptions | None = None,
    ) -> None:
        self.recognizer = recognizer
        self.options = options or TrackerOptions()
        self._pose = prior
        self._time_s: float | None = None  # of the last pose
        self._turn_rad_s = np.zeros(3)
        self._move_m_s = np.zeros(3)  # of the view centre
        self._last_time_s = -np.inf
        self._misses = 0
        self._rivals: list[tuple[Pose, float]] = []
        self._vouched = (0.0, 0)  # support in the last search, frames since

    @property
    def prior(self) -> Pose | None:
        """camera_from_target of the last frame that gave a pose, or the one given at the start."""
        return self._pose

    @property
    def rates(self) -> tuple[Array, Array] | None:
        """Turn (3,) rad/s and velocity (3,) m/s of the view centre, camera frame, of two poses."""
        if self._time_s is None or not (self._turn_rad_s.any() or self._move_m_s.any()):
            return None
        return self._turn_rad_s, self._move_m_s

    def predicted(self, time_s: float) -> Pose | None:
        """camera_from_target expected at a time."""
        if self._pose is None or self._time_s is None:
            return self._pose
        if not (self._turn_rad_s.any() or self._move_m_s.any()):
            return self._pose
        ahead_s = min(time_s - self._time_s, self.options.longest_prediction_s)
        centre_m = self.recognizer.model.centre_m
        rotation = Rotation.from_rotvec(self._turn_rad_s * ahead_s).as_matrix()
        rotation = rotation @ self._pose.rotation
        centre = self._pose.apply(centre_m) + self._move_m_s * ahead_s
        if centre[2] < 0.1 * self.recognizer.model.target_radius_m:
            return self._pose
        return Pose(rotation, centre - rotation @ centre_m)

    def update(
        self, time_s: float, image: npt.ArrayLike, sun_camera: npt.ArrayLike | None = None
    ) -> AppearanceObservation:
        """Look at the next frame.

        Args:
            sun_camera: (3,) towards the Sun, camera frame, if it is known.

        Raises:
            ValueError: the time is not finite or not later than the frame's before.
            RendezviewError: the image does not fit the camera.
        """
        if not (np.isfinite(time_s) and time_s > self._last_time_s):
            raise ValueError(
                f"frames must come in order of time: {time_s} s after {self._last_time_s} s"
            )
        self._last_time_s = time_s
        if self._time_s is None:
            self._time_s = time_s  # a first prior is of the first frame's time
        if time_s - self._time_s > self.options.longest_outage_s:
            self._pose = None
        observation = self._look(time_s, image, sun_camera)
        if observation.pose is None:
            self._misses += 1
        else:
            self._follow(observation.pose, time_s)
            self._vouch(observation)
        return observation

    def _look(
        self, time_s: float, image: npt.ArrayLike, sun_camera: npt.ArrayLike | None
    ) -> AppearanceObservation:
        if self._pose is None and self._rivals:
            return self._decide(image, sun_camera)
        error_rad = min(
            self.recognizer.matcher.options.prior_error_rad
            + self._misses * self.options.widening_rad,
            self.options.widest_rad,
        )
        prior = self.predicted(time_s)
        observation = self.recognizer.recognize(
            image, prior, error_rad, sun_camera, self._enough_support()
        )
        refines = self.recognizer.search is not None
        if (
            refines
            and prior is not None
            and observation.pose is None
            and self._misses >= self.options.anew_after
        ):
            anew = self.recognizer.recognize(image, None, None, sun_camera)
            if anew.pose is not None and (anew.confidence or 0.0) >= self.options.anew_confidence:
                self._time_s = None  # a new start: no rate across it
                return anew
        if observation.status is Status.AMBIGUOUS and self._pose is None:
            self._rivals = [(pose, 0.0) for pose in observation.candidates]
        return observation

    def _vouch(self, observation: AppearanceObservation) -> None:
        """Remember what support the pose has where it was the best of several."""
        found = observation.found
        if found is None:
            self._vouched = (0.0, 0)
        elif found.single:
            self._vouched = (self._vouched[0], self._vouched[1] + 1)
        else:
            self._vouched = (found.best.inlier_ratio, 0)

    def _enough_support(self) -> float:
        """For the pose next to the prediction: less than usual, if a search bore it out lately."""
        support, frames = self._vouched
        if self._misses or support == 0.0 or frames >= self.options.vouched_frames:
            return 1.0
        return self.options.vouched_share * support

    def _decide(
        self, image: npt.ArrayLike, sun_camera: npt.ArrayLike | None
    ) -> AppearanceObservation:
        """Both rivals against the next frame; the answer when one leads."""
        looks = []
        for pose, merit in self._rivals:
            observation = self.recognizer.recognize(image, pose, None, sun_camera)
            found = observation.found
            if found is not None:
                looks.append((merit + found.merit, observation, found.best.pose))
        looks.sort(key=lambda look: -look[0])
        # Rivals that end at one pose are one.
        for k in range(len(looks) - 1, 0, -1):
            if any(looks[k][2].angle_to(look[2]) < _SAME_RAD for look in looks[:k]):
                del looks[k]
        if not looks:
            self._rivals = []
            return self.recognizer.recognize(image, None, None, sun_camera)
        best = looks[0]
        lead = best[0] - looks[1][0] if len(looks) > 1 else np.inf
        if lead >= self.options.decided_by and best[1].pose is not None:
            self._rivals = []
            return best[1]
        self._rivals = [(pose, merit) for merit, _, pose in looks]
        return replace(
            best[1],
            status=Status.AMBIGUOUS,
            reason=f"{len(looks)} poses still fit; they are followed until one leads",
            pose=None,
            covariance=None,
        )

    def _follow(self, pose: Pose, time_s: float) -> None:
        """Take a pose over, and the rates since the last one."""
        if self._pose is not None and self._time_s is not None and time_s > self._time_s:
            since_s = time_s - self._time_s
            centre_m: Array = self.recognizer.model.centre_m
            turn = Rotation.from_matrix(pose.rotation @ self._pose.rotation.T).as_rotvec()
            self._turn_rad_s = turn / since_s
            self._move_m_s = (pose.apply(centre_m) - self._pose.apply(centre_m)) / since_s
        else:
            self._turn_rad_s, self._move_m_s = np.zeros(3), np.zeros(3)
        self._pose, self._time_s, self._misses, self._rivals = pose, time_s, 0, []
