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
    covariance_of,
    gauss_newton_step,
    nearest_distance,
    nearest_views,
    normal_equations,
)
from rendezview.sensors.appearance.edges.contours import CREASE, NO_POINT, OUTLINE, POINT_UNIT
from rendezview.sensors.appearance.edges.edge_search import (
    COLUMNS,
    FOUND,
    NOT_FOUND,
    NX,
    NY,
    OUTSIDE,
    RESIDUAL,
    STATE,
    WEIGHT,
    U,
    V,
)
from rendezview.sensors.appearance.edges.strain import StrainMoves
from rendezview.sensors.appearance.edges.view_tables import (
    Lens,
    ViewTables,
    pose_slope_into,
    project_edge,
)

Float32s = npt.NDArray[np.float32]


class Maps(NamedTuple):
    """The maps of one sketch that poses are aligned to, and where it lies in the frame."""

    cover: Float32s  # (h, w)
    edge: Float32s  # (h, w) smoothed
    crease: Float32s  # (h, w) smoothed; half of the edges are in it
    place: Array  # (3,) of ``Sketch.place``


# Two more columns for each point: the map at its predicted place, and the cover's step across it.
AT, CONTRAST = COLUMNS, COLUMNS + 1
WIDTH = COLUMNS + 2  # Source: by construction

_LEAST_PROBABILITY = 0.08  # of an edge, to be a candidate. Source: experiment photo-accuracy
# Source: experiment photo-accuracy
_STEP_PX = 3.0  # sketch px to either side of an outline, where the cover is read
# Source: experiment photo-accuracy
_LEAST_CONTRAST = 0.15  # of the cover, added: where the cover is wrong an edge still counts
# Source: as edges/alignment.py
CUT_SPREADS = 2.5  # of the spread: residuals beyond do not count (Tukey)
_LEAST_EDGES = 10  # found, for six unknowns. Source: as edges/alignment.py
# Source: a tenth of an edge's error, by construction
_STOP_PX = 0.05  # sketch px; a shorter step is the last
_HELD = 1e-3  # damping, share of the information. Source: as edges/alignment.py
# Source: experiment photo-accuracy
_LEAST_SIGMA_PX = 0.3  # sketch px; one σ of an edge in the best of cases
# Information of about a radian and a target radius. Source: as edges/refinement.py
_NOTHING_KNOWN = 1e-4


@njit(cache=True, nogil=True, error_model="numpy")
def read_map(plane: Float32s, x: float, y: float) -> float:
    """The map at a place, bilinear; −1 outside."""
    height, width = plane.shape
    if not (x >= 0.0 and y >= 0.0 and x < width - 1.0 and y < height - 1.0):
        return -1.0
    i, j = int(y), int(x)
    fy, fx = y - i, x - j
    upper = plane[i, j] * (1.0 - fx) + plane[i, j + 1] * fx
    lower = plane[i + 1, j] * (1.0 - fx) + plane[i + 1, j + 1] * fx
    return upper * (1.0 - fy) + lower * fy  # type: ignore[no-any-return]


@njit(cache=True, nogil=True, error_model="numpy")
def predict_edge(
    point: npt.NDArray[np.int16], tangent: npt.NDArray[np.int8], lens: Lens, place: Array,
    unit_m: float, rotation: Array, centre: Array, row: Array,
) -> bool:  # fmt: skip
    """Place, normal and Jacobian of a contour point in the sketch; False where it has none."""
    edge = project_edge(
        point[0] * unit_m, point[1] * unit_m, point[2] * unit_m, tangent, lens, rotation, centre
    )
    if not edge.is_visible:
        return False
    pose_slope_into(edge, row)
    for a in range(6):  # not `row[:6] *=`, which compiles for two seconds
        row[a] *= place[0]
    row[U], row[V] = place[0] * edge.u + place[1], place[0] * edge.v + place[2]
    row[NX], row[NY] = edge.nx, edge.ny
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def likeliest_edge(
    plane: Float32s, cover: Float32s, row: Array, reach_px: int, spread_px: float, outline: bool
) -> tuple[float, float]:
    """Place along the normal and score of the likeliest edge near a predicted one; score 0: none.

    The edge of an outline must have the target inside and the sky outside.
    """
    u, v, nx, ny = row[U], row[V], row[NX], row[NY]
    best, at = 0.0, 0.0
    before = read_map(plane, u - nx * (reach_px + 1), v - ny * (reach_px + 1))
    here = read_map(plane, u - nx * reach_px, v - ny * reach_px)
    for k in range(-reach_px, reach_px + 1):
        after = read_map(plane, u + nx * (k + 1), v + ny * (k + 1))
        peak = here >= before and here > after and here > _LEAST_PROBABILITY
        if peak and before >= 0.0 and after >= 0.0:
            bend = before - 2.0 * here + after
            place = k + (0.5 * (before - after) / bend if bend < 0.0 else 0.0)
            score = here * np.exp(-0.5 * (place / spread_px) ** 2)
            if outline:
                inside, outside = place - _STEP_PX, place + _STEP_PX
                step = read_map(cover, u + nx * inside, v + ny * inside)
                step -= read_map(cover, u + nx * outside, v + ny * outside)
                score *= max(step + _LEAST_CONTRAST, 0.02)
            if score > best:
                best, at = score, place
        before, here = here, after
    return at, best


