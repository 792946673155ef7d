"""Gauss–Newton of a pose on a sketch: the compiled loops.

The contour points of the nearest view of the model are looked for in the sketch's maps of edges and
creases along their normals, as ``edges/alignment.py`` does it in the grey frame. All lengths are
sketch pixels, so they are shares of the target's size whatever its size in the frame.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.geometry.pose import Array
from rendezview.geometry.so3 import orthonormalise
from rendezview.sensors.appearance.edges.alignment import (
    CUT_SPREADS,
    Stage,
    nearest_views,
    take_step,
)
from rendezview.sensors.appearance.edges.measured import MeasuredEdges, nothing_known
from rendezview.sensors.appearance.edges.predicted import (
    COLUMNS,
    FOUND,
    NX,
    NY,
    OUTSIDE,
    RESIDUAL,
    STATE,
    WEIGHT,
    U,
    V,
    point_count,
    predict_edges,
)
from rendezview.sensors.appearance.model.contours import CREASE, OUTLINE, POINT_UNIT
from rendezview.sensors.appearance.model.view_tables import Lens, ViewTables

Float32s = npt.NDArray[np.float32]


class Maps(NamedTuple):
    """The maps of one sketch that poses are aligned to."""

    cover: Float32s  # (h, w)
    edge: Float32s  # (h, w) smoothed
    crease: Float32s  # (h, w) smoothed; half of the edges are in it


_LEAST_PROBABILITY = 0.08  # of an edge, to be a candidate. Source: experiment photo-accuracy
# Source: experiment photo-accuracy
_STEP_PX = 3.0  # sketch px to either side of an outline, where the cover is read
# Source: experiment photo-accuracy
_LEAST_CONTRAST = 0.15  # of the cover, added: where the cover is wrong an edge still counts
# Source: a tenth of an edge's error, by construction
_STOP_PX = 0.05  # sketch px; a shorter step is the last
_HELD = float(Stage._field_defaults["damping"])  # share of the information
# Source: experiment photo-accuracy
_LEAST_SIGMA_PX = 0.3  # sketch px; one σ of an edge in the best of cases


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def lies_in(plane: Float32s, x: float, y: float) -> bool:
    """Whether a map can be read there."""
    height, width = plane.shape
    return x >= 0.0 and y >= 0.0 and x < width - 1.0 and y < height - 1.0


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def read_map(plane: Float32s, x: float, y: float) -> float:
    """The map at a place, bilinear; −1 outside."""
    if not lies_in(plane, x, y):
        return -1.0
    i, j = int(y), int(x)
    fy, fx = y - i, x - j
    upper = plane[i, j] * (1.0 - fx) + plane[i, j + 1] * fx
    lower = plane[i + 1, j] * (1.0 - fx) + plane[i + 1, j + 1] * fx
    return upper * (1.0 - fy) + lower * fy  # type: ignore[no-any-return]


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def read_line(
    plane: Float32s, x: float, y: float, nx: float, ny: float, reach_px: int, line: Float32s
) -> None:
    """The map at a place and at so many steps (nx, ny) to either side, bilinear; −1 outside.

    ``line`` is (2 reach + 1,). Where both ends lie inside, the loop has no branches, and the
    compiler makes vectors of it: most of alignment is spent here.
    """
    height, width = plane.shape
    x0, y0, x1, y1 = x - reach_px * nx, y - reach_px * ny, x + reach_px * nx, y + reach_px * ny
    if not (
        min(x0, x1) >= 0.0 and min(y0, y1) >= 0.0
        and max(x0, x1) < width - 1.5 and max(y0, y1) < height - 1.5
    ):  # fmt: skip
        for k in range(2 * reach_px + 1):
            line[k] = read_map(plane, x0 + k * nx, y0 + k * ny)
        return
    values, below = plane.reshape(-1), np.uint64(width)
    left, top = np.float32(x0), np.float32(y0)
    step_x, step_y = np.float32(nx), np.float32(ny)
    for k in range(2 * reach_px + 1):
        u, v = left + np.float32(k) * step_x, top + np.float32(k) * step_y
        column, row = np.int32(u), np.int32(v)
        fx, fy = u - np.float32(column), v - np.float32(row)
        at = np.uint64(np.int64(row) * width + np.int64(column))  # no check for negative ones
        upper = values[at] + fx * (values[at + np.uint64(1)] - values[at])
        at += below
        lower = values[at] + fx * (values[at + np.uint64(1)] - values[at])
        line[k] = upper + fy * (lower - upper)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def likeliest_edge(
    line: Float32s, cover: Float32s, row: Array, reach_px: int, spread_px: float, outline: bool
) -> tuple[float, float]:
    """Place along the normal and score of the likeliest edge near a predicted one; score 0: none.

    The edge of an outline must have the target inside and the sky outside. ``line`` is the map
    along the normal, (2 reach + 3,), of ``read_line``.
    """
    u, v, nx, ny = row[U], row[V], row[NX], row[NY]
    best, at = 0.0, 0.0
    for k in range(1, 2 * reach_px + 2):
        here = float(line[k])
        if not (here > _LEAST_PROBABILITY and here >= line[k - 1] and here > line[k + 1]):
            continue
        before, after = float(line[k - 1]), float(line[k + 1])
        if before < 0.0 or after < 0.0:
            continue
        bend = before - 2.0 * here + after
        place = k - reach_px - 1 + (0.5 * (before - after) / bend if bend < 0.0 else 0.0)
        score = here * np.exp(-0.5 * (place / spread_px) ** 2)
        if outline:
            inside, outside = place - _STEP_PX, place + _STEP_PX
            step = read_map(cover, u + nx * inside, v + ny * inside)
            step -= read_map(cover, u + nx * outside, v + ny * outside)
            score *= max(step + _LEAST_CONTRAST, 0.02)
        if score > best:
            best, at = score, place
    return at, best


@njit(cache=True, nogil=True, error_model="numpy")
def predict_view(
    lens: Lens, views: ViewTables, rotation: Array, centre: Array, stride: int, edges: Array
) -> tuple[int, int, int]:
    """``predict_edges`` of the view nearest to a pose; its shell, its number, its points."""
    nearest = np.zeros(1, dtype=np.int64)
    shell = nearest_views(views.directions, views.shells_m, rotation, centre, nearest)
    view = nearest[0]
    count, unit_m = point_count(views.kind[shell, view]), views.radius_m * POINT_UNIT
    point, tangent = views.point[shell, view], views.tangent[shell, view]
    predict_edges(point, tangent, count, stride, lens, unit_m, rotation, centre, edges)
    return shell, view, count


@njit(cache=True, nogil=True, error_model="numpy")
def measure_sketch(
    maps: Maps, lens: Lens, views: ViewTables, rotation: Array, centre: Array, reach_px: int,
    spread_px: float, stride: int, inner_weight: float, edges: Array,
) -> int:  # fmt: skip
    """Look for the contour points of the nearest view; returns how many it has.

    Args:
        lens: of a camera whose picture the sketch is.
        rotation: (3, 3), and ``centre``: (3,) of the view centre, camera frame.
        reach_px: how far to look to either side.
        spread_px: σ of the preference for near edges.
        stride: every so many-th point only.
        inner_weight: of creases and steps, beside the outline.
        edges: (N, COLUMNS) measurements.
    """
    shell, view, count = predict_view(lens, views, rotation, centre, stride, edges)
    kinds, line = views.kind[shell, view], np.empty(2 * reach_px + 3, np.float32)
    for j in range(0, count, stride):
        row, kind = edges[j], kinds[j]
        if row[STATE] == OUTSIDE:
            continue
        u, v, nx, ny = row[U], row[V], row[NX], row[NY]
        if not lies_in(maps.edge, u, v):
            row[STATE] = OUTSIDE
            continue
        if kind == CREASE:  # not ``plane = …``: another name of an array costs as much as reading
            read_line(maps.crease, u, v, nx, ny, reach_px + 1, line)
        else:
            read_line(maps.edge, u, v, nx, ny, reach_px + 1, line)
        outline = kind == OUTLINE
        off, score = likeliest_edge(line, maps.cover, row, reach_px, spread_px, outline)
        if score > 0.0:
            row[STATE], row[RESIDUAL] = FOUND, off
            row[WEIGHT] = score if outline else inner_weight * score
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def align_to_sketch(
    maps: Maps, lens: Lens, views: ViewTables, stages: Array, rotation: Array, centre: Array,
    edges: Array,
) -> bool:  # fmt: skip
    """Move a pose (in place) onto the edges of a sketch; False where it finds no hold.

    Args:
        stages: (K, 5) reach, spread (sketch px), steps, stride, weight of inner edges.
        edges: (N, COLUMNS) scratch; holds the last measurements afterwards.
    """
    for stage in stages:
        reach, spread = int(stage[0]), stage[1]
        for _ in range(int(stage[2])):
            edges[:, STATE] = OUTSIDE
            measure_sketch(
                maps, lens, views, rotation, centre, reach, spread, int(stage[3]), stage[4], edges
            )
            moved_px = take_step(
                edges, CUT_SPREADS * spread, _HELD, 1.0, lens, views, rotation, centre
            )
            if moved_px < 0.0:
                return False
            if moved_px < _STOP_PX:
                break
    orthonormalise(rotation)
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def sketch_agreement(
    maps: Maps, lens: Lens, views: ViewTables, rotation: Array, centre: Array, stride: int,
    edges: Array,
) -> tuple[float, float, float, float]:  # fmt: skip
    """How well a pose agrees with a sketch along the model's edges, at every so many-th point.

    Returns:
        Mean probability of an edge on the outline, and on inner edges; mean step of the cover
        across the outline; share of the outline in the sketch.
    """
    shell, view, count = predict_view(lens, views, rotation, centre, stride, edges)
    kinds, beside_px = views.kind[shell, view], _STEP_PX + 1.0
    outline = inner = contrast = visible = inners = outlines = 1e-9
    for j in range(0, count, stride):
        row, kind = edges[j], kinds[j]
        at = -1.0
        if row[STATE] != OUTSIDE:
            if kind == CREASE:
                at = read_map(maps.crease, row[U], row[V])
            else:
                at = read_map(maps.edge, row[U], row[V])
        if kind == OUTLINE:
            outlines += 1.0
            if at >= 0.0:
                dx, dy = beside_px * row[NX], beside_px * row[NY]
                visible += 1.0
                outline += at
                contrast += read_map(maps.cover, row[U] - dx, row[V] - dy)
                contrast -= read_map(maps.cover, row[U] + dx, row[V] + dy)
        elif at >= 0.0:
            inners += 1.0
            inner += at
    return outline / visible, inner / inners, contrast / visible, visible / outlines


def align_all_to_sketch(
    maps: Maps, lens: Lens, views: ViewTables, stages: Array, rotations: Array, centres: Array,
    scores: Array, stride: int = 1,
) -> None:  # fmt: skip
    """``align_to_sketch`` and ``sketch_agreement`` (``stride`` is its) of K poses, in place.

    ``scores`` is (K, 4), all −1 for the poses that find no hold.
    """
    edges = np.zeros((views.point.shape[2], COLUMNS))
    for k in range(rotations.shape[0]):
        scores[k] = -1.0
        if align_to_sketch(maps, lens, views, stages, rotations[k], centres[k], edges):
            scores[k] = sketch_agreement(maps, lens, views, rotations[k], centres[k], stride, edges)


def pose_covariance(
    maps: Maps, lens: Lens, views: ViewTables, stage: Array, rotation: Array, centre: Array,
    arm: Array, strain: Array,
) -> tuple[Array, Array, float]:  # fmt: skip
    """(6, 6) of a pose aligned in a stage, its edges taken as independent; (6, 6) of a strained
    craft; the edges' rms, sketch px.

    Args:
        arm: (3,) from the target's origin to the view centre, camera axes; the covariance is the
            origin's.
        strain: (6, 6) of the strain, as in ``MeasuredEdges.strained``.
    """
    edges = np.zeros((views.point.shape[2], COLUMNS))
    edges[:, STATE] = OUTSIDE
    spread = float(stage[1])
    measure_sketch(
        maps, lens, views, rotation, centre, int(stage[0]), spread, 1, float(stage[4]), edges
    )
    known = MeasuredEdges.of(edges, CUT_SPREADS * spread, rotation, centre)
    loose, residual = nothing_known(views.radius_m), known.residual_rms_px
    covariance = max(residual, _LEAST_SIGMA_PX) ** 2 * known.covariance(loose, arm)
    return covariance, known.strained(loose, arm, strain), residual
