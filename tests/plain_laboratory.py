"""The plain laboratory of lights (plain_lights.py) as the product sees it, and the product's own.

For tests and experiments, which ask both the same questions.
"""

from __future__ import annotations

import json
import math
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tests import plain_lights as plain

from rendezview.calibration.laboratory import CameraRecord, LaboratoryRecord, PlateView
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.sensors.beacons import Lens, Photodiode, Response, Rig, RigCamera
from rendezview_ground.simulate.led_laboratory import Laboratory, LaboratoryOptions
from rendezview_ground.simulate.led_pictures import PictureOptions, draw, picture_rig

_STEP = 1e-6  # rad, m; of numeric derivatives
_UP = np.array([0.0, 0.0, -1.0])  # a light's normal in the target's frame


def rotation_of(yaw: float, pitch: float, roll: float) -> np.ndarray:
    """Eq. 3a–c as a matrix: ``p_fixed = rotation @ p_body + (x_cm, y_cm, z_cm)``."""
    cy, sy = np.cos(yaw), np.sin(yaw)
    cp, sp = np.cos(pitch), np.sin(pitch)
    cr, sr = np.cos(roll), np.sin(roll)
    return np.array(
        [
            [cp * cy, -cr * sy + sr * sp * cy, sr * sy + cr * sp * cy],
            [cp * sy, cr * cy + sr * sp * sy, -sr * cy + cr * sp * sy],
            [-sp, sr * cp, cr * cp],
        ]
    )


def pose_of(place: plain.Place) -> Pose:
    """camera_from_room."""
    return Pose(place.rotation, -place.rotation @ place.position)


def picture_bound(rig: Rig, leds: np.ndarray, pose: Pose, options: PictureOptions) -> np.ndarray:
    """(6, 6) Cramér–Rao bound of rig_from_target from one picture of each camera.

    The position of a round Gaussian spot in white noise σ has a standard deviation of at least
    ``sqrt(2/π) σ / peak`` px per coordinate. Rounding to whole grey levels adds 1/12 to σ².
    """
    sigma_px = math.sqrt(2.0 / math.pi * (options.noise_grey**2 + 1.0 / 12.0)) / options.peak_grey
    information = np.zeros((6, 6))
    for camera in rig.cameras:
        jacobian = np.empty((2 * len(leds), 6))
        for i in range(6):
            step = np.zeros(6)
            step[i] = _STEP
            ahead = camera.project(pose.perturbed(step).apply(leds))
            behind = camera.project(pose.perturbed(-step).apply(leds))
            jacobian[:, i] = ((ahead - behind) / (2.0 * _STEP)).ravel()
        information += jacobian.T @ jacobian / sigma_px**2
    return np.linalg.inv(information)


