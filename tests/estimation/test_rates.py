"""Filters of rates: against plain numpy and scipy, and their errors against their claims."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.spatial.transform import Rotation
from tests.estimation.swings import AXIS, SIGMA, swinging

from rendezview.estimation import rate_filters as bank_module
from rendezview.estimation.rate_filters import surprise
from rendezview.estimation.rates import TURNS, RateBank
from rendezview.geometry.pose import Pose


def errors_of(motion, hertz, seconds, seed, after_s):
    """Errors (N, 6) of the rates, of a line through eight readings, and NEES (N,)."""
    rng, bank, kept = np.random.default_rng(seed), RateBank(), []
    ours, lines, nees = [], [], []
    for t in np.arange(0.0, seconds, 1.0 / hertz):
        pose, truth = motion(t)
        seen = pose.perturbed(rng.normal(0.0, SIGMA))
        found = bank.add(float(t), seen, np.diag(SIGMA**2))
        kept = [*kept, (t, seen)][-8:]
        if found is None or t < after_s:
            continue
        way = [
            np.append(Rotation.from_matrix(p.rotation @ seen.rotation.T).as_rotvec(),
                      p.translation_m) for _, p in kept
        ]  # fmt: skip
        lines.append(np.polyfit([k[0] for k in kept], way, 1)[0] - truth)
        ours.append(found.rates - truth)
        nees.append(ours[-1] @ np.linalg.solve(found.covariance, ours[-1]))
    return np.array(ours), np.array(lines), np.array(nees)


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.parametrize(("k", "dt"), [(0.7, 0.3), (2.4, 2.0), (1e-4, 0.05), (0.0, 0.4)])
def test_a_swing_moves_as_its_differential_equation_says(k, dt):
    carry, slope = np.empty((3, 2)), np.empty((3, 2))
    bank_module.transition(dt, k, carry, slope)
    flow = expm(dt * np.array([[0, 1, 0], [0, 0, 1], [0, -k * k, 0]]))
    np.testing.assert_allclose(carry, flow[:, 1:], atol=1e-9)
    up, down = (expm(dt * np.array([[0, 1, 0], [0, 0, 1], [0, -((k * f) ** 2), 0]]))[:, 1:]
                for f in (np.exp(1e-5), np.exp(-1e-5)))  # fmt: skip
    np.testing.assert_allclose(slope, (up - down) / 2e-5, atol=1e-8)


def plain_filter(dt, kind, walk, state, covariance, off, error):
    """One filter's step by dense matrices: state, covariance, move, correction and likelihood."""
    swings, k = kind[2] > 0.0, np.exp(state[12]) if kind[2] > 0.0 else 0.0

    def ahead(x):
        rate = np.exp(x[12]) if swings else 0.0
        flow = expm(
            dt * np.array([[0, 1, 1, 0], [0, 0, 0, 0], [0, 0, 0, 1], [0, 0, -(rate**2), 0]])
        )
        return np.append((flow @ x[:12].reshape(4, 3)).ravel(), x[12])

    full = state.copy()
    carry = np.array([(ahead(full + d) - ahead(full - d)) / 2e-6 for d in 1e-6 * np.eye(13)]).T
    if not swings:
        carry[:12, 12] = 0.0
    unsure, swing = covariance[12, 12], state[6:9]
    wrong = 0.2 * 4 * k**3 * unsure * (np.trace(covariance[6:9, 6:9]) + unsure * swing @ swing) / 3
    noise = np.zeros((4, 4))
    places = np.ix_([0, 2, 3], [0, 2, 3])
    noise[places] = (kind[0] ** 2 + (wrong if swings else 0.0)) * np.array(
        [[dt**5 / 20, dt**4 / 8, dt**3 / 6], [dt**4 / 8, dt**3 / 3, dt**2 / 2],
         [dt**3 / 6, dt**2 / 2, dt]]
    )  # fmt: skip
    noise[:2, :2] += kind[1] ** 2 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    full_noise = np.zeros((13, 13))
    full_noise[:12, :12] = np.kron(noise, np.eye(3))
    full_noise[12, 12] = walk**2 * dt if swings else 0.0
    before, predicted = carry @ covariance @ carry.T + full_noise, ahead(full)
    spread = before[:3, :3] + error
    gain = before[:, :3] @ np.linalg.inv(spread)
    change = gain @ off
    likely = -0.5 * (off @ np.linalg.solve(spread, off) + np.linalg.slogdet(spread)[1])
    return (predicted[:3], np.append(np.zeros(3), (predicted + change)[3:]), change[:3],
            before - gain @ before[:3], likely)  # fmt: skip


