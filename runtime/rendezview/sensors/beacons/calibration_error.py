"""How the errors of a rig's calibration and of the lights' places move the poses.

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
    Sights,
    intrinsics_of,
    with_intrinsics,
)

_STEP = 1e-4  # σ of a parameter × this, of its slope. Source: by construction, root of rounding
_POSE_STEP = 1e-6  # rad, and share of the range. Source: by construction, root of rounding
# A covariance is used again while the pose has moved by less: rad, and share of the range. Source:
# by construction, it then changes by a few per cent
_STILL_RAD, _STILL_SHARE = 0.05, 0.03


class CalibrationError:
    """The covariance that a rig's calibration, and the places of a target's lights, add to a pose.

    Args:
        rig: with the covariance of its calibration.
        leds: (L, 3) lights in the target frame, m.
        sigmas_m: (L,) σ of each coordinate of a light's place; None: not known.
    """

    def __init__(self, rig: Rig, leds: Array, sigmas_m: Array | None = None) -> None:
        self.rig, self.leds, self._sigmas_m = rig, leds, sigmas_m
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
        # Pose, lights that it shows, shares, and (M, 6) px of these lights by the pose.
        self._last: tuple[Pose, bytes, dict[str, Array | None], Array] | None = None

    def __bool__(self) -> bool:
        """Whether any of it is known."""
        return len(self._parameters) > 0 or self._sigmas_m is not None

    @property
    def last(self) -> dict[str, Array | None]:
        """The shares of the last pose; not known where there was none."""
        return {"calibration": None, "places": None} if self._last is None else self._last[2]

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
        """(6, 6) by cause, ``calibration`` and ``places``, None where a cause is not known.

        In the rig frame, left perturbation.

        Args:
            rig_from_target: the pose.
            weight: (C, L, 2) 1/σ of the ideal places, 0 where not visible.
        """
        seen = np.asarray((weight > 0.0).all(axis=2))
        key = seen.tobytes()
        if self._last is not None:
            pose, before, shares, _ = self._last
            away = np.linalg.norm(pose.translation_m - rig_from_target.translation_m)
            near = away < _STILL_SHARE * np.linalg.norm(rig_from_target.translation_m)
            if before == key and near and pose.angle_to(rig_from_target) < _STILL_RAD:
                return shares
        slopes, by_pose = self._pose_by_parameters(rig_from_target, weight, seen)
        calibration = slopes @ self._covariance @ slopes.T if self._parameters else None
        places = self._by_places(by_pose, self._scale(weight, seen), seen)
        shares = {"calibration": calibration, "places": places}
        self._last = rig_from_target, key, shares, by_pose
        return shares

    def _by_places(self, by_pose: Array, scale: Array, seen: npt.NDArray[np.bool_]) -> Array | None:
        """(6, 6) by the lights' places: a light moves its own spots as the whole target does."""
        if self._sigmas_m is None:
            return None
        whitened = scale[:, None] * by_pose
        inverse = np.linalg.inv(whitened.T @ whitened)
        light = np.concatenate([np.repeat(np.flatnonzero(row), 2) for row in seen])
        pull = np.zeros((6, 6))
        for k, sigma in enumerate(self._sigmas_m):
            own = whitened[light == k]
            moved = sigma * own.T @ own[:, 3:]
            pull += moved @ moved.T
        return np.asarray(inverse @ pull @ inverse)

    def noise(self, pose: Pose, weight: Array) -> Array:
        """(6, 6) covariance of the last pose by the noise of its spots alone.

        The weights allow for the whole floor and for the lights' places, so the estimate stays what
        it is. Of the floor only the lens model's share, where it is known, is an error of a spot.

        Args:
            pose: rig_from_target, as `shares` had it.
            weight: (C, L, 2) as `shares` had it, of the same lights.
        """
        assert self._last is not None
        seen = np.asarray((weight > 0.0).all(axis=2))
        scale = self._scale(weight, seen)
        less = []
        for camera, row in zip(self.rig.cameras, seen, strict=True):
            floor = 0.0 if camera.misfit is None else camera.floor**2 - camera.misfit**2
            depth = camera.camera_from_rig.apply(pose.apply(self.leds[row]))[:, 2:]
            focal = np.array([camera.fx, camera.fy])
            sigmas = np.zeros((1, 1)) if self._sigmas_m is None else self._sigmas_m[row, None]
            less.append((floor + (sigmas * focal / depth) ** 2).ravel())
        share = np.clip(1.0 - np.concatenate(less) * scale**2, 0.0, 1.0)
        slopes = scale[:, None] * self._last[3]
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
