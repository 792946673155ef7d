"""The loops of the filter, compiled: prediction in place, gain, and the turn of an attitude."""

from __future__ import annotations

import numpy as np
from numba import njit

from rendezview.estimation.linear_algebra import square_root
from rendezview.estimation.motion import predict_covariance
from rendezview.geometry import so3
from rendezview.geometry.pose import Array


@njit(cache=True, nogil=True, error_model="numpy")
def turned(vector: Array, rotation: Array) -> Array:
    """exp([vector]×) rotation, orthonormalised, so that rounding does not add up."""
    out = np.empty((3, 3))
    so3.perturb_into(vector, rotation, out)
    so3.orthonormalise(out)
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def craft_accelerations(
    arm: Array, angular: float, linear: float, along: float, pointing: float
) -> Array:
    """(6, 6) spectral density of the accelerations of two craft.

    The target rotates, one craft translates against the other, and the camera rotates: by w,
    which rotates the target by w and moves it by w × arm.

    Args:
        arm: (3,) translation from the camera to the target, m.
        angular, linear, along, pointing: squared `MotionOptions`.
    """
    density = np.zeros((6, 6))
    swing = np.zeros((3, 3))  # w ↦ w × arm
    swing[0, 1], swing[0, 2] = arm[2], -arm[1]
    swing[1, 0], swing[1, 2] = -arm[2], arm[0]
    swing[2, 0], swing[2, 1] = arm[1], -arm[0]
    square = arm[0] ** 2 + arm[1] ** 2 + arm[2] ** 2
    for i in range(3):
        density[i, i] = angular + pointing
        density[3 + i, 3 + i] = linear
    for i in range(3):
        for j in range(3):
            density[3 + i, j] = density[j, 3 + i] = pointing * swing[i, j]
            if square > 0.0:
                density[3 + i, 3 + j] += along * arm[i] * arm[j] / square
            for k in range(3):
                density[3 + i, 3 + j] += pointing * swing[i, k] * swing[j, k]
    return density


@njit(cache=True, nogil=True, error_model="numpy")
def predicted(
    rotation: Array,
    translation: Array,
    rates: Array,
    extras: Array,
    covariance: Array,
    fading: Array,
    dt: float,
    angular: float,
    linear: float,
    along: float,
    pointing: float,
) -> tuple[Array, Array, Array, Array]:
    """Rotation, translation, extras and covariance ``dt`` later.

    ``fading`` (n - 12, 2) is how fast each of the extras is forgotten: by time (1/s), and by
    change of the logarithm of the range.
    """
    square, inwards = 0.0, 0.0
    for i in range(3):
        square += translation[i] * translation[i]
        inwards += translation[i] * rates[3 + i]
    speed = abs(inwards) / square if square > 0.0 else 0.0
    fade = np.empty(len(extras))
    for i in range(len(extras)):
        fade[i] = np.exp(-dt * (fading[i, 0] + speed * fading[i, 1]))
    turn = so3.exp(dt * rates[:3])
    density = craft_accelerations(translation, angular, linear, along, pointing)
    out = predict_covariance(covariance, turn, dt, density, fade)
    later = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            later[i, j] = (
                turn[i, 0] * rotation[0, j]
                + turn[i, 1] * rotation[1, j]
                + turn[i, 2] * rotation[2, j]
            )
    so3.orthonormalise(later)
    return later, translation + dt * rates[3:], fade * extras, out


@njit(cache=True, nogil=True, error_model="numpy")
def whitened(
    covariance: Array, design: Array, noise: Array, residual: Array
) -> tuple[bool, float, float, Array, Array, Array]:
    """A residual in units of its covariance S = H P Hᵀ + R = L Lᵀ.

    Args:
        covariance: (n, n) P.
        design: (m, n) H, of the measurement's slope by every state.
        noise: (m, m) R, white.
        residual: (m,) measured − expected.

    Returns:
        Whether S is positive; NIS; ln|S|; (n, m) P Hᵀ; (m, m) L; (m,) L⁻¹ residual.
    """
    m, n = design.shape
    across = np.zeros((n, m))
    for k in range(m):
        for j in range(n):
            h = design[k, j]
            if h != 0.0:
                for i in range(n):
                    across[i, k] += covariance[j, i] * h  # symmetric: along the row
    spread = np.empty((m, m))
    for i in range(m):
        for j in range(i + 1):
            s = 0.5 * (noise[i, j] + noise[j, i])
            for k in range(n):
                if design[i, k] != 0.0:
                    s += design[i, k] * across[k, j]
            spread[i, j] = spread[j, i] = s
    lower = square_root(spread)
    white = residual.copy()
    nis, logarithm = 0.0, 0.0
    for i in range(m):
        if not lower[i, i] > 0.0:
            return False, np.inf, np.inf, across, lower, white
        for k in range(i):
            white[i] -= lower[i, k] * white[k]
        white[i] /= lower[i, i]
        nis += white[i] * white[i]
        logarithm += 2.0 * np.log(lower[i, i])
    return True, nis, logarithm, across, lower, white


