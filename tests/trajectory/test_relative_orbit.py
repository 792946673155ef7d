"""Clohessy and Wiltshire's equations against their own differential form."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from tests.trajectory.closed_loop import push

from rendezview.trajectory.relative_orbit import transition, velocity_to_reach

N = 0.0011


def integrated(state, push_m_s2, dt_s, n):
    def slope(_, s):
        x, _, z, u, v, w = s
        a = push_m_s2
        return [
            u, v, w,
            3 * n * n * x + 2 * n * v + a[0], -2 * n * u + a[1], -n * n * z + a[2],
        ]  # fmt: skip

    return solve_ivp(slope, (0.0, dt_s), state, rtol=1e-11, atol=1e-12).y[:, -1]


@pytest.mark.parametrize("n", [0.0, 1e-7, N])
@pytest.mark.parametrize("dt_s", [3.0, 700.0, 5000.0])
def test_transition_and_push_solve_the_differential_equations(n, dt_s):
    rng = np.random.default_rng(1)
    state = rng.standard_normal(6) * [30, 30, 30, 0.02, 0.02, 0.02]
    acceleration = 1e-5 * rng.standard_normal(3)
    found = transition(n, dt_s) @ state + push(n, dt_s, acceleration)
    np.testing.assert_allclose(
        found, integrated(state, acceleration, dt_s, n), rtol=1e-6, atol=1e-6
    )


def test_transitions_chain():
    np.testing.assert_allclose(
        transition(N, 900.0) @ transition(N, 300.0), transition(N, 1200.0), atol=1e-9
    )


def test_thrust_reaches_the_place_asked_for():
    shift = np.array([1.0, -2.0, 0.5])
    delta_v = velocity_to_reach(N, 600.0, shift)
    assert delta_v is not None
    np.testing.assert_allclose(transition(N, 600.0)[:3, 3:] @ delta_v, shift, atol=1e-12)


def test_after_half_an_orbit_no_thrust_across_the_plane_reaches_anything():
    assert velocity_to_reach(N, np.pi / N, [0.0, 0.0, 1.0]) is None
    assert velocity_to_reach(N, 0.0, [1.0, 0.0, 0.0]) is None
