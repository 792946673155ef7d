"""The optics laboratory of Welch et al. (1991): lights on a rotary stage, two photodiodes.

Laboratory (rig) frame: z down, origin at the stage. The cameras hang above the stage and see six
lights, which are switched on one after the other. The paper gives neither the positions of the
cameras nor those of the lights. Here the lights of ``models_cad/scole`` fill the field of the
paper's lens and detector (25 mm, 1 cm × 1 cm).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from rendezview.calibration.laboratory import CameraRecord, LaboratoryRecord, PlateView
from rendezview.geometry.pose import Array, Pose
from rendezview.sensors.beacons import Lens, Photodiode, Response, Rig, RigCamera

_STEP = 1e-6  # rad, m; step of the numeric derivatives of the bound


@dataclass(frozen=True, kw_only=True)
class LaboratoryOptions:
    """Options of the laboratory."""

    signal_to_noise: float = 200.0  # largest signal of an electrode over r.m.s. noise of one
    height_m: float = 7.0  # of the cameras above the stage
    baseline_m: float = 6.0
    focal_m: float = 0.025
    half_width_m: float = 0.005
    pin_cushion: float = 0.04  # distortion of the reading at the middle of an edge; 7 % at a corner
    plane_tilt_rad: float = float(np.deg2rad(2.0))  # of the lights' plane against the stage
    plate_sigma_m: float = 0.0005  # of the calibration plate's lights; the paper's: below 0.05 in
    distorted: bool = True  # a lens with all of eq. 6, misaligned; False: a perfect one


def electrode_currents(readings: Array) -> Array:
    """(..., 2) readings of eq. 1, 2 → (..., 4) currents x1 x2 y1 y2 of a light of 2."""
    x, y = readings[..., 0], readings[..., 1]
    return 0.5 * np.stack([1.0 + x, 1.0 - x, 1.0 + y, 1.0 - y], -1)


class Laboratory:
    """The truth: cameras, detectors and stage.

    Args:
        leds: (L, 3) lights in the target frame, metres.
        options: of the laboratory.
        seed: of lens, detectors and misalignment, which differ between laboratories.
    """

    def __init__(
        self, leds: npt.ArrayLike, options: LaboratoryOptions | None = None, seed: int = 0
    ) -> None:
        self.leds = np.asarray(leds, dtype=np.float64)
        self.options = options or LaboratoryOptions()
        rng = np.random.default_rng([seed, 1991])
        self.rig = Rig(
            tuple(self._camera(name, side, rng) for name, side in (("left", -0.5), ("right", 0.5)))
        )
        self._skew = [rng.normal(0.0, 0.004, (2, 3)) for _ in self.rig.cameras]
        across = rng.uniform(0.0, 2.0 * np.pi)
        tilt = self.options.plane_tilt_rad * np.array([np.cos(across), np.sin(across), 0.0])
        self.stage_from_target = Pose(Rotation.from_rotvec(tilt).as_matrix(), np.zeros(3))

    @property
    def noise(self) -> float:
        """R.m.s. noise of one current; the light is 2, so that the largest current is 1."""
        return 1.0 / self.options.signal_to_noise

    def _camera(self, name: str, side: float, rng: np.random.Generator) -> RigCamera:
        o = self.options
        place = np.array([side * o.baseline_m, 0.0, -o.height_m])
        ahead = -place / np.linalg.norm(place)
        right = np.cross([0.0, 1.0, 0.0], ahead)
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(ahead, right), ahead])
        lens, cx, cy, focal = Lens(), 0.0, 0.0, o.focal_m
        if o.distorted:
            rotation = Rotation.from_rotvec(rng.normal(0.0, 0.005, 3)).as_matrix() @ rotation
            lens = Lens(
                (0.20 + rng.normal(0.0, 0.03), rng.normal(0.0, 0.3), 0.0),
                (rng.normal(0.0, 0.004), rng.normal(0.0, 0.004), rng.normal(0.0, 3.0)),
                (rng.normal(0.0, 0.004), rng.normal(0.0, 0.004)),
            )
            cx, cy = rng.normal(0.0, 1e-4, 2)
            focal *= 1.0 + rng.normal(0.0, 0.01)
        return RigCamera(
            name, focal, focal, cx, cy, Pose(rotation, -rotation @ place), lens,
            photodiode=Photodiode(
                Response.linear(o.half_width_m), self.noise, o.half_width_m
            ),
        )  # fmt: skip

    def stage(self, angle_rad: npt.ArrayLike) -> list[Pose]:
        """rig_from_target at angles of the rotary stage, whose axis is the laboratory's z."""
        angles = np.atleast_1d(np.asarray(angle_rad, dtype=np.float64))
        turns = Rotation.from_rotvec(np.outer(angles, [0.0, 0.0, 1.0])).as_matrix()
        return [Pose(turn, np.zeros(3)) @ self.stage_from_target for turn in turns]

    def response(self, camera: int, positions_m: Array) -> Array:
        """(..., 2) metres on a detector → (..., 2) readings of eq. 1, 2 without noise.

        Pin-cushion that is no cubic when inverted, and amplifiers whose gains and offsets
        differ a little.
        """
        p = positions_m / self.options.half_width_m
        r2 = (p**2).sum(axis=-1, keepdims=True)
        bent = 0.9 * p * (1.0 + self.options.pin_cushion * r2 * (1.0 - 0.1 * r2))
        if not self.options.distorted:
            return np.asarray(p)
        skew = self._skew[camera]
        return np.asarray(bent @ (np.eye(2) + skew[:, :2]).T + skew[:, 2])

    def light(self, camera: int, positions_m: Array) -> Array:
        """(..., 2) metres on a detector → (..., 4) currents x1 x2 y1 y2 without noise."""
        return electrode_currents(self.response(camera, positions_m))

    def noiseless(self, camera: int, points_rig_m: Array) -> Array:
        """(N, 3) lights → (N, 4) currents; NaN where off the detector."""
        places = self.rig.cameras[camera].project(points_rig_m)
        places[(np.abs(places) > self.options.half_width_m).any(axis=1)] = np.nan
        return self.light(camera, places)

    def currents(self, poses: list[Pose], rng: np.random.Generator | None) -> Array:
        """(N, C, L, 4) of poses rig_from_target; without noise where ``rng`` is None."""
        exact = np.array(
            [
                [self.noiseless(k, pose.apply(self.leds)) for k in range(len(self.rig))]
                for pose in poses
            ]
        )
        return exact if rng is None else exact + rng.normal(0.0, self.noise, exact.shape)

    def scan(
        self, pose_at: Callable[[float], Pose], times_s: Array, rng: np.random.Generator | None
    ) -> Array:
        """(C, L, 4) currents of one reading whose lights shine one after the other.

        Args:
            pose_at: rig_from_target at a time.
            times_s: (L,) of each light.
            rng: of the noise; None: without.
        """
        places = np.array(
            [pose_at(float(t)).apply(led) for t, led in zip(times_s, self.leds, strict=True)]
        )
        exact = np.array([self.noiseless(k, places) for k in range(len(self.rig))])
        return exact if rng is None else exact + rng.normal(0.0, self.noise, exact.shape)

    def calibration(self, rng: np.random.Generator, scans: int = 60) -> LaboratoryRecord:
        """The measurements of a calibration of this laboratory, with the noise of its readings.

        A scan of 30 × 30 places, aligned beams, a plate of 6 × 7 lights before each lens
        and at twelve surveyed places, everything averaged over ``scans`` frames.
        """
        o = self.options
        side = np.linspace(-0.92, 0.92, 30) * o.half_width_m
        beam = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
        plate = np.column_stack(
            [np.mgrid[:6, :7].reshape(2, -1).T * 0.36 - (0.9, 1.08), np.zeros(42)]
        )
        real_plate = plate + rng.normal(0.0, o.plate_sigma_m, plate.shape)
        cameras, views = [], []
        for k, camera in enumerate(self.rig.cameras):
            exact = self.light(k, beam)
            scan = exact + rng.normal(0.0, self.noise, (scans, *exact.shape))
            principal = np.array([camera.cx, camera.cy])
            centre = principal + np.multiply(camera.lens.centre, camera.fx)
            beams = [
                self.light(k, place) + rng.normal(0.0, self.noise, (scans, 4))
                for place in (principal, centre)
            ]
            cameras.append(CameraRecord(camera.name, o.focal_m, o.half_width_m, beam, scan, *beams))
            before_lens = Pose(np.eye(3), np.array([0.02, -0.03, 6.4]))
            seen = self._averaged(k, camera.camera_from_rig.inverse() @ before_lens, real_plate,
                                  rng, scans)  # fmt: skip
            only = tuple(seen if i == k else None for i in range(len(self.rig)))
            views.append(PlateView(None, only, scans))
        for number in range(12):
            height = (-0.5, 0.0, 0.5)[number % 3]
            turned = Rotation.from_euler("zyx", [0.5 * number, *rng.uniform(-0.35, 0.35, 2)])
            place = Pose(turned.as_matrix(), np.array([*rng.uniform(-0.1, 0.1, 2), height]))
            both = tuple(
                self._averaged(k, place, real_plate, rng, scans) for k in range(len(self.rig))
            )
            views.append(PlateView(place, both, scans))
        return LaboratoryRecord(tuple(cameras), plate, o.plate_sigma_m, tuple(views))

    def _averaged(
        self, k: int, rig_from_plate: Pose, plate: Array, rng: np.random.Generator, scans: int
    ) -> Array:
        exact = self.noiseless(k, rig_from_plate.apply(plate))
        return exact + rng.normal(0.0, self.noise / np.sqrt(scans), exact.shape)

    def bound(self, pose: Pose) -> Array:
        """(6, 6) Cramér–Rao bound of rig_from_target from one reading's currents.

        Of all unbiased estimators that know the calibration but not how bright each light
        appears in each camera. Derivatives are numerical, of the simulation itself.
        """
        cameras, lights = len(self.rig), len(self.leds)
        jacobian = np.zeros((cameras, lights, 4, 6))
        for i in range(6):
            step = np.zeros(6)
            step[i] = _STEP
            ahead, behind = pose.perturbed(step), pose.perturbed(-step)
            jacobian[..., i] = self.currents([ahead], None)[0] - self.currents([behind], None)[0]
        jacobian /= 2.0 * _STEP
        light = self.currents([pose], None)[0]
        information = np.zeros((6, 6))
        for k in range(cameras):
            for j in range(lights):
                if not np.isfinite(light[k, j]).all():
                    continue
                e = light[k, j] / np.linalg.norm(light[k, j])  # brightness scales all four
                across = jacobian[k, j] - np.outer(e, e @ jacobian[k, j])
                information += across.T @ across
        return np.asarray(np.linalg.inv(information) * self.noise**2)
