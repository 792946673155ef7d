"""Where the grey picture has the edges that a pose predicts: the inner loop of refinement.

For every contour point the picture is read along the image normal, as the mean of a few
parallel lines. Candidate edges are the extremes of the smoothed slope that stand out of the
noise; the strong one nearest to the prediction is taken. Against a dark sky the outside must
be sky. In the last stage the edge is placed where the strip of surfaces that the model has
there, as bright as the light makes them, fits the profile: the steepest slope alone lies up to
half a pixel inside a darkening rim and outside a thin boom.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.geometry.lens import distorted
from rendezview.geometry.pose import Array
from rendezview.sensors.appearance.edges.contours import (
    DEPTH_UNIT,
    NO_POINT,
    OUTLINE,
    POINT_UNIT,
    RUN_UNIT,
    SURFACES,
    start_radii,
)
from rendezview.sensors.appearance.edges.profile import (
    across,
    begins_at,
    in_shadow,
    steps_of,
    strip_place,
)

LONGEST_PX = 40  # of the search to either side
# Columns of the measurements: six of the Jacobian of the residual (rotation about the view
# centre, rad, translation, m, camera axes, left), then
RESIDUAL, WEIGHT, STATE, U, V, NX, NY = 6, 7, 8, 9, 10, 11, 12  # N: outwards
COLUMNS = 13
FOUND, NOT_FOUND, OUTSIDE, CROWDED = 1.0, 0.0, -1.0, -2.0  # STATE of a point

_RUN_PER_POINT = RUN_UNIT / POINT_UNIT
_LINES_APART_PX = 1.5
_HALF_CONTRAST = 60.0  # grey levels at which an edge counts half of the strongest (squared)
_SIGMAS = 3.0  # of the smoothed slope: a candidate
_DIM_SLOPE = 4.0  # grey levels a pixel, of the outline before a dark sky
_EVEN_SLOPE = 12.0  # at which noise and what the model does not know err alike
_LEAST_SLOPE = 10.0  # grey levels a pixel; the grain of foil stays below
_INNER_WEIGHT = 0.3  # of creases and steps: two in three of their edges are others
_LEAST_CONTRAST = 4.0  # grey levels; a strip with less has no edge
_FAR_PX = 99.0  # where the first surface of an inner edge begins
_SLACK_PX = 3.0  # more than that no surface is believed to have moved, or four times its place
_SURE_PX2 = 0.08**2  # an edge this sure weighs half
_STRAINED = 0.5  # of the target's radius: how far from its middle edges lie
_UNFITTED_WEIGHT = 0.1  # of an edge that its strip does not fit


class ViewTables(NamedTuple):
    """The sparse views of one model as the compiled loops read them; see ``Contours``."""

    directions: Array
    shells_m: Array
    point: npt.NDArray[np.int16]
    tangent: npt.NDArray[np.int8]
    kind: npt.NDArray[np.uint8]
    run: npt.NDArray[np.uint8]
    strip: npt.NDArray[np.uint8]
    start: npt.NDArray[np.int8]
    palette: npt.NDArray[np.float32]
    radius_m: float
    blur_px: float
    shape_error: float


@njit(cache=True, nogil=True, fastmath=True, forceinline=True)
def measure_edges(  # type: ignore[no-untyped-def]
    image, lens, frame, views, shell, view, rotation, centre, shade, sun, reach_px, spread_px,
    smooth_px, room_px, lines, stride, fit, out,
):  # fmt: skip
    """Look for the edge of every contour point of one view; returns how many points there are.

    Args:
        image: (H, W) uint8.
        lens: (12,) fx fy cx cy and the eight coefficients of distortion, and whether any of
            them is not zero.
        frame: (6,) as in ``Sky.vector``.
        views: ``ViewTables``; ``shell`` and ``view`` say which is seen.
        rotation: (3, 3), and ``centre``: (3,) of the view centre, camera frame.
        shade: (K,) brightness of the kinds of surface, of ``light``; read where ``fit`` is.
        sun: (3,) direction to the Sun, camera frame, or zero.
        reach_px: how far to look to either side.
        spread_px: σ of the preference for near edges.
        smooth_px: width of the two boxes whose difference is the slope.
        room_px: points with another edge nearer than this are left out.
        lines: parallel lines read.
        stride: every so many-th point only.
        fit: place the edge by ``strip_place``.
        out: (N, COLUMNS) measurements.
    """
    height, width = image.shape
    camera, bent = lens
    noise, sky, dark = frame[0], frame[1], frame[2] > 0.0
    point, tangent = views.point[shell, view], views.tangent[shell, view]
    kind, run, strip = views.kind[shell, view], views.run[shell, view], views.strip[shell, view]
    start = views.start[shell, view]
    radius_m, blur_px = views.radius_m, views.blur_px
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    unit_m = radius_m * POINT_UNIT
    profile = np.empty(2 * LONGEST_PX + 32)
    # Bilinear reading takes a quarter off the noise.
    least = max(_SIGMAS * noise * np.sqrt(2.0 / (smooth_px * lines)), _LEAST_SLOPE)
    # Before a dark sky the outside must be sky, which grain on the target is not.
    least_outline = max(_SIGMAS * noise * 0.75 * np.sqrt(2.0 / (smooth_px * lines)), _DIM_SLOPE)
    margin = smooth_px + 2
    places, depths, levels = np.empty(SURFACES), np.empty(SURFACES), np.empty(SURFACES)
    fitted = np.empty(2)
    grainy = 0.75 * noise / np.sqrt(lines)
    # Where the camera was in the model's view; target axes at the view centre.
    drawn_eye = views.directions[view] * views.shells_m[shell]
    sunward = rotation.T @ sun
    drawn, away = np.empty(6), np.empty(3)
    side = 2.0
    total = 0
    for j in range(point.shape[0]):
        if kind[j] == NO_POINT:
            break
        total += 1
        row = out[j]
        row[WEIGHT], row[STATE], row[NX], row[NY] = 0.0, OUTSIDE, 0.0, 0.0
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
            u, v = distorted(x, y, camera)
            u1, v1 = distorted(x + h, y, camera)
            u2, v2 = distorted(x, y + h, camera)
            m00, m10, m01, m11 = (u1 - u) / h, (v1 - v) / h, (u2 - u) / h, (v2 - v) / h
        u, v = fx * u + cx, fy * v + cy
        row[U], row[V] = u, v
        bx, by = fx * (m00 * ax + m01 * ay), fy * (m10 * ax + m11 * ay)
        length = np.sqrt(bx * bx + by * by)
        if length < 1e-9:
            continue
        nx, ny = by / length, -bx / length  # outwards
        row[NX], row[NY] = nx, ny
        gx, gy = nx * fx * m00 + ny * fy * m10, nx * fx * m01 + ny * fy * m11
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
        row[STATE] = FOUND
        free = min(inner, outer) if kind[j] == OUTLINE else inner
        placed = False
        if fit:
            body = radius_m * fx * inverse
            across(drawn_eye, px, py, pz, tangent[j], drawn)
            outline = kind[j] == OUTLINE
            places[0] = 0.0 if outline else -_FAR_PX
            for k in range(1, SURFACES):
                inside = start_radii(start[j, k - 1, 0])
                deeper = start[j, k - 1, 1] * DEPTH_UNIT
                ex, ey = begins_at(
                    px, py, pz, inside * radius_m, deeper * radius_m, drawn_eye, drawn, rotation,
                    centre,
                )  # fmt: skip
                place = -(gx * (ex - x) + gy * (ey - y))
                inside *= body
                far = 3.0 * abs(inside) + _SLACK_PX
                places[k] = min(max(place, inside - far), inside + far)
            shaded = False
            if outline:
                away[0], away[1], away[2] = px - drawn_eye[0], py - drawn_eye[1], pz - drawn_eye[2]
                away /= np.sqrt(away[0] * away[0] + away[1] * away[1] + away[2] * away[2])
                shaded = in_shadow(
                    start_radii(start[j, 0, 0]), -start[j, 0, 1] * DEPTH_UNIT, sunward, drawn, away
                )
            steps = steps_of(outline, strip[j], shade, places, shaded, depths, levels)
            contrast = 0.0
            for step in range(steps):
                contrast = max(contrast, abs(levels[step]))
            if contrast > _LEAST_CONTRAST:
                held = dark and kind[j] == OUTLINE
                background = sky if held else profile[count - 1 - margin]
                placed = strip_place(
                    profile, count, back, at, depths, levels, steps, background, held, blur_px,
                    grainy, fitted,
                )  # fmt: skip
        if placed:
            at = fitted[0]
            # Where the craft may differ from its mesh, edges are equally unsure.
            sure = _SURE_PX2 + (_STRAINED * views.shape_error * body) ** 2
            row[WEIGHT] = sure / (sure + fitted[1])
        else:
            # A thin body's edges are displaced by what the blur makes of it.
            sure = steepness * steepness / (steepness * steepness + _EVEN_SLOPE * _EVEN_SLOPE)
            row[WEIGHT] = sure * min(1.0, max(0.01, 0.5 * (free - 1.5)))
            if kind[j] != OUTLINE:
                row[WEIGHT] *= _INNER_WEIGHT
            if fit:
                row[WEIGHT] *= _UNFITTED_WEIGHT
        row[RESIDUAL] = at
        row[WEIGHT] *= np.exp(-0.5 * (at / spread_px) ** 2)
        j0, j1, j2 = gx * inverse, gy * inverse, -(gx * x + gy * y) * inverse
        row[0], row[1], row[2] = j2 * qy - j1 * qz, j0 * qz - j2 * qx, j1 * qx - j0 * qy
        row[3], row[4], row[5] = j0, j1, j2
    for j in range(total, out.shape[0]):
        out[j, WEIGHT], out[j, STATE] = 0.0, OUTSIDE
    return total
