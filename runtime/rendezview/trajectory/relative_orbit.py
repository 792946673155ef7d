"""Motion beside a target on a circular orbit: the equations of Clohessy and Wiltshire (1960).

Hill's frame: x outwards from the Earth, y along the orbital velocity (V-bar), z along the orbit's
normal; origin at the target. With mean motion n and acceleration a of all but gravity

    x'' = 3 n² x + 2 n y' + a_x        y'' = −2 n x' + a_y        z'' = −n² z + a_z

They are linear, so a path is its first state times a matrix, thrusts superpose, and n = 0 is
motion without gravity. Errors grow with the square of distance over orbital radius: 5 mm at 200 m.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.geometry.pose import Array

# Of a thrust on the place, over that of free motion: less reaches nothing. Source: by construction,
# a bound only
_LEAST_GAIN = 1e-3


@njit(cache=True, nogil=True, error_model="numpy")
def response(
    mean_motion_rad_s: float, dt_s: float, position: Array, velocity: Array, pushed: Array
) -> None:
    """Fill (3, 3) matrices of the place after ``dt_s``: of first place, velocity, constant push.

    Divisions by n are worked out beforehand, so that n = 0 needs no case of its own.
    """
    n, t = mean_motion_rad_s, dt_s
    turn = n * t
    half = 0.5 * turn
    sinc = math.sin(turn) / turn if abs(turn) > 1e-6 else 1.0 - turn * turn / 6.0
    sinc_half = math.sin(half) / half if abs(half) > 1e-6 else 1.0 - half * half / 6.0
    s = t * sinc  # sin(nt) / n
    c = 0.5 * t * t * sinc_half * sinc_half  # (1 − cos nt) / n²
    if abs(turn) > 0.05:
        d = (turn - math.sin(turn)) / (n * n)  # (nt − sin nt) / n²
    else:
        d = n * t * t * t / 6.0 * (1.0 - turn * turn / 20.0 * (1.0 - turn * turn / 42.0))
    position[:] = 0.0
    velocity[:] = 0.0
    pushed[:] = 0.0
    position[0, 0] = 1.0 + 3.0 * n * n * c
    position[1, 0] = -6.0 * n * n * d
    position[1, 1] = 1.0
    position[2, 2] = 1.0 - n * n * c
    velocity[0, 0] = s
    velocity[0, 1] = 2.0 * n * c
    velocity[1, 0] = -2.0 * n * c
    velocity[1, 1] = 4.0 * s - 3.0 * t
    velocity[2, 2] = s
    pushed[0, 0] = c
    pushed[0, 1] = 2.0 * d
    pushed[1, 0] = -2.0 * d
    pushed[1, 1] = 4.0 * c - 1.5 * t * t
    pushed[2, 2] = c


def transition(mean_motion_rad_s: float, dt_s: float) -> Array:
    """(6, 6) from a state (place m, velocity m/s) to the state ``dt_s`` later, free motion."""
    n = mean_motion_rad_s
    matrix = np.empty((6, 6))
    pushed = np.empty((3, 3))
    rr, rv = np.empty((3, 3)), np.empty((3, 3))
    response(n, dt_s, rr, rv, pushed)
    sine, cosine = math.sin(n * dt_s), math.cos(n * dt_s)
    matrix[:3, :3], matrix[:3, 3:] = rr, rv
    matrix[3:, :3] = [
        [3.0 * n * sine, 0.0, 0.0],
        [-6.0 * n * (1.0 - cosine), 0.0, 0.0],
        [0.0, 0.0, -n * sine],
    ]
    matrix[3:, 3:] = [
        [cosine, 2.0 * sine, 0.0],
        [-2.0 * sine, 4.0 * cosine - 3.0, 0.0],
        [0.0, 0.0, cosine],
    ]
    return matrix


def velocity_to_reach(
    mean_motion_rad_s: float, dt_s: float, shift_m: npt.ArrayLike
) -> Array | None:
    """(3,) change of velocity now, m/s, that shifts the place after ``dt_s`` by ``shift_m`` (3,).

    None where no thrust does so: near half and whole orbits a thrust across the plane, or along
    it, comes back to nothing.
    """
    rr, rv, pushed = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    response(mean_motion_rad_s, dt_s, rr, rv, pushed)
    if dt_s <= 0.0 or np.linalg.svd(rv, compute_uv=False)[-1] < _LEAST_GAIN * dt_s:
        return None
    return np.asarray(np.linalg.solve(rv, np.asarray(shift_m, dtype=np.float64)))
