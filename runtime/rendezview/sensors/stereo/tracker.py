"""The tracker: each reading is solved from the last estimate; a lost target is found again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rendezview.geometry.pose import Array, Pose
from rendezview.io.target import Target
from rendezview.sensors.observation import Status
from rendezview.sensors.stereo import motion
from rendezview.sensors.stereo.agreement import (
    FEWEST_LIGHTS,
    Disagreement,
    Fit,
    agree,
    distance,
    iterate,
)
from rendezview.sensors.stereo.collinearity import lights_seen
from rendezview.sensors.stereo.detectors import Spots
from rendezview.sensors.stereo.euler import YawPitchRoll, yaw_pitch_roll
from rendezview.sensors.stereo.identity import identify, nearest_lights
from rendezview.sensors.stereo.motion import Motion, MotionOptions
from rendezview.sensors.stereo.rig import Rig, Sights, required_leds
from rendezview.sensors.stereo.start import candidates

_ALIKE = 15.0  # sums of squares closer than this do not tell two minima apart


@dataclass(frozen=True, kw_only=True)
class TrackerOptions:
    """How a target is followed."""

    motion: MotionOptions | None = None  # the filter; None: each reading's pose as it is
    longest_outage_s: float = 5.0  # after that the last estimate says nothing
    window: float = 0.03  # normalised; unnamed spots are looked for so far from the forecast


@dataclass(frozen=True, slots=True, eq=False)
class StereoObservation:
    """One reading's answer. Poses are ``None`` where there is none, with the reason."""

    status: Status
    reason: str | None = None
    fit: Fit | None = None  # this reading alone, rig frame
    estimate: Motion | None = None  # the filter after it, where there is one
    found_anew: bool = False  # without help of the estimate before
    spots: tuple[Spots, ...] = ()  # with the lights' numbers
    camera_from_rig: Pose | None = None  # of the first camera

    @property
    def rig_from_target(self) -> Pose | None:
        """The pose in the rig (laboratory) frame: the filter's where there is one."""
        source = self.estimate or self.fit
        return None if source is None else Pose(source.rotation, source.translation)

    @property
    def pose(self) -> Pose | None:
        """``camera_from_target`` of the first camera."""
        found = self.rig_from_target
        return (
            None if found is None or self.camera_from_rig is None else self.camera_from_rig @ found
        )

    @property
    def covariance(self) -> Array | None:
        """(6, 6) of `pose`, in the frame of the first camera."""
        if self.estimate is not None:
            in_rig = self.estimate.covariance[:6, :6]
        elif self.fit is not None:
            in_rig = np.asarray(np.linalg.inv(self.fit.information), np.float64)
        else:
            return None
        assert self.camera_from_rig is not None
        both = np.kron(np.eye(2), self.camera_from_rig.rotation)
        return np.asarray(both @ in_rig @ both.T)

    @property
    def yaw_pitch_roll(self) -> YawPitchRoll | None:
        """ψ, θ, φ of eq. 3 in the rig frame, radians."""
        source = self.estimate or self.fit
        return None if source is None else yaw_pitch_roll(source.rotation)

    @property
    def left_out(self) -> tuple[tuple[int, int], ...]:
        """(camera, light) that were seen and not believed."""
        return () if self.fit is None else self.fit.left_out

    @property
    def exchanged(self) -> tuple[tuple[int, int], ...]:
        """Pairs of lights that were seen under each other's number."""
        return () if self.fit is None else self.fit.exchanged


