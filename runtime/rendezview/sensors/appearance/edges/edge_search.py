"""The search for the edges that a pose predicts: the inner loop of refinement.

For every contour point the image is read along the normal of the edge, as the mean of a few
parallel lines. Candidate edges are the extremes of the smoothed slope above the noise; the
strongest near the prediction is taken. Before a dark sky the outside must be sky. In the last
stages the model's edge profile under the fitted light is fitted to the grey levels: the steepest
slope alone lies up to half a pixel inside a darkening rim and outside a thin boom.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from rendezview.geometry.pose import Array
from rendezview.geometry.so3 import rotate_back_into
from rendezview.io.grey_frame import Picture
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
    FAR_PX,
    LEAST_CONTRAST,
    SLACK_PX,
    edge_axes,
    in_shadow,
    profile_steps,
    project_start,
)
from rendezview.sensors.appearance.edges.profile_fit import fit_profile
from rendezview.sensors.appearance.edges.view_tables import (
    Lens,
    Two,
    ViewTables,
    through_lens,
)

LONGEST_PX = 40  # px; longest search to either side. Source: by construction, of the stages
# Columns of the measurements: six of the Jacobian of the residual (rotation about the view
# centre, rad, translation, m, camera axes, left), then these. N is the normal, outwards.
RESIDUAL, WEIGHT, STATE, U, V, NX, NY = 6, 7, 8, 9, 10, 11, 12
COLUMNS = 13  # Source: by construction
FOUND, NOT_FOUND, OUTSIDE, CROWDED = 1.0, 0.0, -1.0, -2.0  # STATE of a point

_RUN_PER_POINT = RUN_UNIT / POINT_UNIT
# m; a point must lie before the camera.
_LEAST_DEPTH_M = 1e-6  # Source: by construction, no division by 0
_BORDER_PX = 2.0  # px; the lines read stay inside the image by this. Source: by construction
_LINES_APART_PX = 1.5  # px. Source: by hand, seeds of docs/notes/refinement.md
# Of a pixel's noise, after bilinear reading. Source: by hand, seeds of docs/notes/refinement.md
_BILINEAR_NOISE = 0.75

# Candidates.
_SIGMAS = 3.0  # of the smoothed slope above its noise. Source: normal distribution, 0.3 %
# grey levels a pixel; the grain of foil stays below. Source: by hand, seeds of
# docs/notes/refinement.md
_LEAST_SLOPE = 10.0
# grey levels a pixel; enough for the outline before a dark sky. Source: by hand, seeds of
# docs/notes/refinement.md
_DIM_SLOPE = 4.0
_SKY_SIGMAS, _SKY_SHARE = 3.5, 0.4  # beyond an outline: noise above the sky, or share of the step
# grey levels a pixel; such an edge scores a quarter of the strongest. Source: by hand, seeds of
# docs/notes/refinement.md
_HALF_CONTRAST = 60.0

# Weights.
# grey levels a pixel; noise and the model's errors displace the edge alike. Source: by hand, seeds
# of docs/notes/refinement.md
_EVEN_SLOPE = 12.0
# Of creases and steps: two in three of their edges are others. Source: by hand, seeds of
# docs/notes/refinement.md
_INNER_WEIGHT = 0.3
# px²; an edge with this variance weighs half. Source: by hand, seeds of docs/notes/refinement.md
_HALF_WEIGHT_PX2 = 0.08**2
# Of the target's radius: distance of the edges from its middle. Source: by hand, seeds of
# docs/notes/refinement.md
_STRAINED = 0.5
# Of an edge whose profile does not fit. Source: by hand, seeds of docs/notes/refinement.md
_UNFITTED_WEIGHT = 0.1


@njit(cache=True, nogil=True, fastmath=True, forceinline=True)
def measure_edges(
    image: Picture, lens: Lens, frame: Array, views: ViewTables, shell: int, view: int,
    rotation: Array, centre: Array, shade: Array, sun: Array, reach_px: int, spread_px: float,
    smooth_px: int, room_px: float, lines: int, stride: int, fit: bool, out: Array,
) -> int:  # fmt: skip
    """Search for the edge of every contour point of one view; returns how many points it has.

    Args:
        image: (H, W) uint8.
        lens: ``lens_vector`` of the camera, and whether it distorts.
        frame: (6,) as in ``Sky.vector``.
        views: tables of the model; ``shell`` and ``view`` name the view.
        rotation: (3, 3), and ``centre``: (3,) of the view centre, camera frame.
        shade: (K,) brightness of each kind of surface, of ``fit_light``; read if ``fit``.
        sun: (3,) direction to the Sun, camera frame, or zero.
        reach_px: how far to search to either side.
        spread_px: σ of the preference for near edges.
        smooth_px: width of the two boxes whose difference is the slope.
        room_px: points with another edge nearer than this are left out.
        lines: parallel lines read.
        stride: every so many-th point only.
        fit: place the edge by its profile.
        out: (N, COLUMNS) measurements.
    """
    noise, sky, dark = frame[0], frame[1], frame[2] > 0.0
    point, tangent = views.point[shell, view], views.tangent[shell, view]
    kind, run = views.kind[shell, view], views.run[shell, view]
    strip, start = views.strip[shell, view], views.start[shell, view]
    camera, radius_m = lens[0], views.radius_m
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    unit_m = radius_m * POINT_UNIT
    profile = np.empty(2 * LONGEST_PX + 32)
    averaged = np.sqrt(2.0 / (smooth_px * lines))
    least = max(_SIGMAS * noise * averaged, _LEAST_SLOPE)
    # Before a dark sky the outside must be sky, so a dimmer edge of the outline is enough.
    least_outline = max(_SIGMAS * noise * _BILINEAR_NOISE * averaged, _DIM_SLOPE)
    margin = smooth_px + 2
    grainy = _BILINEAR_NOISE * noise / np.sqrt(lines)
    eye = views.directions[view] * views.shells_m[shell]  # of the model's view
    sunward = np.empty(3)
    rotate_back_into(rotation, sun, sunward)
    places, depths, levels = np.empty(SURFACES), np.empty(SURFACES), np.empty(SURFACES)
    axes, away, fitted = np.empty(6), np.empty(3), np.empty(2)
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
        if depth <= _LEAST_DEPTH_M:
            continue
        inverse = 1.0 / depth
        x, y = (qx + centre[0]) * inverse, (qy + centre[1]) * inverse
        t0, t1, t2 = tangent[j, 0], tangent[j, 1], tangent[j, 2]
        tz = rotation[2, 0] * t0 + rotation[2, 1] * t1 + rotation[2, 2] * t2
        ax = rotation[0, 0] * t0 + rotation[0, 1] * t1 + rotation[0, 2] * t2 - x * tz
        ay = rotation[1, 0] * t0 + rotation[1, 1] * t1 + rotation[1, 2] * t2 - y * tz
        u, v, m00, m01, m10, m11 = through_lens(x, y, lens)
        u, v = fx * u + cx, fy * v + cy
        row[U], row[V] = u, v
        bx, by = fx * (m00 * ax + m01 * ay), fy * (m10 * ax + m11 * ay)
        length = np.sqrt(bx * bx + by * by)
        if length < 1e-9:  # the edge runs along the line of sight
            continue
        nx, ny = by / length, -bx / length  # outwards
        row[NX], row[NY] = nx, ny
        # Derivatives of a place along the normal with x and y.
        gx, gy = nx * fx * m00 + ny * fy * m10, nx * fx * m01 + ny * fy * m11
        scale = _RUN_PER_POINT * unit_m * fx * inverse
        inner, outer = run[j, 0] * scale, run[j, 1] * scale
        outline = kind[j] == OUTLINE
        if inner < room_px or (outline and outer < room_px):
            row[STATE] = CROWDED
            continue
        back = int(min(reach_px, max(inner, 2.0))) + margin
        ahead = int(min(reach_px, max(outer, 2.0))) + margin
        if not read_profile(image, u, v, nx, ny, back, ahead, lines, profile):
            continue
        row[STATE] = NOT_FOUND
        count = back + ahead + 1
        held = dark and outline
        at, steepness = strongest_edge(
            profile, count, back, smooth_px, spread_px, least_outline if held else least, held,
            sky, noise,
        )  # fmt: skip
        if steepness == 0.0:
            continue
        row[STATE] = FOUND
        placed = False
        if fit:
            body = radius_m * fx * inverse
            edge_axes(eye, px, py, pz, tangent[j], axes)
            places[0] = 0.0 if outline else -FAR_PX
            for k in range(1, SURFACES):
                inside = start_radii(start[j, k - 1, 0])
                deeper = start[j, k - 1, 1] * DEPTH_UNIT
                ex, ey = project_start(
                    px, py, pz, inside * radius_m, deeper * radius_m, eye, axes, rotation, centre
                )
                projected = -(gx * (ex - x) + gy * (ey - y))
                inside *= body
                far = 3.0 * abs(inside) + SLACK_PX
                places[k] = min(max(projected, inside - far), inside + far)
            shaded = False
            if outline:
                away[0], away[1], away[2] = px - eye[0], py - eye[1], pz - eye[2]
                away /= np.sqrt(away[0] * away[0] + away[1] * away[1] + away[2] * away[2])
                shaded = in_shadow(
                    start_radii(start[j, 0, 0]), -start[j, 0, 1] * DEPTH_UNIT, sunward, axes, away
                )
            steps = profile_steps(outline, strip[j], shade, places, shaded, depths, levels)
            contrast = 0.0
            for step in range(steps):
                contrast = max(contrast, abs(levels[step]))
            if contrast > LEAST_CONTRAST:
                background = sky if held else profile[count - 1 - margin]
                placed = fit_profile(
                    profile, count, back, at, depths, levels, steps, background, held,
                    views.blur_px, grainy, fitted,
                )  # fmt: skip
        if placed:
            at = fitted[0]
            # Where the craft may differ from its mesh, all edges are uncertain by as much.
            strain_px = _STRAINED * views.shape_error * body
            half_px2 = _HALF_WEIGHT_PX2 + strain_px**2
            row[WEIGHT] = half_px2 / (half_px2 + fitted[1])
        else:
            free = min(inner, outer) if outline else inner
            row[WEIGHT] = unfitted_weight(steepness, free, outline, fit)
        row[RESIDUAL] = at
        row[WEIGHT] *= np.exp(-0.5 * (at / spread_px) ** 2)
        j0, j1, j2 = gx * inverse, gy * inverse, -(gx * x + gy * y) * inverse
        row[0], row[1], row[2] = j2 * qy - j1 * qz, j0 * qz - j2 * qx, j1 * qx - j0 * qy
        row[3], row[4], row[5] = j0, j1, j2
    for j in range(total, out.shape[0]):
        out[j, WEIGHT], out[j, STATE] = 0.0, OUTSIDE
    return total


@njit(cache=True, nogil=True, fastmath=True, forceinline=True)
def read_profile(
    image: Picture, u: float, v: float, nx: float, ny: float, back: int, ahead: int, lines: int,
    profile: Array,
) -> bool:  # fmt: skip
    """Grey levels from ``back`` pixels inside an edge to ``ahead`` outside, bilinear.

    The mean of parallel lines; False where they leave the image. ``profile`` gets the levels.
    """
    height, width = image.shape
    u0, v0 = u - back * nx, v - back * ny
    u1, v1 = u + ahead * nx, v + ahead * ny
    if not (
        min(u0, u1) >= _BORDER_PX
        and min(v0, v1) >= _BORDER_PX
        and max(u0, u1) < width - 1.0 - _BORDER_PX
        and max(v0, v1) < height - 1.0 - _BORDER_PX
    ):
        return False
    count = back + ahead + 1
    for i in range(count):
        profile[i] = 0.0
    share = 1.0 / lines
    for line in range(lines):
        shift = _LINES_APART_PX * (line - 0.5 * (lines - 1))
        a, b = u0 - shift * ny, v0 + shift * nx
        for i in range(count):
            column, row = int(a), int(b)
            fa, fb = a - column, b - row
            upper = image[row, column] * (1.0 - fa) + image[row, column + 1] * fa
            lower = image[row + 1, column] * (1.0 - fa) + image[row + 1, column + 1] * fa
            profile[i] += share * (upper + fb * (lower - upper))
            a += nx
            b += ny
    return True


@njit(cache=True, nogil=True, fastmath=True, forceinline=True)
def strongest_edge(
    profile: Array, count: int, back: int, smooth_px: int, spread_px: float, needed: float,
    held: bool, sky: float, noise: float,
) -> Two:  # fmt: skip
    """The extreme of the smoothed slope with the best score, which falls with its distance.

    Args:
        profile: (≥ count,) grey levels, from inside to outside; ``back`` is at place 0.
        smooth_px, spread_px: as of ``measure_edges``.
        needed: least slope, grey levels a pixel.
        held: the outside must be sky, of level ``sky``.

    Returns:
        Place, px outwards, by the parabola through three slopes, and the slope; 0 for none.
    """
    best, at, steepness = 0.0, 0.0, 0.0
    before, here = 0.0, 0.0  # slopes two steps and one step ago
    for i in range(smooth_px - 1, count - smooth_px):
        slope = 0.0
        for q in range(smooth_px):
            slope += profile[i + 1 + q] - profile[i - q]
        slope /= smooth_px
        size = abs(here)
        if i > smooth_px and size >= needed and size >= abs(before) and size > abs(slope):
            possible = True
            if held:
                beyond = profile[min(i + 1 + smooth_px, count - 1)]
                possible = here < 0.0 and beyond < sky + max(_SKY_SIGMAS * noise, _SKY_SHARE * size)
            place = i - 0.5 - back
            strength = size / (size + _HALF_CONTRAST)
            score = strength * strength * np.exp(-0.5 * (place / spread_px) ** 2)
            if possible and score > best:
                bend = abs(before) - 2.0 * size + abs(slope)
                best, at, steepness = score, place, size
                if bend < 0.0:
                    at += 0.5 * (abs(before) - abs(slope)) / bend
        before, here = here, slope
    return at, steepness


@njit(cache=True, nogil=True, fastmath=True, forceinline=True)
def unfitted_weight(steepness: float, free: float, outline: bool, fit: bool) -> float:
    """Weight of an edge at the steepest slope; ``free``: px to the next edge.

    The edges of a thin body are displaced by the blur.
    """
    weight = steepness * steepness / (steepness * steepness + _EVEN_SLOPE * _EVEN_SLOPE)
    weight *= min(1.0, max(0.01, 0.5 * (free - 1.5)))
    if not outline:
        weight *= _INNER_WEIGHT
    if fit:
        weight *= _UNFITTED_WEIGHT
    return weight


@njit(cache=True, nogil=True)
def point_of_slope(edge: Array, rotation: Array, centre_m: Array, q: Array, g: Array) -> None:
    """Fill q (3,), the point of an edge from the view centre, and g (3,), its slope, target axes.

    A pose slope is (x × j, j) for a point x, and j · (x + centre) = 0 as for every projection: so
    the point follows from it.
    """
    x, d = edge[:3], edge[3:6]
    along = -(d[0] * centre_m[0] + d[1] * centre_m[1] + d[2] * centre_m[2])
    square = max(d[0] * d[0] + d[1] * d[1] + d[2] * d[2], 1e-30)
    x0 = (d[1] * x[2] - d[2] * x[1] + d[0] * along) / square
    x1 = (d[2] * x[0] - d[0] * x[2] + d[1] * along) / square
    x2 = (d[0] * x[1] - d[1] * x[0] + d[2] * along) / square
    for i in range(3):
        q[i] = rotation[0, i] * x0 + rotation[1, i] * x1 + rotation[2, i] * x2
        g[i] = rotation[0, i] * d[0] + rotation[1, i] * d[1] + rotation[2, i] * d[2]


@njit(cache=True, nogil=True)
def points_of_slopes(slopes: Array, rotation: Array, centre_m: Array) -> Array:
    """(N, 3) the points of N slopes, see ``point_of_slope``."""
    points, g = np.empty((len(slopes), 3)), np.empty(3)
    for n in range(len(slopes)):
        point_of_slope(slopes[n], rotation, centre_m, points[n], g)
    return points
