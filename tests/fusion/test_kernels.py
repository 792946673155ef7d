"""The compiled loops beside plain numpy and numerical derivatives."""

import math

import numpy as np
import pytest
from scipy.linalg import block_diag, expm
from scipy.spatial.transform import Rotation

from rendezview.estimation.linear_algebra import square_root
from rendezview.fusion.kernels import (
    MOTION,
    add_noise,
    changes,
    mixed,
    moments,
    predicted,
    transit,
)
from rendezview.fusion.update_kernels import compared, corrected, jitter_step, white_share
from rendezview.geometry import so3

ACCELERATIONS = np.array(
    [[5e-4, 1e-3, 30.0, 60.0], [2e-3, 1e-2, 30.0, 40.0], [3e-2, 2e-2, 9.0, 5.0]]
)
JITTERS = np.array([[6e-3, 0.4, 1e-4], [7e-3, 2.0, 4e-4]])


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
    rng = np.random.default_rng(1)
    after, dt, n = nominal(rng), 0.7, 25
    fade = rng.uniform(0.2, 1.0, n - MOTION)
    step = design_of_step(dt, 0.3, 0.9, after, fade)
    for _ in range(5):
        row = rng.standard_normal(n)
        found = row.copy()
        rotation, place, rate, velocity = after
        transit(found, dt, 0.3, 0.9, exp(-dt * rate), rotation, place, velocity, fade)
        assert found == pytest.approx(step @ row, abs=1e-12)


def test_an_error_goes_on_as_the_nominal_motion_does():
    """Numerical derivatives of the motion by every entry, at small rates times dt."""
    rng = np.random.default_rng(2)
    rotation, place, _, velocity = nominal(rng)
    dt, rate, nothing = 0.5, 0.02 * rng.standard_normal(3), np.zeros(3)
    start = (rotation, place, rate, velocity, nothing, nothing)
    after = after_step(start[:4], dt)
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
        row = np.zeros(MOTION)
        row[entry] = 1.0
        transit(
            row, dt, math.exp(-dt / 0.4), math.exp(-dt / 30.0), exp(-dt * rate), after[0],
            after[1], after[3], np.zeros(0),
        )  # fmt: skip
        # Rows and columns of the rate are linear in rate times dt.
        assert row == pytest.approx(slope, abs=0.03 if 6 <= entry < 9 else 1e-6), entry


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
    out = np.zeros((20, 20))
    add_noise(
        out, dt, rotation, place, velocity, angular, acceleration, lasting, jitter, slew
    )  # fmt: skip
    return out


