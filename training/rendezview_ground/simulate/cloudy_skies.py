"""Random pictures of the Earth from orbit: ground, layers of clouds, sometimes the limb.

They are like no place, and more varied than the Earth of `background`: coasts, streets of clouds,
cyclones, veils. Source of all numbers: by construction of the training set of the sketch network.
"""

from __future__ import annotations

import cv2
import numpy as np
from scipy import fft
from scipy.special import expit

from rendezview.geometry.pose import Array
from rendezview.geometry.zbuffer import Float32s


def cloudy_sky(side: int, rng: np.random.Generator, *, whole: bool = False) -> Float32s:
    """(S, S) radiance 0 … 1.3; the brightest hundredth lies above 1.

    ``whole``: from so far that the Earth's disc is smaller than the picture, or little larger.
    """
    radiance = _ground(side, rng)
    for _ in range(rng.integers(0, 3) if rng.random() < 0.9 else 0):
        cover = _clouds(side, rng) * rng.uniform(0.4, 1.0)
        radiance = radiance * (1.0 - cover) + cover * rng.uniform(0.6, 1.0)
    if whole:
        radius_px = side * rng.uniform(0.12, 0.6)
        depth_px, angle = rng.uniform(0.3, 1.5) * radius_px, rng.uniform(0.0, 2.0 * np.pi)
        radiance = _with_limb(radiance, rng, radius_px, depth_px, angle)
    elif rng.random() < 0.35:
        radius_px = float(np.exp(rng.uniform(np.log(150.0), np.log(2500.0))))
        angle, depth_px = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(-0.3, 0.6) * side
        radiance = _with_limb(radiance, rng, radius_px, depth_px, angle)
    if rng.random() < 0.3:
        soft = cv2.GaussianBlur(radiance.astype(np.float32), (0, 0), rng.uniform(0.5, 2.5))
        radiance = np.asarray(soft)
    brightest = max(float(np.percentile(radiance, 99.0)), 0.05)
    return np.asarray(np.clip(radiance / brightest, 0.0, 1.3), dtype=np.float32)


def _ground(side: int, rng: np.random.Generator) -> Array:
    """0 … 1: sea and land with sharp or soft coasts."""
    height = _noise(side, rng, rng.uniform(1.6, 2.3))
    if rng.random() < 0.6:
        height = _warped(height, rng.uniform(1.0, 8.0), rng.uniform(2.0, 10.0), rng)
    level = rng.uniform(-1.5, 1.5)
    land = _smooth_step(height, level, level + rng.uniform(0.01, 0.15))
    sea = rng.uniform(0.02, 0.3) * (1.0 + rng.uniform(0.0, 0.3) * _noise(side, rng, 1.8))
    soil = rng.uniform(0.1, 0.6) * (
        1.0 + rng.uniform(0.02, 0.3) * _noise(side, rng, rng.uniform(0.8, 1.6))
    )
    return np.clip(sea * (1.0 - land) + soil * land, 0.0, 1.0)


def _clouds(side: int, rng: np.random.Generator) -> Array:
    """0 … 1, opacity: large fields with fine structure, stretched, turned into vortices, warped."""
    large = _noise(side, rng, rng.uniform(1.6, 2.4))
    slope, stretch = rng.uniform(0.9, 1.5), np.exp(rng.uniform(-0.7, 0.7))
    fine = _noise(side, rng, slope, stretch, rng.uniform(1.0, 8.0))
    if rng.random() < 0.5:
        fine = 1.2 - 1.5 * np.abs(fine)  # ridges
    share = rng.uniform(0.3, 1.2)
    where = 1.0 if rng.random() < 0.5 else _smooth_step(large, -1.0, 1.5)
    height = 0.8 * large + share * fine * where
    for _ in range(rng.integers(0, 3)):
        height = _swirled(height, rng)
    if rng.random() < 0.7:
        height = _warped(height, rng.uniform(2.0, 14.0), rng.uniform(4.0, 25.0), rng)
    level = rng.uniform(-1.0, 1.2)
    cover = _smooth_step(height, level, level + rng.uniform(0.3, 2.5))
    return cover * (1.0 - rng.uniform(0.0, 0.4) * _smooth_step(fine, -1.0, 2.0))


def _with_limb(
    radiance: Array, rng: np.random.Generator, radius: float, depth: float, angle: float
) -> Array:
    """The edge of the Earth's disc with a glow above it, and darker ground towards it.

    The disc of this radius reaches ``depth`` px beyond the picture's middle, at an angle.
    """
    side = len(radiance)
    y, x = np.mgrid[0:side, 0:side].astype(np.float32)
    middle = 0.5 * side + (radius - depth) * np.array([np.cos(angle), np.sin(angle)])
    above = np.hypot(x - middle[0], y - middle[1]) - radius
    width = rng.uniform(0.5, 6.0)
    glow = np.exp(-np.abs(above) / (width * rng.uniform(1.0, 4.0))) * rng.uniform(0.0, 0.5)
    falloff = np.exp(np.minimum(above, 0.0) / 60.0) * (above < 0.0)
    dimmed = 1.0 - rng.uniform(0.0, 0.6) * falloff
    return radiance * expit(-above / width) * dimmed + glow  # type: ignore[no-any-return]


def _noise(
    side: int, rng: np.random.Generator, slope: float, stretch: float = 1.0, lowest: float = 1.0
) -> Array:
    """(S, S) of mean 0 and σ 1: power-law noise from a lowest frequency, cycles a side."""
    frequency = np.hypot(
        fft.fftfreq(side)[:, None] * side * stretch, fft.rfftfreq(side)[None] * side
    )
    frequency[0, 0] = 1.0
    amplitude = np.where(frequency < lowest, 0.0, frequency**-slope)
    white = fft.rfft2(rng.standard_normal((side, side)))
    noise = fft.irfft2(white * amplitude, s=(side, side))
    return (noise - noise.mean()) / noise.std()  # type: ignore[no-any-return]


def _warped(picture: Array, most_px: float, size_px: float, rng: np.random.Generator) -> Array:
    """The picture with its places moved by smooth noise: σ of the moves and of the noise, px."""
    side = len(picture)
    moves = []
    for _ in range(2):
        white = rng.standard_normal((side, side)).astype(np.float32)
        moves.append(np.asarray(cv2.GaussianBlur(white, (0, 0), size_px)))
    y, x = np.mgrid[0:side, 0:side].astype(np.float32)
    dx, dy = (most_px * move / move.std() for move in moves)
    return _read(picture, x + dx, y + dy)


def _swirled(picture: Array, rng: np.random.Generator) -> Array:
    """The picture with a vortex."""
    side = len(picture)
    y, x = np.mgrid[0:side, 0:side].astype(np.float32)
    centre, size_px, turn = rng.uniform(0.0, side, 2), rng.uniform(40.0, 200.0), rng.uniform(-4, 4)
    dx, dy = x - centre[0], y - centre[1]
    angle = turn * np.exp(-((np.hypot(dx, dy) / size_px) ** 2))
    c, s = np.cos(angle), np.sin(angle)
    return _read(picture, centre[0] + dx * c - dy * s, centre[1] + dx * s + dy * c)


def _read(picture: Array, x: Array, y: Array) -> Array:
    places = x.astype(np.float32), y.astype(np.float32)
    return np.asarray(
        cv2.remap(picture.astype(np.float32), *places, cv2.INTER_LINEAR,
                  borderMode=cv2.BORDER_REFLECT)
    )  # fmt: skip


def _smooth_step(x: Array, low: float, high: float) -> Array:
    t = np.clip((x - low) / (high - low), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)
