"""Contour points of a view: where edges of the target stand in the picture.

Of all crossings of an edge (``crossings.py``) a fixed number is kept, spread evenly, each with how
far the picture is free to either side and the surfaces beside it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.appearance.contours import (
    DIRECTION_UNIT,
    NO_POINT,
    OUTLINE,
    POINT_UNIT,
    RIM_DEPTH_UNIT,
    RIM_WIDTH_UNIT,
    RUN_UNIT,
)
from rendezview.pose import Array
from rendezview.training.crossings import (
    KIND,
    LENGTH,
    STEP_RADII,
    edge_crossings,
    face_normals,
)
from rendezview.training.drawn_view import draw_view
from rendezview.training.mesh import Mesh
from rendezview.training.options import TrainingOptions, ViewGeometry
from rendezview.training.strips import strips
from rendezview.training.surface_palette import packed_surfaces

_BORDER_PX = 4.0  # around the target in the picture
_CLEAR_PX = 6.0  # a run of so many pixels makes an edge as good as any
_FREE_PX = 64  # how far the free run along the normal is looked for
_INNER_SHARE = 0.25  # of the points, for steps and creases inside the outline


def contour_points(
    mesh: Mesh,
    beside: npt.NDArray[np.int32],
    geometry: ViewGeometry,
    direction: Array,
    range_m: float,
    options: TrainingOptions,
) -> dict[str, npt.NDArray[Any]]:
    """Contour points of the target seen from a unit direction (3,) at a range.

    Args:
        beside: of ``faces_beside(mesh)``.
        options: for the number of points and the resolution at which the view is drawn.

    Returns:
        The fields of ``rendezview.appearance.contours.Contours`` for this one view, but instead
        of ``strip`` the ``surfaces`` (N, CELLS, 4) for ``surface_palette``.
    """
    size = options.contour_resolution_px
    view = draw_view(mesh, geometry, direction, range_m, size, _BORDER_PX)
    focal, middle, nearness, owner = view.focal, view.middle, view.nearness, view.owner
    albedo = mesh.face_albedo
    normals = face_normals(view.vertices, view.faces)
    step_m = STEP_RADII * geometry.target_radius_m
    crossings = edge_crossings(
        view.vertices,
        view.vertices[:, :2] / view.vertices[:, 2:] * focal + middle,
        view.faces,
        normals,
        beside,
        albedo,
        focal,
        middle,
        nearness,
        owner,
        step_m,
    )
    edges = np.zeros(owner.shape, dtype=np.bool_)
    _mark(crossings, edges)
    count = options.contour_points
    inner = round(_INNER_SHARE * count)
    # Runs are looked for at four times as many points as are kept.
    crossings = crossings[_chosen(crossings, 4 * (count - inner), 4 * inner)]
    runs_px = _free_runs(crossings, focal, edges, nearness, step_m)
    # A body thinner than the blur shows its edges displaced: such edges only where need be.
    crossings[:, LENGTH] *= np.clip((runs_px.min(axis=1) - 2.0) / _CLEAR_PX, 0.02, 1.0)
    chosen = _chosen(crossings, count - inner, inner)
    kept = crossings[chosen]
    runs_m = runs_px[chosen] * (kept[:, 4] / focal)[:, None]
    place = (kept[:, 2:5] - np.array([0.0, 0.0, range_m])) @ view.rotation
    radius_m = geometry.target_radius_m
    radius_px = 0.5 * size - _BORDER_PX
    towards, colour, rims = strips(kept, view, normals, albedo, radius_px)
    rims /= np.array([radius_px * RIM_WIDTH_UNIT, radius_m * RIM_DEPTH_UNIT])
    surfaces = packed_surfaces(towards @ view.rotation, colour)
    return {
        "point": _packed(place / (radius_m * POINT_UNIT), count, np.int16),
        "tangent": _packed(kept[:, 5:8] @ view.rotation / DIRECTION_UNIT, count, np.int8),
        "kind": _packed(kept[:, KIND], count, np.uint8, NO_POINT),
        "run": _packed(np.minimum(runs_m / (radius_m * RUN_UNIT), 255.0), count, np.uint8),
        "rim": _packed(np.clip(rims, -127, 127), count, np.int8),
        "surfaces": _packed(surfaces, count, np.uint8),
    }


def _packed(
    values: npt.NDArray[Any], count: int, dtype: type[np.integer[Any]], fill: int = 0
) -> npt.NDArray[Any]:
    """Whole numbers, filled up to ``count`` rows."""
    packed = np.full((count, *values.shape[1:]), fill, dtype=dtype)
    packed[: len(values)] = np.rint(values)
    return packed


def _chosen(crossings: Array, outline: int, inner: int) -> npt.NDArray[np.intp]:
    """Points spread evenly over the length of the edges: the outline's first, then the others."""
    inside = crossings[:, KIND] > OUTLINE
    return np.concatenate(
        [
            _spread(crossings, np.flatnonzero(~inside), outline),
            _spread(crossings, np.flatnonzero(inside), inner),
        ]
    )


