"""Prediction of all models of the motion, and what they say together.

All models share one nominal state; each has its own deviation x (M, n), covariance P (M, n, n) and
probability (M,). The state's layout is in `state`.
"""

from __future__ import annotations

import math

import numpy as np

from rendezview.geometry import so3
from rendezview.geometry.pose import Array

MOTION = 18  # attitude, place, rate, velocity, jitter, acceleration. Source: by construction


def transition(
    dt: float, jitter: Array, lasting: Array, turn: Array, rotation: Array, place: Array,
    velocity: Array,
) -> Array:  # fmt: skip
    """(M, 18, 18) F of each model: what becomes of an error of the motion after ``dt``.

    Args:
        jitter, lasting: (M,) what is left of the jitter and the acceleration.
        turn: (3, 3) of the target's axes.
        rotation, place, velocity: nominal state after ``dt``.
    """
    out = np.zeros((len(jitter), 6, 3, 6, 3))
    for kept in range(3):
        out[:, kept, :, kept] = np.eye(3) if kept != 1 else turn
    out[:, 0, :, 2] = dt * rotation
    out[:, 0, :, 4] = (jitter - 1.0)[:, None, None] * np.eye(3)
    out[:, 1, :, 2] = dt * so3.hat(place)
    out[:, 1, :, 3] = dt * turn
    out[:, 1, :, 5] = 0.5 * dt * dt * turn
    out[:, 3, :, 2] = dt * so3.hat(velocity)
    out[:, 3, :, 3] = turn
    out[:, 3, :, 5] = dt * turn
    out[:, 4, :, 4] = jitter[:, None, None] * np.eye(3)
    out[:, 5, :, 5] = lasting[:, None, None] * turn
    return out.reshape(-1, MOTION, MOTION)


def mixed(
    deviations: Array, covariances: Array, weights: Array, moves: Array
) -> tuple[Array, Array, Array]:
    """Deviations, covariances and probabilities before a step in which models may change.

    Blom and Bar-Shalom, IEEE Trans. Automatic Control 33(8), 1988.

    Args:
        moves: (M, M) probability of a change from each model to each.
    """
    later = weights @ moves
    shares = (weights[:, None] * moves / later).T  # of each old model in each new one
    x = shares @ deviations
    off = np.sqrt(shares)[:, :, None] * (deviations - x[:, None])
    p = (shares @ covariances.reshape(len(x), -1)).reshape(covariances.shape)
    p += off.transpose(0, 2, 1) @ off
    return x, p, later


def noise_of(
    dt: float, rotation: Array, place: Array, velocity: Array, angular: float,
    acceleration: Array, lasting: Array, jitter: Array, slew: float,
) -> Array:  # fmt: skip
    """(M, 18, 18) Q of each model: the process noise of a step.

    Args:
        angular, slew: spectral densities, and (M,) that of the ``acceleration``.
        lasting: (M,) variance that the lasting acceleration gains in ``dt``.
        jitter: (M,) variance that the jitter gains.
    """
    pp = acceleration * dt**3 / 3.0 + lasting * dt**4 / 20.0
    pv = acceleration * dt**2 / 2.0 + lasting * dt**3 / 8.0
    vv = acceleration * dt + lasting * dt**2 / 3.0
    pa, va = lasting * dt**2 / 6.0, lasting * dt / 2.0
    turned, zero = jitter + slew * dt, np.zeros(len(jitter))
    axis = np.array(
        [
            [turned, zero, zero, zero, jitter, zero],
            [zero, pp, zero, pv, zero, pa],
            [zero, zero, zero, zero, zero, zero],
            [zero, pv, zero, vv, zero, va],
            [jitter, zero, zero, zero, jitter, zero],
            [zero, pa, zero, va, zero, lasting],
        ]
    ).transpose(2, 0, 1)
    out = np.zeros((len(jitter), 6, 3, 6, 3))
    for i in range(3):
        out[:, :, i, :, i] = axis
    half = 0.5 * dt  # a rate is gained at the middle of the step
    arms = np.empty((12, 3))
    arms[:3], arms[3:6] = half * rotation, half * so3.hat(place)
    arms[6:9], arms[9:] = np.eye(3), half * so3.hat(velocity)
    noise = out.reshape(-1, MOTION, MOTION)
    noise[:, :12, :12] += angular * dt * (arms @ arms.T)
    return noise


