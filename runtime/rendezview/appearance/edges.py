"""Where the grey picture has the edges that a pose predicts: the inner loop of refinement.

For every contour point the picture is read along the image normal, as the mean of a few
parallel lines. Candidate edges are the extremes of the smoothed slope that stand out of the
noise; the strong one nearest to the prediction is taken. Against a dark sky the outside must
be sky, and the edge is placed by fitting the blurred step that a lit body with shaded rim, or
a body as thin as the model says, would show: the steepest slope alone lies up to half a pixel
inside a darkening rim and outside a thin boom.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy.special import ndtr

from rendezview.appearance.contours import NO_POINT, OUTLINE, POINT_UNIT, RUN_UNIT
from rendezview.pose import Array

LONGEST_PX = 40  # of the search to either side
# Columns of the measurements: six of the Jacobian of the residual (rotation about the view
# centre, rad, translation, m, camera axes, left), then
RESIDUAL, WEIGHT, STATE, U, V = 6, 7, 8, 9, 10
COLUMNS = 11
FOUND, NOT_FOUND, OUTSIDE, CROWDED = 1.0, 0.0, -1.0, -2.0  # STATE of a point

_RUN_PER_POINT = RUN_UNIT / POINT_UNIT
_LINES_APART_PX = 1.5
_HALF_CONTRAST = 60.0  # grey levels at which an edge counts half of the strongest (squared)
_SIGMAS = 3.0  # of the smoothed slope: a candidate
_DIM_SLOPE = 4.0  # grey levels a pixel, of the outline before a dark sky
_EVEN_SLOPE = 12.0  # at which noise and what the model does not know err alike
_LEAST_SLOPE = 10.0  # grey levels a pixel; the grain of foil stays below
_INNER_WEIGHT = 0.3  # of creases and steps: two in three of their edges are others
_THIN_PX = 4.0  # a body narrower than this is fitted as a bar, not as a half-plane
_NO_PLACE = 1e9  # no NaN: these loops are compiled as if there were none
_TABLE = 200  # entries a unit of the normal distribution's table
_PHI = ndtr(np.linspace(-5.0, 5.0, 10 * _TABLE + 1))


@njit(cache=True, nogil=True, fastmath=True)
def _phi(z):  # type: ignore[no-untyped-def]
    """The normal distribution function, from its table."""
    place = (z + 5.0) * _TABLE
    if place <= 0.0:
        return 0.0
    if place >= 10.0 * _TABLE:
        return 1.0
    i = int(place)
    return _PHI[i] + (place - i) * (_PHI[i + 1] - _PHI[i])


@njit(cache=True, nogil=True, fastmath=True)
def lens(x, y, k):  # type: ignore[no-untyped-def]
    """OpenCV's distortion k1 k2 p1 p2 k3 k4 k5 k6 of normalised coordinates."""
    r2 = x * x + y * y
    radial = (1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))) / (
        1.0 + r2 * (k[5] + r2 * (k[6] + r2 * k[7]))
    )
    return (
        x * radial + 2.0 * k[2] * x * y + k[3] * (r2 + 2.0 * x * x),
        y * radial + k[2] * (r2 + 2.0 * y * y) + 2.0 * k[3] * x * y,
    )


