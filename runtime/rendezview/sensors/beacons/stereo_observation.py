"""The observation of the stereo tracker."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from rendezview.geometry.pose import Pose
from rendezview.sensors.beacons.budget import Budget
from rendezview.sensors.beacons.detect.detectors import Spots
from rendezview.sensors.beacons.euler import YawPitchRoll, yaw_pitch_roll
from rendezview.sensors.beacons.match.agreement import LightsFit
from rendezview.sensors.beacons.stereo_motion import Motion
from rendezview.sensors.observation import Observation


@dataclass(frozen=True, slots=True)
class Names:
    """Names of the cameras and of the target's lights, for logs."""

    cameras: tuple[str, ...]
    leds: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class StereoObservation(Observation):
    """One reading's answer; `pose` and `covariance` are in the frame of the first camera."""

    fit: LightsFit | None = None  # from this reading only, rig frame
    estimate: Motion | None = None  # the filter after it, where there is one
    restarted: bool = False  # the pose was found without the estimate before
    spots: tuple[Spots, ...] = ()  # with the lights' numbers
    names: Names = Names((), ())
    budget: Budget | None = None  # the covariance by cause

    @property
    def rig_from_target(self) -> Pose | None:
        """The pose in the rig (laboratory) frame: the filter's where there is one."""
        source = self.estimate or self.fit
        return None if source is None else Pose(source.rotation, source.translation)

    @property
    def yaw_pitch_roll(self) -> YawPitchRoll | None:
        """ψ, θ, φ of eq. 3 in the rig frame, radians."""
        source = self.estimate or self.fit
        return None if source is None else yaw_pitch_roll(source.rotation)

    @property
    def left_out(self) -> tuple[tuple[int, int], ...]:
        """(camera, light) pairs that were visible and are outliers."""
        return () if self.fit is None else self.fit.left_out

    @property
    def exchanged(self) -> tuple[tuple[int, int], ...]:
        """Pairs of lights that came under each other's number."""
        return () if self.fit is None else self.fit.exchanged

    @property
    def inliers(self) -> int:
        """Identified spots that the pose explains."""
        return sum(int((found.led >= 0).sum()) for found in self.spots) - len(self.left_out)

    def record(self) -> dict[str, Any]:
        """The observation as its line of JSON (docs/files-logs.md)."""
        angles, fit, names = self.yaw_pitch_roll, self.fit, self.names
        line = Observation.record(self)  # slots: no super() without arguments
        stage_ms = line.pop("stage_ms")
        return line | {
            "rig_from_target": self.rig_from_target,
            "yaw_pitch_roll_rad": None if angles is None else list(angles),
            "common_covariance": self.common,
            "budget": self.budget,
            "rates": None if self.estimate is None else self.estimate.rates,
            "sum_of_squares": None if fit is None else fit.cost,
            "degrees_of_freedom": None if fit is None else fit.spare,
            "left_out": [
                {"camera": names.cameras[camera], "led": names.leds[light]}
                for camera, light in self.left_out
            ],
            "exchanged": [[names.leds[a], names.leds[b]] for a, b in self.exchanged],
            "leds": [
                [names.leds[number] if number >= 0 else None for number in found.led]
                for found in self.spots
            ],
            "found_anew": self.restarted,
            "stage_ms": stage_ms,
        }
