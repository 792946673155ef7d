"""Rendered frames: the recognizer, the ring sensor and the reflector sensor look at pictures."""

from __future__ import annotations

import math

import cv2
import numpy as np
import numpy.typing as npt

from rendezview.fusion import Measurement
from rendezview.geometry import so3
from rendezview.geometry.pose import Array, Pose
from rendezview.io.video_file import VideoWriter
from rendezview.sensors.appearance import Recognizer, Tracker
from rendezview.sensors.appearance.overlay import draw_observation
from rendezview.sensors.beacons import (
    LitDark,
    ReflectorObservation,
    ReflectorSensor,
    StereoObservation,
)
from rendezview.sensors.beacons.match.acquisition import merged
from rendezview.sensors.ring import RingSensor
from rendezview.sensors.ring.prior_log import prior_of_pose
from rendezview_ground.fly.dynamics import Truth
from rendezview_ground.fly.faults import Fault
from rendezview_ground.fly.guidance import Known
from rendezview_ground.fly.sensors import OwnSensors
from rendezview_ground.fly.setup import CAMERA, Setup
from rendezview_ground.simulate import SceneOptions, ShadingOptions, render_frame, sun_at_phase
from rendezview_ground.simulate.reflector_frames import Clutter, ReflectorFrameOptions, render_pair

_STREAM, _GLARE_STREAM = 5, 6  # of the seed
_GLARE_PX = 400.0  # px over which stray light falls by e. Source: chosen, half of the picture
# Of shading, a pixel side. Source: hubble's pin, seeds 0 and 5: with 2 straight edges lie off all
# along, 46 steps are beyond the level; with 4 one
_SAMPLES = 4


def stray_light(peak_grey: float, seed: int) -> npt.NDArray[np.float32]:
    """Light (H, W) that a lens scatters over all of the picture, in grey levels.

    It falls from a side of the picture, which is drawn.
    """
    way = np.random.default_rng([_GLARE_STREAM, seed]).uniform(0.0, 2.0 * math.pi)
    y, x = np.mgrid[: CAMERA.height, : CAMERA.width]
    depth = math.cos(way) * x + math.sin(way) * y
    fallen = peak_grey * np.exp(-(depth - depth.min()) / _GLARE_PX)
    return np.asarray(fallen, dtype=np.float32)


class Pictures:
    """Frames of the target by its own renderer, and the readings that need no recognizer."""

    def __init__(self, setup: Setup, seed: int, fault: Fault | None = None) -> None:
        self.plan, self.mesh, self.fault = setup.plan, setup.mesh, fault
        self.pair, patterns = setup.stereo_pair(), list(setup.patterns)
        self.own = OwnSensors(setup, seed, fault)
        self._rng = np.random.default_rng([_STREAM, seed])
        self._reflectors = ReflectorSensor(CAMERA, patterns) if patterns else None
        self._pattern = merged(patterns) if patterns else None
        self._sun: Array | None = None  # (3,) towards it, inertial
        self._glare = stray_light(fault.size, seed) if fault and fault.kind == "glare" else None

    def begin(self, truth: Truth) -> Pose:
        """Place the Sun; the recognizer's first prior, an attitude with an error."""
        phase = math.radians(self._rng.uniform(*self.plan.target.sun_phase_deg))
        centre = truth.pose.apply(self.mesh.bounding_sphere[0])
        sun = sun_at_phase(centre, phase, self._rng.uniform(0.0, 2.0 * math.pi))
        self._sun = truth.inertial_from_camera @ sun
        tilt = self._rng.standard_normal(3)
        tilt *= math.radians(self.plan.sensors.prior_deg) / np.linalg.norm(tilt)
        return Pose(so3.exp(tilt) @ truth.pose.rotation, truth.pose.translation_m)

    def draw(self, truth: Truth) -> npt.NDArray[np.uint8] | None:
        """The frame of a step (H, W); None: none is due, or the camera is dead."""
        time_s = truth.time_s
        if not self.own.due(time_s, self.plan.sensors.frame_s) or self.own.struck("camera", time_s):
            return None
        glare = self._glare if self.own.struck("glare", time_s) else None
        return self._scene(truth, truth.pose, glare)

    def _scene(
        self, truth: Truth, pose: Pose, glare: npt.NDArray[np.float32] | None
    ) -> npt.NDArray[np.uint8]:
        """What a camera with this pose sees."""
        options = SceneOptions(shading=ShadingOptions(samples=_SAMPLES))
        assert self._sun is not None
        sun = truth.inertial_from_camera.T @ self._sun
        return render_frame(self.mesh, CAMERA, pose, sun, options, self._rng, light=glare)

    def lights(self, image: npt.NDArray[np.uint8], truth: Truth) -> StereoObservation | None:
        """The lights, in pictures of a short exposure; None: the target has none."""
        pair, share = self.pair, np.float32(self.plan.sensors.led_scene)
        if pair is None:
            return None
        glare = self._glare if self.own.struck("glare", truth.time_s) else None
        right = self._scene(truth, pair.rig.cameras[1].camera_from_rig @ truth.pose, glare)
        spots = pair.pictured(truth.pose, (share * image, share * right), self._rng)
        return pair.read(truth.time_s, spots)

    def spots(self, image: npt.NDArray[np.uint8], truth: Truth) -> ReflectorObservation | None:
        """The reflectors, lit and dark, on top of the same scene; None: none are read."""
        sensor, pattern, time_s = self._reflectors, self._pattern, truth.time_s
        far = float(np.linalg.norm(truth.pose.translation_m))
        if sensor is None or pattern is None or far > self.plan.sensors.reflectors_m:
            return None
        options = ReflectorFrameOptions(black_level_grey=0.0)
        scene = Clutter(background=image.astype(np.float32))
        hidden = (0,) if self.own.struck("reflectors", time_s) else ()
        lit, dark = render_pair(
            CAMERA, pattern, truth.pose, options, self._rng, hidden=hidden, clutter=(scene,)
        )
        return sensor.update(time_s, LitDark(lit, dark))


