"""The ellipse as a result, and its geometric fit to points.

Inside the compiled loops an ellipse is its *shape vector* (x, y, A11, A12, A22): the points
``c + A u`` with u on the unit circle and A symmetric, positive definite. Unlike axes and angle
these five are smooth where the ellipse is a circle, as for a ring seen head-on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rendezview.estimation.least_squares import Equations, Options, minimise
from rendezview.sensors.ring.conic import conic_of, distance, ellipse_of_conic, semi_axes

Array = npt.NDArray[np.float64]

# Of the squares' own, added to the start's sums: points without noise leave its equations singular.
_JITTER = 1e-10  # Source: by construction, above rounding
_FIT = Options(least_gain=0.0, relative_gain=1e-9)  # Source: by construction, rounding of a sum


@dataclass(frozen=True, slots=True, eq=False)
class Ellipse:
    """An ellipse in the picture, in pixels of the camera without its lens distortion."""

    centre_px: Array  # (2,)
    semi_axes_px: tuple[float, float]  # long, short
    angle_rad: float  # of the long axis from +x towards +y, in (-π/2, π/2]
    covariance: Array | None = None  # (5, 5) of x, y, long, short (px), angle (rad)
    shape_covariance: Array | None = None  # (5, 5) of the shape vector; see `shape`

    @classmethod
    def from_shape(cls, shape: Array, shape_covariance: Array | None = None) -> Ellipse:
        """From the shape vector (5,) and its covariance (5, 5)."""
        numbers = np.asarray(shape, dtype=np.float64)
        x, y, a11, a12, a22 = numbers.tolist()
        a, b = semi_axes(numbers)
        angle = 0.5 * math.atan2(2.0 * a12, a11 - a22)
        covariance = None
        if shape_covariance is not None:
            jacobian = _axes_jacobian(a, b, angle)
            covariance = jacobian @ shape_covariance @ jacobian.T
            # A circle has no angle: the variance is at most that of a uniform half turn.
            overshoot = covariance[4, 4] / (math.pi**2 / 12.0)
            if overshoot > 1.0:
                covariance[4, :] /= math.sqrt(overshoot)
                covariance[:, 4] /= math.sqrt(overshoot)
        return cls(np.array([x, y]), (a, b), angle, covariance, shape_covariance)

    @property
    def shape(self) -> Array:
        """(5,) x, y, A11, A12, A22 of the points ``c + A u``, |u| = 1; px."""
        c, s = math.cos(self.angle_rad), math.sin(self.angle_rad)
        a, b = self.semi_axes_px
        across = (a - b) * c * s
        return np.array([*self.centre_px, a * c * c + b * s * s, across, a * s * s + b * c * c])

    @classmethod
    def fit(cls, points_px: npt.ArrayLike) -> Ellipse | None:
        """The geometric fit of points (N, 2) px, N ≥ 6, with its covariance; None where none is.

        Least squares of the distances (maximum likelihood for points of even, independent noise),
        from the direct fit; the noise is estimated from what remains.
        """
        points = _points(points_px)
        origin, scale = points.mean(axis=0), float(points.std()) or 1.0
        x, y = ((points - origin) / scale).T
        sums = np.array(
            [np.sum(x ** (n - k) * y**k) for n in (4, 3, 2, 1, 0) for k in range(n + 1)]
        )
        sums[[0, 4]] += _JITTER * len(points)
        conic, start = np.empty(6), np.empty(5)
        if len(points) < 6 or not (conic_of(sums, conic) and ellipse_of_conic(conic, start)):
            return None
        start = start * scale + (*origin, 0.0, 0.0, 0.0)

        def equations(shape: Array) -> Equations:
            if not (shape[2] > 0.0 and shape[2] * shape[4] > shape[3] ** 2):
                return math.inf, np.eye(5), np.zeros(5)
            left, slopes = _distances(shape, points)
            return float(left @ left), slopes.T @ slopes, slopes.T @ left

        found = minimise(equations, np.add, start, options=_FIT)
        if found is None or not found.converged:
            return None
        information = equations(found.at)[1]
        spread = found.cost / max(len(points) - 5, 1)
        covariance = np.asarray(np.linalg.inv(information) * spread, dtype=np.float64)
        return cls.from_shape(found.at, covariance)

    def residuals(self, points_px: npt.ArrayLike) -> Array:
        """Distances (N,) px of points (N, 2) from the ellipse, to first order; outside positive."""
        points = _points(points_px)
        shape = self.shape
        return np.array([distance(shape, x, y) for x, y in points])

    def holds(self, point_px: npt.ArrayLike) -> bool:
        """Whether a point (2,) px lies within."""
        x, y, a, b, c = self.shape
        away = np.linalg.solve([[a, b], [b, c]], np.asarray(point_px, np.float64) - (x, y))
        return bool(away @ away < 1.0)

    def points(self, count: int = 180) -> Array:
        """(count, 2) points on it, px."""
        angles = np.linspace(0.0, 2.0 * math.pi, count, endpoint=False)
        x, y, a, b, c = self.shape
        matrix = np.array([[a, b], [b, c]])
        circle = np.column_stack([np.cos(angles), np.sin(angles)])
        return np.asarray(circle @ matrix + (x, y))


def _distances(shape: Array, points: Array) -> tuple[Array, Array]:
    """Distances (N,) of points (N, 2) from a shape, and their slopes (N, 5) by its numbers."""
    matrix = shape[[2, 3, 3, 4]].reshape(2, 2)
    inverse = np.linalg.inv(matrix)
    away = points - shape[:2]
    u = away @ inverse
    u /= np.linalg.norm(u, axis=1)[:, None]
    for _ in range(3):  # Newton steps along the circle to the nearest point
        along, place = np.column_stack([-u[:, 1], u[:, 0]]) @ matrix, u @ matrix
        left = away - place
        turn = np.sum(left * along, axis=1) / np.sum(along**2 + left * place, axis=1)
        u += np.clip(turn, -0.3, 0.3)[:, None] * np.column_stack([-u[:, 1], u[:, 0]])
        u /= np.linalg.norm(u, axis=1)[:, None]
    n = u @ inverse
    n /= np.linalg.norm(n, axis=1)[:, None]
    slopes = np.column_stack([n, n * u, u[:, 0] * n[:, 1] + u[:, 1] * n[:, 0]])[:, [0, 1, 2, 4, 3]]
    return np.sum((away - u @ matrix) * n, axis=1), slopes


def _axes_jacobian(a: float, b: float, angle: float) -> Array:
    """d(x, y, a, b, angle) / d(x, y, A11, A12, A22)."""
    c, s = math.cos(angle), math.sin(angle)
    out = np.zeros((5, 5))
    out[0, 0] = out[1, 1] = 1.0
    out[2, 2:] = c * c, 2.0 * c * s, s * s
    out[3, 2:] = s * s, -2.0 * c * s, c * c
    apart = max(a - b, 1e-12 * a)
    out[4, 2:] = -c * s / apart, (c * c - s * s) / apart, c * s / apart
    return out


def _points(points_px: npt.ArrayLike) -> Array:
    points = np.asarray(points_px, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 2 or not np.isfinite(points).all():
        raise ValueError(f"points_px must be (N, 2) and finite, not {points.shape}")
    return points