def changes(stays: Array, dt: float) -> Array:
    """(K, K) probability to go from each of K models to each in ``dt``; ``stays`` (K,) s."""
    count = len(stays)
    if count == 1:
        return np.ones((1, 1))
    left = 1.0 - np.exp(-dt / stays)
    out = np.repeat(left[:, None] / (count - 1), count, axis=1)
    np.fill_diagonal(out, 1.0 - left)
    return out


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
    kinds = len(jitters)
    # Accelerations and jitters change on their own.
    moves = np.einsum(
        "ab,ij->aibj", changes(accelerations[:, 3], dt), changes(np.full(kinds, jitter_stay_s), dt)
    ).reshape(len(weights), -1)
    x, p, later = mixed(deviations, covariances, weights, moves)
    turn = so3.exp(-dt * rate)
    new_place, new_velocity = turn @ (place + dt * velocity), turn @ velocity
    new_rotation = so3.exp(rotation @ (dt * rate)) @ rotation  # R exp(ω) = exp(R ω) R
    so3.orthonormalise(new_rotation)
    squares = place @ place + 1e-6, new_place @ new_place + 1e-6  # m²: a place may be zero
    neared = abs(0.5 * math.log(squares[1] / squares[0]))
    fade = np.exp(-dt * fading[:, 0] - neared * fading[:, 1])
    white, sigma, tau, _ = np.repeat(accelerations, kinds, axis=0).T
    swing, swing_s = np.tile(jitters, (len(accelerations), 1)).T
    jitter, lasting = np.exp(-dt / swing_s), np.exp(-dt / tau)
    step = transition(dt, jitter, lasting, turn, new_rotation, new_place, new_velocity)
    motion, biases = slice(0, MOTION), slice(MOTION, None)
    x[:, motion] = (step @ x[:, motion, None])[:, :, 0]
    x[:, biases] *= fade
    p[:, motion] = step @ p[:, motion]
    p[:, :, motion] = p[:, :, motion] @ step.transpose(0, 2, 1)
    p[:, biases] *= fade[:, None]
    p[:, :, biases] *= fade
    p = 0.5 * (p + p.transpose(0, 2, 1))
    p[:, motion, motion] += noise_of(
        dt, new_rotation, new_place, new_velocity, angular**2, white**2,
        sigma**2 * (1.0 - lasting**2), swing**2 * (1.0 - jitter**2), slew**2,
    )  # fmt: skip
    entries = np.arange(MOTION, p.shape[1])
    p[:, entries, entries] += 1.0 - fade**2
    return new_rotation, new_place, rate, new_velocity, x, p, later


def moments(
    rotation: Array, place: Array, rate: Array, velocity: Array, deviations: Array,
    covariances: Array, weights: Array,
) -> tuple[Array, Array, Array, Array]:  # fmt: skip
    """What the models say together, camera frame.

    Returns:
        (3, 3) camera_from_target; (3,) translation; (6,) rates; (12, 12) covariance of rotation
        vector, translation, angular rate, velocity, perturbation on the left.
    """
    mean = weights @ deviations[:, :12]
    off = np.sqrt(weights)[:, None] * (deviations[:, :12] - mean)
    spread = np.tensordot(weights, covariances[:, :12, :12], 1) + off.T @ off
    turned = so3.exp(mean[:3]) @ rotation
    translation = -turned @ (place + mean[3:6])
    rates = np.concatenate([turned @ (rate + mean[6:9]), -turned @ (velocity + mean[9:12])])
    # From (attitude, place, rate, velocity) in the target's axes to those of the camera.
    into = np.zeros((12, 12))
    into[:3, :3] = np.eye(3)
    into[3:6, :3], into[3:6, 3:6] = -so3.hat(translation), -turned
    into[6:9, :3], into[6:9, 6:9] = -so3.hat(rates[:3]), turned
    into[9:, :3], into[9:, 9:] = -so3.hat(rates[3:]), -turned
    out = into @ spread @ into.T
    return turned, translation, rates, 0.5 * (out + out.T)
