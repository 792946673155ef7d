"""Samples of the edge along an ellipse, and the Gauss–Newton step that moves the ellipse onto them.

`sample_gradients` searches a few pixels to either side: fast, for rough ellipses. `update_shape`
solves for the numbers of one or two ellipses, from these samples or from those of `steps`. They are
in pixels without lens distortion; every place that is read goes through the lens model.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.estimation.edge_profile import FAR
from rendezview.estimation.least_squares import tukey_weight
from rendezview.estimation.linear_algebra import largest_size, solve
from rendezview.geometry.lens import LENS_LENGTH, distorted

Gradient = npt.NDArray[np.int16]  # Sobel's sum: 8 × grey levels a pixel

Array = npt.NDArray[np.float64]

# Columns of samples
ANGLE, OFFSET, CONTRAST, WEIGHT, PX, PY, NX, NY, U0, U1, ARC = range(11)
COLUMNS = 11  # Source: by construction


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, inline="always")
def bend(x: float, y: float, lens: Array) -> tuple[float, float]:
    """Pixel of an undistorted pixel; ``lens``: of ``lens_vector``, then whether it bends."""
    if lens[LENS_LENGTH] == 0.0:
        return x, y
    u, v = distorted((x - lens[2]) / lens[0], (y - lens[3]) / lens[1], lens)
    return lens[0] * u + lens[2], lens[1] * v + lens[3]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def frame_at(shape: Array, u0: float, u1: float) -> tuple[float, float, float, float]:
    """Point and outward unit normal of the ellipse at u."""
    a, b, c = shape[2], shape[3], shape[4]
    n0, n1 = c * u0 - b * u1, a * u1 - b * u0
    size = np.sqrt(n0 * n0 + n1 * n1) + 1e-300
    return shape[0] + a * u0 + b * u1, shape[1] + b * u0 + c * u1, n0 / size, n1 / size


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def begin_sample(
    row: Array, shape: Array, lens: Array, angle: float, u0: float, u1: float, room_px: float,
    width: int, height: int,
) -> tuple[float, float, float, float, float, float]:  # fmt: skip
    """Place and normal of a sample at an angle of the circle, u its cosine and sine.

    WEIGHT is 0 where it has so much room in the picture, else -1. Returns the point and its outward
    normal without the lens's distortion, and the point in the picture.
    """
    x, y, nx, ny = frame_at(shape, u0, u1)
    row[ANGLE], row[PX], row[PY], row[NX], row[NY] = angle, x, y, nx, ny
    row[U0], row[U1], row[OFFSET], row[CONTRAST] = u0, u1, 0.0, 0.0
    rx, ry = bend(x, y, lens)
    inside = (
        rx > room_px and ry > room_px
        and rx < width - room_px - 1.0 and ry < height - room_px - 1.0
    )  # fmt: skip
    row[WEIGHT] = 0.0 if inside else -1.0
    return x, y, nx, ny, rx, ry


@njit(cache=True, nogil=True, error_model="numpy")
def sample_gradients(
    dx: Gradient, dy: Gradient, low: float, lens: Array, shape: Array, count: int, band: float,
    samples: Array,
) -> int:  # fmt: skip
    """Edges near an ellipse at ``count`` even angles of its circle; returns how many there are.

    Fills OFFSET (px outwards), CONTRAST (signed slope, Sobel units) and WEIGHT (1 or 0; -1 outside
    of the picture) of ``samples``.
    """
    height, width = dx.shape
    found = 0
    reach = int(np.ceil(band))
    values = np.empty(2 * reach + 3)
    for i in range(count):
        angle = 2.0 * np.pi * i / count
        u0, u1 = np.cos(angle), np.sin(angle)
        row = samples[i]
        _, _, nx, ny, rx, ry = begin_sample(
            row, shape, lens, angle, u0, u1, reach + 2.5, width, height
        )
        if row[WEIGHT] < 0.0:
            continue
        best, at = low, FAR
        for k in range(2 * reach + 3):
            d = k - reach - 1.0
            column, line = int(rx + d * nx + 0.5), int(ry + d * ny + 0.5)
            values[k] = dx[line, column] * nx + dy[line, column] * ny
        for k in range(1, 2 * reach + 2):
            size = abs(values[k])
            if size < best or size < abs(values[k - 1]) or size < abs(values[k + 1]):
                continue
            d = k - reach - 1.0
            near, far = abs(values[k - 1]), abs(values[k + 1])
            curve = near + far - 2.0 * size
            shift = 0.5 * (near - far) / curve if curve < 0.0 else 0.0
            # The nearest edge, unless a much stronger one is beside it.
            if abs(d + shift) <= band and (
                at == FAR or size > 1.5 * best or abs(d + shift) < abs(at)
            ):
                best, at = size, d + shift
                row[CONTRAST] = values[k]
        if at != FAR:
            row[OFFSET], row[WEIGHT] = at, 1.0
            found += 1
    return found


@njit(cache=True, nogil=True, error_model="numpy")
def add_equation(row: Array, weight: float, value: float, normal: Array, right: Array) -> None:
    """Add ``row · x = value`` to the lower half of normal equations (N, N) and right side (N,)."""
    for j in range(row.shape[0]):
        right[j] += weight * row[j] * value
        for k in range(j + 1):
            normal[j, k] += weight * row[j] * row[k]


@njit(cache=True, nogil=True, error_model="numpy")
def solve_equations(normal: Array, right: Array, damping: float, step: Array) -> bool:
    """Fill in the upper half and solve, damped by a share of the trace; False: no equations."""
    count = right.shape[0]
    trace = 0.0
    for j in range(count):
        trace += normal[j, j]
        for k in range(j):
            normal[k, j] = normal[j, k]
    if not trace > 0.0:
        return False
    damped = normal.copy()
    for j in range(count):
        damped[j, j] += damping * trace
    return solve(damped, right, damped, step)


@njit(cache=True, nogil=True, error_model="numpy")
def update_shape(samples: Array, count: int, scale_px: float, shape: Array, normal: Array) -> float:
    """One robust Gauss–Newton step of a shape to the offsets, in place.

    Weights are WEIGHT times Tukey's of OFFSET / ``scale_px``. Returns the largest change, px;
    a negative number where there is no solution.

    Args:
        shape: (5,) of an ellipse; or (6,) of a pair, a shape and ε: the edge that gets brighter
            outwards is larger than the shape by 1 + ε/2, the other one smaller. Offsets are then
            from the edge of a sample's sense.
        normal: (N, N) gets the normal equations.
    """
    normal[:] = 0.0
    unknowns = shape.shape[0]
    pair = unknowns == 6
    right, step, row = np.zeros(unknowns), np.empty(unknowns), np.empty(unknowns)
    share = 1.0
    for i in range(count):
        s = samples[i]
        if s[WEIGHT] <= 0.0:
            continue
        w = s[WEIGHT] * tukey_weight(s[OFFSET], scale_px)
        if w == 0.0:
            continue
        if pair:
            sense = 1.0 if s[CONTRAST] > 0.0 else -1.0
            share = 1.0 + 0.5 * sense * shape[5]
            row[5] = 0.5 * sense * (
                s[NX] * (shape[2] * s[U0] + shape[3] * s[U1])
                + s[NY] * (shape[3] * s[U0] + shape[4] * s[U1])
            )  # fmt: skip
        row[0], row[1] = s[NX], s[NY]
        row[2], row[4] = share * s[NX] * s[U0], share * s[NY] * s[U1]
        row[3] = share * (s[NX] * s[U1] + s[NY] * s[U0])
        add_equation(row, w, s[OFFSET], normal, right)
    if not solve_equations(normal, right, 1e-9 if pair else 1e-7, step):
        return -1.0
    largest = float(largest_size(step[:5]))
    if pair:
        largest = max(largest, 0.5 * (shape[2] + shape[4]) * abs(step[5]))
    for j in range(unknowns):
        shape[j] += step[j]
    if not (shape[2] > 0.0 and shape[2] * shape[4] - shape[3] * shape[3] > 0.0):
        return -1.0
    return largest
