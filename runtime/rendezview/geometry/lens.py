"""A camera's pinhole and lens for compiled loops; `Camera` has the same for arrays."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from rendezview.geometry.camera import Camera, LensModel
from rendezview.geometry.distortion import fisheye_limit_rad, tilt_matrix
from rendezview.geometry.pose import Array

# Layout of a lens vector: fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6, the model, the rest by model.
_MODEL = 12  # Source: by construction
_EXTENDED, _FISHEYE = 1.0, 2.0  # kinds of lenses; 0: at most 8 terms. Source: by construction
_LIMIT = 8  # of a fisheye, in k3's place: largest angle, rad. Source: by construction
_PRISM, _TILT = 13, 17  # s1 s2 s3 s4; the tilt's homography by rows. Source: by construction
LENS_LENGTH = 26  # Source: by construction


def lens_vector(camera: Camera) -> Array:
    """(LENS_LENGTH,) numbers of a camera, for `distorted`."""
    vector = np.zeros(LENS_LENGTH)
    vector[:4] = camera.fx, camera.fy, camera.cx, camera.cy
    terms = camera.distortion
    vector[4 : 4 + min(len(terms), 8)] = terms[:8]
    if camera.lens_model is LensModel.FISHEYE:
        vector[_MODEL], vector[_LIMIT] = _FISHEYE, fisheye_limit_rad(terms)
    elif any(terms[8:]):
        vector[_MODEL] = _EXTENDED
        vector[_PRISM : _PRISM + 4] = terms[8:12]
        tilt = (*terms[12:], 0.0, 0.0)[:2]
        vector[_TILT : _TILT + 9] = tilt_matrix(*tilt).ravel()
    return vector


@njit(cache=True, nogil=True, error_model="numpy")
def _rarely_distorted(x: float, y: float, lens: Array) -> tuple[float, float]:
    """The fisheye, and the polynomial with thin-prism terms and tilt: compiled once, not inlined.

    Beyond the largest angle of a fisheye, NaN.
    """
    r2 = x * x + y * y
    if lens[_MODEL] == _FISHEYE:
        r = math.sqrt(r2)
        theta = math.atan(r)
        if theta > lens[_LIMIT]:
            return math.nan, math.nan
        t2 = theta * theta
        polynomial = 1.0 + t2 * (lens[4] + t2 * (lens[5] + t2 * (lens[6] + t2 * lens[7])))
        scale = theta * polynomial / r if r > 0.0 else 1.0
        return scale * x, scale * y
    radial = (1.0 + r2 * (lens[4] + r2 * (lens[5] + r2 * lens[8]))) / (
        1.0 + r2 * (lens[9] + r2 * (lens[10] + r2 * lens[11]))
    )
    u = x * radial + 2.0 * lens[6] * x * y + lens[7] * (r2 + 2.0 * x * x)
    v = y * radial + lens[6] * (r2 + 2.0 * y * y) + 2.0 * lens[7] * x * y
    u += r2 * (lens[_PRISM] + r2 * lens[_PRISM + 1])
    v += r2 * (lens[_PRISM + 2] + r2 * lens[_PRISM + 3])
    w = lens[_TILT + 6] * u + lens[_TILT + 7] * v + lens[_TILT + 8]
    return (
        (lens[_TILT] * u + lens[_TILT + 1] * v + lens[_TILT + 2]) / w,
        (lens[_TILT + 3] * u + lens[_TILT + 4] * v + lens[_TILT + 5]) / w,
    )


@njit(cache=True, nogil=True, error_model="numpy")
def is_polynomial(lens: Array) -> bool:
    """Whether ``polynomial`` is all of a lens, as it is of most."""
    return lens[_MODEL] == 0.0  # type: ignore[no-any-return]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def polynomial(x: float, y: float, lens: Array) -> tuple[float, float]:
    """OpenCV's distortion of normalised coordinates by at most 8 terms; without branches."""
    r2 = x * x + y * y
    radial = (1.0 + r2 * (lens[4] + r2 * (lens[5] + r2 * lens[8]))) / (
        1.0 + r2 * (lens[9] + r2 * (lens[10] + r2 * lens[11]))
    )
    u = x * radial + 2.0 * lens[6] * x * y + lens[7] * (r2 + 2.0 * x * x)
    v = y * radial + lens[6] * (r2 + 2.0 * y * y) + 2.0 * lens[7] * x * y
    return u, v


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def distorted(x: float, y: float, lens: Array) -> tuple[float, float]:
    """OpenCV's distortion of normalised coordinates; ``lens`` of ``lens_vector``."""
    u, v = polynomial(x, y, lens)
    if lens[_MODEL] != 0.0:
        u, v = _rarely_distorted(x, y, lens)
    return u, v
