"""Prediction of all models of the motion, and what they say together; see `state`."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from rendezview.fusion.options import FusionOptions, MotionOptions
from rendezview.fusion.state import MOTION, FilterState
from rendezview.geometry import so3
from rendezview.geometry.pose import Array, Pose
from rendezview.sensors.measurement import RateMeasurement, ThrustMeasurement

# Of a start until it is confirmed: σ of a rate times a step, rad and ranges. Source: linearisation
_MOST_TURN, _MOST_WAY = 0.5, 0.4
_MOST_STEPS = 100  # of a prediction. Source: a chosen limit; a state that old is lost
_HOLD_S = 1.0  # s for which a rate of the camera is taken to go on. Source: chosen


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
    state: FilterState, dt: float, angular: float, accelerations: Array, jitters: Array,
    slew: float, jitter_stay_s: float,
) -> FilterState:  # fmt: skip
    """The state one step later.

    Args:
        angular: rad/s² √s.
        accelerations: (A, 4) m/s² √s, lasting σ, its correlation, mean stay.
        jitters: (J, 2) σ rad, correlation s. Model a J + j has both.
        slew: rad/√s, wander of the camera's attitude.
    """
    rotation, place, rate, velocity = state.nominal
    kinds = len(jitters)
    # Accelerations and jitters change on their own.
    moves = np.einsum(
        "ab,ij->aibj", changes(accelerations[:, 3], dt), changes(np.full(kinds, jitter_stay_s), dt)
    ).reshape(len(state.weights), -1)
    x, p, later = mixed(state.deviations, state.covariances, state.weights, moves)
    turn = so3.exp(-dt * rate)
    new_place, new_velocity = turn @ (place + dt * velocity), turn @ velocity
    new_rotation = so3.exp(rotation @ (dt * rate)) @ rotation  # R exp(ω) = exp(R ω) R
    so3.orthonormalise(new_rotation)
    squares = place @ place + 1e-6, new_place @ new_place + 1e-6  # m²: a place may be zero
    neared = abs(0.5 * math.log(squares[1] / squares[0]))
    fade = np.exp(-state.fading @ (dt, neared))
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
    return state._replace(
        time_s=state.time_s + dt, rotation=new_rotation, place_m=new_place, velocity=new_velocity,
        deviations=x, covariances=p, weights=later,
    )  # fmt: skip


def predict(state: FilterState, dt_s: float, options: FusionOptions) -> FilterState:
    """The state ``dt_s`` later: rates go on, accelerations and jitter widen it.

    Raises:
        ValueError: the step is negative or not finite.
    """
    if not 0.0 <= dt_s < math.inf:
        raise ValueError(f"the filter goes forward only, not by {dt_s} s")
    if dt_s == 0.0:
        return state
    motion = options.motion
    time_s = state.time_s + dt_s
    if not state.confirmed:
        state = _with_slow_rates(state, dt_s)
    accelerations, jitters = models_of(motion, state.jitter)
    turning = state.turning if time_s <= state.turning_s + _HOLD_S else None
    if turning is not None:  # the camera's swing is known: jitter keeps what it has
        jitters[:, 0], jitters[:, 1] = 0.0, np.inf
    # The noise of a step is exact for a short one.
    steps = min(math.ceil(3.0 * dt_s / motion.acceleration_s), _MOST_STEPS)
    for _ in range(steps):
        state = predicted(
            state, dt_s / steps, motion.angular, accelerations, jitters,
            0.0 if turning is None else state.turning_sigma, motion.jitter_stay_s,
        )  # fmt: skip
    state = state._replace(time_s=time_s)  # without rounding
    return state if turning is None else _swung(state, -dt_s * turning)


def _swung(state: FilterState, swing_rad: Array) -> FilterState:
    """The state after a turn of the camera (3,), on the left of its attitude."""
    swing = so3.exp(swing_rad)
    deviations, covariances = state.deviations.copy(), state.covariances.copy()
    for rows in (slice(0, 3), slice(12, 15)):  # both are in the camera's axes
        deviations[:, rows] = deviations[:, rows] @ swing.T
        covariances[:, rows] = swing @ covariances[:, rows]
        covariances[:, :, rows] = covariances[:, :, rows] @ swing.T
    return state._replace(
        rotation=swing @ state.rotation, deviations=deviations, covariances=covariances
    )


def models_of(motion: MotionOptions, jitter: float) -> tuple[Array, Array]:
    """(A, 4) accelerations and (J, 2) jitters, as `predicted` takes them."""
    accelerations, jitters = _models(motion)
    jitters = jitters.copy()
    jitters[0, 0] = jitter
    return accelerations, jitters


@lru_cache(maxsize=8)
def _models(motion: MotionOptions) -> tuple[Array, Array]:
    accelerations = np.column_stack(
        [
            motion.accelerations,
            motion.lasting_accelerations,
            np.full(len(motion.accelerations), motion.acceleration_s),
            motion.stays_s,
        ]
    )
    return accelerations, np.column_stack([motion.jitters, motion.jitters_s])


def turned(state: FilterState, measurement: RateMeasurement, options: FusionOptions) -> FilterState:
    """The state at the time of a reading of the camera's own rotation, since the one before."""
    dt_s = max(measurement.time_s - state.time_s, 0.0)
    since_s = max(measurement.time_s - state.turning_s, 1e-3)
    # A reading between two of these, as of a thrust, was reached with the rate before.
    ahead_s = state.time_s - max(state.turning_s, state.pose_s)
    if state.turning is not None and ahead_s > 0.0 and since_s <= _HOLD_S:
        state = _swung(state, ahead_s * (state.turning - measurement.rate_rad_s))
    # White noise of a mean rate over an interval is a random walk of the angle.
    sigma = measurement.sigma_rad_s * math.sqrt(min(since_s, _HOLD_S))
    state = state._replace(
        turning=measurement.rate_rad_s, turning_sigma=sigma, turning_s=measurement.time_s
    )
    return predict(state, dt_s, options)


