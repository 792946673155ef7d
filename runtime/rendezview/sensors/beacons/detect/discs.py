"""Projection of a reflector's disc, its place and size, for the compiled loops.

A reflector is a disc. A centroid measures the middle of its ellipse in the picture, not
the picture of its centre: ``e = c c_z − a² (e_z − n n_z)`` over its third component, for a disc
of radius a at c with normal n (the third column of the disc's dual conic ``c cᵀ − a²(I − n nᵀ)``).
At 1 m and 30° of tilt a disc of 25 mm is off by 0.04 px. The laser's light falls with range²
across the disc too, which moves the middle of the brightness towards its near edge by as much:
by 2 k² a² / r² of the in-plane part of c, with k² a² the second moment under the spot's window.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numba import njit

from rendezview.geometry.camera import Camera
from rendezview.geometry.lens import LENS_LENGTH, distorted, lens_vector
from rendezview.geometry.pose import Array, Pose
from rendezview.sensors.beacons.constellation import ReflectorPattern

# σ of the law of light (1 retro-reflected, 0 even): even light is then 1.7 σ away, which leaves the
# normalised error of either within 4 to 8. Source: experiment reflector-nees
_LIGHT_SIGMA = 0.6
# px, σ of the optics and of a pixel's width together. Source: by construction, √(0.7² + 1/12) with
# optics of 0.7 px
BLUR_PX = 0.75
BLUR, LAW = LENS_LENGTH, LENS_LENGTH + 1  # places of what `camera_numbers` appends


def camera_numbers(camera: Camera, blur_px: float = BLUR_PX) -> Array:
    """(LENS_LENGTH + 2,) of ``lens_vector``, the blur and the law of light, for the compiled loops.

    The law is 1 for a retro-reflector, whose light falls with range² across the disc, and 0 for
    even light.
    """
    return np.append(lens_vector(camera), (blur_px, 1.0))


def camera_doubts(camera: Camera) -> Array:
    """(P, LENS_LENGTH + 2) by how much one σ of each error moves `camera_numbers`.

    The first row is the law of light. The others, which are independent of each other, are the
    errors of the camera's calibration; there are none where its covariance is not known.
    """
    light = np.zeros((1, LENS_LENGTH + 2))
    light[0, LAW] = _LIGHT_SIGMA
    if camera.covariance is None:
        return light
    matrix = np.array(camera.covariance)
    values, vectors = np.linalg.eigh(matrix / (scale := _scale(matrix)))
    roots = np.sqrt(np.diag(scale)) * (vectors * np.sqrt(np.maximum(values, 0.0))).T
    terms = np.zeros(len(matrix) - 4)
    terms[: len(camera.distortion)] = camera.distortion[: len(terms)]
    given = np.array([camera.fx, camera.fy, camera.cx, camera.cy, *terms])
    rows = [
        0.5 * (_numbers_of(camera, given + root) - _numbers_of(camera, given - root))
        for root in roots
    ]
    return np.vstack([light, *rows])


def _scale(matrix: Array) -> Array:
    """Products of σ, 1 where a number is exact: a covariance over these is a correlation."""
    sigma = np.sqrt(np.diag(matrix))
    sigma[sigma == 0.0] = 1.0
    return np.outer(sigma, sigma)


def _numbers_of(camera: Camera, values: Array) -> Array:
    """`camera_numbers` of fx fy cx cy and a distortion."""
    fx, fy, cx, cy, *terms = values.tolist()
    terms = terms or camera.distortion
    moved = replace(camera, fx=fx, fy=fy, cx=cx, cy=cy, distortion=tuple(terms), covariance=None)
    return camera_numbers(moved, 0.0)


def predict_spots(camera: Camera, pattern: ReflectorPattern, camera_from_target: Pose) -> Array:
    """(N, 2) centroids of all reflectors in the picture, px; NaN behind the camera."""
    out = np.empty((len(pattern), 2))
    arm = pattern.positions_m - pattern.centre_m
    shift = camera_from_target.apply(pattern.centre_m)
    project_all(
        camera_numbers(camera), arm, pattern.normals, pattern.diameters_m,
        np.ascontiguousarray(camera_from_target.rotation), shift, out,
    )  # fmt: skip
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def project_disc(
    lens: Array, x: float, y: float, z: float, nx: float, ny: float, nz: float, radius: float
) -> tuple[float, float]:
    """Pixel of the middle of a disc's spot; disc at (x, y, z), unit normal n, camera frame."""
    a2 = radius * radius
    r2 = x * x + y * y + z * z
    square = a2 * lens[0] * lens[0] / r2  # of the radius in pixels
    k = 0.5 + 0.131 * square / (square + 5.0 * lens[BLUR] * lens[BLUR])  # as in `expected_size`
    across, near = nx * x + ny * y + nz * z, 2.0 * lens[LAW] * k * k * a2 / r2
    x, y, z = (
        x - near * (x - across * nx),
        y - near * (y - across * ny),
        z - near * (z - across * nz),
    )
    w = z * z - a2 * (1.0 - nz * nz)
    if not (z > 0.0 and w > 0.0):
        return np.nan, np.nan
    u, v = (x * z + a2 * nx * nz) / w, (y * z + a2 * ny * nz) / w
    du, dv = distorted(u, v, lens)
    return lens[0] * du + lens[2], lens[1] * dv + lens[3]


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def disc_radius(
    focal_px: float, x: float, y: float, z: float, nx: float, ny: float, nz: float, radius: float
) -> float:
    """Root mean square of the two half axes of a disc's ellipse, px: its extent in a round window.

    Of the disc's plane (I − n nᵀ) under the projection's derivative; off the boresight the
    picture is stretched.
    """
    u, v = x / z, y / z
    a, b = nx - nz * u, ny - nz * v
    return radius * focal_px / z * math.sqrt(max(0.5 * (2.0 + u * u + v * v - a * a - b * b), 0.0))


