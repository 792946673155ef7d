"""Brown's lens model with all six coefficients of Welch et al., eq. 6.

With q = (x, y) − o, the place from the lens's point of symmetry o, and r² = q · q::

    Δx = x (l1 r² + l2 r⁴ + l3 r⁶) + (1 + p3 r²) (p1 (r² + 2x²) + 2 p2 x y)        (6a)
    Δy = y (l1 r² + l2 r⁴ + l3 r⁶) + (1 + p3 r²) (p2 (r² + 2y²) + 2 p1 x y)        (6b)

in normalised coordinates (sensor coordinates from the principal point, over the focal
length; the paper's l1 in 1/m² is ours over f², and so on). The paper adds Δ to what was
*measured*; OpenCV adds it to the *ideal* point to get the measured one. The polynomial is
the same, so one class serves both; a field holds the sense. OpenCV's p1 is the paper's p2 and the
other way round, and it has no p3 and no point of symmetry of its own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.errors import RendezviewError
from rendezview.estimation.least_squares import MOST_STEPS

Array = npt.NDArray[np.float64]

COEFFICIENT_NAMES = ("l1", "l2", "l3", "p1", "p2", "p3", "ox", "oy")
# A side, of the grid on which models are compared.
_FIELD_SAMPLES = 21  # Source: by construction, a grid


@dataclass(frozen=True, slots=True)
class Lens:
    """Eq. 6; ``corrects``: Δ leads from measured to ideal (the paper), else back (OpenCV).

    Raises:
        ValueError: a wrong number of coefficients, or one that is not finite.
    """

    radial: tuple[float, float, float] = (0.0, 0.0, 0.0)  # l1 l2 l3
    tangential: tuple[float, float, float] = (0.0, 0.0, 0.0)  # p1 p2 p3
    centre: tuple[float, float] = (0.0, 0.0)  # o, from the principal point
    corrects: bool = True

    def __post_init__(self) -> None:
        for name, count in (("radial", 3), ("tangential", 3), ("centre", 2)):
            values = tuple(float(value) for value in getattr(self, name))
            if len(values) != count or not all(map(math.isfinite, values)):
                raise ValueError(f"{name} must be {count} finite numbers, not {values}")
            object.__setattr__(self, name, values)

    @classmethod
    def from_coefficients(cls, coefficients: npt.ArrayLike, *, corrects: bool) -> Lens:
        """From (8,) in the order of `COEFFICIENT_NAMES`."""
        l1, l2, l3, p1, p2, p3, ox, oy = np.asarray(coefficients, dtype=np.float64).tolist()
        return cls((l1, l2, l3), (p1, p2, p3), (ox, oy), corrects)

    @classmethod
    def from_opencv(cls, distortion: tuple[float, ...]) -> Lens:
        """The same lens as OpenCV's k1 k2 p1 p2 [k3 [k4 k5 k6]], exactly.

        Raises:
            RendezviewError: rational, thin-prism or tilt terms, which eq. 6 does not have.
        """
        k1, k2, p1, p2, k3, *more = (*distortion, *([0.0] * 5))
        if any(more):
            raise RendezviewError(
                "the camera has rational, thin-prism or tilt terms (k4 …), which Brown's model "
                "(eq. 6) does not have: calibrate with at most k1 k2 p1 p2 k3"
            )
        return cls((k1, k2, k3), (p2, p1, 0.0), corrects=False)

    def to_opencv(self, reach: float, tolerance: float = 1e-5) -> tuple[float, ...]:
        """OpenCV's k1 k2 p1 p2 k3 of this lens: exact where the models agree, else refitted.

        Args:
            reach: half-width of the field, normalised, over which they have to agree.
            tolerance: largest difference allowed, normalised units.

        Raises:
            RendezviewError: the models differ by more than that (p3, a point of symmetry
                off the principal point, or strong distortion the other way round).
        """
        l1, l2, l3 = self.radial
        p1, p2, p3 = self.tangential
        if not self.corrects and p3 == 0.0 and self.centre == (0.0, 0.0):
            return () if not any((l1, l2, l3, p1, p2)) else (l1, l2, p2, p1, l3)
        side = np.linspace(-reach, reach, _FIELD_SAMPLES)
        ideal = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
        wanted = self.distort(ideal) - ideal
        k1_k2_p1_p2_k3 = [0, 1, 4, 3, 2]  # OpenCV's tangential terms are the others
        columns = Lens(corrects=False).derivatives(ideal)[2][:, :, k1_k2_p1_p2_k3].reshape(-1, 5)
        fitted, *_ = np.linalg.lstsq(columns, wanted.ravel(), rcond=None)
        worst = float(np.abs(columns @ fitted - wanted.ravel()).max())
        if not worst <= tolerance:
            raise RendezviewError(
                f"OpenCV's lens model cannot represent this one: they differ by up to {worst:.2e} "
                f"(normalised) within ±{reach:.2f}, {tolerance:.0e} is allowed; p3 or the point "
                "of symmetry have no place in it: keep the rig file"
            )
        return tuple(fitted.tolist())

    @property
    def coefficients(self) -> Array:
        """(8,) in the order of `COEFFICIENT_NAMES`."""
        return np.array([*self.radial, *self.tangential, *self.centre])

    def undistort(self, measured: npt.ArrayLike) -> Array:
        """(N, 2) measured → ideal, normalised; NaN where the model has no answer."""
        return self._mapped(measured, self.corrects)

    def distort(self, ideal: npt.ArrayLike) -> Array:
        """(N, 2) ideal → measured, normalised; NaN where the model has no answer."""
        return self._mapped(ideal, not self.corrects)

    def undistort_slopes(self, measured: npt.ArrayLike) -> tuple[Array, Array]:
        """Ideal places of measured ones (N, 2) → (N, 2), with their derivatives (N, 2, 2).

        Both are NaN where the model has no answer.
        """
        given = np.asarray(measured, dtype=np.float64)
        ideal = self.undistort(given)
        slopes = self._shifted_slopes(given if self.corrects else ideal)
        return ideal, slopes if self.corrects else np.asarray(np.linalg.inv(slopes), np.float64)

    def derivatives(self, ideal: npt.ArrayLike) -> tuple[Array, Array, Array]:
        """Measured places of ideal ones (N, 2) → (N, 2), with their derivatives.

        Returns also (N, 2, 2) by the ideal place and (N, 2, 8) by the coefficients.
        """
        given = np.asarray(ideal, dtype=np.float64)
        measured = self.distort(given)
        at = measured if self.corrects else given
        c = self.coefficients
        whole, by_coefficients = self._shifted_slopes(at), np.empty((len(at), 2, 8))
        middle = at - c[6:]
        x, y = middle.T
        r2 = x * x + y * y
        p1, p2, p3 = c[3:6]
        g = 1.0 + p3 * r2
        a, b, d = r2 + 2.0 * x * x, 2.0 * x * y, r2 + 2.0 * y * y
        for k in range(3):
            middle = by_coefficients[:, :, k] = middle * r2[:, None]
        by_coefficients[:, 0, 3], by_coefficients[:, 1, 4] = g * a, g * d
        by_coefficients[:, 1, 3] = by_coefficients[:, 0, 4] = g * b
        by_coefficients[:, 0, 5] = r2 * (p1 * a + p2 * b)
        by_coefficients[:, 1, 5] = r2 * (p2 * d + p1 * b)
        by_coefficients[:, :, 6:] = np.eye(2) - whole
        if not self.corrects:
            return measured, whole, by_coefficients
        ok = np.isfinite(measured).all(axis=1)
        whole[~ok] = np.eye(2)
        inverse = np.asarray(np.linalg.inv(whole), np.float64)
        return measured, inverse, -inverse @ by_coefficients

    def _shifted_slopes(self, at: Array) -> Array:
        """(N, 2, 2) derivatives of a place and its shift."""
        slopes = np.empty((len(at), 2, 2))
        _slopes(np.ascontiguousarray(at), self.coefficients, slopes)
        slopes[:, 0, 0] += 1.0
        slopes[:, 1, 1] += 1.0
        return slopes

    def _mapped(self, points: npt.ArrayLike, forwards: bool) -> Array:
        given = np.ascontiguousarray(points, dtype=np.float64)
        if given.ndim != 2 or given.shape[1] != 2:
            raise ValueError(f"points must be (N, 2), not {given.shape}")
        out = np.empty_like(given)
        _map(given, self.coefficients, forwards, out)
        return out


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "arcp"}, forceinline=True)
def shift(x: float, y: float, c: Array) -> tuple[float, float, float, float, float, float]:
    """Δx, Δy of eq. 6 and its derivatives ∂Δx/∂x, ∂Δx/∂y, ∂Δy/∂x, ∂Δy/∂y."""
    x, y = x - c[6], y - c[7]
    r2 = x * x + y * y
    radial = r2 * (c[0] + r2 * (c[1] + r2 * c[2]))
    slope = 2.0 * (c[0] + r2 * (2.0 * c[1] + r2 * 3.0 * c[2]))  # d radial / d(r²), twice
    p1, p2, p3 = c[3], c[4], c[5]
    tx = p1 * (r2 + 2.0 * x * x) + 2.0 * p2 * x * y
    ty = p2 * (r2 + 2.0 * y * y) + 2.0 * p1 * x * y
    g = 1.0 + p3 * r2
    txx, txy = 6.0 * p1 * x + 2.0 * p2 * y, 2.0 * p1 * y + 2.0 * p2 * x
    tyx, tyy = txy, 6.0 * p2 * y + 2.0 * p1 * x
    return (
        x * radial + g * tx,
        y * radial + g * ty,
        radial + slope * x * x + g * txx + 2.0 * p3 * x * tx,
        slope * x * y + g * txy + 2.0 * p3 * y * tx,
        slope * x * y + g * tyx + 2.0 * p3 * x * ty,
        radial + slope * y * y + g * tyy + 2.0 * p3 * y * ty,
    )


@njit(cache=True, nogil=True, error_model="numpy")
def unshift(u: float, v: float, c: Array) -> tuple[float, float, float, float, float, float]:
    """(x, y) with ``(x, y) + Δ(x, y) = (u, v)`` by Newton, and the derivatives of Δ there."""
    x, y = u, v
    for _ in range(MOST_STEPS):
        dx, dy, xx, xy, yx, yy = shift(x, y, c)
        ex, ey = u - x - dx, v - y - dy
        a, d = 1.0 + xx, 1.0 + yy
        determinant = a * d - xy * yx
        if not determinant > 1e-3:  # the model folds the picture here
            return np.nan, np.nan, 0.0, 0.0, 0.0, 0.0
        x += (d * ex - xy * ey) / determinant
        y += (a * ey - yx * ex) / determinant
        if abs(ex) + abs(ey) < 1e-14:
            return x, y, xx, xy, yx, yy
    if abs(ex) + abs(ey) < 1e-11:  # rounding keeps it from 1e-14
        return x, y, xx, xy, yx, yy
    return np.nan, np.nan, 0.0, 0.0, 0.0, 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def _map(points: Array, c: Array, forwards: bool, out: Array) -> None:
    for i in range(points.shape[0]):
        if forwards:
            dx, dy, _, _, _, _ = shift(points[i, 0], points[i, 1], c)
            out[i, 0], out[i, 1] = points[i, 0] + dx, points[i, 1] + dy
        else:
            out[i, 0], out[i, 1], _, _, _, _ = unshift(points[i, 0], points[i, 1], c)


@njit(cache=True, nogil=True, error_model="numpy")
def _slopes(points: Array, c: Array, out: Array) -> None:
    for i in range(points.shape[0]):
        _, _, out[i, 0, 0], out[i, 0, 1], out[i, 1, 0], out[i, 1, 1] = shift(
            points[i, 0], points[i, 1], c
        )
