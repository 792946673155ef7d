"""The χ² of three spots against a triangle of reflectors at the poses of P3P: sizes, brightness."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.estimation.p3p import MAX_ROOTS, p3p_roots
from rendezview.sensors.beacons.detect.discs import disc_radius, expected_size, placed, turned

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Tolerances = tuple[float, float, float, float, float, float, float]


@njit(cache=True, nogil=True, error_model="numpy")
def judge(
    triplets: Ints, directions: Array, sizes: Array, peaks: Array, points: Array, normals: Array,
    diameters: Array, focal_px: float, blur_px: float, tolerances: Tolerances, window: Array,
    score_limit: float, scores: Array, poses: Array,
) -> None:  # fmt: skip
    """χ² of every pose of every triplet: sizes at its ranges, brightnesses among themselves.

    Every pose whose reflectors all face the camera is kept. A post leaves one (Bales); three
    reflectors in one plane across the line of sight often leave two.

    Args:
        triplets: (M, 3) spots as (left, centre, right).
        directions: (N, 3) unit; sizes, peaks: (N,) of the spots.
        points, normals, diameters: (3, 3), (3, 3), (3,) of the triangle, in the same order.
        tolerances: σ of ln(size) of one spot, of ln(diameter) and ln(blur) common to all, of
            ln(brightness) of the centre and between the outer two, the least cosine between a
            normal and its line of sight, and σ of the centre's ln(brightness) a rad² of half the
            base as seen, squared: the beam has a middle.
        window: (2,) nearest and farthest range.
        score_limit: χ² that is of no use.
        scores: (M, 4) result, ∞ where refused; poses: (M, 4, 12) rotation and translation.
    """
    rays = np.empty((3, 3))
    rotations, translations = np.empty((MAX_ROOTS, 3, 3)), np.empty((MAX_ROOTS, 3))
    log_size, log_peak = np.empty(len(sizes)), np.empty(len(peaks))
    for s in range(len(sizes)):
        log_size[s], log_peak[s] = math.log(sizes[s]), math.log(peaks[s])
    for n in range(triplets.shape[0]):
        for k in range(MAX_ROOTS):
            scores[n, k] = np.inf
        for i in range(3):
            for j in range(3):
                rays[i, j] = directions[triplets[n, i], j]
        roots = p3p_roots(rays, points, 1e-3, rotations, translations)
        for k in range(roots):
            if not least_facing(rotations[k], translations[k], points, normals) > 0.0:
                continue
            scores[n, k] = _score(
                rotations[k], translations[k], points, normals, diameters, triplets[n], log_size,
                log_peak, focal_px, blur_px, tolerances, window, score_limit,
            )  # fmt: skip
            for i in range(3):
                for j in range(3):
                    poses[n, k, 3 * i + j] = rotations[k, i, j]
                poses[n, k, 9 + i] = translations[k, i]


@njit(cache=True, nogil=True, error_model="numpy")
def _score(
    rotation: Array, translation: Array, points: Array, normals: Array, diameters: Array,
    triplet: Ints, log_size: Array, log_peak: Array, focal_px: float, blur_px: float,
    tolerances: Tolerances, window: Array, score_limit: float,
) -> float:  # fmt: skip
    """χ² of sizes and brightnesses of a triplet at a pose; ∞ where the pose is refused."""
    size_sigma, diameter_sigma, blur_sigma, peak_sigma, beam_sigma, least_cosine, curve = tolerances
    errors, shine, fall, mean, common = np.empty(3), np.empty(3), np.empty(3), 0.0, 0.0
    for i in range(3):
        x, y, z = placed(rotation, translation, points, i)
        far = math.sqrt(x * x + y * y + z * z)
        if far < window[0] or far > window[1]:
            return np.inf
        nx, ny, nz = turned(rotation, normals, i)
        if -(nx * x + ny * y + nz * z) / far < least_cosine:
            return np.inf
        radius = disc_radius(focal_px, x, y, z, nx, ny, nz, 0.5 * diameters[i])
        s = triplet[i]
        expected = expected_size(blur_px, radius)
        errors[i] = log_size[s] - math.log(expected)
        mean += errors[i] / 3.0
        common += common_variance(blur_px / expected, diameter_sigma, blur_sigma) / 3.0
        # Blur thins a small disc; a retro-reflector's illumination falls with range² too.
        shine[i] = log_peak[s] + 2.0 * math.log(expected / radius)
        fall[i] = 2.0 * math.log(far)
    chi = mean * mean / (size_sigma * size_sigma / 3.0 + common)
    for i in range(3):
        chi += ((errors[i] - mean) / size_sigma) ** 2
    if not chi <= score_limit:
        return np.inf
    # Beam and return fall smoothly across the target: the middle shines like the mean, but for the
    # curve. In even light nothing falls with range: the better of both counts.
    least, base = np.inf, 0.0
    for a in range(3):
        base += (points[2, a] - points[0, a]) ** 2
    peak_sigma = math.hypot(peak_sigma, curve * 0.25 * base / math.exp(0.5 * (fall[0] + fall[2])))
    for law in range(2):
        left, middle, right = (
            shine[0] + law * fall[0], shine[1] + law * fall[1], shine[2] + law * fall[2]
        )  # fmt: skip
        uneven, bright = (left - right) / beam_sigma, (middle - 0.5 * (left + right)) / peak_sigma
        least = min(least, uneven * uneven + bright * bright)
    return float(chi + least)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def common_variance(share: float, diameter_sigma: float, blur_sigma: float) -> float:
    """Variance of ln(size) that an error of diameter and of blur makes in all spots alike.

    ``share``: blur over size; of a small spot the blur is most of its size.
    """
    blurred = min(share * share, 1.0)
    return ((1.0 - blurred) * diameter_sigma) ** 2 + (blurred * blur_sigma) ** 2


@njit(cache=True, nogil=True, error_model="numpy")
def least_facing(rotation: Array, translation: Array, points: Array, normals: Array) -> float:
    """Least cosine between a reflector's normal and its line of sight; below 0 one faces away."""
    least = 1.0
    for i in range(points.shape[0]):
        x, y, z = placed(rotation, translation, points, i)
        nx, ny, nz = turned(rotation, normals, i)
        least = min(least, -(nx * x + ny * y + nz * z) / math.sqrt(x * x + y * y + z * z))
    return float(least)