@pytest.mark.parametrize("row", range(9))
def test_a_filter_is_that_of_plain_numpy(row):
    rng, dt = np.random.default_rng(row), 0.3
    kind = TURNS[row]
    root = rng.normal(0.0, 0.1, (13, 13))
    covariance, state = root @ root.T, np.append(np.zeros(3), rng.normal(0.0, 0.1, 10))
    off, error = rng.normal(0.0, 0.02, 3), np.diag(SIGMA[:3] ** 2)
    wanted = plain_filter(dt, kind, 1e-3, state, covariance, off, error)
    step, change = np.empty(3), np.empty(3)
    bank_module.predict(dt, kind, state, covariance, step)
    likely = bank_module.update(off, error, state, covariance, change)
    for found, expected in zip((step, state, change, covariance), wanted[:4], strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-8)
    assert likely == pytest.approx(wanted[4])


def test_errors_of_the_attitude_turn_with_it():
    rng = np.random.default_rng(2)
    turn, root = Rotation.random(rng=rng).as_matrix(), rng.normal(size=(13, 13))
    covariance, whole = root @ root.T, np.eye(13)
    whole[:3, :3] = turn
    wanted = whole @ covariance @ whole.T
    bank_module.carry_attitude(turn, covariance)
    np.testing.assert_allclose(covariance, wanted, atol=1e-12)


def test_mixed_rates_are_those_of_plain_numpy():
    rng = np.random.default_rng(3)
    root = rng.normal(0.0, 0.1, (4, 13, 13))
    covariances, states = root @ root.transpose(0, 2, 1), rng.normal(0.0, 0.1, (4, 13))
    scores, mean, spread = rng.normal(0.0, 2.0, 4), np.zeros(3), np.zeros((3, 3))
    bank_module.mix(scores, states, covariances, 0, mean, spread)
    weights = np.exp(scores - scores.max())
    weights /= weights.sum()
    both = np.hstack([np.zeros((3, 3)), np.eye(3), np.eye(3), np.zeros((3, 4))])
    rates = states @ both.T
    off = rates - weights @ rates
    assert mean == pytest.approx(weights @ rates)
    wanted = np.einsum("b,ij,bjk,lk->il", weights, both, covariances, both)
    assert spread == pytest.approx(wanted + (weights[:, None] * off).T @ off)


@pytest.mark.parametrize("row", range(9))
def test_a_bank_of_one_filter_is_that_filter(row):
    rng, dt = np.random.default_rng(5), 0.3
    kinds = TURNS[row : row + 1]
    states, covariances = np.zeros((2, 1, 13)), np.empty((2, 1, 13, 13))
    for part in range(2):
        bank_module.begin(kinds[0], states[part, 0], covariances[part, 0])
        covariances[part, 0, :3, :3] = np.diag(SIGMA[:3] ** 2)
    assert np.diag(covariances[0, 0])[3:] == pytest.approx(np.repeat(kinds[0, 3:7], 3)[:10] ** 2)
    first = states[1, 0].copy(), covariances[1, 0].copy()
    place, measured = rng.normal(0.0, 0.1, 3), np.diag(SIGMA**2)
    rotations, places, scores = np.eye(3)[None].copy(), np.zeros((1, 3)), np.full((2, 1), 4.0)
    mean, spread = np.zeros(6), np.zeros((6, 6))
    assert bank_module.step_bank(
        dt, kinds, kinds, rotations, places, states, covariances, scores, np.eye(3), place,
        measured, 0.5, mean, spread,
    )  # fmt: skip
    step, state, change, covariance, likely = plain_filter(
        dt, kinds[0], 1e-3, *first, place, measured[3:, 3:]
    )
    assert places[0] == pytest.approx(step + change, abs=1e-9)
    np.testing.assert_allclose(states[1, 0], state, atol=1e-8)
    np.testing.assert_allclose(covariances[1, 0], covariance, atol=1e-8)
    assert scores[1, 0] == pytest.approx(2.0 + likely)
    assert mean[3:] == pytest.approx(state[3:6] + state[6:9])
    assert rotations[0] == pytest.approx(np.eye(3))
    both = np.hstack([np.zeros((3, 3)), np.eye(3), np.eye(3), np.zeros((3, 4))])
    np.testing.assert_allclose(spread[3:, 3:], both @ covariance @ both.T, atol=1e-8)


@pytest.mark.parametrize("row", range(9))
def test_a_restarted_filter_has_the_rate_of_the_best_and_its_error(row):
    rng, kinds = np.random.default_rng(4), TURNS
    root = rng.normal(0.0, 0.1, (2, 13, 13))
    covariances, states = root @ root.transpose(0, 2, 1), rng.normal(0.0, 0.1, (2, 13))
    bank_module.restart(kinds[row], 0, 1, states, covariances)
    both = np.hstack([np.zeros((3, 3)), np.eye(3), np.eye(3), np.zeros((3, 4))])
    np.testing.assert_allclose(both @ states[1], both @ states[0], atol=1e-14)
    errors = both @ covariances @ both.T
    np.testing.assert_allclose(errors[1], errors[0], atol=1e-14)
    assert np.linalg.eigvalsh(covariances[1]).min() > -1e-12


