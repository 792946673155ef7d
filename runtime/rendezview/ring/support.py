"""How well the picture bears an ellipse out, and where exactly its edge lies.

Two readings. `gradient_support` looks in the gradients a few pixels to either side: fast, for
hypotheses. `step_support` reads the grey picture along the normals and fits a blurred step: what
the answer's accuracy comes from. Both solve for the five numbers of the ellipse by Gauss–Newton.
The ellipse is in pixels without lens distortion; every place read goes through the lens model.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy.special import ndtr

from rendezview.lens import distorted
from rendezview.normal_table import normal_cdf

Array = npt.NDArray[np.float64]

REACH = 3  # px to either side of the step fit
TAPS = 2 * REACH + 1
LEAST_GAP = 2.2  # px between two edges that can still be told apart
# Where the whole profile is no step, its near side may be: px from the edge, first and last.
WINDOWS = ((-REACH, REACH), (-REACH, 1), (-1, REACH), (-2, 1), (-1, 2))
# Columns of samples
ANGLE, OFFSET, CONTRAST, WEIGHT, PX, PY, NX, NY, U0, U1, ARC = range(11)
COLUMNS = 11
_ALIGNED = 0.9  # cosine between gradient and normal
_NO = 1e9


@njit(cache=True, nogil=True, fastmath=True, inline="always")
def bend(x, y, lens):  # type: ignore[no-untyped-def]
    """Pixel of an undistorted pixel; ``lens``: of ``lens_vector``, then whether it bends."""
    if lens[12] == 0.0:
        return x, y
    u, v = distorted((x - lens[2]) / lens[0], (y - lens[3]) / lens[1], lens)
    return lens[0] * u + lens[2], lens[1] * v + lens[3]


def step_basis(blur_px: float) -> Array:
    """(3, TAPS) columns of the model ``b + c Φ((d - δ)/σ)`` in b, c and c δ, at δ = 0."""
    d = np.arange(-REACH, REACH + 1) / blur_px
    return np.vstack(
        [np.ones(TAPS), ndtr(d), -np.exp(-0.5 * d * d) / (np.sqrt(2.0 * np.pi) * blur_px)]
    )


def step_filters(blur_px: float) -> Array:
    """(len(WINDOWS), 3, TAPS) that give b, c and c δ by least squares on each of `WINDOWS`."""
    basis = step_basis(blur_px)
    filters = np.zeros((len(WINDOWS), 3, TAPS))
    for window, (first, last) in zip(filters, WINDOWS, strict=True):
        taps = slice(first + REACH, last + REACH + 1)
        window[:, taps] = np.linalg.pinv(basis[:, taps].T)
    return filters


@njit(cache=True, nogil=True, fastmath=True)
def _frame(shape, u0, u1):  # type: ignore[no-untyped-def]
    """Point and outward unit normal of the ellipse at u."""
    a, b, c = shape[2], shape[3], shape[4]
    n0, n1 = c * u0 - b * u1, a * u1 - b * u0
    size = np.sqrt(n0 * n0 + n1 * n1) + 1e-300
    return shape[0] + a * u0 + b * u1, shape[1] + b * u0 + c * u1, n0 / size, n1 / size


@njit(cache=True, nogil=True, fastmath=True)
def distance(shape, x, y):  # type: ignore[no-untyped-def]
    """Distance of a point from an ellipse, outside positive; exact for circles."""
    a, b, c = shape[2], shape[3], shape[4]
    ex, ey = x - shape[0], y - shape[1]
    determinant = a * c - b * b
    v0, v1 = (c * ex - b * ey) / determinant, (a * ey - b * ex) / determinant
    g0, g1 = (c * v0 - b * v1) / determinant, (a * v1 - b * v0) / determinant
    size = np.sqrt(v0 * v0 + v1 * v1)
    return (size - 1.0) * size / (np.sqrt(g0 * g0 + g1 * g1) + 1e-300)


@njit(cache=True, nogil=True)
def gradient_support(dx, dy, low, lens, shape, count, band, samples):  # type: ignore[no-untyped-def]
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
        x, y, nx, ny = _frame(shape, u0, u1)
        row = samples[i]
        row[ANGLE], row[PX], row[PY], row[NX], row[NY] = angle, x, y, nx, ny
        row[U0], row[U1] = u0, u1
        row[WEIGHT], row[OFFSET], row[CONTRAST] = -1.0, 0.0, 0.0
        rx, ry = bend(x, y, lens)
        if not (
            rx > reach + 2.5
            and ry > reach + 2.5
            and rx < width - reach - 3.5
            and ry < height - reach - 3.5
        ):
            continue
        row[WEIGHT] = 0.0
        best, at = low * 0.9, _NO
        for k in range(2 * reach + 3):
            d = k - reach - 1.0
            column, line = int(rx + d * nx + 0.5), int(ry + d * ny + 0.5)
            values[k] = dx[line, column] * nx + dy[line, column] * ny
        for k in range(1, 2 * reach + 2):
            size = abs(values[k])
            if size < best or size < abs(values[k - 1]) or size < abs(values[k + 1]):
                continue
            d = k - reach - 1.0
            column, line = int(rx + d * nx + 0.5), int(ry + d * ny + 0.5)
            gx, gy = float(dx[line, column]), float(dy[line, column])
            full = np.sqrt(gx * gx + gy * gy)
            if size < _ALIGNED * full:
                continue
            near, far = abs(values[k - 1]), abs(values[k + 1])
            curve = near + far - 2.0 * size
            shift = 0.5 * (near - far) / curve if curve < 0.0 else 0.0
            # The nearest edge, unless a much stronger one is beside it.
            if abs(d + shift) <= band and (
                at == _NO or size > 1.5 * best or abs(d + shift) < abs(at)
            ):
                best, at = max(size, low), d + shift
                row[CONTRAST] = values[k]
        if at != _NO:
            row[OFFSET], row[WEIGHT] = at, 1.0
            found += 1
    return found


@njit(cache=True, nogil=True)
def sense_of(samples, count):  # type: ignore[no-untyped-def]
    """Whether most of the found edges get brighter outwards (1) or darker (-1)."""
    total = 0
    for i in range(count):
        if samples[i, WEIGHT] > 0.0:
            total += 1 if samples[i, CONTRAST] > 0.0 else -1
    return 1.0 if total >= 0 else -1.0


@njit(cache=True, nogil=True)
def update_shape(samples, count, scale_px, shape, normal):  # type: ignore[no-untyped-def]
    """One robust Gauss–Newton step to the offsets; ``normal`` (5, 5) gets the normal equations.

    Weights are WEIGHT times Tukey's of OFFSET / ``scale_px``. Returns the largest change, px;
    a negative number where there is no solution.
    """
    normal[:] = 0.0
    right = np.zeros(5)
    row = np.empty(5)
    for i in range(count):
        s = samples[i]
        if s[WEIGHT] <= 0.0:
            continue
        z = s[OFFSET] / scale_px
        if abs(z) >= 1.0:
            continue
        w = s[WEIGHT] * (1.0 - z * z) ** 2
        row[0], row[1] = s[NX], s[NY]
        row[2], row[4] = s[NX] * s[U0], s[NY] * s[U1]
        row[3] = s[NX] * s[U1] + s[NY] * s[U0]
        for j in range(5):
            right[j] += w * row[j] * s[OFFSET]
            for k in range(j + 1):
                normal[j, k] += w * row[j] * row[k]
    trace = 0.0
    for j in range(5):
        trace += normal[j, j]
        for k in range(j):
            normal[k, j] = normal[j, k]
    if not trace > 0.0:
        return -1.0
    damped = normal.copy()
    for j in range(5):
        damped[j, j] += 1e-7 * trace
    step = np.linalg.solve(damped, right)
    largest = np.max(np.abs(step))
    limit = 0.25 * (shape[2] + shape[4])
    if not largest < limit:
        return -1.0
    shape += step
    if not (shape[2] > 0.0 and shape[2] * shape[4] - shape[3] * shape[3] > 0.0):
        return -1.0
    return largest


@njit(cache=True, nogil=True)
def _crowded(profile, inner, outer, blur_px, solved):  # type: ignore[no-untyped-def]
    """Fit a profile by the step at 0 together with those of the edges at ``inner`` and ``outer``.

    ``solved`` gets level, contrast, contrast × place, and the contrasts of the outer and the inner
    edge. Returns the variance of the third for unit noise, negative where there is no solution.
    """
    system = np.zeros((5, 7))  # normal equations, right side, unit vector of the third
    row = np.empty(5)
    for k in range(TAPS):
        d = float(k - REACH)
        z = d / blur_px
        row[0], row[1] = 1.0, normal_cdf(z)
        row[2] = -np.exp(-0.5 * z * z) / (2.5066282746310002 * blur_px)
        row[3] = normal_cdf((d - outer) / blur_px)
        row[4] = normal_cdf((d - inner) / blur_px) - 1.0  # 0 where the edge is out of reach
        for i in range(5):
            system[i, 5] += row[i] * profile[k]
            for j in range(5):
                system[i, j] += row[i] * row[j]
    system[2, 6] = 1.0
    for i in range(5):
        system[i, i] += 1e-4 if i < 3 else 1e-2  # an edge out of reach has no contrast
    for i in range(5):
        if not system[i, i] > 1e-9:
            return -1.0
        for j in range(5):
            if j == i:
                continue
            share = system[j, i] / system[i, i]
            for k in range(i, 7):
                system[j, k] -= share * system[i, k]
    for i in range(5):
        solved[i] = system[i, 5] / system[i, i]
    solved[0] -= solved[4]  # the inner step was written from its far side
    return system[2, 6] / system[2, 2]


@njit(cache=True, nogil=True, fastmath=True)
def _step(profile, window):  # type: ignore[no-untyped-def]
    """Level, contrast and contrast × place of a profile by a window of `step_filters`."""
    level, contrast, shifted = 0.0, 0.0, 0.0
    for k in range(TAPS):
        level += window[0, k] * profile[k]
        contrast += window[1, k] * profile[k]
        shifted += window[2, k] * profile[k]
    return level, contrast, shifted


@njit(cache=True, nogil=True, fastmath=True)
def _allowed(freedom, noise, contrast, place):  # type: ignore[no-untyped-def]
    """Squares that a step may leave: noise, blur not quite as told, and its bend where it is far."""
    bend_grey = abs(contrast) * (0.02 + 0.2 * place * place)
    return 1.5 * freedom * (noise * noise + 0.1) + bend_grey * bend_grey


@njit(cache=True, nogil=True, fastmath=True)
def step_support(  # type: ignore[no-untyped-def]
    image, lens, shape, spacing_px, sense, noise, filters, basis, blur_px, others, samples,
):  # fmt: skip
    """Blurred steps along the normals of an ellipse; returns the number of samples filled.

    Args:
        image: (H, W) uint8.
        spacing_px: between samples along the ellipse.
        sense: 1 where the edge gets brighter outwards, -1 where darker; 0 takes both.
        noise: σ of a pixel, grey.
        filters, basis: of `step_filters` and `step_basis`; ``blur_px`` their σ.
        others: (K, 5) shapes of other edges: their steps are part of the fit where they are near,
            and where they are nearer than LEAST_GAP there is no sample.
        samples: (≥ count, COLUMNS) out. WEIGHT is 1/σ² (px⁻²) of the place, 0 where there is no
            step, -1 outside of the picture; ARC the angle a sample stands for.
    """
    height, width = image.shape
    profile = np.empty(TAPS)
    solved = np.zeros(5)
    spread = 0.0
    for k in range(TAPS):
        spread += filters[0, 2, k] * filters[0, 2, k]
    angle = 0.0
    count = 0
    long = 0.5 * (shape[2] + shape[4]) + np.sqrt(
        (0.5 * (shape[2] - shape[4])) ** 2 + shape[3] * shape[3]
    )
    short = (shape[2] * shape[4] - shape[3] * shape[3]) / long
    while angle < 2.0 * np.pi and count < samples.shape[0]:
        u0, u1 = np.cos(angle), np.sin(angle)
        x, y, nx, ny = _frame(shape, u0, u1)
        t0, t1 = -shape[2] * u1 + shape[3] * u0, -shape[3] * u1 + shape[4] * u0
        along = np.sqrt(t0 * t0 + t1 * t1)
        step = spacing_px / max(along, 0.2 * long)
        row = samples[count]
        row[ANGLE], row[PX], row[PY], row[NX], row[NY] = angle, x, y, nx, ny
        row[U0], row[U1], row[ARC] = u0, u1, min(step, 2.0 * np.pi - angle)
        row[WEIGHT], row[OFFSET], row[CONTRAST] = -1.0, 0.0, 0.0
        angle += step
        count += 1
        rx, ry = bend(x, y, lens)
        if not (
            rx > REACH + 1.5
            and ry > REACH + 1.5
            and rx < width - REACH - 2.5
            and ry < height - REACH - 2.5
        ):
            continue
        row[WEIGHT] = 0.0
        # The nearest other edge on either side, along the normal.
        inner, outer = -_NO, _NO
        for k in range(others.shape[0]):
            away = -distance(others[k], x, y)  # how far outwards the other edge lies
            o = others[k]
            if (x - o[0]) * nx + (y - o[1]) * ny < 0.0:
                away = -away
            if away >= 0.0:
                outer = min(outer, away)
            else:
                inner = max(inner, away)
        if outer < LEAST_GAP or -inner < LEAST_GAP:
            continue
        bent = lens[12] != 0.0
        for k in range(TAPS):
            d = float(k - REACH)
            a, b = rx + d * nx, ry + d * ny
            if bent:
                a, b = bend(x + d * nx, y + d * ny, lens)
            column, line = int(a), int(b)
            fa, fb = a - column, b - line
            upper = image[line, column] * (1.0 - fa) + image[line, column + 1] * fa
            lower = image[line + 1, column] * (1.0 - fa) + image[line + 1, column + 1] * fa
            profile[k] = upper + fb * (lower - upper)
        level, contrast, shifted = _step(profile, filters[0])
        taken, room = spread, _NO
        if outer < REACH + 2.0 * blur_px or -inner < REACH + 2.0 * blur_px:
            taken = _crowded(profile, inner, outer, blur_px, solved)
            if taken < 0.0:
                continue
            level, contrast, shifted = solved[0], solved[1], solved[2]
            room = 0.6 * min(outer, -inner)
        row[CONTRAST] = contrast
        if contrast * sense < 0.0 or abs(contrast) < 2.5 * noise + 2.0:
            continue
        place = shifted / contrast
        left = 0.0
        for k in range(TAPS):
            e = profile[k] - level - contrast * basis[1, k] - shifted * basis[2, k]
            if room < _NO:
                e -= solved[3] * normal_cdf((k - REACH - outer) / blur_px)
                e -= solved[4] * normal_cdf((k - REACH - inner) / blur_px)
            left += e * e
        # What is left beyond noise is another edge, a shade or a curve of the step's own. An edge
        # that is not known of leaves the near side as it is: the widest window that fits counts.
        if left > _allowed(TAPS - 3, noise, contrast, place):
            for w in range(1, filters.shape[0]):
                first, last = WINDOWS[w][0] + REACH, WINDOWS[w][1] + REACH
                l2, c2, s2 = _step(profile, filters[w])
                if c2 * contrast <= 0.0 or abs(s2) > 1.6 * abs(c2):
                    continue
                rest = 0.0
                for k in range(first, last + 1):
                    rest += (profile[k] - l2 - c2 * basis[1, k] - s2 * basis[2, k]) ** 2
                if rest <= _allowed(last - first - 2, noise, c2, s2 / c2):
                    contrast, place, left, taken = c2, s2 / c2, rest, 0.0
                    for k in range(first, last + 1):
                        taken += filters[w, 2, k] ** 2
                    break
        if abs(place) > min(1.6, room):
            continue
        allowed = (TAPS - 3) * noise * noise + (0.08 * contrast) ** 2
        if left > 6.0 * allowed + 4.0:
            continue
        # A round body's blurred edge lies inside the true one by σ²/2ρ.
        curvature = long * short / max(along, 1e-9) ** 3
        row[OFFSET] = place + 0.5 * blur_px * blur_px * curvature
        variance = taken * (noise * noise + 0.1) / (contrast * contrast) + 4e-4
        row[WEIGHT] = 1.0 / variance
    return count


@njit(cache=True, nogil=True)
def waviness_factor(samples, count):  # type: ignore[no-untyped-def]
    """How much more the means of 36 stretches scatter than independent samples' would, ≥ 1.

    Facets of a CAD ring, shadows, or an edge that is none show here: their errors go together over
    long stretches.
    """
    sums, weights = np.zeros(36), np.zeros(36)
    for i in range(count):
        w = samples[i, WEIGHT]
        if w > 0.0:
            k = min(int(samples[i, ANGLE] * (36.0 / (2.0 * np.pi))), 35)
            sums[k] += w * samples[i, OFFSET]
            weights[k] += w
    total, used = 0.0, 0
    for k in range(36):
        if weights[k] > 0.0:
            total += sums[k] * sums[k] / weights[k]
            used += 1
    return max(total / max(used - 5, 2), 1.0)


@njit(cache=True, nogil=True)
def correlation_factor(samples, count):  # type: ignore[no-untyped-def]
    """Sum of the correlations between a sample's error and its neighbours' (1 for none), ≥ 1."""
    power, pairs = 0.0, 0
    for i in range(count):
        if samples[i, WEIGHT] > 0.0:
            power += samples[i, OFFSET] ** 2 * samples[i, WEIGHT]
            pairs += 1
    if pairs < 12 or power <= 0.0:
        return 2.0
    factor = 1.0
    for lag in range(1, 6):
        total, n = 0.0, 0
        for i in range(count):
            j = i + lag
            if j >= count:
                j -= count
            if samples[i, WEIGHT] > 0.0 and samples[j, WEIGHT] > 0.0:
                total += (
                    samples[i, OFFSET] * samples[j, OFFSET]
                    * np.sqrt(samples[i, WEIGHT] * samples[j, WEIGHT])
                )  # fmt: skip
                n += 1
        if n < 12:
            break
        factor += 2.0 * (total / n) / (power / pairs)
    return min(max(factor, 1.0), 6.0)
