"""The pinhole camera with OpenCV's lens models.

Camera frame: x right, y down, z along the boresight. Pixel (0, 0) is the *centre*
of the top-left pixel, so the picture spans -0.5 … width - 0.5.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.geometry.distortion import distort, distort_fisheye, undistort, undistort_fisheye

Array = npt.NDArray[np.float64]

DISTORTION_LENGTHS = (0, 4, 5, 8, 12, 14)  # coefficients. Source: OpenCV, calib3d
BIT_DEPTHS = (8, 10, 12, 14, 16)  # bits a pixel. Source: cameras as sold
# Points along each border; odd, so that the middle is one of them.
_BORDER_SAMPLES = 65  # Source: by construction
# px; a ray that projects further from its pixel is no answer. Far below any centroid's error.
_UNDISTORT_ERROR_PX = 1e-3  # Source: by construction
# A border of a fisheye's picture that no ray reaches counts as this far off the boresight.
_WIDEST_RAD = math.radians(80.0)  # Source: a chosen limit, tan 80° = 5.7


class LensModel(StrEnum):
    """How a lens bends rays; both are OpenCV's."""

    OPENCV = "opencv"  # polynomial, rational, thin prism and tilt: cv2.projectPoints
    FISHEYE = "fisheye"  # Kannala–Brandt, "equidistant": cv2.fisheye


