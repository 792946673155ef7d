"""Random bright skies: clouds of any spectrum, coasts, fields."""

from __future__ import annotations

import cv2
import numpy as np
from scipy import fft
from scipy.spatial import cKDTree

from rendezview.geometry.zbuffer import Float32s

_LARGEST_FIELDS = 150  # patches; most of a picture of fields


def random_sky(height: int, width: int, rng: np.random.Generator) -> Float32s:
    """(H, W) radiance: clouds, soft or stretched, pieces with sharp borders, patches of fields."""
    clouds = _spectral(height, width, rng)
    kind = rng.integers(4)
    if kind == 1:
        clouds = np.clip((clouds - rng.uniform(0.3, 0.6)) * rng.uniform(2.0, 12.0), 0.0, 1.0)
    elif kind == 2:
        bright = np.where(clouds > rng.uniform(0.35, 0.65), 1.0, rng.uniform(0.0, 0.6))
        clouds = _blurred(bright * (1.0 - 0.3 * _slow(height, width, rng)), rng.uniform(0.3, 1.5))
    elif kind == 3:
        clouds = _blurred(0.5 * _fields(height, width, rng) + 0.5 * clouds, rng.uniform(0.4, 2.0))
    return np.asarray(clouds * rng.uniform(0.05, 1.0) + rng.uniform(0.0, 0.2), dtype=np.float32)


def _spectral(height: int, width: int, rng: np.random.Generator) -> Float32s:
    """0 … 1, power-law noise, cut from twice the size so that it does not repeat."""
    rows, columns = 2 * height, 2 * width
    frequency = np.hypot(fft.fftfreq(rows)[:, None] * height, fft.rfftfreq(columns) * width)
    frequency[0, 0] = 1.0
    white = fft.rfft2(rng.standard_normal((rows, columns)).astype(np.float32))
    slope = rng.uniform(0.9, 2.2)
    noise = fft.irfft2(white * frequency**-slope, s=(rows, columns))[:height, :width]
    low, high = float(noise.min()), float(noise.max())
    return np.asarray((noise - low) / max(high - low, 1e-9), dtype=np.float32)


def _slow(height: int, width: int, rng: np.random.Generator) -> Float32s:
    """0 … 1, smooth interpolation of a few random knots."""
    knots = rng.random(tuple(rng.integers(3, 30, 2))).astype(np.float32)
    smooth = cv2.resize(knots, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.asarray(np.clip(smooth, 0.0, 1.0), dtype=np.float32)


def _fields(height: int, width: int, rng: np.random.Generator) -> Float32s:
    """0 … 1, one level per patch (Voronoi)."""
    count = int(rng.integers(10, _LARGEST_FIELDS))
    seeds = rng.uniform([-20.0, -20.0], [width + 20.0, height + 20.0], (count, 2))
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    nearest = cKDTree(seeds).query(np.stack([x.ravel(), y.ravel()], 1))[1]
    return np.asarray(rng.random(count)[nearest].reshape(height, width), dtype=np.float32)


def _blurred(picture: np.ndarray, sigma_px: float) -> Float32s:
    return np.asarray(cv2.GaussianBlur(picture.astype(np.float32), (0, 0), sigma_px))
