"""The ellipse as a result.

Inside the compiled loops an ellipse is its *shape vector* (x, y, A11, A12, A22): the points
``c + A u`` with u on the unit circle and A symmetric, positive definite. Unlike axes and angle
these five are smooth where the ellipse is a circle, as for a ring seen head-on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rendezview.sensors.ring.conic import semi_axes

Array = npt.NDArray[np.float64]


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
