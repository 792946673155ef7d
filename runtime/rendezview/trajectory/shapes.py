"""Segments of a path as functions of a few parameters and time: compiled, for the simplex.

A place is (3,) m in the path frame, the origin at its centre. The time counts from the middle of
the segment, where parameters disturb each other least.

    circular   turn (3), radius, rate           B exp(turn) (r cos θ, r sin θ, 0), θ = rate t
    spiral     turn (3), radius, rate, climb    the same with r = radius + climb t
    vbar       place (3), velocity (3)          a straight line at even speed …
    hops       … hop (3), period, phase         … and (1 − κ t) hop |sin π(t − phase)/period|
    orbit      place (3), velocity (3)          Clohessy–Wiltshire, from the middle
    drift      … acceleration (3)               the same under a constant push

B is a base attitude near the answer and κ the closing rate over the distance: a hop shrinks with
the distance to go.
"""

from __future__ import annotations

import math
from enum import StrEnum

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.geometry import so3
from rendezview.geometry.pose import Array
from rendezview.trajectory.relative_orbit import response


class Shape(StrEnum):
    """The model of a segment's path."""

    CIRCULAR = "circular"
    SPIRAL = "spiral"
    VBAR = "vbar"  # straight, with hops where the points show them
    ORBIT = "orbit"  # free motion after Clohessy and Wiltshire
    DRIFT = "drift"  # the same with an unknown constant push: drag, a leak


CIRCULAR, SPIRAL, LINE, HOPS, ORBIT, DRIFT = range(6)
SIZE = (5, 6, 6, 11, 6, 9)  # parameters of each. Source: by construction

# The numbers by which the compiled loops know the shapes.
CODES = {
    Shape.CIRCULAR: CIRCULAR,
    Shape.SPIRAL: SPIRAL,
    Shape.VBAR: LINE,
    Shape.ORBIT: ORBIT,
    Shape.DRIFT: DRIFT,
}


@njit(cache=True, nogil=True, error_model="numpy")
def places(
    code: int, parameters: Array, times: Array, base: Array, constants: Array, out: Array
) -> None:
    """Fill (N, 3) with the places at times (N,) from the middle of the segment.

    Equal neighbours in ``times`` (the points of one frame) are worked out once. ``constants`` is
    (mean motion rad/s, κ 1/s).
    """
    p = parameters
    frame = np.empty((3, 3))
    rr, rv, pushed = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    if code <= SPIRAL:
        turned = so3.exp(p[:3])
        for i in range(3):
            for j in range(2):
                frame[i, j] = (
                    base[i, 0] * turned[0, j]
                    + base[i, 1] * turned[1, j]
                    + base[i, 2] * turned[2, j]
                )
    for k in range(len(times)):
        t = times[k]
        if k > 0 and t == times[k - 1]:
            out[k, 0], out[k, 1], out[k, 2] = out[k - 1, 0], out[k - 1, 1], out[k - 1, 2]
        elif code <= SPIRAL:
            r = p[3] + (p[5] * t if code == SPIRAL else 0.0)
            c, s = r * math.cos(p[4] * t), r * math.sin(p[4] * t)
            for i in range(3):
                out[k, i] = frame[i, 0] * c + frame[i, 1] * s
        elif code <= HOPS:
            high = 0.0
            if code == HOPS:
                high = (1.0 - constants[1] * t) * abs(math.sin(math.pi * (t - p[10]) / p[9]))
            for i in range(3):
                out[k, i] = p[i] + p[3 + i] * t + (p[6 + i] * high if code == HOPS else 0.0)
        else:
            response(constants[0], t, rr, rv, pushed)
            for i in range(3):
                out[k, i] = 0.0
                for j in range(3):
                    out[k, i] += rr[i, j] * p[j] + rv[i, j] * p[3 + j]
                    if code == DRIFT:
                        out[k, i] += pushed[i, j] * p[6 + j]


def basis(code: int, times_s: Array, mean_motion_rad_s: float) -> Array:
    """(N, 3, P) of a shape that is linear in its parameters: line, orbit, drift."""
    size = SIZE[code]
    out = np.empty((len(times_s), 3))
    matrix = np.empty((len(times_s), 3, size))
    constants = np.array([mean_motion_rad_s, 0.0])
    for j in range(size):
        places(code, np.eye(size)[j], times_s, np.eye(3), constants, out)
        matrix[:, :, j] = out
    return matrix


def frame_of(normal: npt.ArrayLike, ahead: npt.ArrayLike) -> Array:
    """(3, 3) columns: ``ahead`` made square to ``normal``, the third axis, ``normal``."""
    n = np.asarray(normal, np.float64) / np.linalg.norm(normal)
    a = np.asarray(ahead, np.float64)
    a = a - (a @ n) * n
    a = a / np.linalg.norm(a)
    return np.stack([a, np.cross(n, a), n], axis=1)
