"""A stereo pair on the chaser: the target's lights in it, and the tracker that reads them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from rendezview.fusion import BeamMesh
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose
from rendezview.geometry.ray_cast import first_hits
from rendezview.io.target import Target
from rendezview.sensors.beacons import Rig, RigCamera, Spots, StereoObservation, StereoTracker
from rendezview.sensors.beacons.detect.detectors import UNKNOWN
from rendezview.sensors.beacons.detect.led_spots import find_spots
from rendezview_ground.simulate.led_pictures import PictureOptions, draw

_CLEAR_M = 0.01  # a surface so near to a light is its own. Source: chosen


class StereoPair:
    """Two cameras of one flight, the left one is that of the frames.

    Args:
        baseline_m: of the right camera, along x.
        target: with lights.
        beam: of its mesh, which hides lights.
    """

    def __init__(self, camera: Camera, baseline_m: float, target: Target, beam: BeamMesh) -> None:
        right = Pose(np.eye(3), np.array([-baseline_m, 0.0, 0.0]))
        self.camera, self.beam = camera, beam
        self.rig = Rig(
            (
                RigCamera.from_camera("left", camera, Pose.identity()),
                RigCamera.from_camera("right", camera, right),
            )
        )
        self.tracker = StereoTracker.of_target(self.rig, target)

    def shining(self, number: int, pose: Pose) -> Array:
        """(N, 3) the lights that a camera sees, rig frame: towards it, and nothing between."""
        leds, normals = self.tracker.leds, self.tracker.normals
        eye = (self.rig.cameras[number].camera_from_rig @ pose).inverse().translation_m
        ways = leds - eye
        away = np.linalg.norm(ways, axis=1)
        seen = []
        for k in np.flatnonzero((ways * normals).sum(axis=1) < 0.0):
            beam, mesh = ways[k] / away[k], self.beam
            met, hit = first_hits(mesh.corners, mesh.centres, mesh.radii, eye[None], beam)
            if hit[0] < 0 or met[0] > away[k] - _CLEAR_M:
                seen.append(k)
        return pose.apply(leds[seen])

    def modelled(self, pose: Pose, sigma_px: float, rng: np.random.Generator) -> list[Spots]:
        """Spots without names, with noise; of each camera."""
        found = []
        for number, camera in enumerate(self.rig.cameras):
            places = camera.project(self.shining(number, pose))
            places = places + sigma_px * rng.standard_normal(places.shape)
            size = np.array([self.camera.width, self.camera.height]) - 1.0
            places = places[((places > 0.0) & (places < size)).all(axis=1)]  # not NaN
            sigma = np.full_like(places, sigma_px)
            found.append(Spots(places, sigma, np.full(len(places), UNKNOWN)))
        return found

    def pictured(
        self, pose: Pose, scenes: Sequence[npt.NDArray[np.float32]], rng: np.random.Generator
    ) -> list[Spots]:
        """Spots that are found in pictures with and without the lights; of each camera.

        Args:
            scenes: (H, W) what else each picture shows, grey levels.
        """
        options, found = PictureOptions(), []
        for number, scene in enumerate(scenes):
            lights = self.shining(number, pose)
            lit = draw(self.rig, number, lights, options, rng, scene)
            dark = draw(self.rig, number, lights[:0], options, rng, scene)
            found.append(find_spots(lit, dark=dark))
        return found

    def read(self, time_s: float, spots: Sequence[Spots]) -> StereoObservation:
        """What the tracker makes of a reading."""
        return self.tracker.update(time_s, spots)
