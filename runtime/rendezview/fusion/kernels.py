"""The loops of the filter, compiled: prediction in place, gain, and the turn of an attitude."""

from __future__ import annotations

import numpy as np
from numba import njit

from rendezview.geometry.pose import Array


@njit(cache=True, nogil=True, error_model="numpy")
def turned(vector: Array, rotation: Array) -> Array:
    """exp([vector]×) rotation, by Rodrigues' formula."""
    x, y, z = vector[0], vector[1], vector[2]
    square = x * x + y * y + z * z
    if square < 1e-16:
        sine, cosine = 1.0 - square / 6.0, 0.5 - square / 24.0
    else:
        angle = np.sqrt(square)
        sine = np.sin(angle) / angle
        half = np.sin(0.5 * angle)
        cosine = 2.0 * half * half / square
    turn = np.empty((3, 3))
    turn[0, 0] = 1.0 - cosine * (y * y + z * z)
    turn[1, 1] = 1.0 - cosine * (x * x + z * z)
    turn[2, 2] = 1.0 - cosine * (x * x + y * y)
    turn[0, 1], turn[1, 0] = cosine * x * y - sine * z, cosine * x * y + sine * z
    turn[0, 2], turn[2, 0] = cosine * x * z + sine * y, cosine * x * z - sine * y
    turn[1, 2], turn[2, 1] = cosine * y * z - sine * x, cosine * y * z + sine * x
    out = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            out[i, j] = (
                turn[i, 0] * rotation[0, j] + turn[i, 1] * rotation[1, j]
                + turn[i, 2] * rotation[2, j]
            )  # fmt: skip
    # One step of Newton towards the nearest rotation, so that rounding does not add up.
    square_root = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            dot = 0.0
            for k in range(3):
                dot += out[k, i] * out[k, j]
            square_root[i, j] = -0.5 * dot + (1.5 if i == j else 0.0)
    fixed = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            fixed[i, j] = (
                out[i, 0] * square_root[0, j] + out[i, 1] * square_root[1, j]
                + out[i, 2] * square_root[2, j]
            )  # fmt: skip
    return fixed


