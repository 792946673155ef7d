"""How the errors of a rig's calibration and of the lights' places move the poses.

A calibration is the same wrong in every reading: no average of readings takes it away. To first
order a pose moves by δx = −(JᵀWJ)⁻¹ JᵀW (∂u/∂c) δc, with u where the lights are on the detectors, J
its slope by the pose, c the intrinsics and places of the cameras, whose covariance is saved
with the rig (GUM, JCGM 102:2011, section 6: propagation of a vector's covariance).
"""

from __future__ import annotations

import numpy as np

from rendezview.geometry.pose import Array, Pose
from rendezview.sensors.beacons.budget import SPOTS
from rendezview.sensors.beacons.rig import INTRINSICS, POSE, Rig, Sights, by_pose

_OWN = (*INTRINSICS, *POSE)  # names of a camera's numbers


class CalibrationError:
    """The covariance that a rig's calibration, and the places of a target's lights, add to a pose.

    Args:
        rig: with the covariance of its calibration.
        leds: (L, 3) lights in the target frame, m.
        sigmas_m: (L,) σ of each coordinate of a light's place; None: not known.
    """

    def __init__(self, rig: Rig, leds: Array, sigmas_m: Array | None = None) -> None:
        self.rig, self.leds, self._sigmas_m = rig, leds, sigmas_m
        self._covariance: Array | None = None  # of all numbers of all cameras
        own = [(camera.name, name) for camera in rig.cameras for name in _OWN]
        turn = np.zeros((len(rig.covariance_names), len(own)))
        for given, row in zip(rig.covariance_names, turn, strict=True):
            camera, _, name = given.rpartition(".")
            for one in ("fx", "fy") if name == "f" else (name,):  # one focal length is two
                if (camera, one) in own:
                    row[own.index((camera, one))] = 1.0
        if rig.covariance is not None and turn.any():
            self._covariance = turn.T @ rig.covariance @ turn
        # The shares of the last pose; not known where there was none.
        self.last: dict[str, Array | None] = {"calibration": None, "places": None}

    def __bool__(self) -> bool:
        """Whether any of it is known."""
        return self._covariance is not None or self._sigmas_m is not None

    def loosened(self, sights: Sights, rig_from_target: Pose) -> Sights:
        """The sights with the errors of the lights' places in their σ, at a pose."""
        if self._sigmas_m is None or not self._sigmas_m.any():
            return sights
        weight = sights.weight.copy()
        for k, camera in enumerate(self.rig.cameras):
            depth = camera.camera_from_rig.apply(rig_from_target.apply(self.leds))[:, 2]
            off = (self._sigmas_m / np.maximum(depth, 1e-9))[:, None]
            weight[k] = weight[k] / np.hypot(1.0, weight[k] * off)
        return Sights(sights.xy, weight)

    def shares(self, rig_from_target: Pose, weight: Array) -> dict[str, Array | None]:
        """(6, 6) by cause, ``spots``, ``calibration`` and ``places``, None where one is not known.

        In the rig frame, left perturbation. The weights allow for the whole floor and for the
        lights' places, so the estimate stays what it is. Of the floor only the lens model's share,
        where it is known, is an error of a spot.

        Args:
            rig_from_target: the pose.
            weight: (C, L, 2) 1/σ of the ideal places, 0 where not visible.
        """
        whitened = np.zeros((*weight.shape, 6))
        less, by_number = np.zeros(weight.shape), np.zeros((*weight.shape[:2], 2, len(_OWN)))
        sigmas = np.zeros(len(self.leds)) if self._sigmas_m is None else self._sigmas_m
        for k, camera in enumerate(self.rig.cameras):
            seen = np.flatnonzero((weight[k] > 0.0).all(axis=1))
            points = rig_from_target.apply(self.leds[seen])
            _, by_own, by_point = camera.slopes(points)
            focal = np.array([camera.fx, camera.fy])
            scale = (weight[k, seen] / focal)[:, :, None]  # 1/σ, per detector unit
            by_target = by_pose(by_point, points - rig_from_target.translation_m)
            whitened[k, seen], by_number[k, seen] = scale * by_target, scale * by_own
            floor = 0.0 if camera.misfit is None else camera.floor**2 - camera.misfit**2
            depth = camera.camera_from_rig.apply(points)[:, 2:]
            own = floor + (sigmas[seen, None] * focal / depth) ** 2
            less[k, seen] = own * scale[:, :, 0] ** 2
        slopes = whitened.reshape(-1, 6)
        inverse = np.linalg.inv(slopes.T @ slopes)
        share = np.clip(1.0 - less.ravel(), 0.0, 1.0)
        noise = inverse @ (slopes.T @ (share[:, None] * slopes)) @ inverse
        calibration = places = None
        if self._covariance is not None:
            pulls = np.swapaxes(whitened.reshape(len(self.rig), -1, 6), 1, 2)
            pulls = pulls @ by_number.reshape(len(self.rig), -1, len(_OWN))  # of each camera
            by = inverse @ np.concatenate(pulls, axis=1)
            calibration = by @ self._covariance @ by.T
        if self._sigmas_m is not None:
            # A light moves its own spots as the whole target does.
            own = np.moveaxis(whitened, 1, 0).reshape(len(self.leds), -1, 6)
            moved = sigmas[:, None, None] * (np.swapaxes(own, 1, 2) @ own[:, :, 3:])
            places = inverse @ np.sum(moved @ np.swapaxes(moved, 1, 2), axis=0) @ inverse
        self.last = {"calibration": calibration, "places": places}
        return {SPOTS: noise, **self.last}
