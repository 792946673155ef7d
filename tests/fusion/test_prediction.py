"""Prediction beside dense matrices and numerical derivatives."""

import math

import numpy as np
import pytest
from scipy.linalg import block_diag, expm
from scipy.spatial.transform import Rotation

from rendezview.fusion.prediction import (
    changes,
    estimate_of,
    mixed,
    noise_of,
    predicted,
    transition,
)
from rendezview.fusion.state import MOTION, FilterState
from rendezview.geometry import so3

ACCELERATIONS = np.array(
    [[5e-4, 1e-3, 30.0, 60.0], [2e-3, 1e-2, 30.0, 40.0], [3e-2, 2e-2, 9.0, 5.0]]
)
JITTERS = np.array([[6e-3, 0.4], [7e-3, 2.0]])


def exp(vector):
    return Rotation.from_rotvec(vector).as_matrix()


def log(rotation):
    return Rotation.from_matrix(rotation).as_rotvec()


def hat(v):
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def covariance_of(rng, n):
    root = rng.standard_normal((n, n))
    return root @ root.T / n + 0.1 * np.eye(n)


def nominal(rng):
    """Rotation, place, rate, velocity."""
    rotation = Rotation.random(random_state=rng).as_matrix()
    return rotation, rng.standard_normal(3), 0.3 * rng.standard_normal(3), rng.standard_normal(3)


def models(rng, count, n):
    """Deviations, covariances, weights."""
    weights = rng.uniform(0.1, 1.0, count)
    covariances = np.array([covariance_of(rng, n) for _ in range(count)])
    return 0.1 * rng.standard_normal((count, n)), covariances, weights / weights.sum()


def state_of(motion, of_models, fading=None):
    """A state with this nominal motion and these models."""
    biases = of_models[0].shape[1] - MOTION
    fading = np.zeros((biases, 2)) if fading is None else fading
    return FilterState(0.0, *motion, *of_models, {}, fading, {}, {}, {}, 0.0)


def design_of_step(dt, jitter, lasting, after, fade):
    """F, dense: the error's transition beside the nominal state after the step."""
    rotation, place, rate, velocity = after
    turn, unit, zero = exp(-dt * rate), np.eye(3), np.zeros((3, 3))
    rows = [
        [unit, zero, dt * rotation, zero, (jitter - 1.0) * unit, zero],
        [zero, turn, dt * hat(place), dt * turn, zero, 0.5 * dt**2 * turn],
        [zero, zero, unit, zero, zero, zero],
        [zero, zero, dt * hat(velocity), turn, zero, dt * turn],
        [zero, zero, zero, zero, jitter * unit, zero],
        [zero, zero, zero, zero, zero, lasting * turn],
    ]
    return block_diag(np.block(rows), np.diag(fade))


def moved(state, dt):
    """The motion without noise: rotation, place, rate, velocity, jitter, acceleration."""
    rotation, place, rate, velocity, jitter, acceleration = state
    turn = exp(-dt * rate)
    fresh = math.exp(-dt / 0.4)
    return (
        exp((fresh - 1.0) * jitter) @ rotation @ turn.T,
        turn @ (place + dt * velocity + 0.5 * dt**2 * acceleration),
        rate,
        turn @ (velocity + dt * acceleration),
        fresh * jitter,
        math.exp(-dt / 30.0) * turn @ acceleration,
    )


def difference(one, other):
    """(18,) error state between two."""
    return np.concatenate(
        [log(one[0] @ other[0].T), *(a - b for a, b in zip(one[1:], other[1:], strict=True))]
    )


def after_step(before, dt):
    rotation, place, rate, velocity = before
    turn = exp(-dt * rate)
    return rotation @ turn.T, turn @ (place + dt * velocity), rate, turn @ velocity


def test_an_error_goes_on_as_by_the_dense_matrix():
    after, dt = nominal(np.random.default_rng(1)), 0.7
    rotation, place, rate, velocity = after
    jitter, lasting = np.array([0.3, 0.8]), np.array([0.9, 0.5])
    found = transition(dt, jitter, lasting, exp(-dt * rate), rotation, place, velocity)
    for step, *left in zip(found, jitter, lasting, strict=True):
        assert step == pytest.approx(design_of_step(dt, *left, after, []), abs=1e-12)


def test_an_error_goes_on_as_the_nominal_motion_does():
    """Numerical derivatives of the motion by every entry, at small rates times dt."""
    rng = np.random.default_rng(2)
    rotation, place, _, velocity = nominal(rng)
    dt, rate, nothing = 0.5, 0.02 * rng.standard_normal(3), np.zeros(3)
    start = (rotation, place, rate, velocity, nothing, nothing)
    after = after_step(start[:4], dt)
    left = np.exp([[-dt / 0.4], [-dt / 30.0]])
    step = transition(dt, *left, exp(-dt * rate), after[0], after[1], after[3])[0]
    assert difference(moved(start, dt)[:4], after) == pytest.approx(np.zeros(12), abs=1e-12)
    for entry in range(MOTION):
        tip = np.zeros(MOTION)
        tip[entry] = 1e-5
        ahead, behind = (
            moved(
                (exp(s * tip[:3]) @ rotation, place + s * tip[3:6], rate + s * tip[6:9],
                 velocity + s * tip[9:12], s * tip[12:15], s * tip[15:]),
                dt,
            )
            for s in (1.0, -1.0)
        )  # fmt: skip
        slope = difference(ahead, behind) / 2e-5
        # Rows and columns of the rate are linear in rate times dt.
        assert step[:, entry] == pytest.approx(slope, abs=0.03 if 6 <= entry < 9 else 1e-6), entry