@njit(cache=True, nogil=True, error_model="numpy")
def rotation_vector(rotation: Array, other: Array) -> Array:
    """Rotation vector of ``rotation otherᵀ``, (3,), of length up to π."""
    turn = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            turn[i, j] = (
                rotation[i, 0] * other[j, 0] + rotation[i, 1] * other[j, 1]
                + rotation[i, 2] * other[j, 2]
            )  # fmt: skip
    # By the quaternion's largest part, which is exact near 0 and near π.
    trace = turn[0, 0] + turn[1, 1] + turn[2, 2]
    quat = np.empty(4)  # w x y z
    largest = 0
    best = trace
    for i in range(3):
        if turn[i, i] > best:
            best, largest = turn[i, i], i + 1
    if largest == 0:
        quat[0] = 1.0 + trace
        quat[1] = turn[2, 1] - turn[1, 2]
        quat[2] = turn[0, 2] - turn[2, 0]
        quat[3] = turn[1, 0] - turn[0, 1]
    else:
        i = largest - 1
        j, k = (i + 1) % 3, (i + 2) % 3
        quat[0] = turn[k, j] - turn[j, k]
        quat[1 + i] = 1.0 + turn[i, i] - turn[j, j] - turn[k, k]
        quat[1 + j] = turn[j, i] + turn[i, j]
        quat[1 + k] = turn[k, i] + turn[i, k]
    norm = np.sqrt(quat[1] ** 2 + quat[2] ** 2 + quat[3] ** 2)
    out = np.empty(3)
    if norm < 1e-300:
        out[:] = 0.0
        return out
    sign = 1.0 if quat[0] >= 0.0 else -1.0
    scale = sign * 2.0 * np.arctan2(norm, sign * quat[0]) / norm
    for i in range(3):
        out[i] = scale * quat[1 + i]
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def predict_covariance(
    covariance: Array,
    turn: Array,
    arm: Array,
    dt: float,
    angular: float,
    linear: float,
    along: float,
    pointing: float,
    fade: Array,
) -> Array:
    """P at a later time, (n, n): 12 of motion, then states that only fade.

    Args:
        turn: (3, 3) rotation of the step: the old attitude error turns with the body.
        arm: (3,) translation, round which the camera's own turning swings the target.
        angular, linear, along, pointing: squared densities of the accelerations.
        fade: (n - 12,) factors towards a variance of 1; 1 for a constant.
    """
    n = len(covariance)
    out = covariance.copy()
    row = np.empty(3)
    for j in range(n):  # rows: F P
        for i in range(3):
            row[i] = turn[i, 0] * out[0, j] + turn[i, 1] * out[1, j] + turn[i, 2] * out[2, j]
        for i in range(3):
            out[i, j] = row[i] + dt * out[6 + i, j]
            out[3 + i, j] += dt * out[9 + i, j]
        for i in range(12, n):
            out[i, j] *= fade[i - 12]
    for i in range(n):  # columns: (F P) Fᵀ
        for j in range(3):
            row[j] = turn[j, 0] * out[i, 0] + turn[j, 1] * out[i, 1] + turn[j, 2] * out[i, 2]
        for j in range(3):
            out[i, j] = row[j] + dt * out[i, 6 + j]
            out[i, 3 + j] += dt * out[i, 9 + j]
        for j in range(12, n):
            out[i, j] *= fade[j - 12]
    for i in range(12, n):
        out[i, i] += 1.0 - fade[i - 12] ** 2
    # White accelerations: of the target, of the place, and of the camera, which turns the
    # target by w and moves it by w × arm.
    noise = np.zeros((6, 6))
    swing = np.zeros((3, 3))  # w ↦ w × arm
    swing[0, 1], swing[0, 2] = arm[2], -arm[1]
    swing[1, 0], swing[1, 2] = -arm[2], arm[0]
    swing[2, 0], swing[2, 1] = arm[1], -arm[0]
    for i in range(3):
        noise[i, i] = angular + pointing
        noise[3 + i, 3 + i] = linear
        for j in range(3):
            noise[3 + i, j] = noise[j, 3 + i] = pointing * swing[i, j]
    square = arm[0] ** 2 + arm[1] ** 2 + arm[2] ** 2
    for i in range(3):
        for j in range(3):
            if square > 0.0:
                noise[3 + i, 3 + j] += along * arm[i] * arm[j] / square
            for k in range(3):
                noise[3 + i, 3 + j] += pointing * swing[i, k] * swing[j, k]
    for i in range(6):
        for j in range(6):
            q = noise[i, j]
            out[i, j] += q * dt * dt * dt / 3.0
            out[i, 6 + j] += q * dt * dt / 2.0
            out[6 + i, j] += q * dt * dt / 2.0
            out[6 + i, 6 + j] += q * dt
    return out


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
    turn = turned(dt * rates[:3], np.eye(3))
    out = predict_covariance(
        covariance, turn, translation, dt, angular, linear, along, pointing, fade
    )
    return turned(dt * rates[:3], rotation), translation + dt * rates[3:], fade * extras, out


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
def with_lasting(
    extras: Array, slope: Array, root: Array, start: int, measured: Array
) -> tuple[Array, Array]:
    """(m, n) slope by every state, and (m,) residual less the lasting error at ``start``.

    Args:
        extras: (n - 12,) all states but those of motion.
        slope: (m, 14) by motion, ring radius and depth.
        root: (m, b) by the lasting error.
        measured: (m,) measured − expected, the lasting error left out.
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
    """The state after a measurement: arguments of `with_lasting`, ``white`` (m, m) is what is new.

    Returns:
        Whether it can be used; NIS; ln|S|; (m,) residual less the lasting error; rotation,
        translation, rates, extras and covariance after it.
    """
    design, residual = with_lasting(extras, slope, root, start, measured)
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
    design, residual = with_lasting(extras, slope, root, start, measured)
    fits, nis, logarithm, _, _, _ = whitened(covariance, design, white, residual)
    return fits, nis, logarithm


@njit(cache=True, nogil=True, error_model="numpy")
def square_root(covariance: Array) -> Array:
    """Lower Cholesky factor; zeros where a pivot is none, so that semi-definite is allowed."""
    n = len(covariance)
    lower = np.zeros((n, n))
    for j in range(n):
        s = covariance[j, j]
        for k in range(j):
            s -= lower[j, k] * lower[j, k]
        if s <= 1e-14 * covariance[j, j]:
            continue
        lower[j, j] = np.sqrt(s)
        for i in range(j + 1, n):
            s = covariance[i, j]
            for k in range(j):
                s -= lower[i, k] * lower[j, k]
            lower[i, j] = s / lower[j, j]
    return lower