@pytest.mark.parametrize("hertz", [2.0, 10.0, 30.0])
def test_rates_have_the_errors_that_they_claim(hertz):
    nees = [errors_of(swinging, hertz, 15.0, seed, 4.0)[2] for seed in range(5)]
    assert 3.0 < np.mean(nees) < 8.0


def pushed(t):
    """A steady turn that a push of 6°/s² changes at 6 s for a second."""
    axis, since = np.array([0.6, 0.0, 0.8]), np.clip(t - 6.0, 0.0, 1.0)
    rate = 0.1 + 0.1 * since
    angle = 0.1 * t + 0.05 * since**2 + 0.1 * max(t - 7.0, 0.0)
    pose = Pose(Rotation.from_rotvec(angle * axis).as_matrix(), np.array([0.0, 0.0, 5.0]))
    return pose, np.append(rate * axis, np.zeros(3))


@pytest.mark.parametrize("hertz", [2.0, 5.0, 10.0, 30.0])
def test_a_swinging_target_is_followed_five_times_nearer_than_by_a_line_of_eight_readings(hertz):
    ours, lines, _ = errors_of(swinging, hertz, 20.0, 3, 4.0)
    assert rms(lines[:, :3]) > 5.0 * rms(ours[:, :3])
    assert rms(lines[:, 3:]) > 5.0 * rms(ours[:, 3:])


def test_a_target_that_only_moves_has_a_steady_turn():
    """Which filter counts for the angular rate is not decided by the velocity, which swings."""

    def motion(t):
        turn = Rotation.from_rotvec([0.0, 0.14 * t, 0.0]).as_matrix()
        place = np.array([0.3 * np.sin(0.9 * t), 0.0, 5.0])
        return Pose(turn, place), np.array([0.0, 0.14, 0.0, 0.27 * np.cos(0.9 * t), 0.0, 0.0])

    ours, _, nees = errors_of(motion, 5.0, 30.0, 6, 10.0)
    assert rms(ours[:, :3]) < 3e-4
    assert rms(ours[:, 3:]) < 3e-3
    assert np.mean(nees) < 8.0


def test_a_free_body_with_an_axis_of_symmetry_is_followed():
    """Torque-free: Euler's equations integrated, against the filters and their claims."""
    inertia, hertz = np.array([1.0, 1.0, 1.8]), 10.0

    def change(_, x):
        w = x[4:]
        q = Rotation.from_quat(x[:4])
        spin = np.array([*w, 0.0])
        a, b = q.as_quat(), spin
        product = np.append(a[3] * b[:3] + np.cross(a[:3], b[:3]), -a[:3] @ b[:3])
        return np.append(0.5 * product, np.cross(inertia * w, w) / inertia)

    times = np.arange(0.0, 30.0, 1.0 / hertz)
    start = np.append([0.0, 0.0, 0.0, 1.0], [0.2, 0.0, 0.3])
    path = solve_ivp(change, (0.0, 30.0), start, t_eval=times, rtol=1e-10, atol=1e-12).y.T

    def motion(t):
        x = path[round(t * hertz)]
        turn = Rotation.from_quat(x[:4])
        return Pose(turn.as_matrix(), np.array([0.0, 0.0, 5.0])), np.append(
            turn.apply(x[4:]), np.zeros(3)
        )

    ours, lines, nees = errors_of(motion, hertz, 30.0, 5, 6.0)
    assert rms(lines[:, :3]) > 2.0 * rms(ours[:, :3])
    assert np.mean(nees) < 10.0


def test_after_a_sudden_stop_the_rates_are_right_again_within_two_seconds():
    def motion(t):
        angle, rate = (0.15 * t, 0.15) if t < 15.0 else (2.25, 0.0)
        turn = Rotation.from_rotvec(angle * AXIS).as_matrix()
        return Pose(turn, np.array([0.0, 0.0, 5.0])), np.append(rate * AXIS, np.zeros(3))

    ours, _, nees = errors_of(motion, 10.0, 25.0, 7, 17.0)
    assert rms(ours[:, :3]) < 2e-2
    assert np.mean(nees) < 12.0


def test_a_target_at_rest_has_small_rates_with_small_errors():
    bank, rng = RateBank(), np.random.default_rng(4)
    for t in np.arange(0.0, 10.0, 0.1):
        seen = Pose.identity().perturbed(rng.normal(0.0, SIGMA))
        found = bank.add(float(t), seen, np.diag(SIGMA**2))
    assert np.abs(found.rates).max() < 1e-3
    assert np.sqrt(np.diag(found.covariance)).max() < 2e-3


