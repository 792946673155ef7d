"""Recognition over a sequence: each pose is the prior of the next frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rendezview.appearance.recognizer import Recognizer, Sighting
from rendezview.pose import Pose


@dataclass(frozen=True, kw_only=True)
class TrackerOptions:
    """When to let go of the last pose."""

    widening_rad: float = np.deg2rad(10.0)  # of the search, each frame without a pose
    widest_rad: float = np.deg2rad(60.0)  # a view from the other side is farther off
    longest_outage_s: float = 60.0  # after that the last pose says nothing: look everywhere


class Tracker:
    """Follows one target through the frames of one camera, in order of time."""

    def __init__(
        self,
        recognizer: Recognizer,
        prior: Pose | None = None,
        options: TrackerOptions | None = None,
    ) -> None:
        self.recognizer = recognizer
        self.options = options or TrackerOptions()
        self._prior = prior
        self._prior_time_s: float | None = None
        self._last_time_s = -np.inf
        self._misses = 0

    @property
    def prior(self) -> Pose | None:
        """camera_from_target expected for the next frame."""
        return self._prior

    def update(self, time_s: float, image: npt.ArrayLike) -> Sighting:
        """Look at the next frame.

        Raises:
            ValueError: the time is not finite or not later than the frame's before.
            RendezviewError: the image does not fit the camera.
        """
        if not (np.isfinite(time_s) and time_s > self._last_time_s):
            raise ValueError(
                f"frames must come in order of time: {time_s} s after {self._last_time_s} s"
            )
        self._last_time_s = time_s
        if self._prior_time_s is None:
            self._prior_time_s = time_s  # a first prior is of the first frame's time
        since = time_s - self._prior_time_s
        if since > self.options.longest_outage_s:
            self._prior = None
        error_rad = min(
            self.recognizer.matcher.options.prior_error_rad
            + self._misses * self.options.widening_rad,
            self.options.widest_rad,
        )
        sighting = self.recognizer.recognize(image, self._prior, error_rad)
        if sighting.pose is None:
            self._misses += 1
        else:
            self._misses = 0
            self._prior, self._prior_time_s = sighting.pose, time_s
        return sighting
