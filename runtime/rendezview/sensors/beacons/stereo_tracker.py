"""The tracker: each reading is solved from the last estimate; a lost target is found again."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from rendezview.geometry.pose import Array, Pose
from rendezview.io.target import Target
from rendezview.sensors.arguments import check_time
from rendezview.sensors.beacons import stereo_motion as motion
from rendezview.sensors.beacons.budget import SPOTS, budget_of, common_of
from rendezview.sensors.beacons.calibration_error import CalibrationError
from rendezview.sensors.beacons.detect.detectors import Spots
from rendezview.sensors.beacons.match.agreement import (
    FEWEST_LIGHTS,
    Disagreement,
    LightsFit,
    agree,
    distance,
)
from rendezview.sensors.beacons.match.identity import identify, nearest_lights
from rendezview.sensors.beacons.match.start import candidates
from rendezview.sensors.beacons.pose.collinearity import count_lights
from rendezview.sensors.beacons.rig import Rig, Sights, required_leds
from rendezview.sensors.beacons.stereo_motion import Motion, MotionOptions
from rendezview.sensors.beacons.stereo_observation import Names, StereoObservation
from rendezview.sensors.measurement import turned
from rendezview.sensors.observation import Status


@dataclass(frozen=True, kw_only=True)
class TrackerOptions:
    """How a target is followed."""

    motion: MotionOptions | None = None  # the filter; None: each reading's pose as it is
    # after that the last estimate is no longer used. Source: a chosen limit
    longest_outage_s: float = 5.0
    # Add what the rig's calibration and the lights' places do to each pose's covariance.
    calibration_error: bool = True
    # normalised; unnamed spots are looked for so far from the forecast. Source: by hand; see
    # stereo-accuracy (0.1) --part identity
    window: float = 0.03


class StereoTracker:
    """Follows the lights of one target with the cameras of one rig.

    Args:
        rig: calibrated cameras, two as in the paper, or one, or more.
        leds: (L, 3) lights in the target frame, metres.
        normals: (L, 3) directions of their beams; left out, they shine everywhere.
        options: of following.
        led_names: of the lights, for logs; left out: led1, led2 ...
        sigmas_m: (L,) σ of each coordinate of a light's place; left out: not known.

    Raises:
        RendezviewError: fewer than three lights, or all on one line.
    """

    def __init__(
        self,
        rig: Rig,
        leds: npt.ArrayLike,
        normals: npt.ArrayLike | None = None,
        options: TrackerOptions | None = None,
        led_names: Sequence[str] | None = None,
        sigmas_m: npt.ArrayLike | None = None,
    ) -> None:
        self.rig = rig
        self.leds = required_leds(list(np.asarray(leds, dtype=np.float64)), "the target")
        self.normals = np.zeros_like(self.leds)
        if normals is not None:
            self.normals = np.ascontiguousarray(normals, dtype=np.float64)
        if self.normals.shape != self.leds.shape:
            raise ValueError(f"normals must be {self.leds.shape}, not {self.normals.shape}")
        self.options = options or TrackerOptions()
        self.names = Names(
            tuple(camera.name for camera in rig.cameras),
            tuple(led_names or (f"led{k + 1}" for k in range(len(self.leds)))),
        )
        self._first = rig.cameras[0].camera_from_rig
        sigmas = None if sigmas_m is None else np.asarray(sigmas_m, dtype=np.float64)
        if sigmas is not None and sigmas.shape != (len(self.leds),):
            raise ValueError(f"sigmas_m must be ({len(self.leds)},), not {sigmas.shape}")
        self._calibration = CalibrationError(rig, self.leds, sigmas)
        self._last: Motion | None = None
        self._last_time_s = -np.inf
        self._lock = threading.Lock()  # of the two above

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
        normals = np.array([led.normal for led in target.leds])
        sigmas = np.array([led.position_sigma_m for led in target.leds], dtype=np.float64)
        return cls(
            rig, positions, normals, options, [led.name for led in target.leds],
            None if np.isnan(sigmas).any() else sigmas,
        )  # fmt: skip

    @property
    def estimate(self) -> Motion | None:
        """The last estimate, or None where the target is lost."""
        return self._last

    def update(self, time_s: float, spots: Sequence[Spots]) -> StereoObservation:
        """Solve the next reading, one `Spots` for each camera.

        Named spots keep their names; if any spot has no name, all are identified by geometry.

        Raises:
            ValueError: times that do not rise, or spots that are not this rig's or target's.
        """
        start_s = time.perf_counter()
        with self._lock:
            check_time(time_s, self._last_time_s)
            observation = self._update(time_s, spots)
            self._last_time_s = time_s
        observation.stage_ms["track"] = 1e3 * (time.perf_counter() - start_s)
        return observation

    def _update(self, time_s: float, spots: Sequence[Spots]) -> StereoObservation:
        forecast = self._forecast(time_s)
        restarted, named = forecast is None, tuple(spots)
        fit: LightsFit | Disagreement | None = None
        if not all(found.identified for found in spots):
            fit, named, restarted = self._identify(spots, forecast)
        sights = self.rig.sights(named, len(self.leds))
        if fit is None and count_lights(sights.weight)[0] < FEWEST_LIGHTS:
            return self._partial(time_s, forecast, sights, named)
        if fit is None and forecast is not None:
            sights = self._calibration.loosened(
                sights, Pose(forecast.rotation, forecast.translation)
            )
            fit = agree(self.rig, self.leds, sights, forecast.rotation, forecast.translation)
        known = all(found.identified for found in named)  # else there is nothing to locate
        if fit is None or (isinstance(fit, Disagreement) and not fit.ambiguous and known):
            restarted = True
            fit = self.locate(self.rig.sights(named, len(self.leds)), forecast)
        if isinstance(fit, Disagreement):
            status = Status.AMBIGUOUS if fit.ambiguous else Status.DISAGREE
            return self._none(time_s, status, fit.reason, named)
        return self._accept(time_s, fit, forecast, restarted, named)

    def locate(self, sights: Sights, forecast: Motion | None = None) -> LightsFit | Disagreement:
        """The pose from identified lights without knowing where the target is.

        A forecast only chooses between poses that fit equally well.
        """
        fits: list[LightsFit] = []
        reason = Disagreement("no camera sees three lights")
        for rotation, translation in candidates(self.rig, self.leds, self.normals, sights):
            loose = self._calibration.loosened(sights, Pose(rotation, translation))
            fit = agree(self.rig, self.leds, loose, rotation, translation)
            if isinstance(fit, LightsFit):
                fits.append(fit)
            elif not fits:
                reason = fit
        if not fits:
            return reason
        best, *others = fits
        others = [fit for fit in others if distance(best, fit) > 1.0]
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
    ) -> tuple[LightsFit | Disagreement | None, tuple[Spots, ...], bool]:
        if forecast is not None:
            pose = Pose(forecast.rotation, forecast.translation)
            gate = self.options.window
            named = nearest_lights(self.rig, self.leds, self.normals, spots, pose, gate)
            sights = self._calibration.loosened(self.rig.sights(named, len(self.leds)), pose)
            fit = agree(self.rig, self.leds, sights, forecast.rotation, forecast.translation)
            # A spot that is left over may be a light whose name another took.
            left = sum(int((found.led < 0).sum()) for found in named)
            if isinstance(fit, LightsFit) and not (fit.left_out and left):
                return fit, named, False
        answer = identify(self.rig, self.leds, self.normals, spots)
        if isinstance(answer, Disagreement):
            return answer, tuple(spots), True
        return answer[1], answer[0], True

    def _partial(
        self, time_s: float, forecast: Motion | None, sights: Sights, named: tuple[Spots, ...]
    ) -> StereoObservation:
        lights = int(sights.visible.any(axis=0).sum())
        reason = f"{lights} lights visible, a pose needs {FEWEST_LIGHTS}"
        if self.options.motion is not None and forecast is not None:
            after = motion.update(forecast, self.rig, self.leds, sights.xy, sights.weight)
            if after is not None:
                self._last = after
                return self._found(Status.PARTIAL, reason, time_s, None, after, False, named)
        return self._none(time_s, Status.FEW_LIGHTS, reason, named)

    def _accept(
        self,
        time_s: float,
        fit: LightsFit,
        forecast: Motion | None,
        restarted: bool,
        named: tuple[Spots, ...],
    ) -> StereoObservation:
        options, own, after = self.options.motion, (fit.rotation, fit.translation), None
        if options is not None:
            if forecast is not None and not motion.breaks(forecast, *own, fit.information):
                seen = fit.sights
                after = motion.update(forecast, self.rig, self.leds, seen.xy, seen.weight, own)
            if after is None:  # the first, or the motion exceeds the filter's model
                covariance = np.asarray(np.linalg.inv(fit.information), np.float64)
                after = motion.begin(time_s, *own, covariance, options)
        self._last = after or Motion(time_s, *own, np.zeros(6), np.zeros((12, 12)))
        return self._found(Status.OK, None, time_s, fit, after, restarted, named)

    def _found(
        self, status: Status, reason: str | None, time_s: float, fit: LightsFit | None,
        after: Motion | None, restarted: bool, named: tuple[Spots, ...],
    ) -> StereoObservation:  # fmt: skip
        """The observation of a pose: the filter's where there is one, else the reading's own.

        The covariance of a single reading is the inverse of its information. The calibration's
        share is added.
        """
        answer = StereoObservation(status, reason, fit, after, restarted, named, self.names)
        pose, turn = answer.rig_from_target, self._first.rotation
        assert pose is not None
        if after is not None:
            own = np.asarray(after.covariance[:6, :6])
        else:
            assert fit is not None
            own = np.asarray(np.linalg.inv(fit.information), np.float64)
        covariance, common, budget = turned(own, turn), None, None
        if self.options.calibration_error:
            whole: dict[str, Array | None] = dict(self._calibration.last)
            if self._calibration and fit is not None:
                whole = self._calibration.shares(pose, fit.sights.weight)
            for cause, share in whole.items():
                whole[cause] = None if share is None else turned(share, turn)
            noise = whole.get(SPOTS)
            own = covariance if noise is None or self.options.motion else noise
            whole[SPOTS] = own
            common, budget = common_of(whole), budget_of(whole)
            covariance = own + common
        return replace(
            answer, time_s=time_s, pose=self._first @ pose, covariance=covariance, common=common,
            budget=budget,
        )  # fmt: skip

    def _none(
        self, time_s: float, status: Status, reason: str, named: tuple[Spots, ...]
    ) -> StereoObservation:
        last = self._last
        if last is not None and time_s - last.time_s > self.options.longest_outage_s:
            self._last = None
        return StereoObservation(status, reason, spots=named, names=self.names, time_s=time_s)