class RenderedSensors(Pictures):
    """The project's sensors on pictures of its own renderer."""

    def __init__(
        self, setup: Setup, seed: int, fault: Fault | None = None, film: VideoWriter | None = None
    ) -> None:
        super().__init__(setup, seed, fault)
        assert setup.model is not None
        self.film = film  # receives every frame with the recognizer's pose
        self.ring = ring = setup.port.ring
        self._recognizer = Recognizer(setup.model, CAMERA)
        self._tracker: Tracker | None = None
        self._rings = None
        if ring is not None:
            wrong = fault.size if fault is not None and fault.kind == "ring" else 1.0
            self._rings = RingSensor(CAMERA, wrong * ring.radius_m, circles=ring.circles)

    def read(self, truth: Truth, known: Known | None) -> list[Measurement]:
        """All readings of a step."""
        found = self.own.read(truth)
        if self._tracker is None:
            self._tracker = Tracker(self._recognizer, self.begin(truth))
        image = self.draw(truth)
        if image is None:
            return found
        found += self._look(image, truth.time_s, known)
        seen = (("reflectors", self.spots(image, truth)), ("stereo", self.lights(image, truth)))
        poses = [one.measurement(name) for name, one in seen if one is not None]
        return [*found, *(pose for pose in poses if pose is not None)]

    def _look(
        self, image: npt.NDArray[np.uint8], time_s: float, known: Known | None
    ) -> list[Measurement]:
        """Recognizer and ring; each knows what the filter forecasts for the frame."""
        forecast = None if known is None else known.forecast
        estimate = None if forecast is None else forecast(time_s)
        pose = None if estimate is None else estimate.pose
        assert self._tracker is not None
        if estimate is not None and pose is not None and self._tracker.lost:
            assert estimate.covariance is not None
            self._tracker.expect(pose, estimate.covariance[:6, :6])
        seen = self._tracker.update(time_s, image)
        if self.film is not None:
            model = self._recognizer.model
            drawn = draw_observation(image, seen, CAMERA, model, title=f"{time_s:.0f} s")
            small = cv2.resize(drawn, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
            self.film.add(np.asarray(small, dtype=np.uint8))
        found = [seen.measurement("camera")]
        if self._rings is not None and self.ring is not None:
            prior = None
            if estimate is not None and pose is not None:
                assert estimate.covariance is not None
                prior = prior_of_pose(pose, estimate.covariance[:6, :6], self.ring)
            circle = self._rings.update(time_s, image, prior)
            found.append(circle.measurement("ring", ring=self.ring))
        return [one for one in found if one is not None]