@pytest.mark.parametrize("only", ["angular", "acceleration", "lasting", "jitter", "slew"])
@pytest.mark.parametrize("dt", [1e-3, 0.5, 10.0])
def test_noise_is_positive_semi_definite(only, dt):
    out = noise(dt, **{only: 0.3})
    assert np.array_equal(out, out.T)
    assert out.any()
    assert np.linalg.eigvalsh(out)[0] >= -1e-12 * np.linalg.eigvalsh(out)[-1]
    # It adds, and leaves the biases alone.
    assert not out[MOTION:].any()


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
    fading, angular, stay_s = rng.uniform(0.01, 0.1, (n - MOTION, 2)), 0.01, 300.0
    found = predicted(*state, x, p, weights, fading, dt, angular, ACCELERATIONS, JITTERS, stay_s)
    after = after_step(state, dt)
    for one, expected in zip(found[:4], after, strict=True):
        assert one == pytest.approx(expected, abs=1e-12)
    squares = after[1] @ after[1] + 1e-6, state[1] @ state[1] + 1e-6  # m²: a place may be zero
    neared = 0.5 * abs(math.log(squares[0] / squares[1]))
    fade = np.exp(-dt * fading[:, 0] - neared * fading[:, 1])
    moves = np.kron(changes(ACCELERATIONS[:, 3].copy(), dt), changes(np.full(2, stay_s), dt))
    mixed_x, mixed_p, later = mixed(x, p, weights, moves)
    assert found[6] == pytest.approx(later)
    assert later.sum() == pytest.approx(1.0)
    for m in range(6):
        white, sigma, tau, _ = ACCELERATIONS[m // 2]
        swing, swing_s, slew = JITTERS[m % 2]
        jitter, lasting = math.exp(-dt / swing_s), math.exp(-dt / tau)
        step = design_of_step(dt, jitter, lasting, after, fade)
        expected = step @ mixed_p[m] @ step.T
        add_noise(
            expected, dt, after[0], after[1], after[3], angular**2, white**2,
            sigma**2 * (1.0 - lasting**2), swing**2 * (1.0 - jitter**2), slew**2,
        )  # fmt: skip
        expected[range(MOTION, n), range(MOTION, n)] += 1.0 - fade**2
        assert found[4][m] == pytest.approx(step @ mixed_x[m], abs=1e-12)
        assert found[5][m] == pytest.approx(expected, abs=1e-11)
        assert found[5][m] == pytest.approx(found[5][m].T, abs=1e-13)
        assert np.linalg.eigvalsh(found[5][m])[0] > 0.0


def test_two_halves_of_a_step_are_nearly_the_whole():
    rng = np.random.default_rng(6)
    rotation, place, rate, velocity = nominal(rng)
    state = rotation, 30.0 * place, 0.1 * rate, 0.1 * velocity
    x, p, weights = models(rng, 6, 24)
    fading = np.full((6, 2), 0.01)
    rest = 1e-4, ACCELERATIONS, JITTERS, 300.0
    x[:], p[:] = x[0], p[0]  # of models that are alike: else the mixing differs
    whole = predicted(*state, x, p, weights, fading, 0.1, *rest)
    half = predicted(*state, x, p, weights, fading, 0.05, *rest)
    twice = predicted(*half, fading, 0.05, *rest)
    for one, other in zip(whole[:4], twice[:4], strict=True):
        assert one == pytest.approx(other, abs=1e-9)
    for one, other in zip(whole[5], twice[5], strict=True):
        assert np.abs(one - other).max() < 5e-3 * np.abs(one).max()


def a_measurement(seed, k=5, n=24, count=4):
    """Models, design, noise and residual."""
    rng = np.random.default_rng(seed)
    design = rng.standard_normal((k, n))
    design[:, 9:12] = 0.0  # a velocity is never seen
    return models(rng, count, n), design, covariance_of(rng, k), rng.standard_normal(k)


def test_a_measurement_beside_each_model_is_that_of_numpy():
    (x, p, weights), design, noise, residual = a_measurement(7)
    fits, total, peak, nis, innovation, logs, across, lowers, whites = compared(
        x, p, weights, design, noise, residual
    )
    assert fits
    offs = residual - x @ design.T
    spreads = design @ p @ design.T + noise
    heights = -0.5 * (np.linalg.slogdet(spreads)[1] + 5.0 * math.log(2.0 * math.pi))
    squared = np.array(
        [off @ np.linalg.solve(s, off) for off, s in zip(offs, spreads, strict=True)]
    )
    assert logs == pytest.approx(heights - 0.5 * squared)
    assert total == pytest.approx(math.log(weights @ np.exp(heights - 0.5 * squared)))
    assert peak == pytest.approx(weights @ heights)
    assert nis == pytest.approx(weights @ squared)
    assert innovation == pytest.approx(weights @ offs)
    assert across == pytest.approx(p @ design.T)
    for lower, white, spread, off in zip(lowers, whites, spreads, offs, strict=True):
        assert lower == pytest.approx(np.linalg.cholesky(spread))
        assert white == pytest.approx(np.linalg.solve(np.linalg.cholesky(spread), off))


def test_a_covariance_that_is_not_one_fits_nothing():
    (x, p, weights), design, noise, residual = a_measurement(8)
    assert not compared(x, p, weights, design, noise - 1e3 * np.eye(5), residual)[0]


def test_a_semi_definite_matrix_has_a_root():
    thin = np.random.default_rng(5).standard_normal((5, 3))
    root = square_root(thin @ thin.T)
    assert np.allclose(root @ root.T, thin @ thin.T, atol=1e-7)
    assert not square_root(np.zeros((4, 4))).any()


def test_a_correction_is_that_of_the_textbook_in_each_model():
    (x, p, weights), design, noise, residual = a_measurement(9)
    x *= 0.01  # so that a rotation vector is nearly a vector
    state = nominal(np.random.default_rng(9))
    _, _, _, _, _, logs, across, lowers, whites = compared(
        x, p, weights, design, noise, 0.01 * residual
    )
    found = corrected(*state, x, p, weights, logs, across, lowers, whites)
    likely = weights * np.exp(logs)
    likely /= likely.sum()
    assert found[6] == pytest.approx(likely)
    after = np.empty_like(x)
    for m in range(4):
        spread = design @ p[m] @ design.T + noise
        gain = np.linalg.solve(spread, design @ p[m]).T
        after[m] = x[m] + gain @ (0.01 * residual - design @ x[m])
        assert found[5][m] == pytest.approx((np.eye(24) - gain @ design) @ p[m], abs=1e-12)
        assert np.array_equal(found[5][m], found[5][m].T)
    mean = likely @ after
    assert found[0] == pytest.approx(exp(mean[:3]) @ state[0], abs=1e-12)
    for k in range(1, 4):
        assert found[k] == pytest.approx(state[k] + mean[3 * k : 3 * k + 3])
    # The motion's mean is in the nominal state now; jitter, acceleration, biases stay.
    assert likely @ found[4][:, :12] == pytest.approx(np.zeros(12), abs=1e-12)
    assert found[4][:, 12:] == pytest.approx(after[:, 12:], abs=1e-12)
    assert found[4][:, :12] == pytest.approx(after[:, :12] - mean[:12], abs=1e-12)


def test_a_model_never_dies_out():
    (x, p, weights), design, noise, residual = a_measurement(10)
    logs = np.array([0.0, -1e4, -1e4, -1.0])
    _, _, _, _, _, _, across, lowers, whites = compared(x, p, weights, design, noise, residual)
    after = corrected(
        *nominal(np.random.default_rng(0)), x, p, weights, logs, across, lowers, whites
    )
    assert after[6].min() > 5e-6
    assert after[6].sum() == pytest.approx(1.0)


def share_by_numpy(shares, root, weights, spreads, offs):
    out = np.zeros(len(shares))
    for weight, spread, off in zip(weights, spreads, offs, strict=True):
        along = (root.T @ np.linalg.solve(spread, off)) ** 2
        size = np.diag(root.T @ np.linalg.solve(spread, root))
        out += weight * (np.minimum(along, 25.0 * size) - size) * shares**2
    return np.concatenate([np.full(3, out[:3].mean()), np.full(len(out) - 3, out[3:].mean())])


@pytest.mark.parametrize("k", [5, 6])
@pytest.mark.parametrize("far", [1.0, 100.0])
def test_a_step_of_the_white_share_is_that_of_numpy(k, far):
    (x, p, weights), design, noise, residual = a_measurement(11, k)
    root, shares = np.linalg.cholesky(noise), np.linspace(0.2, 0.9, k)
    residual = far * residual
    *_, lowers, whites = compared(x, p, weights, design, noise, residual)
    spreads, offs = design @ p @ design.T + noise, residual - x @ design.T
    found = white_share(shares, root, weights, lowers, whites)
    assert found == pytest.approx(share_by_numpy(shares, root, weights, spreads, offs))


def test_the_white_share_rests_at_the_truth():
    """Innovations of S as taken teach nothing in the mean; larger ones raise it."""
    rng = np.random.default_rng(12)
    root, shares = np.linalg.cholesky(covariance_of(rng, 6)), np.full(6, 0.4)
    lower = np.linalg.cholesky(covariance_of(rng, 6) + root @ root.T)
    for scale, least, most in ((1.0, -0.01, 0.01), (1.5, 0.02, 1.0), (0.5, -1.0, -0.02)):
        steps = [
            white_share(shares, root, np.ones(1), lower[None], scale * rng.standard_normal((1, 6)))
            for _ in range(4000)
        ]
        mean = np.mean(steps, axis=0)
        assert np.all((least < mean) & (mean < most)), scale


@pytest.mark.parametrize(
    ("kinds", "own"),
    [(1, [0.2, 0.3, 0.4, 0.1]), (2, [0.4, 0.2, 0.3, 0.1]), (2, [0.1, 0.8, 0.05, 0.05])],
)
def test_a_step_of_the_jitter_is_that_of_numpy(kinds, own):
    """By the models of the first jitter, or by all where those are unlikely."""
    (x, p, _), design, noise, residual = a_measurement(13, 6)
    weights = np.array(own)
    *_, lowers, whites = compared(x, p, weights, design, noise, residual)
    gained = 0.7
    found = jitter_step(design, weights, lowers, whites, gained, kinds)
    first = np.where(np.arange(4) % kinds == 0, weights, 0.0)
    if first.sum() < 0.2:
        first = weights
    whole = gained * design[:, :3] @ design[:, :3].T
    slope = curvature = 0.0
    for weight, spread, off in zip(
        first / first.sum(), design @ p @ design.T + noise, residual - x @ design.T, strict=True
    ):
        inverse = np.linalg.inv(spread)
        z = inverse @ off
        slope += weight * (z @ whole @ z - np.trace(inverse @ whole))
        curvature += weight * np.trace(inverse @ whole @ inverse @ whole)
    assert found == pytest.approx(slope / curvature)
    assert jitter_step(0.0 * design, weights, lowers, whites, gained, kinds) == 0.0


def test_the_step_of_the_jitter_leads_to_the_truth():
    rng = np.random.default_rng(14)
    design, rest = rng.standard_normal((6, 20)), covariance_of(rng, 6)
    true, taken, gained = 0.5, 0.2, 0.8
    seen = gained * design[:, :3] @ design[:, :3].T
    real = np.linalg.cholesky(rest + true * seen)
    lower = np.linalg.cholesky(rest + taken * seen)
    steps = [
        jitter_step(
            design, np.ones(1), lower[None],
            np.linalg.solve(lower, real @ rng.standard_normal(6))[None], gained, 1,
        )
        for _ in range(6000)
    ]  # fmt: skip
    assert np.mean(steps) == pytest.approx(true - taken, rel=0.1)


def camera_state(rotation, place, rate, velocity):
    return rotation, -rotation @ place, rotation @ rate, -rotation @ velocity


def test_moments_are_a_numerical_transformation_to_the_camera():
    rng = np.random.default_rng(15)
    state = nominal(rng)
    x, p, weights = models(rng, 5, 22)
    rotation, translation, rates, covariance = moments(*state, x, p, weights)
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
    assert rotation == pytest.approx(here[0], abs=1e-12)
    assert translation == pytest.approx(here[1], abs=1e-12)
    assert rates == pytest.approx(np.concatenate(here[2:]), abs=1e-12)
    into = np.empty((12, 12))
    for entry, tip in enumerate(1e-6 * np.eye(12)):
        into[:, entry] = difference(at(tip), at(-tip)) / 2e-6
    assert covariance == pytest.approx(into @ spread @ into.T, abs=1e-7)
    assert np.array_equal(covariance, covariance.T)


def test_a_rotation_stays_one_over_thousands_of_steps():
    rng = np.random.default_rng(16)
    rotation, place, _, velocity = nominal(rng)
    now = (rotation, place, np.array([0.1, -0.2, 0.3]), 0.0 * velocity, *models(rng, 1, MOTION))
    for _ in range(3000):
        now = predicted(
            *now, np.zeros((0, 2)), 0.1, 0.0, ACCELERATIONS[:1], JITTERS[:1], 300.0
        )  # fmt: skip
    assert np.abs(now[0] @ now[0].T - np.eye(3)).max() < 1e-14
    assert so3.between(now[0], rotation @ exp([30.0, -60.0, 90.0])) == pytest.approx(
        np.zeros(3), abs=1e-9
    )