@njit(cache=True, nogil=True, fastmath=True)
def step_place(profile, count, zero, start, width, sky, sigma):  # type: ignore[no-untyped-def]
    """Place of the edge of a lit body before a dark sky, px outwards; _NO_PLACE where none fits.

    Least squares of ``sky + (b + g d) Φ(d / σ)`` with ``d`` the depth inside the edge: brightness
    b at the rim and its slope g inwards. A body narrower than four pixels is the bar
    ``sky + b (Φ(d / σ) − Φ((d − width) / σ))``.

    Args:
        profile: (≥ count,) grey levels at whole pixels, from inside to outside.
        zero: index of the pixel at place 0.
        start: place of the steepest slope.
        width: of the body along the normal, pixels.
        sigma: of the blur, pixels.
    """
    thin = width < _THIN_PX
    inverse = 1.0 / sigma
    place, b, g = start, 0.0, 0.0
    for step in range(4):
        first = max(0, int(np.ceil(place - 3.2)) + zero)
        last = min(count - 1, int(np.floor(place + 2.8)) + zero)
        if thin:
            first = max(first, int(np.ceil(place - width - 0.8)) + zero)
        if last - first < 3:
            return _NO_PLACE
        if step == 0:
            above, below = 0.0, 1e-9
            for i in range(first, last + 1):
                z = (place - (i - zero)) * inverse
                e = _phi(z)
                if thin:
                    e -= _phi(z - width * inverse)
                above += e * (profile[i] - sky)
                below += e * e
            b = above / below
        # Normal equations of (place, b, g); g is held near 0, a rim shades by a few levels a px.
        a00, a01, a02, a11, a12, a22 = 1e-6, 0.0, 0.0, 0.0, 0.0, 1.0 if thin else 0.05
        c0, c1, c2 = 0.0, 0.0, 0.0
        for i in range(first, last + 1):
            d = place - (i - zero)
            z = d * inverse
            e, slope = _phi(z), 0.39894228 * np.exp(-0.5 * z * z) * inverse
            if thin:
                far = z - width * inverse
                e -= _phi(far)
                slope -= 0.39894228 * np.exp(-0.5 * far * far) * inverse
            level = b + g * d
            r = profile[i] - sky - level * e
            j0, j1 = level * slope + g * e, e
            j2 = 0.0 if thin else d * e
            a00 += j0 * j0
            a01 += j0 * j1
            a02 += j0 * j2
            a11 += j1 * j1
            a12 += j1 * j2
            a22 += j2 * j2
            c0 += j0 * r
            c1 += j1 * r
            c2 += j2 * r
        m00, m01, m02 = a11 * a22 - a12 * a12, a02 * a12 - a01 * a22, a01 * a12 - a02 * a11
        determinant = a00 * m00 + a01 * m01 + a02 * m02
        if abs(determinant) < 1e-9:
            return _NO_PLACE
        m11, m12, m22 = a00 * a22 - a02 * a02, a01 * a02 - a00 * a12, a00 * a11 - a01 * a01
        move = (m00 * c0 + m01 * c1 + m02 * c2) / determinant
        move = min(max(move, -0.5), 0.5)
        place += move
        b += (m01 * c0 + m11 * c1 + m12 * c2) / determinant
        g += (m02 * c0 + m12 * c1 + m22 * c2) / determinant
        if abs(move) < 0.005:
            break
    if abs(place - start) > 1.2 or b <= 3.0:
        return _NO_PLACE
    return place


