"""The background of the target: black sky, stars, and the Earth in the same sunlight.

Radiance is in units of a white Lambert surface that faces the Sun, as for the target.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy.spatial.transform import Rotation

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array
from rendezview.geometry.zbuffer import Float32s
from rendezview_ground.limits import POSITIVE, check
from rendezview_ground.mesh.directions import perpendicular
from rendezview_ground.simulate.distortion import pixel_rays

# Of the ground below: one turn per orbit of 92.6 min. Source: a circular orbit of 400 km
GROUND_RATE_RAD_S = 1.13e-3


@dataclass(frozen=True, slots=True, kw_only=True)
class Earth:
    """A sphere with procedural clouds, sea and land. Eclipse is not modelled."""

    angular_radius_rad: float = 1.22  # rad; from 400 km altitude: arcsin(6378 / 6778) = 70.2°
    seed: int = 0

    def __post_init__(self) -> None:
        check(self, POSITIVE, math.radians(89.0), "angular_radius_rad")


@dataclass(frozen=True, slots=True, kw_only=True)
class Stars:
    """Stars over the whole sky, much brighter than in an exposure for sunlit metal."""

    count: int = 8000  # stars; about 40 in a frame of 30° × 23°
    brightest: float = 1.0  # radiance × pixels of the brightest ones
    seed: int = 0

    def __post_init__(self) -> None:
        check(self, 0.0, math.inf, "count", "brightest")


def star_radiance(camera: Camera, camera_from_sky: npt.ArrayLike, stars: Stars) -> Float32s:
    """Radiance (H, W) of the stars, ``camera_from_sky`` a (3, 3) rotation.

    The light of each star is distributed bilinearly over the four pixels around it, so that the
    centroid is exact.
    """
    rng = np.random.default_rng(stars.seed)
    directions = rng.standard_normal((stars.count, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    # N ∝ L^-1.25 stars are brighter than L; the real sky has exponents of -1.2 to -1.5.
    light = stars.brightest * np.minimum(1.0, (rng.random(stars.count) * 100.0 + 1.0) ** -0.8)
    in_camera = directions @ np.asarray(camera_from_sky, dtype=np.float64).T
    # Distortion polynomials fold far outside the frame, so only stars near it are projected.
    rays = pixel_rays(camera)
    edge = 1.05 * np.hypot(rays[..., 0], rays[..., 1]).max()
    ahead = (in_camera[:, 2] > 0.0) & (
        np.hypot(in_camera[:, 0], in_camera[:, 1]) < edge * in_camera[:, 2]
    )
    sky = np.zeros((camera.height, camera.width), np.float32)
    if not ahead.any():
        return sky
    points_px = np.asarray(camera.project(in_camera[ahead]))
    corner = np.floor(points_px).astype(np.int64)
    part = points_px - corner
    for down in (0, 1):
        for right in (0, 1):
            column, row = corner[:, 0] + right, corner[:, 1] + down
            weight = np.abs(1 - right - part[:, 0]) * np.abs(1 - down - part[:, 1])
            inside = (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
            np.add.at(sky, (row[inside], column[inside]), (weight * light[ahead])[inside])
    return sky


def earth_radiance(
    camera: Camera,
    earth_direction_camera: npt.ArrayLike,
    sun_direction_camera: npt.ArrayLike,
    earth: Earth,
    ground_from_camera: npt.ArrayLike | None = None,
) -> tuple[Float32s, Float32s]:
    """Radiance of the Earth and the transmitted share of background light, both (H, W).

    Args:
        earth_direction_camera: (3,) unit, from the camera to the Earth's centre.
        sun_direction_camera: (3,) unit, towards the Sun.
        ground_from_camera: (3, 3) rotation that selects the visible ground; ``None``: the identity.
    """
    turn = np.eye(3) if ground_from_camera is None else np.asarray(ground_from_camera, np.float64)
    offset = np.random.default_rng(earth.seed).uniform(-50.0, 50.0, 3)
    radiance = np.zeros((camera.height, camera.width), np.float32)
    clear = np.ones((camera.height, camera.width), np.float32)
    _paint_earth(
        pixel_rays(camera),
        np.asarray(earth_direction_camera, dtype=np.float64),
        np.asarray(sun_direction_camera, dtype=np.float64),
        1.0 / math.sin(earth.angular_radius_rad),
        1.0 / max(camera.fx, camera.fy),
        np.ascontiguousarray(turn),
        offset,
        radiance,
        clear,
    )
    return radiance, clear


def ground_rotation(direction: Array, angle_rad: float) -> Array:
    """(3, 3) rotation of the ground below by an angle, about an axis across ``direction``."""
    return np.asarray(Rotation.from_rotvec(angle_rad * perpendicular(direction)).as_matrix())


@njit(cache=True, nogil=True, error_model="numpy")
def _lattice(i: int, j: int, k: int) -> float:
    """A pseudo-random number in [0, 1) from three integers (an integer hash)."""
    h = np.uint32(i * 374761393 + j * 668265263 + k * 1274126177)
    h = np.uint32((h ^ (h >> np.uint32(13))) * np.uint32(1103515245))
    h = np.uint32((h ^ (h >> np.uint32(15))) * np.uint32(2654435761))
    return float(h ^ (h >> np.uint32(16))) / 4294967296.0


@njit(cache=True, nogil=True, error_model="numpy")
def _noise(x: float, y: float, z: float) -> float:
    """Value noise in [0, 1): lattice numbers with smooth interpolation."""
    i, j, k = math.floor(x), math.floor(y), math.floor(z)
    u, v, w = x - i, y - j, z - k
    u, v, w = u * u * (3 - 2 * u), v * v * (3 - 2 * v), w * w * (3 - 2 * w)
    i, j, k = int(i), int(j), int(k)
    total = 0.0
    for a in range(2):
        for b in range(2):
            for c in range(2):
                weight = (u if a else 1 - u) * (v if b else 1 - v) * (w if c else 1 - w)
                total += weight * _lattice(i + a, j + b, k + c)
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def _fractal(x: float, y: float, z: float, frequency: float, footprint: float) -> float:
    """Octaves of noise around 0, none finer than the pixel's footprint on the ground."""
    total, weight = 0.0, 0.5
    for _ in range(13):
        if frequency * footprint > 0.4:
            break
        total += weight * (_noise(x * frequency, y * frequency, z * frequency) - 0.5)
        x, y, z = x + 17.3, y - 9.1, z + 4.7
        frequency, weight = 2.03 * frequency, 0.63 * weight
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def _step(x: float, low: float, high: float) -> float:
    """Smooth step from 0 at ``low`` to 1 at ``high``."""
    t = min(max((x - low) / (high - low), 0.0), 1.0)
    return t * t * (3.0 - 2.0 * t)