@njit(cache=True, nogil=True, error_model="numpy")
def project_all(
    lens: Array, arms: Array, normals: Array, diameters: Array, rotation: Array, shift: Array,
    out: Array,
) -> None:  # fmt: skip
    """Fill (N, 2) pixels of discs whose places in the camera are ``rotation @ arm + shift``."""
    for i in range(arms.shape[0]):
        px, py, pz = turned(rotation, arms, i)
        nx, ny, nz = turned(rotation, normals, i)
        out[i, 0], out[i, 1] = project_disc(
            lens, px + shift[0], py + shift[1], pz + shift[2], nx, ny, nz, 0.5 * diameters[i]
        )


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def placed(
    rotation: Array, translation: Array, points: Array, i: int
) -> tuple[float, float, float]:
    """Point i of the target in the camera frame."""
    p, q, r = points[i, 0], points[i, 1], points[i, 2]
    return (
        rotation[0, 0] * p + rotation[0, 1] * q + rotation[0, 2] * r + translation[0],
        rotation[1, 0] * p + rotation[1, 1] * q + rotation[1, 2] * r + translation[1],
        rotation[2, 0] * p + rotation[2, 1] * q + rotation[2, 2] * r + translation[2],
    )


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def turned(rotation: Array, vectors: Array, i: int) -> tuple[float, float, float]:
    """Vector i of the target on the camera's axes."""
    p, q, r = vectors[i, 0], vectors[i, 1], vectors[i, 2]
    return (
        rotation[0, 0] * p + rotation[0, 1] * q + rotation[0, 2] * r,
        rotation[1, 0] * p + rotation[1, 1] * q + rotation[1, 2] * r,
        rotation[2, 0] * p + rotation[2, 1] * q + rotation[2, 2] * r,
    )


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def expected_size(blur_px: float, radius_px: float) -> float:
    """σ of the window that settles on a disc of some radius under a Gaussian blur, px.

    A small disc adds its second moment, radius²/4; a large one makes the window settle at 0.631
    radii. Between them a curve fitted to computed spots (within 0.5 %).
    """
    square = radius_px * radius_px
    k = 0.5 + 0.131 * square / (square + 5.0 * blur_px * blur_px)
    return math.sqrt(blur_px * blur_px + k * k * square)
