"""What a pose's covariance is made of: noise of the spots, light, camera, places of reflectors."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from rendezview.geometry.pose import Array
from rendezview.sensors.beacons.detect.discs import LAW, project_disc, turned

# Causes of a pose's error, in the order of its shares. All but the first and the last are common to
# the readings of a run: no average takes them away.
CAUSES = ("spots", "light", "camera", "places", "cover")
COVERED = CAUSES.index("cover")
# The law of rims of saturated discs, and its σ over that of the law of light: 0 in even light, 0.13
# of a retro-reflector near by. Source: experiment reflector-nees, at 0.8 m
RIM_LAW, _RIM_SHARE = 0.07, 0.12


@njit(cache=True, nogil=True, error_model="numpy")
def whole_sigma(
    lens: Array, discs: Array, arms: Array, noise: Array, rotation: Array, shift: Array
) -> Array:
    """(K,) σ of the spots with that of their reflectors' places, px."""
    whole = np.empty(noise.shape[0])
    for i in range(noise.shape[0]):
        away = lens[0] * discs[i, 1] / (turned(rotation, arms, i)[2] + shift[2])
        whole[i] = math.sqrt(noise[i] * noise[i] + away * away)
    return whole


@njit(cache=True, nogil=True, error_model="numpy")
def share_out(
    lens: Array, doubts: Array, arms: Array, normals: Array, discs: Array, noise: Array,
    cover: Array, sigma: Array, rotation: Array, shift: Array, shares: Array,
) -> None:  # fmt: skip
    """Fill the covariance of each cause; ``shares[0]`` holds the inverse normal matrix, N⁻¹.

    The pose's slope by what moves the spots by u is N⁻¹ JᵀW ∂u (implicit function theorem), with W
    the weights of the fit: so is N⁻¹ (Σ g gᵀ) N⁻¹ the covariance, g the pull JᵀW δu of one σ.
    """
    jacobian, pull = np.empty((2, 6)), np.empty((shares.shape[0], 6, 6))
    by_doubt, moved = np.zeros((doubts.shape[0], 6)), np.empty(2)
    pull[:], diameters, inverse = 0.0, discs[:, 0].copy(), shares[0].copy()
    for i in range(arms.shape[0]):
        spot_slopes(lens, arms, normals, diameters, rotation, shift, i, jacobian)
        weight = 1.0 / (sigma[i] * sigma[i])
        hidden, place = (weight * cover[i]) ** 2, (weight * discs[i, 1]) ** 2
        spot = (weight * noise[i]) ** 2 - hidden
        for a in range(6):
            for b in range(6):
                for k in range(2):
                    pull[0, a, b] += spot * jacobian[k, a] * jacobian[k, b]
                    pull[COVERED, a, b] += hidden * jacobian[k, a] * jacobian[k, b]
                    for m in range(2):  # a reflector's place moves its spot as the target's does
                        slope = 0.0
                        for c in range(3, 6):
                            slope += jacobian[k, c] * jacobian[m, c]
                        pull[3, a, b] += place * jacobian[k, a] * slope * jacobian[m, b]
        for p in range(doubts.shape[0]):
            _by_doubt(lens, doubts[p], arms, normals, discs, rotation, shift, i, moved)
            for a in range(6):
                by_doubt[p, a] += weight * (jacobian[0, a] * moved[0] + jacobian[1, a] * moved[1])
    for p in range(doubts.shape[0]):
        for a in range(6):
            for b in range(6):
                pull[min(p + 1, 2), a, b] += by_doubt[p, a] * by_doubt[p, b]
    for cause in range(shares.shape[0]):
        _on_both_sides(inverse, pull[cause], shares[cause])


@njit(cache=True, nogil=True, error_model="numpy")
def _on_both_sides(side: Array, middle: Array, out: Array) -> None:
    """Fill ``side @ middle @ sideᵀ``, all (6, 6)."""
    half = np.zeros((6, 6))
    for i in range(6):
        for j in range(6):
            for k in range(6):
                half[i, j] += side[i, k] * middle[k, j]
    for i in range(6):
        for j in range(6):
            out[i, j] = 0.0
            for k in range(6):
                out[i, j] += half[i, k] * side[j, k]


@njit(cache=True, nogil=True, error_model="numpy")
def _by_doubt(
    lens: Array, doubt: Array, arms: Array, normals: Array, discs: Array, rotation: Array,
    shift: Array, i: int, out: Array,
) -> None:  # fmt: skip
    """By how much (2,) one σ of the camera's numbers moves spot i, px."""
    x, y, z = turned(rotation, arms, i)
    nx, ny, nz = turned(rotation, normals, i)
    other, out[:] = np.empty_like(lens), 0.0
    for end in range(2):
        sign = 2.0 * end - 1.0
        for n in range(lens.shape[0]):
            other[n] = lens[n] + sign * doubt[n]
        if lens[LAW] < 1.0:
            other[LAW] = lens[LAW] + sign * _RIM_SHARE * doubt[LAW]
        u, v = project_disc(
            other, x + shift[0], y + shift[1], z + shift[2], nx, ny, nz, 0.5 * discs[i, 0]
        )
        out[0] += 0.5 * sign * u
        out[1] += 0.5 * sign * v


@njit(cache=True, nogil=True, error_model="numpy")
def spot_slopes(
    lens: Array, arms: Array, normals: Array, diameters: Array, rotation: Array, shift: Array,
    i: int, out: Array,
) -> None:  # fmt: skip
    """(2, 6) of spot i by central differences: a turn moves arm and normal, a shift the centre."""
    arm = turned(rotation, arms, i)
    n = turned(rotation, normals, i)
    z = arm[2] + shift[2]
    for k in range(6):  # one call of the projection: each is compiled in its place
        out[0, k] = out[1, k] = 0.0
        for end in range(2):
            h = (1e-5 if k < 3 else 1e-5 * z) * (2 * end - 1)
            tx, ty, tz, mx, my, mz = _displaced(k, arm, n)
            u, v = project_disc(
                lens, arm[0] + shift[0] + h * tx, arm[1] + shift[1] + h * ty, z + h * tz,
                n[0] + h * mx, n[1] + h * my, n[2] + h * mz, 0.5 * diameters[i],
            )  # fmt: skip
            out[0, k] += u / (2.0 * h)
            out[1, k] += v / (2.0 * h)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _displaced(
    k: int, v: tuple[float, float, float], n: tuple[float, float, float]
) -> tuple[float, float, float, float, float, float]:
    """How number k of a pose moves an arm and turns a normal."""
    if k == 0:
        return 0.0, -v[2], v[1], 0.0, -n[2], n[1]
    if k == 1:
        return v[2], 0.0, -v[0], n[2], 0.0, -n[0]
    if k == 2:
        return -v[1], v[0], 0.0, -n[1], n[0], 0.0
    if k == 3:
        return 1.0, 0.0, 0.0, 0.0, 0.0, 0.0
    return 0.0, 1.0 if k == 4 else 0.0, 1.0 if k == 5 else 0.0, 0.0, 0.0, 0.0
