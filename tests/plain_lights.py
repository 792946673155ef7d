"""A plain laboratory of lights, for tests and experiments: numpy, OpenCV, no code of the product.

Two photodiodes, or two picture cameras, look down at a stage. Lights shine with the cosine of the
angle off their normal and fall with the square of the distance. The currents solve the equations
of Welch et al. (NASA TM 102624) backwards: a light's ideal place, eq. 6 for where the lens puts it,
eq. 5 for what the detector then reads, eq. 1 and 2 for the four currents. Picture cameras project
with OpenCV and integrate Gaussian spots over the pixels. Room frame: metres, z down, origin at the
stage.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from tests.plain_pictures import turn

__all__ = [
    "Diode", "Eye", "Place", "brightness", "crooked_diode", "looking_down", "nudged",
    "straight_diode", "turn",
]  # fmt: skip

_FINE = 8  # samples a pixel
_STEPS = 200  # of a fixed point, at most


@dataclass(frozen=True)
class Place:
    """Where a camera is and looks: camera frame x right, y down, z ahead."""

    rotation: np.ndarray  # (3, 3) camera from room
    position: np.ndarray  # (3,) room

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """(..., 3) room → camera."""
        return (points - self.position) @ self.rotation.T


def looking_down(x_m: float, height_m: float) -> Place:
    """A camera ``height_m`` above the stage and ``x_m`` aside, which looks at its middle."""
    lean = turn(np.array([0.0, 1.0, 0.0]), math.atan2(x_m, height_m))
    return Place(lean, np.array([x_m, 0.0, -height_m]))


def brightness(points: np.ndarray, normals: np.ndarray, eye: np.ndarray, far: float) -> np.ndarray:
    """(...,) light that reaches an eye: 1 head-on from ``far`` away, 0 from behind."""
    sight = eye - points
    distance = np.linalg.norm(sight, axis=-1)
    cosine = (sight * normals).sum(axis=-1) / distance
    return np.clip(cosine, 0.0, None) * (far / distance) ** 2


@dataclass(frozen=True)
class Diode:
    """A lateral-effect photodiode behind a lens.

    ``lens`` (8,) holds l1 l2 l3 p1 p2 p3 of eq. 6 and the point of symmetry, normalised by the
    focal length; ``curve`` (2, 10) the coefficients of eq. 5 in half widths: 1 x y xy x² y² x²y xy²
    x³ y³.
    """

    place: Place
    focal_m: float
    half_width_m: float
    principal_m: np.ndarray  # (2,)
    lens: np.ndarray
    curve: np.ndarray

    def on_detector(self, points: np.ndarray) -> np.ndarray:
        """(..., 2) metres on the detector of points (..., 3) of the room; NaN where off it."""
        local = self.place(points)
        ideal = local[..., :2] / local[..., 2:]
        measured = ideal.copy()
        for _ in range(_STEPS if self.lens.any() else 0):
            before, measured = measured, ideal - self._eq6(measured)
            if np.abs(measured - before).max() < 1e-15:
                break
        spot = self.principal_m + self.focal_m * measured
        off = (np.abs(spot) > self.half_width_m).any(axis=-1) | (local[..., 2] <= 0.0)
        spot[off] = np.nan
        return spot

    def _eq6(self, measured: np.ndarray) -> np.ndarray:
        l1, l2, l3, p1, p2, p3 = self.lens[:6]
        x, y = np.moveaxis(measured - self.lens[6:], -1, 0)
        r2 = x**2 + y**2
        radial, more = l1 * r2 + l2 * r2**2 + l3 * r2**3, 1.0 + p3 * r2
        across = x * radial + more * (p1 * (r2 + 2 * x**2) + 2 * p2 * x * y)
        down = y * radial + more * (p2 * (r2 + 2 * y**2) + 2 * p1 * x * y)
        return np.stack([across, down], axis=-1)

    def reading(self, spot_m: np.ndarray) -> np.ndarray:
        """(..., 2) the reading whose eq. 5 is a place on the detector, by Newton's method."""
        wanted = spot_m / self.half_width_m
        read = wanted.copy()
        for _ in range(_STEPS):
            x, y = np.moveaxis(read, -1, 0)
            o, i = np.zeros_like(x), np.ones_like(x)
            value = np.stack([i, x, y, x * y, x**2, y**2, x**2 * y, x * y**2, x**3, y**3], -1)
            by_x = np.stack([o, i, o, y, 2 * x, o, 2 * x * y, y**2, 3 * x**2, o], -1)
            by_y = np.stack([o, o, i, x, o, 2 * y, x**2, 2 * x * y, o, 3 * y**2], -1)
            slopes = np.stack([by_x @ self.curve.T, by_y @ self.curve.T], axis=-1)
            miss = wanted - value @ self.curve.T
            read = read + np.linalg.solve(slopes, miss[..., None])[..., 0]
            if not np.nanmax(np.abs(miss), initial=0.0) > 1e-14:
                break
        return read

    def currents(self, spot_m: np.ndarray, light: np.ndarray | float = 1.0) -> np.ndarray:
        """(..., 4) x1 x2 y1 y2 of eq. 1 and 2, whose pairs each sum to the light."""
        x, y = np.moveaxis(self.reading(spot_m), -1, 0)
        shares = np.stack([1.0 + x, 1.0 - x, 1.0 + y, 1.0 - y], axis=-1)
        return 0.5 * np.asarray(light)[..., None] * shares

    def see(self, points: np.ndarray, normals: np.ndarray, far: float) -> np.ndarray:
        """(..., 4) currents of lights (..., 3) with their normals; NaN where not visible."""
        light = brightness(points, normals, self.place.position, far)
        return self.currents(self.on_detector(points), np.where(light > 0.0, light, np.nan))


