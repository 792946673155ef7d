"""Plain pictures of discs and lights, for tests and experiments: numpy, and no code of the product.

A pinhole camera, discs that are supersampled and blurred, Gaussian lights, false spots, a
background, noise and 8 bits. Pixel (0, 0) is the centre of the first pixel; x right, y down.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Pinhole:
    """A camera without distortion."""

    width: int = 512
    height: int = 384
    focal_px: float = 650.0
    cx: float = 255.5
    cy: float = 191.5

    def project(self, points: np.ndarray) -> np.ndarray:
        """(N, 2) pixels of points (N, 3) in the camera frame."""
        x, y, z = points.T
        return np.column_stack([self.cx + self.focal_px * x / z, self.cy + self.focal_px * y / z])


@dataclass(frozen=True)
class Look:
    """Light and detector."""

    peak: float = 180.0  # grey, of the brightest disc above the black level
    black: float = 10.0  # grey
    noise: float = 2.0  # grey, one σ of one pixel
    blur: float = 0.7  # px, σ of the optics alone
    even: bool = False  # discs in even light; else light that falls with range²
    leak: float = 0.02  # share of the light in the dark picture


def turn(axis: np.ndarray, angle: float) -> np.ndarray:
    """(3, 3) rotation by Rodrigues' formula."""
    x, y, z = np.asarray(axis, float) / np.linalg.norm(axis)
    k = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + math.sin(angle) * k + (1.0 - math.cos(angle)) * k @ k


