"""The pinhole camera with OpenCV's lens distortion.

Camera frame: x right, y down, z along the boresight. Pixel (0, 0) is the *centre*
of the top-left pixel, so the picture spans -0.5 … width - 0.5.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

Array = npt.NDArray[np.float64]

DISTORTION_LENGTHS = (0, 4, 5, 8)  # coefficients. Source: OpenCV, calib3d
# Points along each border; odd, so that the middle is one of them.
_BORDER_SAMPLES = 65  # Source: by construction
_UNDISTORT_ITERATIONS = 200  # a bound for strong lenses. Source: by construction
_UNDISTORT_STEP = 1e-13  # normalised; converged. Source: float64 rounding
# px; a ray that projects further from its pixel is no answer. Far below any centroid's error.
_UNDISTORT_ERROR_PX = 1e-3  # Source: by construction


@dataclass(frozen=True, slots=True)
class Camera:
    """A calibrated camera, ``u = fx x' + cx``, ``v = fy y' + cy``.

    (x', y') are the distorted normalised coordinates, with OpenCV's polynomial
    (radial k1 k2 k3), rational (k4 k5 k6) and tangential (p1 p2) terms.

    Raises:
        ValueError: a size is not positive, a number not finite, a focal length not
            positive, or the number of coefficients none of 0, 4, 5 and 8.
    """

    width: int  # px
    height: int  # px
    fx: float  # px
    fy: float  # px
    cx: float  # px, from the centre of the left column
    cy: float  # px, from the centre of the top row
    distortion: tuple[float, ...] = ()  # k1 k2 p1 p2 [k3 [k4 k5 k6]]

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            value = getattr(self, name)
            if isinstance(value, bool) or int(value) != value or value <= 0:
                raise ValueError(f"{name} must be a positive whole number of pixels, not {value}")
            object.__setattr__(self, name, int(value))
        for name in ("fx", "fy", "cx", "cy"):
            value = float(getattr(self, name))
            if not math.isfinite(value) or (name in ("fx", "fy") and value <= 0.0):
                kind = "positive and finite" if name in ("fx", "fy") else "finite"
                raise ValueError(f"{name} must be {kind}, not {value}")
            object.__setattr__(self, name, value)
        distortion = tuple(float(value) for value in self.distortion)
        if len(distortion) not in DISTORTION_LENGTHS or not all(map(math.isfinite, distortion)):
            raise ValueError(
                f"distortion must be 0, 4, 5 or 8 finite numbers "
                f"(k1 k2 p1 p2 [k3 [k4 k5 k6]]), not {distortion}"
            )
        object.__setattr__(self, "distortion", distortion)

    @classmethod
    def from_fov(cls, width: int, height: int, horizontal_fov_rad: float) -> Camera:
        """An ideal camera: square pixels, principal point in the middle of the picture.

        ``horizontal_fov_rad`` is the angle between the left and the right border.
        """
        if not 0.0 < horizontal_fov_rad < math.pi:
            raise ValueError(f"horizontal_fov_rad must be in (0, π), not {horizontal_fov_rad}")
        focal = 0.5 * width / math.tan(0.5 * horizontal_fov_rad)
        return cls(width, height, focal, focal, 0.5 * (width - 1), 0.5 * (height - 1))

    @property
    def matrix(self) -> Array:
        """The (3, 3) camera matrix K, pixels."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def is_distorted(self) -> bool:
        """Whether any distortion coefficient differs from zero."""
        return any(self.distortion)

    def rays(self, points_px: npt.ArrayLike) -> Array:
        """Undistorted rays of pixels: (N, 2) px → (N, 3) with z = 1, camera frame.

        Distortion is inverted by fixed-point iteration. A point that no ray
        reaches (outside the range where the lens model is invertible) gives NaN for x and y.
        """
        points = np.asarray(points_px, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 2:
            raise ValueError(f"points_px must be (N, 2), not {points.shape}")
        rays = np.empty((len(points), 3))
        _pinhole_rays(points, self.fx, self.fy, self.cx, self.cy, rays)
        if self.is_distorted:
            rays[:, :2] = self._undistort(rays[:, :2].copy())
        return rays

    def project(self, points_m: npt.ArrayLike) -> Array:
        """Pixels of points in the camera frame: (..., 3) m → (..., 2) px.

        NaN for points at or behind the camera plane (z ≤ 0). The lens polynomial
        means nothing far outside the field of view, where it may fold a point
        back into the picture: clip geometry to the view before projecting.
        """
        points = np.asarray(points_m, dtype=np.float64)
        if points.ndim < 1 or points.shape[-1] != 3:
            raise ValueError(f"points_m must be (..., 3), not {points.shape}")
        depth = points[..., 2:]
        with np.errstate(over="ignore"):
            normalised = points[..., :2] / np.where(depth > 0.0, depth, np.nan)
        if self.is_distorted:
            normalised = self._distort(normalised)
        return np.asarray(normalised * (self.fx, self.fy) + (self.cx, self.cy))

    @property
    def half_fov_rad(self) -> float:
        """Half-angle of the largest cone about the boresight that lies in the picture, rad.

        The smallest angle from the boresight to the four borders; 0 when the
        boresight does not meet the picture.
        """
        left, right = -0.5, self.width - 0.5
        top, bottom = -0.5, self.height - 0.5
        if not (left < self.cx < right and top < self.cy < bottom):
            return 0.0
        if not self.is_distorted:
            across = min(self.cx - left, right - self.cx) / self.fx
            down = min(self.cy - top, bottom - self.cy) / self.fy
            return math.atan(min(across, down))
        # The foot of the perpendicular is sampled too: it is the nearest point bar distortion.
        u = np.append(np.linspace(left, right, _BORDER_SAMPLES), self.cx)
        v = np.append(np.linspace(top, bottom, _BORDER_SAMPLES), self.cy)
        border = np.concatenate(
            [np.column_stack([u, np.full_like(u, edge)]) for edge in (top, bottom)]
            + [np.column_stack([np.full_like(v, edge), v]) for edge in (left, right)]
        )
        tangents = np.hypot(*self.rays(border)[:, :2].T)
        reached = tangents[np.isfinite(tangents)]
        return math.atan(reached.min()) if reached.size else 0.0

    def _lens(self, xy: Array) -> tuple[Array, Array]:
        """Radial factor (..., 1) and tangential shift (..., 2) of OpenCV's model at ``xy``."""
        k1, k2, p1, p2, k3, k4, k5, k6 = (*self.distortion, *([0.0] * 8))[:8]
        x, y = xy[..., 0], xy[..., 1]
        r2 = x * x + y * y
        radial = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        shift = np.stack(
            [
                2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
                p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
            ],
            axis=-1,
        )
        return radial[..., None], shift

    def _distort(self, xy: Array) -> Array:
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            radial, shift = self._lens(xy)
            return np.asarray(xy * radial + shift)

    def _undistort(self, distorted: Array) -> Array:
        """Solve ``x' = x radial(x) + shift(x)`` for x; NaN where that does not converge."""
        xy = distorted.copy()
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            for _ in range(_UNDISTORT_ITERATIONS):
                radial, shift = self._lens(xy)
                updated = (distorted - shift) / radial
                step = np.abs(updated - xy)
                xy = updated
                if not np.any(step > _UNDISTORT_STEP):
                    break
            error_px = np.abs(self._distort(xy) - distorted) * (self.fx, self.fy)
        xy[~(error_px < _UNDISTORT_ERROR_PX).all(axis=1)] = np.nan
        return xy


@njit(cache=True, nogil=True)
def _pinhole_rays(points: Array, fx: float, fy: float, cx: float, cy: float, rays: Array) -> None:
    for i in range(points.shape[0]):
        rays[i, 0] = (points[i, 0] - cx) / fx
        rays[i, 1] = (points[i, 1] - cy) / fy
        rays[i, 2] = 1.0