@njit(cache=True, nogil=True, fastmath=True)
def measure_edges(  # type: ignore[no-untyped-def]
    image, camera, bent, rotation, centre, point, tangent, kind, run, radius_m,
    noise, sky, dark, blur_px, reach_px, spread_px, smooth_px, room_px, lines, stride, fit, out,
):  # fmt: skip
    """Look for the edge of every contour point of one view; returns how many points there are.

    Args:
        image: (H, W) uint8.
        camera: (12,) fx fy cx cy and the eight coefficients of distortion; ``bent`` says
            whether any of them is not zero.
        rotation: (3, 3), and ``centre``: (3,) of the view centre, camera frame.
        point, tangent, kind, run: of the view, as ``Contours`` has them.
        noise, sky, dark: of the frame; see ``Sky``.
        reach_px: how far to look to either side.
        spread_px: σ of the preference for near edges.
        smooth_px: width of the two boxes whose difference is the slope.
        room_px: points with another edge nearer than this are left out.
        lines: parallel lines read.
        stride: every so many-th point only.
        fit: place the edge by ``step_place``.
        out: (N, COLUMNS) measurements.
    """
    height, width = image.shape
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    k = camera[4:]
    unit_m = radius_m * POINT_UNIT
    profile = np.empty(2 * LONGEST_PX + 32)
    # Bilinear reading takes a quarter off the noise.
    least = max(_SIGMAS * noise * np.sqrt(2.0 / (smooth_px * lines)), _LEAST_SLOPE)
    # Before a dark sky the outside must be sky, which grain on the target is not.
    least_outline = max(_SIGMAS * noise * 0.75 * np.sqrt(2.0 / (smooth_px * lines)), _DIM_SLOPE)
    margin = smooth_px + 2
    side = 2.0
    total = 0
    for j in range(point.shape[0]):
        if kind[j] == NO_POINT:
            break
        total += 1
        row = out[j]
        row[WEIGHT], row[STATE] = 0.0, OUTSIDE
        if j % stride:
            continue
        px, py, pz = point[j, 0] * unit_m, point[j, 1] * unit_m, point[j, 2] * unit_m
        qx = rotation[0, 0] * px + rotation[0, 1] * py + rotation[0, 2] * pz
        qy = rotation[1, 0] * px + rotation[1, 1] * py + rotation[1, 2] * pz
        qz = rotation[2, 0] * px + rotation[2, 1] * py + rotation[2, 2] * pz
        depth = qz + centre[2]
        if depth <= 1e-6:
            continue
        inverse = 1.0 / depth
        x, y = (qx + centre[0]) * inverse, (qy + centre[1]) * inverse
        t0, t1, t2 = tangent[j, 0], tangent[j, 1], tangent[j, 2]
        tz = rotation[2, 0] * t0 + rotation[2, 1] * t1 + rotation[2, 2] * t2
        ax = rotation[0, 0] * t0 + rotation[0, 1] * t1 + rotation[0, 2] * t2 - x * tz
        ay = rotation[1, 0] * t0 + rotation[1, 1] * t1 + rotation[1, 2] * t2 - y * tz
        u, v = x, y
        m00, m01, m10, m11 = 1.0, 0.0, 0.0, 1.0
        if bent:
            h = 1e-5
            u, v = lens(x, y, k)
            u1, v1 = lens(x + h, y, k)
            u2, v2 = lens(x, y + h, k)
            m00, m10, m01, m11 = (u1 - u) / h, (v1 - v) / h, (u2 - u) / h, (v2 - v) / h
        u, v = fx * u + cx, fy * v + cy
        row[U], row[V] = u, v
        bx, by = fx * (m00 * ax + m01 * ay), fy * (m10 * ax + m11 * ay)
        length = np.sqrt(bx * bx + by * by)
        if length < 1e-9:
            continue
        nx, ny = by / length, -bx / length  # outwards
        scale = _RUN_PER_POINT * unit_m * fx * inverse
        inner, outer = run[j, 0] * scale, run[j, 1] * scale
        if inner < room_px or (kind[j] == OUTLINE and outer < room_px):
            row[STATE] = CROWDED
            continue
        back = int(min(reach_px, max(inner, 2.0))) + margin
        ahead = int(min(reach_px, max(outer, 2.0))) + margin
        u0, v0 = u - back * nx, v - back * ny
        u1, v1 = u + ahead * nx, v + ahead * ny
        if not (
            min(u0, u1) >= side
            and min(v0, v1) >= side
            and max(u0, u1) < width - 1.0 - side
            and max(v0, v1) < height - 1.0 - side
        ):
            continue
        row[STATE] = NOT_FOUND
        count = back + ahead + 1
        for i in range(count):
            profile[i] = 0.0
        share = 1.0 / lines
        for line in range(lines):
            shift = _LINES_APART_PX * (line - 0.5 * (lines - 1))
            a, b = u0 - shift * ny, v0 + shift * nx
            for i in range(count):
                column, line_row = int(a), int(b)
                fa, fb = a - column, b - line_row
                upper = image[line_row, column] * (1.0 - fa) + image[line_row, column + 1] * fa
                lower = (
                    image[line_row + 1, column] * (1.0 - fa) + image[line_row + 1, column + 1] * fa
                )
                profile[i] += share * (upper + fb * (lower - upper))
                a += nx
                b += ny
        best, at, steepness = 0.0, 0.0, 0.0
        needed = least_outline if dark and kind[j] == OUTLINE else least
        before, here = 0.0, 0.0  # slopes one and two half-pixels ago
        for i in range(smooth_px - 1, count - smooth_px):
            slope = 0.0
            for q in range(smooth_px):
                slope += profile[i + 1 + q] - profile[i - q]
            slope /= smooth_px
            size = abs(here)
            if i > smooth_px and size >= needed and size >= abs(before) and size > abs(slope):
                possible = True
                if dark and kind[j] == OUTLINE:
                    beyond = profile[min(i + 1 + smooth_px, count - 1)]
                    possible = here < 0.0 and beyond < sky + max(3.5 * noise, 0.4 * size)
                place = i - 0.5 - back
                strength = size / (size + _HALF_CONTRAST)
                score = strength * strength * np.exp(-0.5 * (place / spread_px) ** 2)
                if possible and score > best:
                    bend = abs(before) - 2.0 * size + abs(slope)
                    best, at, steepness = score, place, size
                    if bend < 0.0:
                        at += 0.5 * (abs(before) - abs(slope)) / bend
            before, here = here, slope
        if best == 0.0:
            continue
        if fit and dark and kind[j] == OUTLINE:
            fitted = step_place(profile, count, back, at, inner, sky, blur_px)
            if fitted != _NO_PLACE:
                at = fitted
        row[STATE] = FOUND
        row[RESIDUAL] = at
        # A thin body's edges are displaced by what the blur makes of it.
        free = min(inner, outer) if kind[j] == OUTLINE else inner
        sure = steepness * steepness / (steepness * steepness + _EVEN_SLOPE * _EVEN_SLOPE)
        near = np.exp(-0.5 * (at / spread_px) ** 2)
        row[WEIGHT] = sure * near * min(1.0, max(0.01, 0.5 * (free - 1.5)))
        if kind[j] != OUTLINE:
            row[WEIGHT] *= _INNER_WEIGHT
        gx, gy = nx * fx * m00 + ny * fy * m10, nx * fx * m01 + ny * fy * m11
        j0, j1, j2 = gx * inverse, gy * inverse, -(gx * x + gy * y) * inverse
        row[0], row[1], row[2] = j2 * qy - j1 * qz, j0 * qz - j2 * qx, j1 * qx - j0 * qy
        row[3], row[4], row[5] = j0, j1, j2
    for j in range(total, out.shape[0]):
        out[j, WEIGHT], out[j, STATE] = 0.0, OUTSIDE
    return total