def look_at(
    rng: np.random.Generator, camera: Pinhole, range_m: float, tilt: float, margin_px: float,
    least_tilt: float = 0.0,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """A target whose face (+z, y up) looks at the camera, tilted by up to ``tilt``, rolled at will.

    Returns rotation (3, 3) and translation (3,), camera from target.
    """
    roll = turn([0, 0, 1], rng.uniform(-math.pi, math.pi))
    way = rng.uniform(0.0, 2.0 * math.pi)
    off = math.sqrt(least_tilt**2 + (tilt**2 - least_tilt**2) * rng.random())
    lean = turn([math.cos(way), math.sin(way), 0.0], off)
    u = rng.uniform(margin_px, camera.width - 1 - margin_px)
    v = rng.uniform(margin_px, camera.height - 1 - margin_px)
    sight = np.array([(u - camera.cx) / camera.focal_px, (v - camera.cy) / camera.focal_px, 1.0])
    sight /= np.linalg.norm(sight)
    across = np.cross([0.0, 0.0, 1.0], sight)
    off = np.linalg.norm(across)
    aim = turn(across, math.asin(min(off, 1.0))) if off > 1e-9 else np.eye(3)
    return aim @ lean @ roll @ np.diag([1.0, -1.0, -1.0]), range_m * sight


def _kernel(sigma: float) -> np.ndarray:
    reach = math.ceil(4.0 * sigma)
    taps = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    return taps / taps.sum()


def _blurred(fine: np.ndarray, sigma: float) -> np.ndarray:
    taps = _kernel(sigma)
    for axis in (0, 1):
        fine = np.apply_along_axis(np.convolve, axis, fine, taps, mode="same")
    return fine


def disc(
    camera: Pinhole, place: np.ndarray, normal: np.ndarray, radius: float, look: Look,
    cover: tuple[float, float] | None = None,
) -> tuple[slice, slice, np.ndarray] | None:  # fmt: skip
    """Rows, columns and grey levels of one disc of unit radiance; None out of the picture.

    A ray through every point of a fine grid meets the disc's plane inside or outside the disc.
    ``cover``: direction (rad) and radii from its middle of an edge behind which it is hidden.
    """
    (u, v), *_ = camera.project(place[None])
    half = math.ceil(radius * camera.focal_px / place[2] * 1.3 + 4.5 * look.blur + 2.0)
    fine = 8 if half < 20 else 4
    x0, y0 = round(float(u)) - half, round(float(v)) - half
    steps = (np.arange((2 * half + 1) * fine) + 0.5) / fine - 0.5
    gx = (x0 + steps[None, :] - camera.cx) / camera.focal_px
    gy = (y0 + steps[:, None] - camera.cy) / camera.focal_px
    depth = float(normal @ place) / (normal[0] * gx + normal[1] * gy + normal[2])
    off2 = (gx * depth - place[0]) ** 2 + (gy * depth - place[1]) ** 2 + (depth - place[2]) ** 2
    rise = np.hypot(*np.gradient(off2)) + 1e-30
    inside = np.clip(0.5 + (radius * radius - off2) / rise, 0.0, 1.0)
    if cover is not None:
        way = math.cos(cover[0]) * (gx * depth - place[0]) + math.sin(cover[0]) * (
            gy * depth - place[1]
        )
        inside = inside * (way < cover[1] * radius)
    if not look.even:
        inside = inside * float(place @ place) / ((gx * gx + gy * gy + 1.0) * depth * depth)
    soft = _blurred(inside, look.blur * fine)
    n = 2 * half + 1
    grey = soft.reshape(n, fine, n, fine).mean(axis=(1, 3))
    top, left = max(y0, 0), max(x0, 0)
    bottom, right = min(y0 + n, camera.height), min(x0 + n, camera.width)
    if bottom <= top or right <= left:
        return None
    return (
        slice(top, bottom),
        slice(left, right),
        grey[top - y0 : bottom - y0, left - x0 : right - x0],
    )


def discs(
    camera: Pinhole, rotation: np.ndarray, translation: np.ndarray, points: np.ndarray,
    normals: np.ndarray, diameters: np.ndarray, look: Look, hidden: tuple[int, ...] = (),
    covers: dict[int, tuple[float, float]] | None = None,
) -> np.ndarray:  # fmt: skip
    """(H, W) light of all discs that face the camera; the brightest reaches ``look.peak``.

    ``covers``: the ``cover`` of a `disc`, by its number.
    """
    picture = np.zeros((camera.height, camera.width))
    places = points @ rotation.T + translation
    for k, place in enumerate(places):
        normal = rotation @ normals[k]
        if k in hidden or place[2] <= 0.0 or normal @ place >= 0.0:
            continue
        painted = disc(camera, place, normal, 0.5 * diameters[k], look, (covers or {}).get(k))
        if painted is not None:
            rows, columns, grey = painted
            falls = 1.0 if look.even else float(translation @ translation / (place @ place))
            picture[rows, columns] += falls * grey
    top = picture.max()
    return picture * (look.peak / top) if top > 0.0 else picture


def lights(camera: Pinhole, spots: np.ndarray, picture: np.ndarray | None = None) -> np.ndarray:
    """(H, W) Gaussian lights (N, 4): x, y, σ (px, optics and pixel together) and peak (grey)."""
    out = np.zeros((camera.height, camera.width)) if picture is None else picture
    for x, y, sigma, peak in spots:
        reach = 5.0 * sigma
        x0, x1 = max(math.ceil(x - reach), 0), min(math.floor(x + reach), camera.width - 1)
        y0, y1 = max(math.ceil(y - reach), 0), min(math.floor(y + reach), camera.height - 1)
        if x1 < x0 or y1 < y0:
            continue
        across = np.exp(-0.5 * ((np.arange(x0, x1 + 1) - x) / sigma) ** 2)
        down = np.exp(-0.5 * ((np.arange(y0, y1 + 1) - y) / sigma) ** 2)
        out[y0 : y1 + 1, x0 : x1 + 1] += peak * down[:, None] * across
    return out


def texture(camera: Pinhole, rng: np.random.Generator, grain_px: float, grey: float) -> np.ndarray:
    """(H, W) smooth random background, 0 to about ``grey``, of some grain."""
    fine = rng.standard_normal((camera.height, camera.width))
    waves = np.hypot(np.fft.fftfreq(camera.height)[:, None], np.fft.fftfreq(camera.width)[None, :])
    soft = np.fft.ifft2(np.fft.fft2(fine) * np.exp(-2.0 * (math.pi * waves * grain_px) ** 2)).real
    return np.clip(grey * (0.5 + soft / (4.0 * soft.std())), 0.0, None)


def eight_bits(picture: np.ndarray, look: Look, rng: np.random.Generator) -> np.ndarray:
    """Black level, noise, saturation and rounding: (H, W) uint8."""
    noisy = picture + look.black
    noisy = noisy + look.noise * rng.standard_normal(picture.shape, dtype=np.float32)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def pair(
    camera: Pinhole, light: np.ndarray, look: Look, rng: np.random.Generator,
    *, false: np.ndarray | None = None, background: tuple[np.ndarray, np.ndarray] | None = None,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """The lit and the dark picture of the light of discs, false spots in the lit one only."""
    lit = light if false is None else lights(camera, false, light.copy())
    dark = look.leak * light
    if background is not None:
        lit, dark = lit + background[0], dark + background[1]
    return eight_bits(lit, look, rng), eight_bits(dark, look, rng)