class PlainLaboratory:
    """The plain laboratory with the questions that experiments ask of the product's own."""

    def __init__(self, leds: np.ndarray, options: LaboratoryOptions, seed: int) -> None:
        self.leds, self.options, self.noise = leds, options, 1.0 / options.signal_to_noise
        o, rng = options, np.random.default_rng([seed, 102624])
        self._far = math.hypot(0.5 * o.baseline_m, o.height_m)
        places = [plain.looking_down(side * o.baseline_m, o.height_m) for side in (-0.5, 0.5)]
        self.diodes = [
            plain.crooked_diode(p, o.focal_m, o.half_width_m, rng) if o.distorted
            else plain.straight_diode(p, o.focal_m, o.half_width_m)
            for p in places
        ]  # fmt: skip
        across = rng.uniform(0.0, 2.0 * math.pi)
        self._tilt = plain.turn([math.cos(across), math.sin(across), 0.0], o.plane_tilt_rad)
        self.eyes = [self._eye(place, rng) for place in places]

    def _eye(self, place: plain.Place, rng: np.random.Generator) -> plain.Eye:
        """A picture camera with the photodiode's field and a lens that bends by some pixels."""
        side = PictureOptions().size_px
        focal, middle = 0.5 * side * self.options.focal_m / self.options.half_width_m, 0.5 * side
        matrix = np.array([[focal, 0.0, middle - 0.5], [0.0, focal, middle - 0.5], [0.0, 0.0, 1.0]])
        lens = np.array([rng.normal(-0.1, 0.02), 0.05, *rng.normal(0.0, 5e-4, 2), 0.0])
        return plain.Eye(place, (side, side), matrix, lens)

    @property
    def rig(self) -> Rig:
        """The photodiodes as a tracker knows them that was told the truth: without distortion."""
        o = self.options
        diode = Photodiode(Response.linear(o.half_width_m), self.noise, o.half_width_m)
        return Rig(
            tuple(
                RigCamera(
                    name, one.focal_m, one.focal_m, 0.0, 0.0, pose_of(one.place), Lens(),
                    photodiode=diode,
                )
                for name, one in zip(("left", "right"), self.diodes, strict=True)
            )
        )  # fmt: skip

    def stage(self, angle_rad: np.ndarray) -> list[Pose]:
        """rig_from_target at angles of the rotary stage."""
        return [Pose(plain.turn([0, 0, 1], a) @ self._tilt, np.zeros(3)) for a in angle_rad]

    def _seen(self, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """(C, ..., 4) currents without noise."""
        return np.array([diode.see(points, normals, self._far) for diode in self.diodes])

    def currents(self, poses: list[Pose], rng: np.random.Generator | None) -> np.ndarray:
        """(N, C, L, 4) of poses; without noise where ``rng`` is None."""
        points = np.array([self.leds @ p.rotation.T + p.translation_m for p in poses])
        normals = np.array([p.rotation @ _UP for p in poses])[:, None, :]
        exact = np.moveaxis(self._seen(points, normals), 0, 1)
        return exact if rng is None else exact + self.noise * rng.standard_normal(exact.shape)

    def light(self, camera: int, positions_m: np.ndarray) -> np.ndarray:
        """(..., 4) currents of a beam at places (..., 2) on a detector."""
        return self.diodes[camera].currents(positions_m)

    def bound(self, pose: Pose) -> np.ndarray:
        """(6, 6) Cramér–Rao bound of the pose; each light is as bright as it likes."""
        exact = self.currents([pose], None)[0].reshape(-1, 4)
        columns = []
        for k in range(6):
            ends = [
                self.currents(
                    [Pose(*plain.nudged(pose.rotation, pose.translation_m, k, step))], None
                )
                for step in (_STEP, -_STEP)
            ]
            columns.append(((ends[0] - ends[1]) / (2.0 * _STEP)).ravel())
        for k, four in enumerate(exact):
            shining = np.zeros_like(exact)
            shining[k] = four
            columns.append(shining.ravel())
        jacobian = np.stack(columns, axis=1)
        seen = np.isfinite(jacobian).all(axis=1)
        jacobian = jacobian[seen][:, (jacobian[seen] != 0.0).any(axis=0)]
        return self.noise**2 * np.linalg.inv(jacobian.T @ jacobian)[:6, :6]

    def calibration(self, rng: np.random.Generator, scans: int = 60) -> LaboratoryRecord:
        """What a laboratory would measure: scans of a beam, two aligned beams, a plate."""
        o = self.options
        side = np.linspace(-0.9, 0.9, 30) * o.half_width_m
        beam = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
        rows, columns = np.divmod(np.arange(42), 7)
        plate = np.column_stack([0.36 * rows - 0.9, 0.36 * columns - 1.08, np.zeros(42)])
        made = plate + o.plate_sigma_m * rng.standard_normal(plate.shape)

        def noisy(exact: np.ndarray, count: int = 1) -> np.ndarray:
            return exact + self.noise / math.sqrt(count) * rng.standard_normal(exact.shape)

        def seen(pose: Pose) -> list[np.ndarray]:
            points = made @ pose.rotation.T + pose.translation_m
            normals = np.broadcast_to(pose.rotation @ _UP, points.shape)
            return [noisy(one, scans) for one in self._seen(points, normals)]

        cameras, views = [], []
        for k, (name, diode) in enumerate(zip(("left", "right"), self.diodes, strict=True)):
            exact = diode.currents(beam)
            places = diode.principal_m, diode.principal_m + diode.focal_m * diode.lens[6:]
            aligned = [
                noisy(np.broadcast_to(diode.currents(place), (scans, 4))) for place in places
            ]
            cameras.append(
                CameraRecord(
                    name, o.focal_m, o.half_width_m, beam,
                    noisy(np.broadcast_to(exact, (scans, *exact.shape))), *aligned,
                )
            )  # fmt: skip
            before = pose_of(diode.place).inverse() @ Pose(np.eye(3), np.array([0.0, 0.0, 6.4]))
            alone = seen(before)
            views.append(
                PlateView(None, tuple(v if i == k else None for i, v in enumerate(alone)), scans)
            )
        for number in range(12):
            x, y = rng.uniform(-0.35, 0.35, 2)
            rotation = plain.turn([1, 0, 0], x) @ plain.turn([0, 1, 0], y)
            rotation = rotation @ plain.turn([0, 0, 1], 0.5 * number)
            shift = np.array([*rng.uniform(-0.1, 0.1, 2), (-0.5, 0.0, 0.5)[number % 3]])
            placed = Pose(rotation, shift)
            views.append(PlateView(placed, tuple(seen(placed)), scans))
        return LaboratoryRecord(tuple(cameras), plate, o.plate_sigma_m, tuple(views))

    # --- picture cameras

    @property
    def picture_rig(self) -> Rig:
        """The picture cameras as they are."""
        cameras = []
        for name, eye in zip(("left", "right"), self.eyes, strict=True):
            (fx, _, cx), (_, fy, cy), _ = eye.matrix.tolist()
            camera = Camera(*eye.size, fx, fy, cx, cy, tuple(eye.distortion.tolist()))
            cameras.append(RigCamera.from_camera(name, camera, pose_of(eye.place)))
        return Rig(tuple(cameras))

    def _peaks(self, eye: plain.Eye, pose: Pose, points: np.ndarray, peak: float) -> np.ndarray:
        normals = np.broadcast_to(pose.rotation @ _UP, points.shape)
        return peak * plain.brightness(points, normals, eye.place.position, self._far)

    def pictures(
        self, pose: Pose, options: PictureOptions, rng: np.random.Generator
    ) -> list[np.ndarray]:
        """A picture of each camera."""
        points, made = self.leds @ pose.rotation.T + pose.translation_m, []
        for eye in self.eyes:
            shown = rng.permutation(len(points))
            peaks = self._peaks(eye, pose, points[shown], options.peak_grey)
            light = (options.spot_sigma_px, options.sky_grey, options.noise_grey)
            made.append(eye.picture(eye.project(points[shown]), peaks, *light, rng))
        return made

    def picture_bound(self, pose: Pose, options: PictureOptions) -> np.ndarray:
        """(6, 6) Cramér–Rao bound from one picture of each camera: √(2/π) σ / peak a light."""
        points = self.leds @ pose.rotation.T + pose.translation_m
        noise, information = math.hypot(options.noise_grey, math.sqrt(1.0 / 12.0)), np.zeros((6, 6))
        for eye in self.eyes:
            sigma = math.sqrt(2.0 / math.pi) * noise
            sigma = sigma / self._peaks(eye, pose, points, options.peak_grey)
            columns = []
            for k in range(6):
                ends = []
                for step in (_STEP, -_STEP):
                    rotation, shift = plain.nudged(pose.rotation, pose.translation_m, k, step)
                    ends.append(eye.project(self.leds @ rotation.T + shift))
                slopes = (ends[0] - ends[1]) / (2.0 * _STEP)
                columns.append((slopes / sigma[:, None]).ravel())
            jacobian = np.stack(columns, axis=1)
            information += jacobian.T @ jacobian
        return np.linalg.inv(information)


class OwnLaboratory(Laboratory):
    """The product's laboratory, its pictures included."""

    @property
    def picture_rig(self) -> Rig:
        """The picture cameras as they are."""
        return picture_rig(self, PictureOptions())

    def pictures(
        self, pose: Pose, options: PictureOptions, rng: np.random.Generator
    ) -> list[np.ndarray]:
        """A picture of each camera."""
        rig = self.picture_rig
        return [draw(rig, c, pose.apply(self.leds), options, rng) for c in range(len(rig))]

    def picture_bound(self, pose: Pose, options: PictureOptions) -> np.ndarray:
        """(6, 6) Cramér–Rao bound from one picture of each camera."""
        return picture_bound(self.picture_rig, self.leds, pose, options)


def write_record(record: LaboratoryRecord, path: Path) -> None:
    """The file of a laboratory (docs/stereo-laboratory.md); a light that is not seen is null."""

    def plain(value: Any) -> Any:
        if isinstance(value, np.ndarray) and value.ndim == 1:
            return np.round(value, 9).tolist() if np.isfinite(value).all() else None
        if isinstance(value, np.ndarray | tuple):
            return [plain(one) for one in value]
        if isinstance(value, Pose):
            return value.as_dict()
        if is_dataclass(value):
            return {field.name: plain(getattr(value, field.name)) for field in fields(value)}
        return value

    path.write_text(json.dumps(plain(record), allow_nan=False))
