"""Several cameras on one chaser, each for its own ranges (Book et al., new developments)."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy.typing as npt

from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Pose
from rendezview.sensors.beacons.constellation import ReflectorPattern
from rendezview.sensors.beacons.detect.difference import LitDark
from rendezview.sensors.beacons.observation import ReflectorObservation
from rendezview.sensors.beacons.tracker import ReflectorSensor
from rendezview.sensors.observation import Status

_RETRY_S = 5.0  # s, a failed camera is left out. Source: by construction, a restart
_MEMORY_S = 5.0  # s, a pose is handed over. Source: by construction, 0.5 m at 0.1 m/s


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

    Where ranges overlap the camera in use stays in use. A camera that fails, or sees no spot in two
    readings in a row, is replaced by the next best; a failed one is tried again later. Where no
    target is tracked the cameras take turns.

    Args:
        cameras: one or more.

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
        self._out_until_s = [-math.inf] * len(ordered)
        self._empty = 0  # readings in a row without a spot
        self._last: _Last | None = None

    @property
    def active(self) -> RangedCamera:
        """The camera whose pictures the next `update` wants."""
        return self.cameras[self._active]

    @property
    def patterns(self) -> list[ReflectorPattern]:
        """The groups of the camera in use."""
        return self.active.sensor.patterns

    def fail(self, time_s: float) -> None:
        """The camera in use gives no picture: another one takes over, at the same time."""
        self._out_until_s[self._active] = time_s + _RETRY_S
        self._turn(time_s)

    def update(
        self, time_s: float, frames: LitDark, acceleration: npt.ArrayLike | None = None
    ) -> tuple[ReflectorObservation, Pose | None]:
        """A reading of the active camera and ``chaser_from_target``; then the next is chosen.

        ``acceleration`` is that of `ReflectorSensor.update`, in the active camera's frame.
        """
        camera = self.active
        reading = camera.sensor.update(time_s, frames, acceleration)
        self._empty = 0 if len(reading.spots) else self._empty + 1
        if reading.pose is None or reading.six is None:
            waiting = reading.status is Status.UNCONFIRMED  # for its second reading
            if not waiting and (self._empty > 1 or not camera.sensor.is_tracking):
                self._turn(time_s)
            return reading, None
        chaser_from_target = camera.camera_from_chaser.inverse() @ reading.pose
        far = reading.six.range_m
        self._last = _Last(time_s, chaser_from_target, far, not reading.roll_ambiguous)
        if not camera.nearest_m <= far <= camera.farthest_m:
            best = min(self._working(time_s), key=lambda k: self._off(k, far))
            if best != self._active and self._off(best, far) < self._off(self._active, far):
                self._use(best, time_s)
        return reading, chaser_from_target

    def _off(self, k: int, far_m: float) -> float:
        """How far a range lies outside those of a camera, m."""
        camera = self.cameras[k]
        return max(camera.nearest_m - far_m, far_m - camera.farthest_m, 0.0)

    def _working(self, time_s: float) -> list[int]:
        """Cameras that have not failed, or all where all have."""
        everyone = range(len(self.cameras))
        return [k for k in everyone if self._out_until_s[k] <= time_s] or list(everyone)

    def _turn(self, time_s: float) -> None:
        """Use another camera: the one for the last range, or the next in turn."""
        count = len(self.cameras)
        others = [k for k in self._working(time_s) if k != self._active]
        if not others:
            return
        recent = self._recent(time_s)
        far = recent.range_m if recent else None
        self._use(
            min(
                others,
                key=lambda k: (
                    0.0 if far is None else self._off(k, far), (self._active - k) % count
                ),
            ),
            time_s,
        )  # fmt: skip

    def _recent(self, time_s: float) -> _Last | None:
        last = self._last
        return last if last is not None and time_s - last.time_s <= _MEMORY_S else None

    def _use(self, k: int, time_s: float) -> None:
        """Make a camera the active one, with the last pose if it is recent."""
        self._active, self._empty = k, 0
        last = self._recent(time_s)
        if last is not None:
            self.active.sensor.start(
                time_s,
                self.active.camera_from_chaser @ last.chaser_from_target,
                roll_known=last.roll_known,
            )


@dataclass(frozen=True, slots=True, eq=False)
class _Last:
    """The last pose of any camera."""

    time_s: float
    chaser_from_target: Pose
    range_m: float
    roll_known: bool