class StereoTracker:
    """Follows the lights of one target with the cameras of one rig.

    Args:
        rig: calibrated cameras, two as in the paper, or one, or more.
        leds: (L, 3) lights in the target frame, metres.
        normals: (L, 3) directions of their beams; left out, they shine everywhere.
        options: of following.

    Raises:
        RendezviewError: fewer than three lights, or all on one line.
    """

    def __init__(
        self,
        rig: Rig,
        leds: npt.ArrayLike,
        normals: npt.ArrayLike | None = None,
        options: TrackerOptions | None = None,
    ) -> None:
        self.rig = rig
        self.leds = required_leds(list(np.asarray(leds, dtype=np.float64)), "the target")
        self.normals = np.zeros_like(self.leds)
        if normals is not None:
            self.normals = np.ascontiguousarray(normals, dtype=np.float64)
        if self.normals.shape != self.leds.shape:
            raise ValueError(f"normals must be {self.leds.shape}, not {self.normals.shape}")
        self.options = options or TrackerOptions()
        self._first = rig.cameras[0].camera_from_rig
        self._last: Motion | None = None
        self._last_time_s = -np.inf

    @classmethod
    def of_target(
        cls, rig: Rig, target: Target, options: TrackerOptions | None = None
    ) -> StereoTracker:
        """A tracker of the LEDs that a target file names.

        Raises:
            RendezviewError: the target has fewer than three LEDs.
        """
        required_leds([led.position_m for led in target.leds], f"target {target.name!r}")
        positions = np.array([led.position_m for led in target.leds])
        return cls(rig, positions, np.array([led.normal for led in target.leds]), options)

    @property
    def estimate(self) -> Motion | None:
        """The last estimate, or None where the target is lost."""
        return self._last

    def update(self, time_s: float, spots: Sequence[Spots]) -> StereoObservation:
        """Solve the next reading, one `Spots` for each camera.

        Named spots are taken as named; if any spot has no name, all are told by geometry.

        Raises:
            ValueError: times that do not rise, or spots that are not this rig's or target's.
        """
        if not (np.isfinite(time_s) and time_s > self._last_time_s):
            raise ValueError(
                f"readings must come in order of time: {time_s} s after {self._last_time_s} s"
            )
        self._last_time_s = time_s
        forecast = self._forecast(time_s)
        found_anew, named = forecast is None, tuple(spots)
        fit: Fit | Disagreement | None = None
        if not all(found.identified for found in spots):
            fit, named, found_anew = self._identify(spots, forecast)
        sights = self.rig.sights(named, len(self.leds))
        if fit is None and lights_seen(sights.weight) < FEWEST_LIGHTS:
            return self._partial(time_s, forecast, sights, named)
        if fit is None and forecast is not None:
            fit = iterate(self.rig, self.leds, sights, forecast.rotation, forecast.translation)
            if fit is None or not fit.agrees:
                fit = agree(self.rig, self.leds, sights, forecast.rotation, forecast.translation)
        if fit is None or (isinstance(fit, Disagreement) and not fit.ambiguous):
            found_anew = True
            fit = self.locate(sights, forecast)
        if isinstance(fit, Disagreement):
            self._lose(time_s)
            status = Status.AMBIGUOUS if fit.ambiguous else Status.DISAGREE
            return StereoObservation(status, fit.reason, spots=named)
        return self._accept(time_s, fit, forecast, found_anew, named)

    def locate(self, sights: Sights, forecast: Motion | None = None) -> Fit | Disagreement:
        """The pose from identified lights without knowing where the target is.

        A forecast only chooses between poses that fit equally well.
        """
        found = candidates(self.rig, self.leds, self.normals, sights)
        if not found:
            return Disagreement("no camera sees three lights, nor two cameras the same three")
        fits: list[tuple[float, Fit]] = []
        reason = Disagreement("the lights do not determine a pose")
        for candidate in found:
            if candidate.cost > found[0].cost + _ALIKE:
                break
            pose = candidate.rig_from_target
            fit = agree(self.rig, self.leds, sights, pose.rotation, pose.translation_m)
            if isinstance(fit, Fit):
                fits.append((candidate.cost, fit))
            elif not fits:
                reason = fit
        if not fits:
            return reason
        best = fits[0][1]
        others = [fit for _, fit in fits[1:] if distance(best, fit) > 1.0]
        if not others:
            return best
        if forecast is not None:
            turned = [np.trace(fit.rotation @ forecast.rotation.T) for fit in (best, *others)]
            order = np.argsort(turned)
            if turned[order[-1]] > 1.0 + 2.0 * np.cos(np.deg2rad(20.0)):
                return [best, *others][int(order[-1])]
        return Disagreement(
            f"{1 + len(others)} poses fit the lights equally well: show more lights, or a prior",
            ambiguous=True,
        )

    def _forecast(self, time_s: float) -> Motion | None:
        last = self._last
        if last is None or time_s - last.time_s > self.options.longest_outage_s:
            return None
        if self.options.motion is None:
            return last
        return motion.predict(last, time_s, self.options.motion)

    def _identify(
        self, spots: Sequence[Spots], forecast: Motion | None
    ) -> tuple[Fit | Disagreement | None, tuple[Spots, ...], bool]:
        if forecast is not None:
            pose = Pose(forecast.rotation, forecast.translation)
            gate = self.options.window
            named = nearest_lights(self.rig, self.leds, self.normals, spots, pose, gate)
            sights = self.rig.sights(named, len(self.leds))
            fit = agree(self.rig, self.leds, sights, forecast.rotation, forecast.translation)
            # A spot that is left over may be a light whose name another took.
            left = sum(int((found.led < 0).sum()) for found in named)
            if isinstance(fit, Fit) and not (fit.left_out and left):
                return fit, named, False
        told = identify(self.rig, self.leds, self.normals, spots)
        if isinstance(told, Disagreement):
            return told, tuple(spots), True
        return told[1], told[0], True

    def _partial(
        self, time_s: float, forecast: Motion | None, sights: Sights, named: tuple[Spots, ...]
    ) -> StereoObservation:
        lights = int(sights.seen.any(axis=0).sum())
        reason = f"{lights} lights seen, a pose needs {FEWEST_LIGHTS}"
        if self.options.motion is not None and forecast is not None:
            after = motion.update(forecast, self.rig, self.leds, sights.xy, sights.weight)
            if after is not None:
                self._last = after
                return StereoObservation(
                    Status.PARTIAL, reason, estimate=after, spots=named, camera_from_rig=self._first
                )
        self._lose(time_s)
        return StereoObservation(Status.FEW_LIGHTS, reason, spots=named)

    def _accept(
        self,
        time_s: float,
        fit: Fit,
        forecast: Motion | None,
        found_anew: bool,
        named: tuple[Spots, ...],
    ) -> StereoObservation:
        options = self.options.motion
        if options is None:
            self._last = Motion(time_s, fit.rotation, fit.translation, _NO_RATES, _NO_COVARIANCE)
            return StereoObservation(Status.OK, None, fit, None, found_anew, named, self._first)
        after = None
        own = fit.rotation, fit.translation
        if forecast is not None and not motion.breaks(forecast, *own, fit.information):
            after = motion.update(
                forecast, self.rig, self.leds, fit.sights.xy, fit.sights.weight, own
            )
        if after is None:  # the first, or the target did what the filter holds impossible
            covariance = np.asarray(np.linalg.inv(fit.information), np.float64)
            after = motion.begin(time_s, fit.rotation, fit.translation, covariance, options)
        self._last = after
        return StereoObservation(Status.OK, None, fit, after, found_anew, named, self._first)

    def _lose(self, time_s: float) -> None:
        if self._last is not None and time_s - self._last.time_s > self.options.longest_outage_s:
            self._last = None


_NO_RATES = np.zeros(6)
_NO_COVARIANCE = np.zeros((12, 12))
