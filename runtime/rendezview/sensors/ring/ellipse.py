"""The ellipse as a result, and three fits to points: the paper's, an unbiased one, the geometric.

Inside the compiled loops an ellipse is its *shape vector* (x, y, A11, A12, A22): the points
``c + A u`` with u on the unit circle and A symmetric, positive definite. Unlike axes and angle
these five are smooth where the ellipse is a circle, as for a ring seen head-on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.estimation.linear_algebra import invert, solve_scaled
from rendezview.sensors.ring.conic import sampson

Array = npt.NDArray[np.float64]

_GEOMETRIC_STEPS = 12  # Source: by construction, a bound only


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
        x, y, a, b, angle = (
            float(value) for value in axes_of_shape(np.asarray(shape, dtype=float))
        )
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
        return np.asarray(shape_of_axes(self._row()))

    @classmethod
    def fit(cls, points_px: npt.ArrayLike) -> Ellipse | None:
        """The geometric fit of points (N, 2) px, N ≥ 6, with its covariance; None where none is.

        Least squares of the distances (maximum likelihood for points of even, independent noise),
        from the hyper-accurate fit; the noise is estimated from what remains.
        """
        points = _points(points_px)
        start = fit_hyper(points)
        if start is None or len(points) < 6:
            return None
        shape = start.shape
        covariance = np.empty((5, 5))
        if not fit_geometric(points, shape, covariance):
            return None
        return cls.from_shape(shape, covariance)

    def residuals(self, points_px: npt.ArrayLike) -> Array:
        """Distances (N,) px of points (N, 2) from the ellipse, to first order; outside positive."""
        points = _points(points_px)
        row = self._row()
        return np.array([sampson(row, x, y) for x, y in points])

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

    def _row(self) -> Array:
        return np.array([*self.centre_px, *self.semi_axes_px, self.angle_rad])


def fit_hyper(points_px: npt.ArrayLike) -> Ellipse | None:
    """Algebraic fit without the bias of second order (Kanatani & Rangarajan 2011).

    Points (N, 2) px, N ≥ 5. None where the conic is no ellipse.
    """
    points = _points(points_px)
    if len(points) < 5:
        return None
    origin, scale = points.mean(axis=0), float(points.std()) or 1.0
    x, y = ((points - origin) / scale).T
    one = np.ones_like(x)
    design = np.column_stack([x * x, 2 * x * y, y * y, 2 * x, 2 * y, one])
    count = len(points)
    moments = design.T @ design / count
    # V0 of every point: the covariance of its row for unit noise.
    zero = np.zeros_like(x)
    dx = np.column_stack([2 * x, 2 * y, zero, 2 * one, zero, zero])
    dy = np.column_stack([zero, 2 * x, 2 * y, zero, 2 * one, zero])
    taubin = (dx.T @ dx + dy.T @ dy) / count
    second = np.array([1.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    mean = design.mean(axis=0)
    normal = taubin + np.outer(mean, second) + np.outer(second, mean)
    values, vectors = np.linalg.eigh(moments)
    if values[1] <= 1e-14 * values[-1]:
        return None  # the points do not determine a conic
    kept = (vectors[:, 1:] / values[1:]) @ vectors[:, 1:].T  # pseudo-inverse of rank 5
    weights = np.sum((design @ kept) * design, axis=1)
    normal -= (design * weights[:, None]).T @ design / count**2
    across = design @ kept
    normal -= _hyper_cross(design, across, dx, dy) / count**2
    try:
        inverse = np.linalg.inv(moments + 1e-15 * np.trace(moments) * np.eye(6))
    except np.linalg.LinAlgError:
        return None
    values, vectors = np.linalg.eig(inverse @ normal)
    conic = np.real(vectors[:, int(np.argmax(np.abs(values)))])
    return _of_conic(conic * [1, 2, 1, 2, 2, 1], origin, scale)


def _hyper_cross(design: Array, across: Array, dx: Array, dy: Array) -> Array:
    """Second sum of the hyper normalisation: of V0 M⁻ ξ ξᵀ and its transpose."""
    total = np.zeros((6, 6))
    for half in (dx, dy):
        inner = np.einsum("ni,ni->n", half, across)
        part = (half * inner[:, None]).T @ design
        total += part + part.T
    return total


def _of_conic(conic: Array, origin: Array, scale: float) -> Ellipse | None:
    a, b, c, d, e, f = conic
    matrix = np.array([[a, b / 2], [b / 2, c]])
    if np.linalg.det(matrix) <= 0.0:
        return None
    centre = -0.5 * np.linalg.solve(matrix, [d, e])
    level = -(f + 0.5 * float(np.dot([d, e], centre)))
    values, vectors = np.linalg.eigh(matrix / level if level else matrix)
    if values[0] <= 0.0:
        return None
    long = vectors[:, 0]
    axes = scale / np.sqrt(values)
    return Ellipse(
        origin + scale * centre,
        (float(axes[0]), float(axes[1])),
        _wrapped(math.atan2(long[1], long[0])),
    )


@njit(cache=True, nogil=True, error_model="numpy")
def shape_of_axes(row: Array) -> Array:
    """Shape vector (5,) of x, y, a, b, angle (5,)."""
    c, s = np.cos(row[4]), np.sin(row[4])
    a, b = row[2], row[3]
    shape = np.empty(5)
    shape[0], shape[1] = row[0], row[1]
    shape[2], shape[4] = a * c * c + b * s * s, a * s * s + b * c * c
    shape[3] = (a - b) * c * s
    return shape


@njit(cache=True, nogil=True, error_model="numpy")
def axes_of_shape(shape: Array) -> Array:
    """x, y, a, b, angle (5,) of a shape vector (5,)."""
    half, diff = 0.5 * (shape[2] + shape[4]), 0.5 * (shape[2] - shape[4])
    root = np.sqrt(diff * diff + shape[3] * shape[3])
    row = np.empty(5)
    row[0], row[1], row[2], row[3] = shape[0], shape[1], half + root, half - root
    row[4] = 0.5 * np.arctan2(shape[3], diff) if root > 0.0 else 0.0
    return row


@njit(cache=True, nogil=True, error_model="numpy")
def fit_geometric(points: Array, shape: Array, covariance: Array) -> bool:
    """Gauss–Newton on the distances of points (N, 2); False where it fails. In place."""
    n = points.shape[0]
    normal, lower = np.empty((5, 5)), np.empty((5, 5))
    right, step, row = np.empty(5), np.empty(5), np.empty(5)
    for _ in range(_GEOMETRIC_STEPS):
        normal[:] = 0.0
        right[:] = 0.0
        total = 0.0
        a, b, c = shape[2], shape[3], shape[4]
        determinant = a * c - b * b
        if not (determinant > 0.0 and a > 0.0):
            return False
        for i in range(n):
            dx, dy = points[i, 0] - shape[0], points[i, 1] - shape[1]
            u0, u1, n0, n1, r = _foot(a, b, c, determinant, dx, dy)
            row[0], row[1] = n0, n1
            row[2], row[3], row[4] = n0 * u0, n0 * u1 + n1 * u0, n1 * u1
            total += r * r
            for j in range(5):
                right[j] += row[j] * r
                for k in range(j + 1):
                    normal[j, k] += row[j] * row[k]
        if not solve_scaled(normal, right, lower, step):
            return False
        longest = 0.5 * (a + c)
        largest = np.max(np.abs(step))
        if not largest < 1e6:
            return False
        if largest > 0.3 * longest:
            step *= 0.3 * longest / largest
        shape += step
        if largest < 1e-9 * longest:
            break
    if not (shape[2] > 0.0 and shape[2] * shape[4] - shape[3] * shape[3] > 0.0):
        return False
    if not invert(normal, lower, covariance):
        return False
    covariance *= total / max(n - 5, 1)
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _foot(
    a: float, b: float, c: float, determinant: float, dx: float, dy: float
) -> tuple[float, float, float, float, float]:
    """The point A u nearest to (dx, dy), |u| = 1, of an ellipse about 0 with A = ((a, b), (b, c)).

    Returns u, the outward unit normal there, and the distance.
    """
    u0, u1 = (c * dx - b * dy) / determinant, (a * dy - b * dx) / determinant
    size = np.sqrt(u0 * u0 + u1 * u1) + 1e-300
    u0, u1 = u0 / size, u1 / size
    for _ in range(3):  # Newton steps along the circle
        t0, t1 = -(a * u1) + b * u0, -(b * u1) + c * u0  # A u', u' = (-u1, u0)
        q0, q1 = a * u0 + b * u1, b * u0 + c * u1  # A u
        e0, e1 = dx - q0, dy - q1
        slope = e0 * t0 + e1 * t1
        bend = t0 * t0 + t1 * t1 + e0 * q0 + e1 * q1
        turn = slope / bend if bend > 0.0 else 0.0
        turn = min(max(turn, -0.3), 0.3)
        cos, sin = np.cos(turn), np.sin(turn)
        u0, u1 = cos * u0 - sin * u1, sin * u0 + cos * u1
    n0, n1 = c * u0 - b * u1, a * u1 - b * u0  # normal: A⁻¹ u
    size = np.sqrt(n0 * n0 + n1 * n1)
    n0, n1 = n0 / size, n1 / size
    q0, q1 = a * u0 + b * u1, b * u0 + c * u1
    return u0, u1, n0, n1, (dx - q0) * n0 + (dy - q1) * n1


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


def _wrapped(angle: float) -> float:
    """Into (-π/2, π/2]."""
    turned = math.remainder(angle, math.pi)
    return math.pi / 2 if turned == -math.pi / 2 else turned


def _points(points_px: npt.ArrayLike) -> Array:
    points = np.asarray(points_px, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 2 or not np.isfinite(points).all():
        raise ValueError(f"points_px must be (N, 2) and finite, not {points.shape}")
    return points
