"""The cameras of a stereo tracker, each with its detector and lens, in one rig frame.

The rig frame is the paper's fixed laboratory frame; with two ordinary cameras it is most
simply the first camera's own.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera, LensModel
from rendezview.geometry.pose import Pose
from rendezview.sensors.beacons.detect.brown_lens import COEFFICIENT_NAMES, Array, Lens
from rendezview.sensors.beacons.detect.detectors import Photodiode, Spots

# Numbers of a camera in the order of their covariance: intrinsics, then camera_from_rig.
INTRINSICS = ("fx", "fy", "cx", "cy", *COEFFICIENT_NAMES)
POSE = ("wx", "wy", "wz", "tx", "ty", "tz")


@dataclass(frozen=True, slots=True, eq=False)
class RigCamera:
    """One camera: ``u = fx x' + cx``, ``v = fy y' + cy``, in the detector's units.

    (x', y') is measured, normalised; the lens leads from there to the ideal (x/z, y/z).

    Raises:
        ValueError: a number is not finite, or a focal length or size not positive.
    """

    name: str
    fx: float  # detector units: px, or m
    fy: float
    cx: float  # principal point
    cy: float
    camera_from_rig: Pose
    lens: Lens = field(default_factory=Lens)
    size: tuple[int, int] | None = None  # width, height in px; None: a photodiode
    photodiode: Photodiode | None = None
    floor: float = 0.0  # what calibration leaves, r.m.s., detector units; added to each spot's σ
    sigma: dict[str, float] = field(default_factory=dict)  # of what was calibrated, by name
    rms: float | None = None  # calibration residual, detector units
    # the lens model's share of the floor; the rest is noise of the board's corners
    misfit: float | None = None

    def __post_init__(self) -> None:
        for name, least in (("fx", 0.0), ("fy", 0.0), ("cx", -math.inf), ("cy", -math.inf)):
            value = float(getattr(self, name))
            if not (math.isfinite(value) and value > least):
                raise ValueError(f"{name} of camera {self.name!r} must not be {value}")
        if not 0.0 <= self.floor < math.inf:
            raise ValueError(f"floor of camera {self.name!r} must not be {self.floor}")
        if (self.size is None) == (self.photodiode is None):
            raise ValueError(f"camera {self.name!r} needs a size in pixels or a photodiode")
        if self.size is not None and not all(isinstance(n, int) and n > 0 for n in self.size):
            raise ValueError(f"size of camera {self.name!r} must be positive, not {self.size}")

    @classmethod
    def from_camera(cls, name: str, camera: Camera, camera_from_rig: Pose) -> RigCamera:
        """From a camera of OpenCV's model.

        Raises:
            RendezviewError: a fisheye, or terms that Brown's model does not have.
        """
        if camera.lens_model is LensModel.FISHEYE:
            raise RendezviewError(
                f"camera {name!r} has a fisheye lens, which Brown's model (eq. 6) does not have: "
                "calibrate with k1 k2 p1 p2 k3"
            )
        return cls(
            name, camera.fx, camera.fy, camera.cx, camera.cy, camera_from_rig,
            Lens.from_opencv(camera.distortion), (camera.width, camera.height),
        )  # fmt: skip

    def to_camera(self) -> Camera:
        """The same as a camera of OpenCV's model, lens refitted where the models differ.

        Raises:
            RendezviewError: a photodiode, or the models differ by more than 0.01 px.
        """
        if self.size is None:
            raise RendezviewError(f"camera {self.name!r} is a photodiode: OpenCV has no such model")
        distortion = self.lens.to_opencv(self.reach, 0.01 / max(self.fx, self.fy))
        return Camera(*self.size, self.fx, self.fy, self.cx, self.cy, distortion)

    @property
    def reach(self) -> float:
        """Largest half-width of the field, normalised."""
        if self.size is None:
            assert self.photodiode is not None
            half = self.photodiode.half_width_m
            return (half + max(abs(self.cx), abs(self.cy))) / min(self.fx, self.fy)
        width, height = self.size
        return max(
            max(self.cx, width - 1 - self.cx) / self.fx,
            max(self.cy, height - 1 - self.cy) / self.fy,
        )

    def project(self, points_rig_m: npt.ArrayLike) -> Array:
        """(N, 3) points in the rig frame → (N, 2) detector units; NaN where not in front."""
        points = self.camera_from_rig.apply(np.asarray(points_rig_m, dtype=np.float64))
        depth = np.where(points[:, 2:] > 0.0, points[:, 2:], np.nan)
        normalised = self.lens.distort(points[:, :2] / depth)
        return np.asarray(normalised * (self.fx, self.fy) + (self.cx, self.cy))

    def slopes(self, points_rig_m: Array) -> tuple[Array, Array, Array]:
        """Places (N, 2) of points (N, 3) in front, and their slopes in detector units.

        Returns also (N, 2, 18) by INTRINSICS and POSE, and (N, 2, 3) by the point in the rig frame.
        """
        c = self.camera_from_rig
        arm = points_rig_m @ c.rotation.T
        points = arm + c.translation_m
        ideal = points[:, :2] / points[:, 2:]
        measured, by_ideal, by_lens = self.lens.derivatives(ideal)
        focal = np.array([self.fx, self.fy])
        by_point = np.zeros((len(points), 2, 3))  # ∂ ideal / ∂ p_camera
        by_point[:, 0, 0] = by_point[:, 1, 1] = 1.0 / points[:, 2]
        by_point[:, :, 2] = -ideal / points[:, 2:]
        by_point = focal[:, None] * (by_ideal @ by_point)
        by_own = np.zeros((len(points), 2, len(INTRINSICS) + len(POSE)))
        by_own[:, 0, 0], by_own[:, 1, 1] = measured.T
        by_own[:, 0, 2] = by_own[:, 1, 3] = 1.0
        by_own[:, :, 4:12] = focal[:, None] * by_lens
        by_own[:, :, 12:] = by_pose(by_point, arm)
        return measured * focal + (self.cx, self.cy), by_own, by_point @ c.rotation

    def ideal(self, spots: Spots) -> tuple[Array, Array]:
        """(N, 2) ideal places of spots, normalised, and their standard deviations."""
        focal = np.array([self.fx, self.fy])
        measured = (spots.positions - (self.cx, self.cy)) / focal
        ideal, slopes = self.lens.undistort_slopes(measured)
        sigma = np.hypot(spots.sigma, self.floor) / focal
        sigma = np.sqrt(((slopes * sigma[:, None]) ** 2).sum(axis=2))
        return ideal, np.where(np.isfinite(ideal), sigma, np.nan)


@dataclass(frozen=True, slots=True, eq=False)
class Sights:
    """Where all cameras saw the target's lights at one time: the 24 numbers of eq. 4."""

    xy: Array  # (C, L, 2) ideal places x/z, y/z; 0 where not visible
    weight: Array  # (C, L, 2) 1/σ; 0 where not visible

    @property
    def visible(self) -> npt.NDArray[np.bool_]:
        """(C, L) which camera saw which light."""
        return np.asarray((self.weight > 0.0).all(axis=2))


