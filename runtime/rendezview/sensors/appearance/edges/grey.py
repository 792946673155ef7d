"""The search for the edges that a pose predicts: the inner loop of refinement.

For every contour point the image is read along the normal of the edge, as the mean of a few
parallel lines. Candidate edges are the extremes of the smoothed slope above the noise; the
strongest near the prediction is taken. Before a dark sky the outside must be sky. In the last
stages the model's edge profile under the fitted light is fitted to the grey levels: the steepest
slope alone lies up to half a pixel inside a darkening rim and outside a thin boom.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from rendezview.geometry.pose import Array
from rendezview.io.grey_frame import WHITE_GREY, Picture
from rendezview.sensors.appearance.edges.predicted import (
    CROWDED,
    FOUND,
    NOT_FOUND,
    OUTSIDE,
    RESIDUAL,
    STATE,
    WEIGHT,
    edge_of_row,
    point_count,
    predict_edges,
)
from rendezview.sensors.appearance.edges.profile import (
    ProfileScratch,
    expected_profile,
    profile_scratch,
    view_at_pose,
)
from rendezview.sensors.appearance.edges.profile_fit import (
    Flags,
    fit_clipped_profile,
    fit_profile,
)
from rendezview.sensors.appearance.edges.profile_levels import mark_clipped, read_profile
from rendezview.sensors.appearance.model.contours import OUTLINE, POINT_UNIT, RUN_UNIT
from rendezview.sensors.appearance.model.view_tables import (
    Lens,
    ProjectedEdge,
    Two,
    ViewTables,
)

LONGEST_PX = 40  # px; longest search to either side. Source: by construction, of the stages
_MARGIN_PX = 2  # px; read beyond the reach and the slope. Source: by construction
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
# σ of the blur: the steepest slope before a white surface lies outside of its edge by about that.
# Source: normal distribution, a surface of 1 to 6 times white, log-even: 0.7
_WHITE_SIGMAS = 0.7
_BESIDE_PX = 2  # px; the surface beside an edge is read there. Source: by construction, as its blur


class EdgeLimits(NamedTuple):
    """What the noise of a frame and the width of the slopes leave of an edge."""

    noise: float  # of a pixel, one σ, grey levels
    sky: float  # its grey level
    dark: bool  # whether the sky is
    slope: float  # least of an edge, grey levels a pixel
    outline_slope: float  # least of the outline before a dark sky
    profile_noise: float  # of a grey level of a profile, one σ


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def _edge_limits(frame: Array, smooth_px: int, lines: int) -> EdgeLimits:
    """Limits in a frame, (6,) as in ``Sky.vector``; the others as of ``measure_edges``."""
    noise = frame[0]
    averaged = np.sqrt(2.0 / (smooth_px * lines))
    # Before a dark sky the outside must be sky, so a dimmer edge of the outline is enough.
    return EdgeLimits(
        noise,
        frame[1],
        frame[2] > 0.0,
        max(_SIGMAS * noise * averaged, _LEAST_SLOPE),
        max(_SIGMAS * noise * _BILINEAR_NOISE * averaged, _DIM_SLOPE),
        _BILINEAR_NOISE * noise / np.sqrt(lines),
    )


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def measure_edges(
    image: Picture, lens: Lens, frame: Array, views: ViewTables, shell: int, view: int,
    rotation: Array, centre: Array, shade: Array, sun: Array, reach_px: int, spread_px: float,
    smooth_px: int, room_px: float, lines: int, stride: int, fit: bool, out: Array,
) -> int:  # fmt: skip
    """Search for the edge of every contour point of one view; returns how many points it has.

    Args:
        image: (H, W) uint8; ``lens``: ``lens_vector`` of the camera, and whether it distorts.
        frame: (6,) as in ``Sky.vector``; ``shell`` and ``view``: of the tables ``views``.
        rotation: (3, 3), and ``centre``: (3,) of the view centre, camera frame.
        shade: (K,) of ``fit_light``, read if ``fit``; sun: (3,) to the Sun, camera frame, or 0.
        reach_px: how far to search to either side; spread_px: σ of the preference for near edges.
        smooth_px: width of the two boxes whose difference is the slope.
        room_px: points with another edge nearer than this are left out.
        lines: parallel lines read; stride: every so many-th point only.
        fit: place the edge by its profile; out: (N, COLUMNS) measurements.
    """
    point, kind = views.point[shell, view], views.kind[shell, view]
    tangent, run = views.tangent[shell, view], views.run[shell, view]
    strip, start = views.strip[shell, view], views.start[shell, view]
    unit_m, radius_px_m = views.radius_m * POINT_UNIT, views.radius_m * lens[0][0]
    limits = _edge_limits(frame, smooth_px, lines)
    eye = views.directions[view] * views.shells_m[shell]
    at_pose = view_at_pose(eye, views.radius_m, rotation, centre, sun, shade)
    scratch, fitted = profile_scratch(), np.empty(2)
    profile, total = np.empty(2 * LONGEST_PX + 32), point_count(kind)
    clipped = np.zeros(len(profile), dtype=np.bool_)
    out[:, WEIGHT], out[:, STATE] = 0.0, OUTSIDE
    predict_edges(point, tangent, total, stride, lens, unit_m, rotation, centre, out)
    for j in range(0, total, stride):
        row = out[j]
        if row[STATE] == OUTSIDE:
            continue
        px, py, pz = point[j, 0] * unit_m, point[j, 1] * unit_m, point[j, 2] * unit_m
        edge = edge_of_row(row, px, py, pz, rotation, centre)
        outline, body_px = kind[j] == OUTLINE, radius_px_m * edge.inverse
        inner, outer = run[j, 0] * RUN_UNIT * body_px, run[j, 1] * RUN_UNIT * body_px
        state, at, steepness, back, count = _search_edge(
            image, edge, outline, inner, outer, limits, reach_px, spread_px, smooth_px, room_px,
            lines, profile,
        )  # fmt: skip
        row[STATE] = state
        if state != FOUND:
            continue
        steps, white = 0, False
        if fit:
            white = mark_clipped(image, edge, back, at, count, lines, profile, clipped)
            steps = expected_profile(
                px, py, pz, tangent[j], edge, outline, strip[j], start[j], body_px, at_pose, scratch
            )
        free = min(inner, outer) if outline else inner
        place, weight = _place_edge(
            profile, clipped, white, count, back, at, steepness, steps, outline, free, fit, limits,
            smooth_px, views.blur_px, views.shape_error * body_px, scratch, fitted,
        )  # fmt: skip
        row[RESIDUAL], row[WEIGHT] = place, weight * np.exp(-0.5 * (place / spread_px) ** 2)
    return total


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def _search_edge(
    image: Picture, edge: ProjectedEdge, outline: bool, inner: float, outer: float,
    limits: EdgeLimits, reach_px: int, spread_px: float, smooth_px: int, room_px: float, lines: int,
    profile: Array,
) -> tuple[float, float, float, int, int]:  # fmt: skip
    """The steepest slope along the normal of one edge.

    Args:
        inner, outer: pixels to the next edge inwards and outwards.
        reach_px, spread_px, smooth_px, room_px, lines: as of ``measure_edges``.
        profile: gets the grey levels.

    Returns:
        The edge's state, the place of the slope, pixels outwards, the slope, the pixels of the
        profile inside the edge, and all of its pixels.
    """
    if inner < room_px or (outline and outer < room_px):
        return CROWDED, 0.0, 0.0, 0, 0
    margin = smooth_px + _MARGIN_PX
    back = int(min(reach_px, max(inner, 2.0))) + margin
    ahead = int(min(reach_px, max(outer, 2.0))) + margin
    if not read_profile(image, edge.u, edge.v, edge.nx, edge.ny, back, ahead, lines, profile):
        return OUTSIDE, 0.0, 0.0, 0, 0
    count = back + ahead + 1
    held = limits.dark and outline
    at, steepness = strongest_edge(
        profile, count, back, smooth_px, spread_px, limits.outline_slope if held else limits.slope,
        held, limits.sky, limits.noise,
    )  # fmt: skip
    return FOUND if steepness > 0.0 else NOT_FOUND, at, steepness, back, count


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def _place_edge(
    profile: Array, clipped: Flags, white: bool, count: int, back: int, at: float, steepness: float,
    steps: int, outline: bool, free_px: float, fit: bool, limits: EdgeLimits, smooth_px: int,
    blur_px: float, shape_px: float, scratch: ProfileScratch, fitted: Array,
) -> Two:  # fmt: skip
    """Place of an edge, pixels outwards, and its weight.

    Args:
        profile, count, back, at, steepness: of ``_search_edge``.
        clipped, white: of ``mark_clipped``.
        steps: of the profile that the model expects, in ``scratch``; with 0 the steepest slope
            is the place.
        free_px: to the next edge.
        shape_px: one σ of the mesh's error at the target's radius.
        fitted: (2,) scratch.
    """
    if steps > 0:
        held = limits.dark and outline
        background = limits.sky if held else profile[count - 1 - smooth_px - _MARGIN_PX]
        if white:
            fits = fit_clipped_profile(
                profile, clipped, count, back, at, scratch.depths, scratch.levels, steps,
                background, held, blur_px, limits.profile_noise, fitted,
            )  # fmt: skip
        else:
            fits = fit_profile(
                profile, count, back, at, scratch.depths, scratch.levels, steps, background, held,
                blur_px, limits.profile_noise, fitted,
            )  # fmt: skip
        if fits:
            # Where the craft may differ from its mesh, all edges are uncertain by as much.
            half_px2 = _HALF_WEIGHT_PX2 + (_STRAINED * shape_px) ** 2
            return fitted[0], half_px2 / (half_px2 + fitted[1])
    at = off_white(profile, count, back, at, blur_px)
    return at, unfitted_weight(steepness, free_px, outline, fit)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def off_white(profile: Array, count: int, back: int, at: float, blur_px: float) -> float:
    """Place of an edge whose steepest slope is ``at``: that of a white surface lies outside it."""
    here = int(np.rint(at)) + back
    inside = profile[max(here - _BESIDE_PX, 0)] >= WHITE_GREY
    outside = profile[min(here + _BESIDE_PX, count - 1)] >= WHITE_GREY
    if inside == outside:
        return at
    return at - _WHITE_SIGMAS * blur_px if inside else at + _WHITE_SIGMAS * blur_px


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
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


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
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


@njit(cache=True, nogil=True, error_model="numpy")
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


@njit(cache=True, nogil=True, error_model="numpy")
def points_of_slopes(slopes: Array, rotation: Array, centre_m: Array) -> Array:
    """(N, 3) the points of N slopes, see ``point_of_slope``."""
    points, g = np.empty((len(slopes), 3)), np.empty(3)
    for n in range(len(slopes)):
        point_of_slope(slopes[n], rotation, centre_m, points[n], g)
    return points