def _spread(crossings: Array, candidates: npt.NDArray[np.intp], count: int) -> npt.NDArray[np.intp]:
    """``count`` of the candidates at equal steps of length along a curve that fills the picture."""
    if len(candidates) <= count:
        return candidates
    x, y = crossings[candidates, 0], crossings[candidates, 1]
    order = candidates[np.argsort(_morton(x, y), kind="stable")]
    length = np.cumsum(crossings[order, LENGTH])
    places = (np.arange(count) + 0.5) / count * length[-1]
    return np.unique(order[np.searchsorted(length, places)])


def _morton(x: Array, y: Array) -> npt.NDArray[np.int64]:
    """Place on the Z-order curve over cells of 4 × 4 pixels."""
    code = np.zeros(len(x), dtype=np.int64)
    a, b = (x / 4.0).astype(np.int64), (y / 4.0).astype(np.int64)
    for bit in range(12):
        code |= ((a >> bit) & 1) << (2 * bit)
        code |= ((b >> bit) & 1) << (2 * bit + 1)
    return code


@njit(cache=True, nogil=True)
def _mark(crossings, edges):  # type: ignore[no-untyped-def]
    for k in range(crossings.shape[0]):
        edges[int(np.rint(crossings[k, 1])), int(np.rint(crossings[k, 0]))] = True


@njit(cache=True, nogil=True)
def _free_runs(points, focal, edges, nearness, step):  # type: ignore[no-untyped-def]
    """(N, 2) pixels along the image normal to the next edge, inwards and outwards.

    Nearer than 2.5 pixels the marks of an edge's own line are in the way: there a run ends
    where the body does, or where another begins.
    """
    height, width = edges.shape
    runs = np.empty((points.shape[0], 2))
    for k in range(points.shape[0]):
        x, y, z = points[k, 2], points[k, 3], points[k, 4]
        # Picture of the tangent: d(x/z, y/z)
        tx = points[k, 5] - x / z * points[k, 7]
        ty = points[k, 6] - y / z * points[k, 7]
        length = np.sqrt(tx * tx + ty * ty) + 1e-30
        nx, ny = ty / length, -tx / length
        for way in range(2):
            sign = 1.0 if way else -1.0
            run = 0.75
            while run < _FREE_PX:
                column = int(np.rint(points[k, 0] + sign * run * nx))
                row = int(np.rint(points[k, 1] + sign * run * ny))
                if not (0 <= row < height and 0 <= column < width):
                    run = _FREE_PX
                    break
                if run >= 2.5:
                    if edges[row, column]:
                        break
                elif way == 0:
                    if nearness[row, column] * (z + step) < 1.0:
                        break
                elif points[k, 8] == 0.0 and nearness[row, column] > 0.0:
                    break
                run += 0.25 if run < 2.5 else 0.5
            runs[k, way] = run
    return runs