@njit(cache=True, nogil=True)
def grain(image: npt.NDArray[np.uint8]) -> float:
    """Noise of a frame (one σ), from second differences along rows on a sparse grid.

    The mean of all but the largest, so that edges and clouds do not count.
    """
    height, width = image.shape
    step = max(1, height // 64)
    counts = np.zeros(512, dtype=np.int64)
    total = 0
    for row in range(step // 2, height, step):
        for column in range(1, width - 1, 7):
            a = int(image[row, column - 1]) - 2 * int(image[row, column])
            counts[min(511, abs(a + int(image[row, column + 1])))] += 1
            total += 1
    if total == 0:
        return 1.0
    seen, mean = 0, 0.0
    for value in range(512):
        take = min(counts[value], total // 2 - seen)
        seen += take
        mean += take * value
        if seen >= total // 2:
            break
    # The mean of the smaller half of |N(0, 1)| is 0.3247; second differences have σ √6.
    return float(mean / max(seen, 1) / (0.3247 * np.sqrt(6.0)))


def camera_vector(camera: object) -> Array:
    """(12,) fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6 of a ``Camera``, for the compiled loops."""
    distortion = (*camera.distortion, *([0.0] * 8))[:8]  # type: ignore[attr-defined]
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy, *distortion])  # type: ignore[attr-defined]
