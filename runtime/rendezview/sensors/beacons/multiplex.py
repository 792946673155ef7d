"""Lights that shine one after the other: the target moves between the first and the last of a scan.

Six lights 1/60 s apart turn by 1.7° at 20°/s while they are read. Each spot is moved back to the
time of the reading by the rates of filters over the poses before. What the rates' error adds goes
into the spots' errors and into the pose's covariance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from rendezview.estimation.motion import extrapolate
from rendezview.estimation.rates import RateBank
from rendezview.geometry.pose import Pose
from rendezview.sensors.beacons.detect.detectors import Spots
from rendezview.sensors.beacons.rig import RigCamera, by_pose
from rendezview.sensors.beacons.stereo_observation import StereoObservation
from rendezview.sensors.beacons.stereo_tracker import StereoTracker
from rendezview.sensors.observation import Status

# rad/s and m/s, σ of rates that nothing is known of. Source: by construction, twice the 20°/s at
# which a scan of 0.1 s is a problem
_FIRST_RATE, _FIRST_VELOCITY = 0.5, 0.15


class MultiplexedTracker:
    """A tracker whose lights shine at ``time_s + times_s[k]``; poses are at ``time_s``.

    Args:
        tracker: of the target's lights, without this object's knowledge of time.
        times_s: (L,) of each light within a scan, seconds.

    Raises:
        ValueError: not one finite time for each light.
    """

    def __init__(self, tracker: StereoTracker, times_s: npt.ArrayLike) -> None:
        self.tracker = tracker
        self.times_s = np.asarray(times_s, dtype=np.float64)
        if self.times_s.shape != (len(tracker.leds),) or not np.isfinite(self.times_s).all():
            raise ValueError(
                f"times_s must be {len(tracker.leds)} finite numbers, not {self.times_s.tolist()}"
            )
        self._middle_s = float(self.times_s.mean())
        self._rig_from_first = tracker.rig.cameras[0].camera_from_rig.inverse()
        self._bank = RateBank()
        self._forget()

    def _forget(self) -> None:
        self._bank.clear()
        self._last: tuple[float, Pose] | None = None
        self._rates = np.zeros(6)
        sigma = [_FIRST_RATE] * 3 + [_FIRST_VELOCITY] * 3
        self._covariance = np.diag(np.square(sigma))

    def update(self, time_s: float, spots: Sequence[Spots]) -> StereoObservation:
        """As `StereoTracker.update`; spots without a light's number are not moved."""
        last = self._last
        if last is not None and time_s - last[0] > self.tracker.options.longest_outage_s:
            self._forget()
            last = None
        pose = None if last is None else extrapolate(last[1], self._rates, time_s - last[0])
        still = [
            self._still(found, camera, pose)
            for found, camera in zip(spots, self.tracker.rig.cameras, strict=True)
        ]
        observation = self.tracker.update(time_s, still)
        if observation.status is not Status.OK or observation.pose is None:
            return observation
        assert observation.covariance is not None
        covariance = observation.covariance + self._middle_s**2 * self._covariance
        found = self._bank.add(time_s, observation.pose, covariance)
        self._last = (time_s, observation.pose)
        if found is not None:
            self._rates, self._covariance = found.rates, found.covariance
        return replace(observation, covariance=covariance)

    def _still(self, spots: Spots, camera: RigCamera, pose: Pose | None) -> Spots:
        """The spots as they would be if all lights shone at the reading's time."""
        named = spots.led >= 0
        if not named.any():
            return spots
        lights = spots.led[named]
        positions, sigma = spots.positions.copy(), spots.sigma.copy()
        away_s = self.times_s[lights] - self._middle_s
        if pose is None:  # a turning body moves its spots by the turn times their spread
            spread = float(np.sqrt(positions[named].var(axis=0).sum()))
            sigma[named] = np.hypot(sigma[named], _FIRST_RATE * spread * np.abs(away_s)[:, None])
            return Spots(positions, sigma, spots.led)
        leds = self.tracker.leds[lights]
        places = self._rig_from_first.apply(pose.apply(leds))
        later = [extrapolate(pose, self._rates, after_s) for after_s in self.times_s[lights]]
        moved = np.array([there.apply(led) for there, led in zip(later, leds, strict=True)])
        moved = camera.project(self._rig_from_first.apply(moved))
        positions[named] -= moved - camera.project(places)
        by_place = camera.slopes(places)[2] @ self._rig_from_first.rotation
        slopes = by_pose(by_place, leds @ pose.rotation.T)  # detector units a second, by the rates
        spread = np.einsum("nij,jk,nik->ni", slopes, self._covariance, slopes)
        sigma[named] = np.hypot(sigma[named], np.sqrt(spread) * np.abs(away_s)[:, None])
        seen = np.isfinite(positions).all(axis=1) & np.isfinite(sigma).all(axis=1)
        return Spots(positions[seen], sigma[seen], spots.led[seen])