@njit(cache=True, nogil=True, error_model="numpy")
def gain(
    covariance: Array, design: Array, noise: Array, residual: Array
) -> tuple[bool, float, float, Array, Array]:
    """Whether S of `whitened` is positive; NIS; ln|S|; (n,) correction; (n, n) P after it."""
    m, n = design.shape
    fits, nis, logarithm, across, lower, white = whitened(covariance, design, noise, residual)
    correction = np.zeros(n)
    if not fits:
        return False, nis, logarithm, correction, covariance
    # P Hᵀ L⁻ᵀ, so that P falls by its square and stays symmetric.
    for r in range(n):
        for i in range(m):
            s = across[r, i]
            for k in range(i):
                s -= lower[i, k] * across[r, k]
            across[r, i] = s / lower[i, i]
    after = np.empty((n, n))
    for i in range(n):
        for k in range(m):
            correction[i] += across[i, k] * white[k]
        for j in range(i + 1):
            s = 0.5 * (covariance[i, j] + covariance[j, i])
            for k in range(m):
                s -= across[i, k] * across[j, k]
            after[i, j] = s
            after[j, i] = s
    return True, nis, logarithm, correction, after


@njit(cache=True, nogil=True, error_model="numpy")
def with_bias(
    extras: Array, slope: Array, root: Array, start: int, measured: Array
) -> tuple[Array, Array]:
    """(m, n) slope by every state, and (m,) residual less the bias at ``start``.

    Args:
        extras: (n - 12,) all states but those of motion.
        slope: (m, 14) by motion, ring radius and depth.
        root: (m, b) by the bias.
        measured: (m,) measured − expected, the bias left out.
    """
    m = len(measured)
    design = np.zeros((m, 12 + len(extras)))
    residual = measured.copy()
    for i in range(m):
        for j in range(slope.shape[1]):
            design[i, j] = slope[i, j]
        for j in range(root.shape[1]):
            design[i, start + j] = root[i, j]
            residual[i] -= root[i, j] * extras[start - 12 + j]
    return design, residual


@njit(cache=True, nogil=True, error_model="numpy")
def corrected(
    rotation: Array,
    translation: Array,
    rates: Array,
    extras: Array,
    covariance: Array,
    slope: Array,
    root: Array,
    start: int,
    white: Array,
    measured: Array,
) -> tuple[bool, float, float, Array, Array, Array, Array, Array, Array]:
    """The state after a measurement: arguments of `with_bias`, ``white`` (m, m) the white noise.

    Returns:
        Whether it can be used; NIS; ln|S|; (m,) residual less the bias; rotation,
        translation, rates, extras and covariance after it.
    """
    design, residual = with_bias(extras, slope, root, start, measured)
    fits, nis, logarithm, step, after = gain(covariance, design, white, residual)
    for i in range(len(step)):
        fits = fits and np.isfinite(step[i])
    return (
        fits, nis, logarithm, residual, turned(step[:3], rotation), translation + step[3:6],
        rates + step[6:12], extras + step[12:], after,
    )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def distance(
    extras: Array,
    covariance: Array,
    slope: Array,
    root: Array,
    start: int,
    white: Array,
    measured: Array,
) -> tuple[bool, float, float]:
    """As `corrected`, but only whether it can be used, NIS and ln|S|."""
    design, residual = with_bias(extras, slope, root, start, measured)
    fits, nis, logarithm, _, _, _ = whitened(covariance, design, white, residual)
    return fits, nis, logarithm
