"""The loops of the filter, compiled: prediction of all models, and what they say together.

All models share one nominal state; each has its own deviation x (M, n), covariance P (M, n, n) and
probability (M,). The state's layout is in `state`.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from rendezview.geometry import so3
from rendezview.geometry.pose import Array

MOTION = 18  # attitude, place, rate, velocity, jitter, acceleration. Source: by construction


@njit(cache=True, nogil=True, error_model="numpy")
def transit(
    row: Array, dt: float, jitter: float, lasting: float,
    turn: Array, rotation: Array, place: Array, velocity: Array, fade: Array,
) -> None:  # fmt: skip
    """An error (n,) after ``dt``, in place: F of the filter.

    Args:
        jitter, lasting: what is left of the jitter and the acceleration.
        turn: (3, 3) of the target's axes.
        rotation, place, velocity: nominal state after ``dt``.
        fade: (n - 18,) what is left of each bias.
    """
    tx = row[3] + dt * row[9] + 0.5 * dt * dt * row[15]
    ty = row[4] + dt * row[10] + 0.5 * dt * dt * row[16]
    tz = row[5] + dt * row[11] + 0.5 * dt * dt * row[17]
    ux, uy, uz = row[9] + dt * row[15], row[10] + dt * row[16], row[11] + dt * row[17]
    ax, ay, az = row[15], row[16], row[17]
    wx, wy, wz = dt * row[6], dt * row[7], dt * row[8]
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        w_j, w_k = dt * row[6 + j], dt * row[6 + k]
        row[i] += (jitter - 1.0) * row[12 + i]
        row[i] += rotation[i, 0] * wx + rotation[i, 1] * wy + rotation[i, 2] * wz
        row[3 + i] = turn[i, 0] * tx + turn[i, 1] * ty + turn[i, 2] * tz
        row[3 + i] += place[j] * w_k - place[k] * w_j
        row[9 + i] = turn[i, 0] * ux + turn[i, 1] * uy + turn[i, 2] * uz
        row[9 + i] += velocity[j] * w_k - velocity[k] * w_j
        row[12 + i] *= jitter
        row[15 + i] = lasting * (turn[i, 0] * ax + turn[i, 1] * ay + turn[i, 2] * az)
    for i in range(len(fade)):
        row[MOTION + i] *= fade[i]


@njit(cache=True, nogil=True, error_model="numpy")
def mixed(
    deviations: Array, covariances: Array, weights: Array, moves: Array
) -> tuple[Array, Array, Array]:
    """Deviations, covariances and probabilities before a step in which models may change.

    Blom and Bar-Shalom, IEEE Trans. Automatic Control 33(8), 1988.

    Args:
        moves: (M, M) probability of a change from each model to each.
    """
    count, n = deviations.shape
    later = np.zeros(count)
    for i in range(count):
        for j in range(count):
            later[j] += weights[i] * moves[i, j]
    x, p = np.zeros((count, n)), np.zeros((count, n, n))
    for j in range(count):
        for i in range(count):
            share = weights[i] * moves[i, j] / later[j]
            for a in range(n):
                x[j, a] += share * deviations[i, a]
        for i in range(count):
            share = weights[i] * moves[i, j] / later[j]
            if share < 1e-9:
                continue
            for a in range(n):
                off = share * (deviations[i, a] - x[j, a])
                for b in range(a + 1):
                    p[j, a, b] += share * covariances[i, a, b]
                    p[j, a, b] += off * (deviations[i, b] - x[j, b])
        for a in range(n):
            for b in range(a):
                p[j, b, a] = p[j, a, b]
    return x, p, later


@njit(cache=True, nogil=True, error_model="numpy")
def add_noise(
    covariance: Array, dt: float, rotation: Array, place: Array, velocity: Array, angular: float,
    acceleration: float, lasting: float, jitter: float, slew: float,
) -> None:  # fmt: skip
    """Add the process noise of one model to P (n, n), in place.

    Args:
        angular, acceleration, slew: spectral densities.
        lasting: variance that the lasting acceleration gains in ``dt``.
        jitter: variance that the jitter gains.
    """
    arms = np.zeros((12, 3))  # a rate gained at the middle of the step
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        arms[3 + i, k], arms[3 + i, j] = 0.5 * dt * place[j], -0.5 * dt * place[k]
        arms[9 + i, k], arms[9 + i, j] = 0.5 * dt * velocity[j], -0.5 * dt * velocity[k]
        arms[6 + i, i] = 1.0
        for j in range(3):
            arms[i, j] = 0.5 * dt * rotation[i, j]
    gained = angular * dt
    for a in range(12):
        for b in range(12):
            s = arms[a, 0] * arms[b, 0] + arms[a, 1] * arms[b, 1] + arms[a, 2] * arms[b, 2]
            covariance[a, b] += gained * s
    pp = acceleration * dt**3 / 3.0 + lasting * dt**4 / 20.0
    pv = acceleration * dt**2 / 2.0 + lasting * dt**3 / 8.0
    vv = acceleration * dt + lasting * dt**2 / 3.0
    for i in range(3):
        covariance[i, i] += jitter + slew * dt
        covariance[i, 12 + i] += jitter
        covariance[12 + i, i] += jitter
        covariance[12 + i, 12 + i] += jitter
        covariance[3 + i, 3 + i] += pp
        covariance[3 + i, 9 + i] += pv
        covariance[9 + i, 3 + i] += pv
        covariance[9 + i, 9 + i] += vv
        covariance[3 + i, 15 + i] += lasting * dt**2 / 6.0
        covariance[15 + i, 3 + i] += lasting * dt**2 / 6.0
        covariance[9 + i, 15 + i] += lasting * dt / 2.0
        covariance[15 + i, 9 + i] += lasting * dt / 2.0
        covariance[15 + i, 15 + i] += lasting


@njit(cache=True, nogil=True, error_model="numpy")
def changes(stays: Array, dt: float) -> Array:
    """(K, K) probability to go from each of K models to each in ``dt``; ``stays`` (K,) s."""
    count = len(stays)
    out = np.ones((count, count))
    for i in range(count):
        left = 1.0 - math.exp(-dt / stays[i])
        for j in range(count):
            if count > 1:
                out[i, j] = left / (count - 1) if i != j else 1.0 - left
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def switches(accelerations: Array, kinds: int, jitter_stay_s: float, dt: float) -> Array:
    """(M, M) probability to go from each model to each in ``dt``: of `predicted`'s arguments."""
    by_acceleration = changes(accelerations[:, 3].copy(), dt)
    by_jitter = changes(np.full(kinds, jitter_stay_s), dt)
    count = len(accelerations) * kinds
    moves = np.empty((count, count))
    for i in range(count):
        for j in range(count):
            change = by_acceleration[i // kinds, j // kinds] * by_jitter[i % kinds, j % kinds]
            moves[i, j] = change
    return moves


@njit(cache=True, nogil=True, error_model="numpy")
def predicted(
    rotation: Array, place: Array, rate: Array, velocity: Array, deviations: Array,
    covariances: Array, weights: Array, fading: Array, dt: float, angular: float,
    accelerations: Array, jitters: Array, slew: float, jitter_stay_s: float,
) -> tuple[Array, Array, Array, Array, Array, Array, Array]:  # fmt: skip
    """Rotation, place, rate, velocity, deviations, covariances and weights ``dt`` later.

    Args:
        fading: (n - 18, 2) how fast each bias is forgotten: 1/s, and per ln of the range.
        angular: rad/s² √s.
        accelerations: (A, 4) m/s² √s, lasting σ, its correlation, mean stay.
        jitters: (J, 2) σ rad, correlation s. Model a J + j has both.
        slew: rad/√s, wander of the camera's attitude.
    """
    count, n = deviations.shape
    kinds = len(jitters)
    moves = switches(accelerations, kinds, jitter_stay_s, dt)
    x, p, later = mixed(deviations, covariances, weights, moves)
    turn = so3.exp(-dt * rate)
    new_place, new_velocity = np.empty(3), np.empty(3)
    so3.rotate_into(turn, place + dt * velocity, new_place)
    so3.rotate_into(turn, velocity, new_velocity)
    turn_seen, new_rotation = np.empty(3), np.empty((3, 3))
    so3.rotate_into(rotation, dt * rate, turn_seen)
    so3.perturb_into(turn_seen, rotation, new_rotation)  # R exp(ω) = exp(R ω) R
    so3.orthonormalise(new_rotation)
    before, after = 1e-6, 1e-6
    for i in range(3):
        before += place[i] * place[i]
        after += new_place[i] * new_place[i]
    neared = abs(0.5 * math.log(after / before))
    fade = np.empty(n - MOTION)
    for i in range(len(fade)):
        fade[i] = math.exp(-dt * fading[i, 0] - neared * fading[i, 1])
    for m in range(count):
        white, sigma, tau, _ = accelerations[m // kinds]
        swing, swing_s = jitters[m % kinds]
        jitter, lasting = math.exp(-dt / swing_s), math.exp(-dt / tau)
        transit(
            x[m], dt, jitter, lasting, turn, new_rotation, new_place, new_velocity, fade
        )  # fmt: skip
        for _ in range(2):  # F (P Fᵀ): rows, then those of the transpose
            for i in range(n):
                transit(
                    p[m, i], dt, jitter, lasting, turn, new_rotation, new_place, new_velocity, fade
                )  # fmt: skip
            for i in range(n):
                for j in range(i):
                    p[m, i, j], p[m, j, i] = p[m, j, i], p[m, i, j]
        add_noise(
            p[m], dt, new_rotation, new_place, new_velocity, angular**2, white**2,
            sigma**2 * (1.0 - lasting**2), swing**2 * (1.0 - jitter**2), slew**2,
        )  # fmt: skip
        for i in range(len(fade)):
            p[m, MOTION + i, MOTION + i] += 1.0 - fade[i] ** 2
    return new_rotation, new_place, rate.copy(), new_velocity, x, p, later


@njit(cache=True, nogil=True, error_model="numpy")
def moments(
    rotation: Array, place: Array, rate: Array, velocity: Array, deviations: Array,
    covariances: Array, weights: Array,
) -> tuple[Array, Array, Array, Array]:  # fmt: skip
    """What the models say together, camera frame.

    Returns:
        (3, 3) camera_from_target; (3,) translation; (6,) rates; (12, 12) covariance of rotation
        vector, translation, angular rate, velocity, perturbation on the left.
    """
    count = len(weights)
    mean, spread = np.zeros(12), np.zeros((12, 12))
    for m in range(count):
        for i in range(12):
            mean[i] += weights[m] * deviations[m, i]
    for m in range(count):
        for i in range(12):
            for j in range(12):
                off = (deviations[m, i] - mean[i]) * (deviations[m, j] - mean[j])
                spread[i, j] += weights[m] * (covariances[m, i, j] + off)
    turned = np.empty((3, 3))
    so3.perturb_into(mean[:3], rotation, turned)
    minus_place = -(place + mean[3:6])
    translation, rates = np.empty(3), np.empty(6)
    so3.rotate_into(turned, minus_place, translation)
    so3.rotate_into(turned, rate + mean[6:9], rates[:3])
    so3.rotate_into(turned, -(velocity + mean[9:12]), rates[3:])
    # From (attitude, place, rate, velocity) in the target's axes to those of the camera.
    into = np.zeros((12, 12))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        into[i, i] = 1.0
        into[3 + i, j], into[3 + i, k] = translation[k], -translation[j]
        into[6 + i, j], into[6 + i, k] = rates[k], -rates[j]
        into[9 + i, j], into[9 + i, k] = rates[3 + k], -rates[3 + j]
        for j in range(3):
            into[3 + i, 3 + j] = -turned[i, j]
            into[6 + i, 6 + j] = turned[i, j]
            into[9 + i, 9 + j] = -turned[i, j]
    half, out = np.zeros((12, 12)), np.zeros((12, 12))
    for i in range(12):
        for j in range(12):
            for k in range(12):
                half[i, j] += into[i, k] * spread[k, j]
    for i in range(12):
        for j in range(i + 1):
            for k in range(12):
                out[i, j] += half[i, k] * into[j, k]
            out[j, i] = out[i, j]
    return turned, translation, rates, out