@dataclass(frozen=True)
class Eye:
    """A picture camera with OpenCV's lens: k1 k2 p1 p2 k3."""

    place: Place
    size: tuple[int, int]
    matrix: np.ndarray  # (3, 3)
    distortion: np.ndarray  # (5,)

    def project(self, points: np.ndarray) -> np.ndarray:
        """(N, 2) pixels of points (N, 3) of the room."""
        no_turn = np.zeros(3)
        spots, _ = cv2.projectPoints(
            self.place(points), no_turn, no_turn, self.matrix, self.distortion
        )
        return spots.reshape(-1, 2)

    def picture(
        self, spots: np.ndarray, peaks: np.ndarray, sigma_px: float, sky: float, noise: float,
        rng: np.random.Generator,
    ) -> np.ndarray:  # fmt: skip
        """(H, W) uint8 of Gaussian spots (N, 2) px with peaks (N,) grey above the sky."""
        width, height = self.size
        grey = sky + noise * rng.standard_normal((height, width))
        step = (np.arange(_FINE) + 0.5) / _FINE - 0.5
        reach = math.ceil(6.0 * sigma_px)
        for (u, v), peak in zip(spots, peaks, strict=True):
            if not (math.isfinite(u) and math.isfinite(v) and peak > 0.0):
                continue
            columns = np.arange(max(round(u) - reach, 0), min(round(u) + reach + 1, width))
            rows = np.arange(max(round(v) - reach, 0), min(round(v) + reach + 1, height))
            if not (columns.size and rows.size):
                continue
            x, y = columns[:, None] + step - u, rows[:, None] + step - v
            across = np.exp(-0.5 * (x / sigma_px) ** 2).mean(axis=1)
            down = np.exp(-0.5 * (y / sigma_px) ** 2).mean(axis=1)
            grey[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] += peak * np.outer(
                down, across
            )
        return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


def crooked_diode(
    place: Place, focal_m: float, half_width_m: float, rng: np.random.Generator
) -> Diode:
    """A diode with pin-cushion of about 4 %, uneven amplifiers and all of eq. 6, misaligned."""
    wobble = rng.normal(0.0, 0.005, 3)
    aim = turn(wobble, float(np.linalg.norm(wobble))) @ place.rotation
    lens = np.array(
        [
            rng.normal(0.2, 0.03), rng.normal(0.0, 0.3), 0.0, *rng.normal(0.0, 0.004, 2),
            rng.normal(0.0, 3.0), *rng.normal(0.0, 0.004, 2),
        ]
    )  # fmt: skip
    curve = np.zeros((2, 10))
    curve[0, 1] = curve[1, 2] = 1.11  # the reading is smaller than the place …
    curve[0, [7, 8]] = curve[1, [6, 9]] = -0.05  # … and grows towards the rim: x r² and y r²
    curve[:, :3] += rng.normal(0.0, 0.004, (2, 3))
    curve[:, 3:] += rng.normal(0.0, 0.002, (2, 7))
    return Diode(
        Place(aim, place.position), focal_m * (1.0 + rng.normal(0.0, 0.01)), half_width_m,
        rng.normal(0.0, 1e-4, 2), lens, curve,
    )  # fmt: skip


def straight_diode(place: Place, focal_m: float, half_width_m: float) -> Diode:
    """A perfect diode behind a perfect lens."""
    curve = np.zeros((2, 10))
    curve[0, 1] = curve[1, 2] = 1.0
    return Diode(place, focal_m, half_width_m, np.zeros(2), np.zeros(8), curve)


def nudged(
    rotation: np.ndarray, translation: np.ndarray, which: int, step: float
) -> tuple[np.ndarray, np.ndarray]:
    """A pose turned about (0 to 2) or moved along (3 to 5) an axis of the room."""
    axis = np.eye(3)[which % 3]
    if which < 3:
        return turn(axis, step) @ rotation, translation
    return rotation, translation + step * axis
