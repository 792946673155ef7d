"""Lenses of other programs, as the nearest lens of our camera.

A lens bends (x, y) = (X/Z, Y/Z), before focal lengths and principal point. Those here depend on the
angle from the boresight alone, or nearly so. A fisheye's polynomial in that angle, with a focal
length of its own, is fitted to the lens over the picture; what it leaves is measured there, and a
lens that it does not meet is refused. So sensors, exports and services have two lens models.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from rendezview.geometry.distortion import distort
from rendezview.geometry.pose import Array

Bend = Callable[[Array], Array]  # (N, 2) to (N, 2)
Six = list[float]  # width, height, fx, fy, cx, cy

_MOST_PX = 0.1  # that a lens may differ anywhere. Source: a third of a good calibration's residual
_WIDEST_RAD = math.radians(89.0)  # directions further off have no pixel. Source: `Camera`
_ANGLES, _AZIMUTHS = 120, 48  # rays of the fit. Source: twice as many change no residual
_TERMS = 5  # θ … θ⁹. Source: Kannala and Brandt


def double_sphere(xi: float, alpha: float) -> Bend:
    """Source: Usenko, Demmel, Cremers, The double sphere camera model, 3DV 2018, eq. 40–42."""

    def bend(xy: Array) -> Array:
        square = np.sum(xy * xy, axis=1)
        lifted = xi * np.sqrt(square + 1.0) + 1.0
        far = np.sqrt(square + lifted * lifted)
        return np.asarray(xy / (alpha * far + (1.0 - alpha) * lifted)[:, None])

    return bend


def extended_unified(alpha: float, beta: float) -> Bend:
    """Source: Khomutenko, Garcia, Martinet, An enhanced unified camera model, RA-L 2016, eq. 10."""

    def bend(xy: Array) -> Array:
        far = np.sqrt(beta * np.sum(xy * xy, axis=1) + 1.0)
        return np.asarray(xy / (alpha * far + 1.0 - alpha)[:, None])

    return bend


def omnidirectional(xi: float, terms: tuple[float, ...] = ()) -> Bend:
    """With ``k1 k2 p1 p2`` after the mirror. Source: Mei, Rives, ICRA 2007, section II."""

    def bend(xy: Array) -> Array:
        mirrored = xy / (1.0 + xi * np.sqrt(np.sum(xy * xy, axis=1) + 1.0))[:, None]
        return distort(mirrored, terms) if any(terms) else mirrored

    return bend


def field_of_view(omega_rad: float) -> Bend:
    """Source: Devernay, Faugeras, Straight lines have to be straight, MVA 2001, eq. 13."""

    def bend(xy: Array) -> Array:
        radius = np.hypot(xy[:, 0], xy[:, 1])
        bent = np.arctan(2.0 * radius * math.tan(0.5 * omega_rad)) / omega_rad
        return np.asarray(xy * (bent / radius)[:, None])

    return bend


def division(k: float) -> Bend:
    """Source: Fitzgibbon, CVPR 2001, eq. 4, solved for the distorted point."""

    def bend(xy: Array) -> Array:
        with np.errstate(invalid="ignore"):
            root = np.sqrt(1.0 - 4.0 * k * np.sum(xy * xy, axis=1))
        return np.asarray(xy * (2.0 / (1.0 + root))[:, None])

    return bend


def thin_prism_fisheye(terms: tuple[float, ...]) -> Bend:
    """``k1 k2 p1 p2 k3 k4 sx1 sy1`` on the equidistant picture. Source: COLMAP, models.h."""
    k1, k2, p1, p2, k3, k4, s1, s2 = terms

    def bend(xy: Array) -> Array:
        radius = np.hypot(xy[:, 0], xy[:, 1])
        u, v = (xy * (np.arctan(radius) / radius)[:, None]).T
        square = u * u + v * v
        radial = 1.0 + square * (k1 + square * (k2 + square * (k3 + square * k4)))
        across = 2.0 * p1 * u * v + p2 * (square + 2.0 * u * u) + s1 * square
        down = 2.0 * p2 * u * v + p1 * (square + 2.0 * v * v) + s2 * square
        return np.stack([u * radial + across, v * radial + down], axis=1)

    return bend


def as_fisheye(name: str, bend: Bend, six: Six) -> tuple[Six, dict[str, float]]:
    """The six numbers and ``k1 k2 k3 k4`` of the fisheye that is nearest to a lens.

    Args:
        name: of the lens, for messages.
        bend: the lens.
        six: width and height, px, and what the lens's coordinates are multiplied with.

    Raises:
        ValueError: no fisheye is within 0.1 px of it in the whole picture.
    """
    rays, bent = _rays(bend, six)
    if len(rays) < _TERMS:
        raise ValueError(f"{name}: no ray before the camera meets the picture")
    radius = np.hypot(rays[:, 0], rays[:, 1])
    angle = np.arctan(radius)
    powers = np.stack([angle ** (2 * j + 1) / radius for j in range(_TERMS)], axis=1)
    focal = np.array(six[2:4])
    columns = (powers[:, None, :] * rays[:, :, None] * focal[:, None]).reshape(-1, _TERMS)
    wanted = (bent * focal).ravel()
    found = np.linalg.lstsq(columns, wanted, rcond=None)[0]
    apart = float(np.abs(columns @ found - wanted).max())
    if not apart <= _MOST_PX or found[0] <= 0.0:
        raise ValueError(
            f"{name}: this lens is {apart:.2g} px from the nearest fisheye in some places, at most "
            f"{_MOST_PX:g} is taken: calibrate with equidistant (Kannala–Brandt), or undistort the "
            "images first"
        )
    width, height, fx, fy, cx, cy = six
    terms = {f"k{j}": float(found[j] / found[0]) for j in range(1, _TERMS)}
    return [width, height, fx * float(found[0]), fy * float(found[0]), cx, cy], terms


def _rays(bend: Bend, six: Six) -> tuple[Array, Array]:
    """Rays (N, 2) that meet the picture, out to where the lens folds, and where they go (N, 2)."""
    width, height, fx, fy, cx, cy = six
    tangents = np.tan(np.linspace(0.0, _WIDEST_RAD, _ANGLES + 1)[1:])
    azimuths = np.linspace(0.0, 2.0 * math.pi, _AZIMUTHS, endpoint=False)
    directions = np.stack([np.cos(azimuths), np.sin(azimuths)], axis=1)
    rays = tangents[:, None, None] * directions
    bent = bend(rays.reshape(-1, 2)).reshape(rays.shape)
    with np.errstate(invalid="ignore"):
        grows = np.diff(np.hypot(bent[..., 0], bent[..., 1]), axis=0, prepend=0.0) > 0.0
        u, v = bent[..., 0] * fx + cx, bent[..., 1] * fy + cy
        inside = (u >= -0.5) & (u <= width - 0.5) & (v >= -0.5) & (v <= height - 0.5)
    met = np.logical_and.accumulate(grows, axis=0) & inside
    return rays[met], bent[met]