@njit(cache=True, nogil=True, error_model="numpy")
def _ground_albedo(x: float, y: float, z: float, footprint: float, slant: float) -> float:
    """Albedo of clouds, land, sea and haze at a place of the unit sphere.

    Args:
        footprint: of the pixel on the ground, Earth radii.
        slant: cosine between the line of sight and the vertical.
    """
    # A slow displacement field stretches the clouds like weather.
    bend = 0.08 * _fractal(x, y, z, 6.0, max(footprint, 0.02))
    x, y, z = x + bend, y - bend, z + bend
    cover = _fractal(x, y, z, 4.0, max(footprint, 0.01))
    cloud = _step(0.8 * _fractal(x, y, z, 30.0, footprint) + 0.8 * cover, -0.06, 0.18)
    height = _fractal(x + 31.0, y, z, 2.0, max(footprint, 0.001))
    land = _step(height, 0.0, 0.01)
    ground = (1.0 - land) * 0.05 + land * (
        0.2 + 0.4 * _fractal(x, y, z, 90.0, max(footprint, 5e-4))
    )
    albedo = (1.0 - cloud) * ground + cloud * 0.8
    haze = min(0.05 / slant, 0.3)
    return albedo * (1.0 - haze) + haze * 0.9


@njit(cache=True, nogil=True, error_model="numpy")
def _paint_earth(
    rays: Array, centre: Array, sun: Array, distance: float, pixel: float, turn: Array,
    offset: Array, radiance: Float32s, clear: Float32s,
) -> None:  # fmt: skip
    """Intersect each pixel's ray with a unit sphere at ``distance`` along ``centre``."""
    air = 0.0016  # Earth radii (10 km); height over which the limb's glow falls by 1/e
    for row in range(rays.shape[0]):
        for column in range(rays.shape[1]):
            d = rays[row, column] / np.sqrt(np.sum(rays[row, column] ** 2))
            along = distance * np.sum(d * centre)
            # Squared distance of the ray from the centre; below 1 it hits the ground.
            nearest_2 = distance * distance - along * along
            if along <= 0.0:
                continue
            if nearest_2 >= 1.0:
                height = math.sqrt(nearest_2) - 1.0
                haze = math.exp(-height / air)
                if haze < 1e-3:
                    continue
                up = (along * d - distance * centre) / math.sqrt(nearest_2)
                radiance[row, column] = 0.30 * haze * max(np.sum(up * sun) + 0.05, 0.0)
                clear[row, column] = 1.0 - haze
                continue
            clear[row, column] = 0.0
            depth = along - math.sqrt(1.0 - nearest_2)
            up = depth * d - distance * centre
            daylight = np.sum(up * sun)
            if daylight <= -0.05:
                continue
            slant = max(-np.sum(up * d), 0.02)
            footprint = pixel * depth / slant
            x, y, z = 0.0, 0.0, 0.0
            for k in range(3):
                x += turn[0, k] * up[k]
                y += turn[1, k] * up[k]
                z += turn[2, k] * up[k]
            x, y, z = x + offset[0], y + offset[1], z + offset[2]
            albedo = _ground_albedo(x, y, z, footprint, slant)
            radiance[row, column] = max(albedo, 0.0) * max(daylight, 0.03 * (daylight + 0.05))