@njit(cache=True, nogil=True, error_model="numpy")
def measure_sketch(
    maps: Maps, lens: Lens, views: ViewTables, rotation: Array, centre: Array, reach_px: int,
    spread_px: float, stride: int, inner_weight: float, edges: Array,
) -> int:  # fmt: skip
    """Look for the contour points of the nearest view; returns how many rows are filled.

    Args:
        rotation: (3, 3), and ``centre``: (3,) of the view centre, camera frame.
        reach_px: how far to look to either side.
        spread_px: σ of the preference for near edges.
        stride: every so many-th point only.
        inner_weight: of creases and steps, beside the outline.
        edges: (N, WIDTH) measurements.
    """
    nearest = np.zeros(1, dtype=np.int64)
    shell = nearest_views(views.directions, views.shells_m, rotation, centre, nearest)
    view = nearest[0]
    count = 0
    for j in range(0, views.point.shape[2], stride):
        kind = views.kind[shell, view, j]
        if kind == NO_POINT:
            break
        row = edges[count]
        count += 1
        row[:] = 0.0
        row[STATE] = OUTSIDE
        if not predict_edge(
            views.point[shell, view, j], views.tangent[shell, view, j], lens, maps.place,
            views.radius_m * POINT_UNIT, rotation, centre, row,
        ):  # fmt: skip
            continue
        plane = maps.crease if kind == CREASE else maps.edge
        at = read_map(plane, row[U], row[V])
        if at < 0.0:
            continue
        outline = kind == OUTLINE
        row[STATE], row[AT] = NOT_FOUND, at
        if outline:
            dx, dy = (_STEP_PX + 1.0) * row[NX], (_STEP_PX + 1.0) * row[NY]
            row[CONTRAST] = read_map(maps.cover, row[U] - dx, row[V] - dy)
            row[CONTRAST] -= read_map(maps.cover, row[U] + dx, row[V] + dy)
        place, score = likeliest_edge(plane, maps.cover, row, reach_px, spread_px, outline)
        if score > 0.0:
            row[STATE], row[RESIDUAL] = FOUND, place
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
        edges: (N, WIDTH) scratch; holds the last measurements afterwards.
    """
    matrix, right = np.empty((6, 6)), np.empty(6)
    for stage in stages:
        reach, spread = int(stage[0]), stage[1]
        for _ in range(int(stage[2])):
            edges[:, STATE] = OUTSIDE
            measure_sketch(
                maps, lens, views, rotation, centre, reach, spread, int(stage[3]), stage[4], edges
            )
            used, weights = normal_equations(edges, CUT_SPREADS * spread, matrix, right)
            if used < _LEAST_EDGES:
                return False
            scale = lens[0][0] * maps.place[0] / centre[2]  # sketch px a metre
            held = _HELD * weights * scale * scale
            moved = gauss_newton_step(
                matrix, right, held, 1.0, views.radius_m, nearest_distance(views), rotation, centre
            )
            if moved < 0.0:
                return False
            if scale * moved < _STOP_PX:
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
    nearest = np.zeros(1, dtype=np.int64)
    shell = nearest_views(views.directions, views.shells_m, rotation, centre, nearest)
    kinds = views.kind[shell, nearest[0]]
    one = int(np.int64(1))  # as a literal, numba would compile a copy of what is called for it
    count = measure_sketch(maps, lens, views, rotation, centre, one, 1.0, stride, 1.0, edges)
    outline = inner = contrast = visible = inners = outlines = 1e-9
    for j in range(count):
        seen = edges[j, STATE] != OUTSIDE
        if kinds[j * stride] == OUTLINE:
            outlines += 1.0
            if seen:
                visible += 1.0
                outline += edges[j, AT]
                contrast += edges[j, CONTRAST]
        elif seen:
            inners += 1.0
            inner += edges[j, AT]
    return outline / visible, inner / inners, contrast / visible, visible / outlines


def align_all_to_sketch(
    maps: Maps, lens: Lens, views: ViewTables, stages: Array, rotations: Array, centres: Array,
    scores: Array, stride: int = 1,
) -> None:  # fmt: skip
    """``align_to_sketch`` and ``sketch_agreement`` (``stride`` is its) of K poses, in place.

    ``scores`` is (K, 4), all −1 for the poses that find no hold.
    """
    edges = np.zeros((views.point.shape[2], WIDTH))
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
        strain: (6, 6) of the strain, see ``StrainMoves``.
    """
    edges = np.zeros((views.point.shape[2], WIDTH))
    edges[:, STATE] = OUTSIDE
    spread = float(stage[1])
    measure_sketch(
        maps, lens, views, rotation, centre, int(stage[0]), spread, 1, float(stage[4]), edges
    )
    loose = _NOTHING_KNOWN * np.array([1.0] * 3 + [views.radius_m**-2] * 3)
    cut = CUT_SPREADS * spread
    covariance, residual = covariance_of(edges, cut, _LEAST_SIGMA_PX, loose, arm)
    strained = StrainMoves.of(edges, cut, loose, rotation, centre).covariance(arm, strain)
    return covariance, strained, residual
