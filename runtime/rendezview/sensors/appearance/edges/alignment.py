"""Gauss–Newton of a pose on the edges of a grey frame: the compiled loops."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.estimation.linear_algebra import solve_scaled
from rendezview.geometry.pose import Array
from rendezview.geometry.so3 import orthonormalise, perturb_into
from rendezview.io.grey_frame import Picture
from rendezview.sensors.appearance.edges.grey import measure_edges
from rendezview.sensors.appearance.edges.lighting import fit_light
from rendezview.sensors.appearance.edges.predicted import (
    COLUMNS,
    FOUND,
    OUTSIDE,
    RESIDUAL,
    STATE,
    WEIGHT,
)
from rendezview.sensors.appearance.hypothesis import inlier_ratio
from rendezview.sensors.appearance.model.contours import NO_POINT, OUTLINE
from rendezview.sensors.appearance.model.view_tables import Lens, ViewTables


class Stage(NamedTuple):
    """One stage of the search for a pose, from coarse to fine; a row of numbers for ``align``."""

    reach_px: float  # how far edges are looked for
    spread_px: float  # σ of the preference for near edges
    steps: float  # at most
    smooth_px: float = 1.0
    room_px: float = 0.0  # points with another edge nearer than this are left out
    lines: float = 1.0  # parallel lines read
    stride: float = 1.0  # every so many-th point only
    fit: float = 0.0  # 1: edges are placed by their profiles
    views: float = 1.0  # nearest ones whose points are looked for
    damping: float = 1e-3  # of the normal equations: unobservable components stay as they were
    relaxation: float = 1.0  # of a step: weights that fall with the residual make it too short
    stop_px: float = 0.1  # a shorter step is the last; on a small target it is shorter still


# Its columns, in the same order.
(
    REACH, SPREAD, STEPS, SMOOTH, ROOM, LINES, STRIDE, FIT, VIEWS, DAMPING, RELAXATION, STOP,
) = range(len(Stage._fields))  # fmt: skip

CLOSE_PX = 1.5  # px; spread of a refined pose's inliers … Source: fixed with error_model.json
LOOSE_PX = 2.0 * CLOSE_PX  # px; … and of a roughly aligned one's. Source: by construction
_LOOSE_STRIDE = 2  # one point in two is enough to judge that. Source: by construction
AGREEING = 0.53  # of the spread: it counts exp(−½). Source: fixed with error_model.json
# Source: experiment pose-accuracy: one of 200 right poses lies below (commit b583915)
_LEAST_RATIO = 0.65  # of the best loose ratio; poses below are dropped
CUT_SPREADS = 2.5  # spreads; no residual beyond counts. Source: by hand, docs/notes/refinement.md
_LEAST_EDGES = 12  # found, for six unknowns: twice as many. Source: by construction
_LONGEST_TURN_RAD = 0.2  # rad, of one step. Source: by construction, linear to 2 %
_ALONG = 0.1  # of a move in depth, which shows so much less. Source: by construction
_SMALL = 0.01  # of the target's radius, px: a smaller one stops earlier. Source: by construction
NEAREST_RADII = 1.02  # of the target's radius: nearer has diverged. Source: by construction
_NEAREST_SHELL = 0.8  # of the nearest distance of views that show a part. Source: by construction
_FURTHEST_RADII = 1e9  # of the target's radius: farther too. Source: by construction
DIVERGED = -9.0  # returned by ``align`` for no pose. Source: by construction


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def nearest_views(
    directions: Array, shells_m: Array, rotation: Array, centre: Array,
    views: npt.NDArray[np.int64],
) -> int:  # fmt: skip
    """The shell nearest to a pose; ``views`` gets its views nearest to the pose."""
    distance = np.sqrt(centre[0] ** 2 + centre[1] ** 2 + centre[2] ** 2)
    x = -(rotation[0, 0] * centre[0] + rotation[1, 0] * centre[1] + rotation[2, 0] * centre[2])
    y = -(rotation[0, 1] * centre[0] + rotation[1, 1] * centre[1] + rotation[2, 1] * centre[2])
    z = -(rotation[0, 2] * centre[0] + rotation[1, 2] * centre[1] + rotation[2, 2] * centre[2])
    last = len(views) - 1
    most = np.empty(len(views))
    most[:] = -2.0 * distance
    for i in range(directions.shape[0]):
        along = directions[i, 0] * x + directions[i, 1] * y + directions[i, 2] * z
        if along > most[last]:
            k = last
            while k > 0 and along > most[k - 1]:
                most[k], views[k] = most[k - 1], views[k - 1]
                k -= 1
            most[k], views[k] = along, i
    # Perspective goes with the inverse of the distance.
    shell, least = 0, 1.0 / distance + 1.0 / shells_m[0]
    for i in range(shells_m.shape[0]):
        apart = abs(1.0 / shells_m[i] - 1.0 / distance)
        if apart < least:
            shell, least = i, apart
    return shell


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def normal_equations(edges: Array, cut: float, matrix: Array, right: Array) -> tuple[int, float]:
    """Sums of w J Jᵀ and w J r over the edges with |r| < cut; how many, and the sum of w."""
    matrix[:] = 0.0
    right[:] = 0.0
    used, weights = 0, 0.0
    for j in range(edges.shape[0]):
        if edges[j, STATE] != FOUND:
            continue
        r = edges[j, RESIDUAL]
        q = r / cut
        if q * q >= 1.0:
            continue
        w = edges[j, WEIGHT] * (1.0 - q * q) ** 2
        used += 1
        weights += w
        for a in range(6):
            wj = w * edges[j, a]
            right[a] += wj * r
            for b in range(a + 1):
                matrix[a, b] += wj * edges[j, b]
    for a in range(6):
        for b in range(a):
            matrix[b, a] = matrix[a, b]
    return used, weights


@njit(cache=True, nogil=True, error_model="numpy")
def nearest_distance(views: ViewTables) -> float:
    """Least depth of the view centre, m: just outside the target, or inside its nearest view."""
    outside = NEAREST_RADII * views.radius_m
    return min(outside, _NEAREST_SHELL * views.shells_m[0])  # type: ignore[no-any-return]


@njit(cache=True, nogil=True, error_model="numpy")
def align(
    image: Picture, lens: Lens, frame: Array, stages: Array, views: ViewTables, rotation: Array,
    centre: Array, edges: Array,
) -> float:  # fmt: skip
    """Move a pose (in place) onto the edges.

    Args:
        lens: ``lens_vector`` of the camera, and whether it distorts.
        frame: (6,) as in ``Sky.vector``.
        stages: (K, 12) from coarse to fine, rows of ``Stage``.
        rotation: (3, 3), and ``centre``: (3,) of the view centre, camera frame.
        edges: (M, COLUMNS) scratch, a row for every point of the views of any stage; holds the
            last measurements afterwards.

    Returns:
        How well one light explains the frame, see ``fit_light``, 0 where that was not asked;
        ``DIVERGED`` where too few edges are found or the pose runs away.
    """
    shade = np.zeros(views.palette.shape[0])
    radius_m = views.radius_m
    sun = np.zeros(3)
    explained = 0.0
    points = views.point.shape[2]
    shell, view, count = 0, 0, int(np.int64(0))
    for stage in stages:
        fit = stage[FIT] > 0.0
        nearest = np.zeros(int(stage[VIEWS]), dtype=np.int64)
        edges[len(nearest) * points :, STATE] = OUTSIDE
        if fit:
            explained = fit_light(
                image, edges, count, views.kind[shell, view], views.strip[shell, view],
                views.start[shell, view], views.palette, rotation, centre,
                lens[0][0] * radius_m / centre[2], frame, sun, shade,
            )  # fmt: skip
        for _ in range(int(stage[STEPS])):
            shell = nearest_views(views.directions, views.shells_m, rotation, centre, nearest)
            view = nearest[0]
            for k in range(len(nearest) - 1, -1, -1):  # the nearest last: its count is kept
                rows = edges[k * points : (k + 1) * points]
                count = measure_edges(
                    image, lens, frame, views, shell, nearest[k], rotation, centre, shade, sun,
                    int(stage[REACH]), stage[SPREAD], int(stage[SMOOTH]), stage[ROOM],
                    int(stage[LINES]), int(stage[STRIDE]), fit, rows,
                )  # fmt: skip
            scale = lens[0][0] / centre[2]  # pixels a metre
            moved_px = take_step(
                edges, CUT_SPREADS * stage[SPREAD], stage[DAMPING], stage[RELAXATION], lens, views,
                rotation, centre,
            )  # fmt: skip
            if moved_px < 0.0:
                return DIVERGED
            # The last step is small in pixels, and beside a target that is small itself.
            if moved_px < stage[STOP] * min(1.0, _SMALL * scale * radius_m):
                break
    orthonormalise(rotation)
    return explained


@njit(cache=True, nogil=True, error_model="numpy")
def take_step(
    edges: Array, cut: float, damping: float, relaxation: float, lens: Lens, views: ViewTables,
    rotation: Array, centre: Array,
) -> float:  # fmt: skip
    """Move a pose in place by one damped step onto the edges last measured, of any source.

    Args:
        edges: (N, COLUMNS); residuals beyond ``cut`` do not count.
        damping: share of the information, held; rotations count at the target's radius.
        relaxation: of the step.
        lens: of the picture of the edges.
        rotation: (3, 3), and ``centre``: (3,) of the view centre, camera frame.

    Returns:
        Pixels that the target's points move, about; −1 where too few edges are found, they give no
        step, or the view centre comes too near or too far.
    """
    matrix, right = np.empty((6, 6)), np.empty(6)
    used, weights = normal_equations(edges, cut, matrix, right)
    if used < _LEAST_EDGES:
        return -1.0
    scale, radius_m = lens[0][0] / centre[2], views.radius_m  # pixels a metre
    held = damping * weights * scale * scale
    for a in range(3):
        matrix[a, a] += held * radius_m * radius_m
        matrix[3 + a, 3 + a] += held
    step, lower, turned = np.empty(6), np.empty((6, 6)), np.empty((3, 3))
    if not solve_scaled(matrix, right, lower, step):
        return -1.0
    for a in range(6):
        step[a] *= relaxation
    turn = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
    shift = np.sqrt(step[3] ** 2 + step[4] ** 2 + (_ALONG * step[5]) ** 2)
    share = min(1.0, _LONGEST_TURN_RAD / (turn + 1e-12))
    for a in range(6):
        step[a] *= share
    perturb_into(step, rotation, turned)
    for a in range(3):
        centre[a] += step[3 + a]
        for b in range(3):
            rotation[a, b] = turned[a, b]
    if not (centre[2] > nearest_distance(views) and centre[2] < _FURTHEST_RADII * radius_m):
        return -1.0
    return scale * (turn * radius_m + shift)  # type: ignore[no-any-return]


@njit(cache=True, nogil=True, error_model="numpy")
def inlier_ratios(
    image: Picture, lens: Lens, frame: Array, views: ViewTables, rotation: Array, centre: Array,
    spread_px: float, stride: int, edges: Array,
) -> tuple[float, float, float]:  # fmt: skip
    """How well a pose explains the frame: shares of the outline and of inner edges, and visible.

    An edge within half the spread of its place counts nearly whole; every ``stride``-th point is
    looked at. ``visible`` is the share of the outline's points that lie in the picture.
    """
    nearest = np.zeros(1, dtype=np.int64)
    shell = nearest_views(views.directions, views.shells_m, rotation, centre, nearest)
    view = nearest[0]
    kinds = views.kind[shell, view]
    one = int(np.int64(1))  # as a literal, numba would compile a copy of what is called for it
    count = measure_edges(
        image, lens, frame, views, shell, view, rotation, centre, np.zeros(1), np.zeros(3),
        int(np.ceil(2.5 * spread_px)), spread_px, one, 0.0, one, stride, bool(one == 0), edges,
    )  # fmt: skip
    outline, inner = 0.0, 0.0
    outlines, inners, visible = 1e-9, 1e-9, 0.0
    for j in range(0, count, stride):
        agrees = 0.0
        if edges[j, STATE] == FOUND:
            agrees = np.exp(-0.5 * (edges[j, RESIDUAL] / (AGREEING * spread_px)) ** 2)
        if kinds[j] == OUTLINE:
            outlines += 1.0
            outline += agrees
            visible += edges[j, STATE] >= 0.0
        elif kinds[j] != NO_POINT:
            inners += 1.0
            inner += agrees
    return outline / outlines, inner / inners, visible / outlines


def align_each(
    image: Picture, lens: Lens, frame: Array, first: Array, then: Array, views: ViewTables,
    rotations: Array, centres: Array, survivors: int, ratios: Array,
) -> None:  # fmt: skip
    """``align`` and ``inlier_ratios`` of K hypotheses, in place.

    All go through the stages ``first``; the ``survivors`` with the best loose inlier ratio, go
    on through ``then``, but for those far below the best. ``ratios`` is (K, 3), 0 for the others
    and the lost.

    Not compiled: its calls cost 0.1 ms a frame, and a copy of ``align`` to compile seconds.
    """
    edges = np.zeros((views.point.shape[2], COLUMNS))
    rough = np.zeros(len(rotations))
    ratios[:] = 0.0
    for k, (rotation, centre) in enumerate(zip(rotations, centres, strict=True)):
        if align(image, lens, frame, first, views, rotation, centre, edges) != DIVERGED:
            outline, inner, _ = inlier_ratios(
                image, lens, frame, views, rotation, centre, LOOSE_PX, _LOOSE_STRIDE, edges
            )
            rough[k] = inlier_ratio(outline, inner)
    least = _LEAST_RATIO * rough.max(initial=0.0)
    for k in np.argsort(-rough, kind="stable")[:survivors]:
        if rough[k] < least or rough[k] <= 0.0:
            break
        pose = rotations[k], centres[k]
        if align(image, lens, frame, then, views, *pose, edges) != DIVERGED:
            ratios[k] = inlier_ratios(image, lens, frame, views, *pose, CLOSE_PX, 1, edges)
