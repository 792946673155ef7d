"""Contour points of a view: where edges of the target stand in the picture.

Of all crossings of an edge (``crossings.py``) a fixed number is kept, spread evenly, each with how
far the picture is free to either side and the surfaces beside it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.geometry.pose import Array
from rendezview.sensors.appearance.edges.contours import (
    DEPTH_UNIT,
    DIRECTION_UNIT,
    NO_POINT,
    OUTLINE,
    POINT_UNIT,
    RUN_UNIT,
    packed_start,
)
from rendezview.training.crossings import (
    KIND,
    LENGTH,
    STEP_RADII,
    edge_crossings,
    face_normals,
)
from rendezview.training.drawn_view import draw_view
from rendezview.training.edge_profiles import strips
from rendezview.training.mesh import Mesh
from rendezview.training.options import TrainingOptions, ViewGeometry
from rendezview.training.surface_palette import packed_surfaces

_BORDER_PX = 4.0  # around the target in the picture
_THIN_PX = 2.0  # a shorter run makes a bad edge, …
_CLEAR_RADII = 3.0 / 196.0  # … so much more of the target's radius one as good as any
_FREE_RADII = 64.0 / 196.0  # how far the free run along the normal is looked for
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
        The fields of `Contours` for this one view, but instead of
        ``strip`` the ``surfaces`` (N, SURFACES, 4) for ``surface_palette``.
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
    radius_px = 0.5 * size - _BORDER_PX
    runs_px = _free_runs(crossings, focal, edges, nearness, step_m, _FREE_RADII * radius_px)
    # A body thinner than the blur shows its edges displaced: such edges only where need be.
    clear = (runs_px.min(axis=1) - _THIN_PX) / (_CLEAR_RADII * radius_px)
    crossings[:, LENGTH] *= np.clip(clear, 0.02, 1.0)
    chosen = _chosen(crossings, count - inner, inner)
    kept = crossings[chosen]
    runs_m = runs_px[chosen] * (kept[:, 4] / focal)[:, None]
    radius_m = geometry.target_radius_m
    towards, colour, starts = strips(kept, view, beside, normals, albedo, radius_px)
    points = kept[:, 2:5]
    begins = _inwards(kept, starts[..., 0] * radius_px / focal)
    inside, deeper = _from_points(points, kept[:, 5:8], begins, starts[..., 1])
    starts = np.stack([packed_start(inside / radius_m), deeper / (radius_m * DEPTH_UNIT)], axis=-1)
    place = (points - np.array([0.0, 0.0, range_m])) @ view.rotation
    surfaces = packed_surfaces(towards @ view.rotation, colour)
    return {
        "point": _packed(place / (radius_m * POINT_UNIT), count, np.int16),
        "tangent": _packed(kept[:, 5:8] @ view.rotation / DIRECTION_UNIT, count, np.int8),
        "kind": _packed(kept[:, KIND], count, np.uint8, NO_POINT),
        "run": _packed(np.minimum(runs_m / (radius_m * RUN_UNIT), 255.0), count, np.uint8),
        "start": _packed(np.clip(starts, -127, 127), count, np.int8),
        "surfaces": _packed(surfaces, count, np.uint8),
    }


def _inwards(crossings: Array, shift: Array) -> Array:
    """(N, K, 3) rays, z = 1, that lie normalised (N, K) inwards of N crossings in the picture."""
    x, y = crossings[:, 2] / crossings[:, 4], crossings[:, 3] / crossings[:, 4]
    tx, ty = crossings[:, 5] - x * crossings[:, 7], crossings[:, 6] - y * crossings[:, 7]
    length = np.maximum(np.hypot(tx, ty), 1e-30)
    u = x[:, None] - shift * (ty / length)[:, None]
    v = y[:, None] + shift * (tx / length)[:, None]
    return np.stack([u, v, np.ones_like(u)], axis=-1)


def _from_points(points: Array, along: Array, rays: Array, z: Array) -> tuple[Array, Array]:
    """(N, K) how far inwards of N points, across the ray to each, and how much deeper, m.

    The inverse of ``strip_fit.begins_at``.

    Args:
        points: (N, 3), camera frame, and ``along``: (N, 3) unit, the edge there.
        rays: (N, K, 3) to the places, and ``z``: (N, K) of them, 0 where it is that of the point.
    """
    outwards = np.cross(along, points)
    outwards /= np.maximum(np.linalg.norm(outwards, axis=1), 1e-30)[:, None]
    ahead = points - np.sum(points * along, axis=1)[:, None] * along
    distance = np.linalg.norm(ahead, axis=1)[:, None]
    ahead /= distance
    aside = np.einsum("nkj,nj->nk", rays, outwards)
    forward = np.einsum("nkj,nj->nk", rays, ahead)
    inside = -aside / forward * distance
    farther = np.where(z > 0.0, z * forward / distance - 1.0, 0.0)
    return inside, farther * np.linalg.norm(points, axis=1)[:, None]


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
    found = order[:0]
    # Those that stand for more than a step are met again: then the steps are too long.
    for steps in range(count, 4 * count, max(1, count // 20)):
        places = (np.arange(steps) + 0.5) / steps * length[-1]
        met = np.unique(order[np.searchsorted(length, places)])
        if len(met) > count:
            break
        found = met
    return found


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
def _free_runs(points, focal, edges, nearness, step, most):  # type: ignore[no-untyped-def]
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
            while run < most:
                column = int(np.rint(points[k, 0] + sign * run * nx))
                row = int(np.rint(points[k, 1] + sign * run * ny))
                if not (0 <= row < height and 0 <= column < width):
                    run = most
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
