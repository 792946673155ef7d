"""How the errors of a rig's calibration move the poses that it measures.

A calibration is the same wrong in every reading: no average of readings takes it away. To first
order a pose moves by δx = −(JᵀWJ)⁻¹ JᵀW (∂u/∂c) δc, with u where the lights are on the detectors, J
its slope by the pose, c the intrinsics and places of the cameras, whose covariance is saved
with the rig (GUM, JCGM 102:2011, section 6: propagation of a vector's covariance).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rendezview.geometry.pose import Array, Pose
from rendezview.sensors.beacons.rig import (
    INTRINSICS,
    POSE,
    Rig,
    RigCamera,
    intrinsics_of,
    with_intrinsics,
)

_STEP = 1e-4  # σ of a parameter × this, of its slope. Source: by construction, root of rounding
_POSE_STEP = 1e-6  # rad, and share of the range. Source: by construction, root of rounding
# A covariance is used again while the pose has moved by less: rad, and share of the range. Source:
# by construction, it then changes by a few per cent
_STILL_RAD, _STILL_SHARE = 0.05, 0.03


class CalibrationError:
    """The covariance that a rig's calibration adds to a pose; for one target's lights."""

    def __init__(self, rig: Rig, leds: Array) -> None:
        self.rig, self.leds = rig, leds
        known = {
            f"{camera.name}.{name}": (k, name)
            for k, camera in enumerate(rig.cameras)
            for name in (*INTRINSICS, "f", *POSE)
        }
        named = enumerate(rig.covariance_names if rig.covariance is not None else ())
        kept = [i for i, name in named if name in known]
        self._parameters = [known[rig.covariance_names[i]] for i in kept]
        self._covariance = (
            np.zeros((0, 0)) if rig.covariance is None else rig.covariance[np.ix_(kept, kept)]
        )
        # Pose, lights that it shows, covariance, and (M, 6) px of these lights by the pose.
        self._last: tuple[Pose, bytes, Array, Array] | None = None

    def __bool__(self) -> bool:
        """Whether the rig has a covariance at all."""
        return len(self._parameters) > 0

    def covariance(self, rig_from_target: Pose, weight: Array) -> Array:
        """(6, 6) in the rig frame, left perturbation.

        Args:
            rig_from_target: the pose.
            weight: (C, L, 2) 1/σ of the ideal places, 0 where not visible.
        """
        seen = np.asarray((weight > 0.0).all(axis=2))
        key = seen.tobytes()
        if self._last is not None:
            pose, before, covariance, _ = self._last
            away = np.linalg.norm(pose.translation_m - rig_from_target.translation_m)
            near = away < _STILL_SHARE * np.linalg.norm(rig_from_target.translation_m)
            if before == key and near and pose.angle_to(rig_from_target) < _STILL_RAD:
                return covariance
        slopes, by_pose = self._pose_by_parameters(rig_from_target, weight, seen)
        covariance = slopes @ self._covariance @ slopes.T
        self._last = rig_from_target, key, covariance, by_pose
        return covariance

    def noise(self, weight: Array) -> Array | None:
        """(6, 6) covariance of the last pose by the noise of its spots, without the corners' noise.

        The weights allow for the whole floor, so the estimate stays what it is; of the floor only
        the lens model's share is an error of a spot. None where a camera does not know that share.

        Args:
            weight: (C, L, 2) as `covariance` had it, of the same lights.
        """
        cameras = self.rig.cameras
        by_pose = np.empty((0, 6)) if self._last is None else self._last[3]
        if any(camera.misfit is None for camera in cameras) or not len(by_pose):
            return None
        seen = np.asarray((weight > 0.0).all(axis=2))
        scale = self._scale(weight, seen)
        less = [
            np.full(2 * int(row.sum()), camera.floor**2 - (camera.misfit or 0.0) ** 2)
            for camera, row in zip(cameras, seen, strict=True)
        ]
        share = np.clip(1.0 - np.concatenate(less) * scale**2, 0.0, 1.0)
        slopes = scale[:, None] * by_pose
        inverse = np.linalg.inv(slopes.T @ slopes)
        return np.asarray(inverse @ (slopes.T @ (share[:, None] * slopes)) @ inverse)

    def _scale(self, weight: Array, seen: npt.NDArray[np.bool_]) -> Array:
        """(M,) 1/σ of the spots' numbers, per detector unit."""
        return np.concatenate(
            [
                (weight[k, seen[k]] / (camera.fx, camera.fy)).ravel()
                for k, camera in enumerate(self.rig.cameras)
            ]
        )

    def _pose_by_parameters(
        self, pose: Pose, weight: Array, seen: npt.NDArray[np.bool_]
    ) -> tuple[Array, Array]:
        """(6, P) how a pose follows the parameters of the calibration; (M, 6) px by the pose."""
        cameras = self.rig.cameras
        lit = [np.flatnonzero(row) for row in seen]
        scale = self._scale(weight, seen)
        far = float(np.linalg.norm(pose.translation_m))

        def places(which: int | None, camera: RigCamera | None, at: Pose) -> Array:
            points = at.apply(self.leds)
            return np.concatenate(
                [
                    (camera if k == which and camera is not None else own)
                    .project(points[lit[k]])
                    .ravel()
                    for k, own in enumerate(cameras)
                ]
            )

        by_pose = np.empty((len(scale), 6))
        for i in range(6):
            h = _POSE_STEP if i < 3 else _POSE_STEP * far
            step = np.zeros(6)
            step[i] = h
            ahead, behind = (
                places(None, None, pose.perturbed(step)),
                places(None, None, pose.perturbed(-step)),
            )
            by_pose[:, i] = (ahead - behind) / (2.0 * h)
        by_parameter = np.empty((len(scale), len(self._parameters)))
        sigma = np.sqrt(np.diag(self._covariance))
        for i, (k, name) in enumerate(self._parameters):
            h = _STEP * max(float(sigma[i]), 1e-12)
            ends = [places(k, moved(cameras[k], name, sign * h), pose) for sign in (1.0, -1.0)]
            by_parameter[:, i] = (ends[0] - ends[1]) / (2.0 * h)
        solved = np.linalg.lstsq(
            scale[:, None] * by_pose, scale[:, None] * by_parameter, rcond=None
        )[0]
        return np.asarray(-solved), by_pose


def moved(camera: RigCamera, name: str, step: float) -> RigCamera:
    """The camera with one parameter of its calibration changed, by its name in the bundle."""
    values, pose = intrinsics_of(camera), camera.camera_from_rig
    if name in POSE:
        change = np.zeros(6)
        change[POSE.index(name)] = step
        pose = pose.perturbed(change)
    else:
        for each in ("fx", "fy") if name == "f" else (name,):
            values[INTRINSICS.index(each)] += step
    return with_intrinsics(camera, values, pose)


def turned(covariance: Array, rotation: Array) -> Array:
    """A covariance (6, 6) of a pose in a frame turned by ``rotation``."""
    both = np.zeros((6, 6))
    both[:3, :3] = both[3:, 3:] = rotation
    return np.asarray(both @ covariance @ both.T)