@dataclass(frozen=True, slots=True, eq=False)
class Rig:
    """One or more cameras that look at the same target."""

    cameras: tuple[RigCamera, ...]
    covariance: Array | None = None  # of the calibration's free parameters
    covariance_names: tuple[str, ...] = ()
    rotations: Array = field(init=False)  # (C, 3, 3) camera from rig
    translations: Array = field(init=False)  # (C, 3)

    def __post_init__(self) -> None:
        if not self.cameras:
            raise ValueError("a rig needs at least one camera")
        names = [camera.name for camera in self.cameras]
        if len(set(names)) < len(names):
            raise ValueError(f"the cameras of a rig need different names, not {names}")
        object.__setattr__(self, "cameras", tuple(self.cameras))
        poses = [camera.camera_from_rig for camera in self.cameras]
        object.__setattr__(self, "rotations", np.stack([p.rotation for p in poses]))
        object.__setattr__(self, "translations", np.stack([p.translation_m for p in poses]))

    def __len__(self) -> int:
        return len(self.cameras)

    def sights(self, spots: Sequence[Spots], leds: int) -> Sights:
        """The tracker's input from identified spots, one `Spots` for each camera.

        Spots without identity, and those that the lens model cannot correct, are left out;
        of several spots with one number none is believed.

        Raises:
            ValueError: a number of cameras or lights that is not the rig's or target's.
        """
        if len(spots) != len(self.cameras):
            raise ValueError(f"{len(spots)} cameras' spots for a rig of {len(self.cameras)}")
        xy, weight = np.zeros((len(spots), leds, 2)), np.zeros((len(spots), leds, 2))
        for k, (camera, found) in enumerate(zip(self.cameras, spots, strict=True)):
            if (found.led >= leds).any():
                raise ValueError(f"camera {camera.name!r} names a light beyond the target's {leds}")
            ideal, sigma = camera.ideal(found)
            times = np.bincount(found.led[found.led >= 0], minlength=leds)
            one = (found.led >= 0) & np.isfinite(ideal).all(axis=1) & (times[found.led] == 1)
            xy[k, found.led[one]], weight[k, found.led[one]] = ideal[one], 1.0 / sigma[one]
        return Sights(xy, weight)


def required_leds(positions: Sequence[npt.ArrayLike], what: str) -> Array:
    """(L, 3) places of a target's lights, checked.

    Raises:
        RendezviewError: fewer than three, or all on one line.
    """
    leds = np.ascontiguousarray(positions, dtype=np.float64).reshape(-1, 3)
    if len(leds) < 3 or not np.isfinite(leds).all():
        raise RendezviewError(
            f"{what}: has {len(leds)} lights, a pose needs at least 3: add [[leds]] to target.toml"
        )
    spread = np.linalg.svd(leds - leds.mean(axis=0), compute_uv=False)
    if spread[1] < 1e-6 * spread[0] or spread[0] == 0.0:
        raise RendezviewError(f"{what}: its lights are all on one line: a pose needs a triangle")
    return leds


def by_pose(by_point: Array, arms: Array) -> Array:
    """(N, 2, 6) slopes by a pose's left perturbation from those by its points (N, 2, 3).

    ``arms`` (N, 3): the points less the pose's place. ``d p / d(rotation vector) = −[R p]×``.
    """
    x, y, z = arms.T[:, :, None]
    u, v, w = by_point[..., 0], by_point[..., 1], by_point[..., 2]
    slopes = np.empty((*by_point.shape[:2], 6))
    slopes[..., 0], slopes[..., 1], slopes[..., 2] = y * w - z * v, z * u - x * w, x * v - y * u
    slopes[..., 3:] = by_point
    return slopes


def intrinsics_of(camera: RigCamera) -> Array:
    """(12,) in the order of INTRINSICS."""
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy, *camera.lens.coefficients])


def with_intrinsics(camera: RigCamera, values: Array, pose: Pose) -> RigCamera:
    """The camera with other intrinsics (12,) at another place."""
    fx, fy, cx, cy = values[:4].tolist()
    lens = Lens.from_coefficients(values[4:], corrects=camera.lens.corrects)
    return replace(camera, fx=fx, fy=fy, cx=cx, cy=cy, lens=lens, camera_from_rig=pose)
