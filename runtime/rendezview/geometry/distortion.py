"""OpenCV's lens models on normalised coordinates, for arrays.

The polynomial model is ``x' = x radial(r²) + shift(x)`` with a radial fraction (k1 … k6),
tangential (p1 p2) and thin-prism terms (s1 … s4), and a tilt of the sensor (τx τy). The fisheye
model is that of Kannala and Brandt: ``r' = θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸)`` with
the angle θ from the boresight. Source: OpenCV, calib3d; Kannala and Brandt, TPAMI 28(8), 2006.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

_UNDISTORT_ITERATIONS = 200  # a bound for strong lenses. Source: by construction
_UNDISTORT_STEP = 1e-13  # normalised; converged. Source: float64 rounding
_BISECTIONS = 60  # halve π/2 below float64's rounding. Source: by construction


def tilt_matrix(tau_x_rad: float, tau_y_rad: float) -> Array:
    """(3, 3) homography of a sensor that is tilted about x, then y. Source: OpenCV, calib3d."""
    cx, sx = math.cos(tau_x_rad), math.sin(tau_x_rad)
    cy, sy = math.cos(tau_y_rad), math.sin(tau_y_rad)
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cx, sx], [0.0, -sx, cx]])
    about_y = np.array([[cy, 0.0, -sy], [0.0, 1.0, 0.0], [sy, 0.0, cy]])
    turn = about_y @ about_x
    along = np.array([[turn[2, 2], 0.0, -turn[0, 2]], [0.0, turn[2, 2], -turn[1, 2]], [0, 0, 1.0]])
    return np.asarray(along @ turn)


def distort(xy: Array, coefficients: tuple[float, ...]) -> Array:
    """(..., 2) distorted coordinates of the polynomial model, 4 to 14 coefficients."""
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        radial, shift = _polynomial(xy, coefficients)
        bent = xy * radial + shift
        return _turned(bent, tilt_matrix(*coefficients[12:])) if any(coefficients[12:]) else bent


def undistort(distorted: Array, coefficients: tuple[float, ...]) -> Array:
    """Solve ``distort(xy) = distorted`` by fixed-point iteration: (N, 2); not checked."""
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        if any(coefficients[12:]):
            distorted = _turned(
                distorted, np.asarray(np.linalg.inv(tilt_matrix(*coefficients[12:])))
            )
        xy = distorted.copy()
        for _ in range(_UNDISTORT_ITERATIONS):
            radial, shift = _polynomial(xy, coefficients)
            updated = (distorted - shift) / radial
            step = np.abs(updated - xy)
            xy = updated
            if not np.any(step > _UNDISTORT_STEP):
                break
    return xy


def distort_fisheye(xy: Array, coefficients: tuple[float, ...]) -> Array:
    """(..., 2) distorted coordinates of the fisheye model, 4 coefficients.

    NaN beyond the angle where the polynomial turns back.
    """
    r = np.hypot(xy[..., 0], xy[..., 1])
    theta = np.arctan(r)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        scale = np.where(r > 0.0, _fisheye_radius(theta, coefficients) / r, 1.0)
    scale = np.where(theta <= fisheye_limit_rad(coefficients), scale, np.nan)
    return np.asarray(xy * scale[..., None])


def undistort_fisheye(distorted: Array, coefficients: tuple[float, ...]) -> Array:
    """Coordinates (N, 2) whose picture is ``distorted``; NaN where no ray below 90° gets there."""
    r = np.hypot(distorted[:, 0], distorted[:, 1])
    low, high = np.zeros_like(r), np.full_like(r, fisheye_limit_rad(coefficients))
    reached = r < _fisheye_radius(high, coefficients)
    for _ in range(_BISECTIONS):
        theta = 0.5 * (low + high)
        beyond = _fisheye_radius(theta, coefficients) > r
        low, high = np.where(beyond, low, theta), np.where(beyond, theta, high)
    with np.errstate(invalid="ignore", divide="ignore"):
        scale = np.where(r > 0.0, np.tan(0.5 * (low + high)) / r, 1.0)
    return np.asarray(distorted * np.where(reached, scale, np.nan)[:, None])


def fisheye_limit_rad(coefficients: tuple[float, ...]) -> float:
    """Largest angle from the boresight that the polynomial maps uniquely; at most 90°."""
    k1, k2, k3, k4 = coefficients
    turns = np.roots([9.0 * k4, 7.0 * k3, 5.0 * k2, 3.0 * k1, 1.0])  # of its derivative, in θ²
    real = turns[np.isreal(turns)].real
    return float(min([0.5 * math.pi, *np.sqrt(real[real > 0.0])]))


def _fisheye_radius(theta: Array, coefficients: tuple[float, ...]) -> Array:
    k1, k2, k3, k4 = coefficients
    t2 = theta * theta
    return np.asarray(theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))))


def _polynomial(xy: Array, coefficients: tuple[float, ...]) -> tuple[Array, Array]:
    """Radial factor (..., 1) and shift (..., 2) of the polynomial model at ``xy``."""
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = (*coefficients, *([0.0] * 12))[:12]
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    radial = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    shift = np.stack(
        [
            2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) + r2 * (s1 + r2 * s2),
            p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y + r2 * (s3 + r2 * s4),
        ],
        axis=-1,
    )
    return radial[..., None], shift


def _turned(xy: Array, homography: Array) -> Array:
    turned = xy @ homography[:, :2].T + homography[:, 2]
    return np.asarray(turned[..., :2] / turned[..., 2:])