@dataclass(frozen=True, slots=True)
class Camera:
    """A calibrated camera, ``u = fx x' + cx``, ``v = fy y' + cy``.

    (x', y') are the distorted normalised coordinates, by OpenCV's polynomial with radial (k1 …
    k6), tangential (p1 p2), thin-prism (s1 … s4) and tilt (τx τy) terms, or by the fisheye model
    of Kannala and Brandt (k1 … k4). Directions 90° or more from the boresight have no pixel.

    Raises:
        ValueError: a size is not positive, a number not finite, a focal length not
            positive, a number of coefficients that the lens model does not have (0, 4, 5, 8, 12 or
            14; fisheye: 4), a bit depth other than 8, 10, 12, 14 and 16, or a matrix that is no
            covariance of these numbers.
    """

    width: int  # px
    height: int  # px
    fx: float  # px
    fy: float  # px
    cx: float  # px, from the centre of the left column
    cy: float  # px, from the centre of the top row
    distortion: tuple[float, ...] = ()  # k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [τx τy]]]]
    lens_model: LensModel = LensModel.OPENCV
    bit_depth: int | None = None  # of pictures with 16-bit levels; None: from the picture file
    # (4 + D, 4 + D) of fx fy cx cy (px) and D coefficients, as calibration knows them; a
    # coefficient beyond `distortion` is 0 with its σ. None: not known.
    covariance: tuple[tuple[float, ...], ...] | None = field(
        default=None, repr=False, compare=False
    )
    # What a reader of its file questions, one sentence each: see `rendezview.io.plausible`.
    doubts: tuple[str, ...] = field(default=(), repr=False, compare=False)

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
        finite = all(map(math.isfinite, distortion))
        object.__setattr__(self, "lens_model", LensModel(self.lens_model))
        if self.lens_model is LensModel.FISHEYE:
            if len(distortion) != 4 or not finite:
                raise ValueError(
                    f"distortion of a fisheye must be 4 finite numbers (k1 k2 k3 k4), "
                    f"not {distortion}"
                )
        elif len(distortion) not in DISTORTION_LENGTHS or not finite:
            raise ValueError(
                f"distortion must be 0, 4, 5, 8, 12 or 14 finite numbers "
                f"(k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [τx τy]]]]), not {distortion}"
            )
        object.__setattr__(self, "distortion", distortion)
        object.__setattr__(self, "doubts", tuple(self.doubts))
        if self.bit_depth is not None and self.bit_depth not in BIT_DEPTHS:
            raise ValueError(f"bit_depth must be one of {BIT_DEPTHS}, not {self.bit_depth}")
        if self.covariance is not None:
            object.__setattr__(self, "covariance", self._checked_covariance(self.covariance))

    def _checked_covariance(self, given: npt.ArrayLike) -> tuple[tuple[float, ...], ...]:
        matrix = np.asarray(given, dtype=np.float64)
        least = 4 + len(self.distortion)
        lengths = (0, 4) if self.lens_model is LensModel.FISHEYE else DISTORTION_LENGTHS
        sizes = [4 + n for n in lengths if 4 + n >= least or n == 0]
        if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1] or len(matrix) not in sizes:
            raise ValueError(
                f"covariance must be of 4 numbers (fx fy cx cy) or {least} and more (with the "
                f"distortion), not {matrix.shape}"
            )
        if not np.isfinite(matrix).all():
            raise ValueError("covariance must be finite")
        sigma = np.sqrt(np.abs(np.diag(matrix)))
        scaled = matrix / np.outer(*[np.where(sigma > 0.0, sigma, 1.0)] * 2)
        if np.abs(scaled - scaled.T).max() > 1e-6 or np.linalg.eigvalsh(scaled)[0] < -1e-6:
            raise ValueError("covariance must be symmetric and not negative")
        return tuple(tuple(row) for row in matrix.tolist())

    @property
    def sigma(self) -> Array | None:
        """(4 + D,) one σ of fx fy cx cy and the coefficients; None where it is not known."""
        return None if self.covariance is None else np.sqrt(np.diag(np.array(self.covariance)))

    @classmethod
    def from_matrix(
        cls, matrix: npt.ArrayLike, size: Sequence[int], distortion: Sequence[float] = ()
    ) -> Camera:
        """The camera of a (3, 3) matrix K, or its nine numbers row by row, and (width, height) px.

        Raises:
            ValueError: not [fx 0 cx; 0 fy cy; 0 0 1]; the message names what it looks like.
        """
        fx, fy, cx, cy = intrinsics_of(matrix)
        width, height = size
        return cls(width, height, fx, fy, cx, cy, tuple(distortion))

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
        """Whether the lens is other than a pinhole."""
        return self.lens_model is LensModel.FISHEYE or any(self.distortion)

    @property
    def pinhole(self) -> Camera:
        """The camera with the same matrix and size, without its lens."""
        return replace(self, distortion=(), lens_model=LensModel.OPENCV, covariance=None)

    def cropped(self, x_px: int, y_px: int, width: int, height: int) -> Camera:
        """The camera of a region of interest; (x_px, y_px) is its top-left pixel.

        Raises:
            ValueError: the region is empty or not inside the picture.
        """
        inside = 0 <= x_px <= self.width - width and 0 <= y_px <= self.height - height
        if not (inside and width > 0 and height > 0):
            raise ValueError(
                f"a region of {width} × {height} px at ({x_px}, {y_px}) is not inside a picture of "
                f"{self.width} × {self.height} px"
            )
        return replace(self, width=width, height=height, cx=self.cx - x_px, cy=self.cy - y_px)

    def binned(self, across: int, down: int | None = None) -> Camera:
        """The camera whose pixels are ``across`` × ``down`` pixels of this one (default: square).

        An incomplete pixel at the right or lower border is left out.

        Raises:
            ValueError: not positive, or larger than the picture.
        """
        down = across if down is None else down
        if not (1 <= across <= self.width and 1 <= down <= self.height):
            raise ValueError(
                f"binning must be between 1 and the picture's size, not {across} × {down}"
            )
        if across == down == 1:
            return self
        covariance = self.covariance
        if covariance is not None:
            scale = np.ones(len(covariance))
            scale[:4] = 1.0 / across, 1.0 / down, 1.0 / across, 1.0 / down
            covariance = (np.array(covariance) * np.outer(scale, scale)).tolist()
        return replace(
            self,
            width=self.width // across,
            height=self.height // down,
            fx=self.fx / across,
            fy=self.fy / down,
            cx=(self.cx + 0.5) / across - 0.5,
            cy=(self.cy + 0.5) / down - 0.5,
            covariance=covariance,
        )

    def rays(self, points_px: npt.ArrayLike) -> Array:
        """Undistorted rays of pixels: (N, 2) px → (N, 3) with z = 1, camera frame.

        Distortion is inverted by iteration. A point that no ray reaches (outside the
        range where the lens model is invertible) gives NaN for x and y.
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
        if self.lens_model is LensModel.FISHEYE:
            return float(min([_WIDEST_RAD, *np.arctan(reached)]))
        return math.atan(reached.min()) if reached.size else 0.0

    def _distort(self, xy: Array) -> Array:
        bend = distort_fisheye if self.lens_model is LensModel.FISHEYE else distort
        return bend(xy, self.distortion)

    def _undistort(self, distorted: Array) -> Array:
        """The coordinates (N, 2) that are distorted to these; NaN where there are none."""
        straighten = undistort_fisheye if self.lens_model is LensModel.FISHEYE else undistort
        xy = straighten(distorted, self.distortion)
        with np.errstate(over="ignore", invalid="ignore"):
            error_px = np.abs(self._distort(xy) - distorted) * (self.fx, self.fy)
        xy[~(error_px < _UNDISTORT_ERROR_PX).all(axis=1)] = np.nan
        return xy


def intrinsics_of(matrix: npt.ArrayLike) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy of a (3, 3) matrix K, or of its nine numbers row by row.

    Raises:
        ValueError: not [fx 0 cx; 0 fy cy; 0 0 1]; the message names what it looks like.
    """
    try:
        given = np.asarray(matrix, dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError("a camera matrix must be numbers: [fx 0 cx; 0 fy cy; 0 0 1]") from None
    if given.size != 9 or not np.isfinite(given).all():
        raise ValueError(f"has {given.size} numbers, needs the 9 finite ones of a 3 × 3 matrix")
    k = given.reshape(3, 3)
    if not k[:2].any():
        raise ValueError("all zero: this camera is not calibrated. Calibrate it")
    skewed = abs(k[0, 1]) > 1e-6 * abs(k[0, 0])
    if skewed or k[1, 0] != 0.0 or k[2].tolist() != [0.0, 0.0, 1.0]:
        if k[2, 2] == 1.0 and not k[:2, 2].any() and k[2, :2].any():
            why = "it is transposed, as MATLAB and column by column; transpose it"
        elif k[2, 2] == -1.0:
            why = "it is of OpenGL, which looks along −z; give OpenCV's, with cx and cy positive"
        elif k[2, 2] not in (0.0, 1.0) and not k[2, :2].any() and not skewed:
            why = f"it is scaled; divide it by its last number, {k[2, 2]:g}"
        else:
            why = "calibrate without skew"
        listed = given.ravel().tolist()
        raise ValueError(f"must be [fx 0 cx; 0 fy cy; 0 0 1] (no skew), not {listed}: {why}")
    return float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2])


@njit(cache=True, nogil=True, error_model="numpy")
def _pinhole_rays(points: Array, fx: float, fy: float, cx: float, cy: float, rays: Array) -> None:
    for i in range(points.shape[0]):
        rays[i, 0] = (points[i, 0] - cx) / fx
        rays[i, 1] = (points[i, 1] - cy) / fy
        rays[i, 2] = 1.0