def test_mixed_models_are_those_of_the_textbook():
    rng = np.random.default_rng(3)
    x, p, weights = models(rng, 3, 20)
    moves = rng.uniform(0.1, 1.0, (3, 3))
    moves /= moves.sum(axis=1, keepdims=True)
    found_x, found_p, later = mixed(x, p, weights, moves)
    assert later == pytest.approx(moves.T @ weights)
    for j in range(3):
        share = weights * moves[:, j] / later[j]
        mean = share @ x
        off = x - mean
        spread = np.einsum("i,iab->ab", share, p) + np.einsum("i,ia,ib->ab", share, off, off)
        assert found_x[j] == pytest.approx(mean, abs=1e-12)
        assert found_p[j] == pytest.approx(spread, abs=1e-12)
    # The mixture as a whole stays as it was.
    assert later @ found_x == pytest.approx(weights @ x, abs=1e-12)


def test_models_change_by_their_mean_stay():
    stays = np.array([60.0, 40.0, 5.0])
    found = changes(stays, 0.5)
    assert found.sum(axis=1) == pytest.approx(np.ones(3))
    assert np.diag(found) == pytest.approx(np.exp(-0.5 / stays))
    assert found[0, 1] == pytest.approx(found[0, 2])
    assert changes(np.array([60.0]), 100.0) == pytest.approx(np.ones((1, 1)))


def noise(dt, angular=0.0, acceleration=0.0, lasting=0.0, jitter=0.0, slew=0.0):
    rotation, place, _, velocity = nominal(np.random.default_rng(4))
    one = np.array([[acceleration], [lasting], [jitter]])
    return noise_of(dt, rotation, place, velocity, angular, *one, slew)[0]


@pytest.mark.parametrize("only", ["angular", "acceleration", "lasting", "jitter", "slew"])
@pytest.mark.parametrize("dt", [1e-3, 0.5, 10.0])
def test_noise_is_positive_semi_definite(only, dt):
    out = noise(dt, **{only: 0.3})
    assert np.array_equal(out, out.T)
    assert out.any()
    assert np.linalg.eigvalsh(out)[0] >= -1e-12 * np.linalg.eigvalsh(out)[-1]


@pytest.mark.parametrize("lasting", [False, True])
@pytest.mark.parametrize("dt", [0.1, 0.5, 4.0])
def test_noise_of_accelerations_is_its_integral(lasting, dt):
    """Van Loan's integral over the step of white noise into v, or into a lasting a."""
    drift = np.zeros((3, 3))
    drift[0, 1] = drift[1, 2] = 1.0
    density = np.diag([0.0, 0.0, 0.2]) if lasting else np.diag([0.0, 0.2, 0.0])
    both = expm(np.block([[-drift, density], [np.zeros((3, 3)), drift.T]]) * dt)
    integral = both[3:, 3:].T @ both[:3, 3:]
    out = noise(dt, lasting=0.2 * dt) if lasting else noise(dt, acceleration=0.2)
    for axis in range(3):
        entries = np.array([3, 9, 15]) + axis
        assert out[np.ix_(entries, entries)] == pytest.approx(integral, rel=1e-9, abs=1e-15)
    assert out[3, 4] == 0.0


def test_noise_of_jitter_is_that_of_attitude_and_jitter_alike_and_slew_of_attitude():
    out = noise(0.5, jitter=0.3, slew=0.2)
    for axis in range(3):
        entries = np.array([axis, 12 + axis])
        assert out[np.ix_(entries, entries)] == pytest.approx(
            np.array([[0.4, 0.3], [0.3, 0.3]]), abs=1e-12
        )


def test_noise_of_the_rate_is_a_rate_gained_at_the_middle_of_the_step():
    dt, (rotation, place, _, velocity) = 0.5, nominal(np.random.default_rng(4))
    arms = np.vstack(
        [0.5 * dt * rotation, 0.5 * dt * hat(place), np.eye(3), 0.5 * dt * hat(velocity)]
    )
    assert noise(dt, angular=0.3)[:12, :12] == pytest.approx(0.15 * arms @ arms.T, abs=1e-12)


