"""Several cameras on one chaser, each for its own ranges (Book et al., new developments)."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Pose
from rendezview.sensors.observation import Status
from rendezview.sensors.reflectors.difference import LitDark
from rendezview.sensors.reflectors.observation import ReflectorObservation
from rendezview.sensors.reflectors.pattern import ReflectorPattern
from rendezview.sensors.reflectors.sensor import ReflectorSensor


@dataclass(frozen=True, slots=True, eq=False)
class RangedCamera:
    """One sensor and the ranges it is for."""

    name: str
    sensor: ReflectorSensor
    camera_from_chaser: Pose  # how it is mounted
    nearest_m: float
    farthest_m: float


class SwitchingSensor:
    """Uses the camera whose ranges hold the target, and hands the pose over to the next.

    Where ranges overlap the camera in use stays in use. Without a pose the cameras take turns.

    Raises:
        RendezviewError: no cameras, ranges that do not rise, or a gap between them.
    """

    def __init__(self, cameras: list[RangedCamera]) -> None:
        if not cameras:
            raise RendezviewError("a switching sensor needs cameras: give one or more")
        ordered = sorted(cameras, key=lambda camera: camera.farthest_m)
        for camera in ordered:
            if not 0.0 <= camera.nearest_m < camera.farthest_m:
                raise RendezviewError(
                    f"camera {camera.name!r}: ranges must rise, not {camera.nearest_m} to "
                    f"{camera.farthest_m} m"
                )
        for near, far in itertools.pairwise(ordered):
            if far.nearest_m > near.farthest_m:
                raise RendezviewError(
                    f"between {near.farthest_m} and {far.nearest_m} m no camera is in use: "
                    "let their ranges overlap"
                )
        self.cameras = ordered
        self._active = len(ordered) - 1

    @property
    def active(self) -> RangedCamera:
        """The camera whose pictures the next `update` wants."""
        return self.cameras[self._active]

    @property
    def patterns(self) -> list[ReflectorPattern]:
        """The groups of the camera in use."""
        return self.active.sensor.patterns

    def update(self, time_s: float, frames: LitDark) -> tuple[ReflectorObservation, Pose | None]:
        """A reading of the active camera and ``chaser_from_target``; then the next is chosen."""
        camera = self.active
        reading = camera.sensor.update(time_s, frames)
        if reading.pose is None or reading.six is None:
            waiting = reading.status is Status.UNCONFIRMED  # for its second reading
            if not (waiting or camera.sensor.is_tracking):
                self._active = (self._active - 1) % len(self.cameras)
            return reading, None
        chaser_from_target = camera.camera_from_chaser.inverse() @ reading.pose
        far = reading.six.range_m
        if not camera.nearest_m <= far <= camera.farthest_m:
            middles = [
                0.0 if c.nearest_m <= far <= c.farthest_m
                else min(abs(far - c.nearest_m), abs(far - c.farthest_m))
                for c in self.cameras
            ]  # fmt: skip
            best = min(range(len(middles)), key=lambda k: middles[k])
            if best != self._active:
                self._active = best
                following = self.active
                following.sensor.start(
                    time_s,
                    following.camera_from_chaser @ chaser_from_target,
                    roll_known=not reading.roll_ambiguous,
                )
        return reading, chaser_from_target