def test_a_singular_covariance_starts_the_bank_anew():
    bank = RateBank()
    bank.add(0.0, Pose.identity(), np.diag(SIGMA**2))
    assert bank.add(0.1, Pose.identity(), np.diag(SIGMA**2)) is not None
    assert bank.add(0.2, Pose.identity(), np.full((6, 6), np.nan)) is None


@pytest.mark.parametrize("hertz", [5, 10])
def test_pointing_errors_are_not_taken_for_swings_faster_than_the_readings(hertz):
    for seed in range(3):
        rng, bank, places, speeds = np.random.default_rng(seed), RateBank(), [], []
        for k in range(60):
            shake = Rotation.from_rotvec(np.radians(0.3) * rng.normal(size=3)).as_matrix()
            seen = Pose(shake, shake @ [0.0, 0.0, 9.0]).perturbed(rng.normal(0.0, SIGMA))
            found = bank.add(k / hertz, seen, np.diag(SIGMA**2))
            places.append(seen.translation_m)
            if found is not None:
                speeds.append(np.linalg.norm(found.rates[3:]))
        steps = np.linalg.norm(np.diff(places, axis=0), axis=1) * hertz
        assert max(speeds) < 2.0 * steps.max()  # 5 to 150 times without the limit


def test_a_surprise_is_a_jump_of_range_or_attitude_and_leaves_the_filters_as_they_are():
    rng, bank, twin = np.random.default_rng(8), RateBank(), RateBank()
    covariance = np.diag(SIGMA**2)
    pose, _ = swinging(0.0)
    assert bank.surprise(0.0, pose, covariance) == 0.0
    for t in np.arange(0.0, 4.0, 0.1):
        pose, _ = swinging(t)
        seen = pose.perturbed(rng.normal(0.0, SIGMA))
        assert bank.surprise(float(t), seen, covariance) < 30.0
        ours, theirs = (one.add(float(t), seen, covariance) for one in (bank, twin))
        assert (ours is None) == (theirs is None)
    np.testing.assert_array_equal(ours.rates, theirs.rates)
    pose, _ = swinging(4.0)
    place = pose.translation_m
    across = np.cross(place, [0.0, 1.0, 0.0])
    aside = Rotation.from_rotvec(0.05 * across / np.linalg.norm(across)).as_matrix()
    harmless = (
        pose, Pose(aside @ pose.rotation, aside @ place), Pose(pose.rotation, aside @ place)
    )  # fmt: skip
    for same in harmless:
        assert bank.surprise(4.0, same, covariance) < 20.0
    jumps = (
        pose.perturbed([0.0, 0.15, 0.0, 0.0, 0.0, 0.0]),
        Pose(pose.rotation, 1.05 * place),
    )  # fmt: skip
    for other in jumps:
        assert bank.surprise(4.0, other, covariance) > 60.0


def test_a_surprise_is_the_distance_from_the_prediction_of_numpy():
    """One filter of each part; the place off along the line of sight only."""
    dt, kinds = 0.5, TURNS[:1]
    rng = np.random.default_rng(9)
    states, covariances = np.zeros((2, 1, 13)), np.zeros((2, 1, 13, 13))
    for part in range(2):
        bank_module.begin(kinds[0], states[part, 0], covariances[part, 0])
        root = rng.normal(0.0, 0.02, (3, 3))
        covariances[part, 0, :3, :3] = root @ root.T
    rotations, places = np.eye(3)[None].copy(), np.array([[0.4, -0.2, 4.0]])
    measured = np.diag(SIGMA**2)
    place, turn = 1.03 * places[0], np.array([0.02, -0.05, 0.03])
    rotation = Rotation.from_rotvec(turn).as_matrix()
    wanted = 0.0
    for part, off in enumerate((turn, place - places[0])):
        spread = covariances[part, 0, :3, :3] + dt**2 * covariances[part, 0, 3:6, 3:6]
        spread = spread + kinds[0, bank_module.WALK] ** 2 * dt**3 / 3.0 * np.eye(3)
        own = slice(3 * part, 3 * part + 3)
        wanted += off @ np.linalg.solve(spread + measured[own, own], off)
    before = states.copy(), covariances.copy(), rotations.copy(), places.copy()
    found = surprise(
        dt, kinds, kinds, rotations, places, states, covariances, np.zeros((2, 1)), rotation,
        place, measured,
    )  # fmt: skip
    assert found == pytest.approx(wanted, rel=1e-6)
    for kept, now in zip(before, (states, covariances, rotations, places), strict=True):
        np.testing.assert_array_equal(kept, now)