def pushed(state: FilterState, measurement: ThrustMeasurement) -> FilterState:
    """The state after a known change of the camera's velocity."""
    covariances = state.covariances.copy()
    for i in range(9, 12):
        covariances[:, i, i] += measurement.sigma_m_s**2
    change = state.rotation.T @ measurement.velocity_change_m_s
    return state._replace(velocity=state.velocity + change, covariances=covariances)


def _with_slow_rates(state: FilterState, dt_s: float) -> FilterState:
    """The state with rates that a step can still be linearised with."""
    scale = np.ones(state.deviations.shape[1])
    away = math.sqrt(state.place_m @ state.place_m)
    for rows, most in ((slice(6, 9), _MOST_TURN), (slice(9, 12), _MOST_WAY * away)):
        block = np.diagonal(state.covariances[:, rows, rows], axis1=1, axis2=2)
        sigma = math.sqrt(block.max())
        if sigma * dt_s > most:
            scale[rows] = most / (sigma * dt_s)
    if scale.min() == 1.0:
        return state
    covariances = state.covariances * scale[:, None] * scale
    return state._replace(covariances=covariances)


def estimate_of(state: FilterState) -> tuple[Pose, Array, Array]:
    """What the models say together, camera frame.

    Returns:
        camera_from_target; (6,) rates; (12, 12) covariance of rotation vector, translation, angular
        rate, velocity, perturbation on the left.
    """
    rotation, place, rate, velocity = state.nominal
    mean = state.weights @ state.deviations[:, :12]
    off = np.sqrt(state.weights)[:, None] * (state.deviations[:, :12] - mean)
    spread = np.tensordot(state.weights, state.covariances[:, :12, :12], 1) + off.T @ off
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
    return Pose(turned, translation), rates, 0.5 * (out + out.T)