@pytest.mark.parametrize("dt", [0.05, 0.5, 3.0])
def test_a_prediction_is_that_of_dense_matrices(dt):
    rng = np.random.default_rng(5)
    state, n = nominal(rng), 23
    x, p, weights = models(rng, 6, n)
    fading, angular, slew = rng.uniform(0.01, 0.1, (n - MOTION, 2)), 0.01, 2e-4
    rest = ACCELERATIONS, JITTERS, slew, 300.0
    found = predicted(state_of(state, (x, p, weights), fading), dt, angular, *rest)
    after = after_step(state, dt)
    assert found.time_s == dt
    for one, expected in zip(found.nominal, after, strict=True):
        assert one == pytest.approx(expected, abs=1e-12)
    squares = after[1] @ after[1] + 1e-6, state[1] @ state[1] + 1e-6  # m²: a place may be zero
    neared = 0.5 * abs(math.log(squares[0] / squares[1]))
    fade = np.exp(-dt * fading[:, 0] - neared * fading[:, 1])
    moves = np.kron(changes(ACCELERATIONS[:, 3], dt), changes(np.full(2, 300.0), dt))
    mixed_x, mixed_p, later = mixed(x, p, weights, moves)
    assert found.weights == pytest.approx(later)
    assert later.sum() == pytest.approx(1.0)
    for m in range(6):
        white, sigma, tau, _ = ACCELERATIONS[m // 2]
        swing, swing_s = JITTERS[m % 2]
        jitter, lasting = math.exp(-dt / swing_s), math.exp(-dt / tau)
        step = design_of_step(dt, jitter, lasting, after, fade)
        expected = step @ mixed_p[m] @ step.T
        gained = white**2, sigma**2 * (1.0 - lasting**2), swing**2 * (1.0 - jitter**2)
        expected[:MOTION, :MOTION] += noise_of(
            dt, after[0], after[1], after[3], angular**2, *np.array([gained]).T, slew**2
        )[0]
        expected[range(MOTION, n), range(MOTION, n)] += 1.0 - fade**2
        p_m = found.covariances[m]
        assert found.deviations[m] == pytest.approx(step @ mixed_x[m], abs=1e-12)
        assert p_m == pytest.approx(expected, abs=1e-11)
        assert p_m == pytest.approx(p_m.T, abs=1e-13)
        assert np.linalg.eigvalsh(p_m)[0] > 0.0


def test_two_halves_of_a_step_are_nearly_the_whole():
    rng = np.random.default_rng(6)
    rotation, place, rate, velocity = nominal(rng)
    x, p, weights = models(rng, 6, 24)
    x[:], p[:] = x[0], p[0]  # of models that are alike: else the mixing differs
    motion = rotation, 30.0 * place, 0.1 * rate, 0.1 * velocity
    state = state_of(motion, (x, p, weights), np.full((6, 2), 0.01))
    rest = 1e-4, ACCELERATIONS, JITTERS, 2e-4, 300.0
    whole = predicted(state, 0.1, *rest)
    twice = predicted(predicted(state, 0.05, *rest), 0.05, *rest)
    for one, other in zip(whole.nominal, twice.nominal, strict=True):
        assert one == pytest.approx(other, abs=1e-9)
    for one, other in zip(whole.covariances, twice.covariances, strict=True):
        assert np.abs(one - other).max() < 5e-3 * np.abs(one).max()


def camera_state(rotation, place, rate, velocity):
    return rotation, -rotation @ place, rotation @ rate, -rotation @ velocity


def test_moments_are_a_numerical_transformation_to_the_camera():
    rng = np.random.default_rng(15)
    state = nominal(rng)
    x, p, weights = models(rng, 5, 22)
    pose, rates, covariance = estimate_of(state_of(state, (x, p, weights)))
    mean = weights @ x[:, :12]
    off = x[:, :12] - mean
    spread = np.einsum("m,mij->ij", weights, p[:, :12, :12])
    spread += np.einsum("m,mi,mj->ij", weights, off, off)

    def at(tip):
        turned, place, rate, velocity = state
        step = mean + tip
        # The mean first, so that the perturbation is about it.
        return camera_state(
            exp(tip[:3]) @ exp(mean[:3]) @ turned, place + step[3:6], rate + step[6:9],
            velocity + step[9:],
        )  # fmt: skip

    here = at(np.zeros(12))
    assert pose.rotation == pytest.approx(here[0], abs=1e-12)
    assert pose.translation_m == pytest.approx(here[1], abs=1e-12)
    assert rates == pytest.approx(np.concatenate(here[2:]), abs=1e-12)
    into = np.empty((12, 12))
    for entry, tip in enumerate(1e-6 * np.eye(12)):
        into[:, entry] = difference(at(tip), at(-tip)) / 2e-6
    assert covariance == pytest.approx(into @ spread @ into.T, abs=1e-7)
    assert np.array_equal(covariance, covariance.T)


def test_a_rotation_stays_one_over_thousands_of_steps():
    rng = np.random.default_rng(16)
    rotation, place, _, velocity = nominal(rng)
    motion = rotation, place, np.array([0.1, -0.2, 0.3]), 0.0 * velocity
    now = state_of(motion, models(rng, 1, MOTION))
    for _ in range(3000):
        now = predicted(now, 0.1, 0.0, ACCELERATIONS[:1], JITTERS[:1], 0.0, 300.0)
    assert np.abs(now.rotation @ now.rotation.T - np.eye(3)).max() < 1e-14
    assert so3.between(now.rotation, rotation @ exp([30.0, -60.0, 90.0])) == pytest.approx(
        np.zeros(3), abs=1e-9
    )
