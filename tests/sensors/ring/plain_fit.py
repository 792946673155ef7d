"""Ellipses through points, by numpy and scipy: no code of the product but its result."""

from __future__ import annotations

import numpy as np
from scipy.linalg import sqrtm
from scipy.optimize import least_squares

from rendezview.sensors.ring import Ellipse


def shape_through(points: np.ndarray) -> np.ndarray:
    """Shape vector (5,) of the ellipse through exact points (N, 2), from its equation."""
    origin, scale = points.mean(axis=0), points.std()
    x, y = ((points - origin) / scale).T
    design = np.column_stack([x * x - y * y, x * y, x, y, np.ones_like(x)])
    a, b, d, e, f = np.linalg.lstsq(design, -0.5 * (x * x + y * y), rcond=None)[0]
    square = np.array([[0.5 + a, 0.5 * b], [0.5 * b, 0.5 - a]])
    middle = -0.5 * np.linalg.solve(square, [d, e])
    root = np.real(sqrtm((middle @ square @ middle - f) * np.linalg.inv(square)))
    return np.array([*(origin + scale * middle), *(scale * root[[0, 0, 1], [0, 1, 1]])])


def geometric_fit(points: np.ndarray) -> Ellipse:
    """The least squares of the distances, to first order, with its covariance."""

    def distances(shape: np.ndarray) -> np.ndarray:
        inverse = np.linalg.inv([shape[[2, 3]], shape[[3, 4]]])
        round_it = (points - shape[:2]) @ inverse
        size = np.linalg.norm(round_it, axis=1)
        return (size - 1.0) * size / np.linalg.norm(round_it @ inverse, axis=1)

    found = least_squares(distances, shape_through(points), x_scale="jac")
    spread = 2.0 * found.cost / (len(points) - 5)
    return Ellipse.from_shape(found.x, spread * np.linalg.inv(found.jac.T @ found.jac))
