"""Contour points of a view: places of the target's edges in the picture.

A fixed number of the edge crossings (``crossings.py``) is kept, evenly spread. Each has its free
length to either side and the profile of surfaces beside it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.geometry.pose import Array
from rendezview.geometry.zbuffer import Float32s, Int32s
from rendezview.sensors.appearance.model.contours import (
    DEPTH_UNIT,
    DIRECTION_UNIT,
    NO_POINT,
    OUTLINE,
    POINT_UNIT,
    RUN_UNIT,
    packed_start,
)
from rendezview_ground.learn.options import TrainingOptions, ViewGeometry
from rendezview_ground.learn.views.drawn_view import DrawnView, draw_view
from rendezview_ground.learn.views.edge_profiles import edge_profiles
from rendezview_ground.learn.views.surface_palette import packed_surfaces
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.render.crossings import (
    FACE,
    KIND,
    LENGTH,
    STEP_RADII,
    edge_crossings,
    edge_pixels,
    face_normals,
)
from rendezview_ground.render.curve import evenly_spread
from rendezview_ground.render.projection import SurfaceRenderer

_BORDER_PX = 4.0  # px around the target in the picture
_THIN_PX = 2.0  # px; an edge with a shorter free run is unreliable
_CLEAR_RADII = 3.0 / 196.0  # target radii beyond _THIN_PX; from there an edge is fully reliable
_FREE_RADII = 64.0 / 196.0  # target radii; length along the normal in which a free run ends
_INNER_SHARE = 0.25  # share of the points for steps and creases inside the outline
_NEAR_SHARE = 0.5  # the same of a near view, whose outline is mostly beside the picture
_MARGIN_PX = 8  # px; no edge of a near view is nearer to the border
_CANDIDATES = 4  # candidates per kept point, for which free runs are measured
# Pixels per kept point, for which the exact crossing is computed. Source: experiment benchmark: the
# median attitude error of a first pose is 0.023°, with 8 it is 0.082°
_PIXELS = 24
_LEAST_RELIABILITY = 0.02  # weight of an unreliable edge: chosen only where there is no other
_OWN_LINE_PX = 2.5  # px; nearer, the marks of an edge's own line block the search


def contour_points(
    mesh: Mesh,
    beside: npt.NDArray[np.int32],
    geometry: ViewGeometry,
    direction: Array,
    range_m: float,
    options: TrainingOptions,
    renderer: SurfaceRenderer | None = None,
) -> dict[str, npt.NDArray[Any]]:
    """Contour points of the target seen from a unit direction (3,) at a range.

    Args:
        beside: of ``faces_beside(mesh)``.
        options: gives the number of points and the resolution of the drawn view.
        renderer: of the mesh, see ``draw_view``.

    Returns:
        The fields of `Contours` for this view, with the ``surfaces`` (N, SURFACES, 4) for
        ``surface_palette`` instead of ``strip``.
    """
    size = options.contour_resolution_px
    view = draw_view(mesh, geometry, direction, range_m, size, _BORDER_PX, renderer)
    focal, middle, nearness, owner = view.focal, view.middle, view.nearness, view.owner
    albedo = mesh.face_albedo
    normals = face_normals(view.vertices, view.faces)
    step_m = STEP_RADII * geometry.target_radius_m
    count = options.contour_points
    inner = round((_INNER_SHARE if geometry.near_half_rad is None else _NEAR_SHARE) * count)
    pixels, edges = edge_pixels(
        view.vertices, view.faces, normals, albedo, focal, middle, nearness, owner, step_m
    )
    if geometry.near_half_rad is not None:
        pixels = _of_sphere(pixels, view, range_m, geometry.target_radius_m)
    crossings = edge_crossings(
        view.vertices, view.points, view.faces, normals, beside,
        _some_pixels(pixels, _PIXELS * (count - inner), _PIXELS * inner), focal, middle, nearness,
        owner, step_m,
    )  # fmt: skip
    crossings = _candidates(crossings, mesh, count - inner, inner)
    radius_px = 0.5 * size - _BORDER_PX
    runs_px = _free_runs(crossings, focal, edges, nearness, step_m, _FREE_RADII * radius_px)
    # The edges of a body thinner than the blur appear displaced.
    clear = (runs_px.min(axis=1) - _THIN_PX) / (_CLEAR_RADII * radius_px)
    crossings[:, LENGTH] *= np.clip(clear, _LEAST_RELIABILITY, 1.0)
    chosen = _chosen(crossings, count - inner, inner)
    kept = crossings[chosen]
    runs_m = runs_px[chosen] * (kept[:, 4] / focal)[:, None]
    radius_m = geometry.target_radius_m
    normal, colour, starts = edge_profiles(kept, view, beside, normals, albedo, radius_px)
    points = kept[:, 2:5]
    begins = _inwards(kept, starts[..., 0] * radius_px / focal)
    inside, deeper = _from_points(points, kept[:, 5:8], begins, starts[..., 1])
    starts = np.stack([packed_start(inside / radius_m), deeper / (radius_m * DEPTH_UNIT)], axis=-1)
    place = (points - np.array([0.0, 0.0, range_m])) @ view.rotation
    surfaces = packed_surfaces(normal @ view.rotation, colour)
    turning = {}
    if mesh.face_part is not None:
        faces = kept[:, FACE].astype(np.intp)
        turning["part"] = _packed(mesh.face_part[faces], count, np.uint8)
    return turning | {
        "point": _packed(place / (radius_m * POINT_UNIT), count, np.int16),
        "tangent": _packed(kept[:, 5:8] @ view.rotation / DIRECTION_UNIT, count, np.int8),
        "kind": _packed(kept[:, KIND], count, np.uint8, NO_POINT),
        "run": _packed(np.minimum(runs_m / (radius_m * RUN_UNIT), 255.0), count, np.uint8),
        "start": _packed(np.clip(starts, -127, 127), count, np.int8),
        "surfaces": _packed(surfaces, count, np.uint8),
    }


def _of_sphere(pixels: Int32s, view: DrawnView, range_m: float, radius_m: float) -> Int32s:
    """The pixels (M, 4) of ``edge_pixels`` inside the border that show a sphere's content."""
    last = len(view.owner) - 1 - _MARGIN_PX
    u, v = pixels[:, 0], pixels[:, 1]
    z = 1.0 / view.nearness[v, u]
    x, y = (u - view.middle) / view.focal * z, (v - view.middle) / view.focal * z
    inside = x**2 + y**2 + (z - range_m) ** 2 < radius_m**2
    inside &= (np.minimum(u, v) >= _MARGIN_PX) & (np.maximum(u, v) <= last)
    return np.ascontiguousarray(pixels[inside])


def _inwards(crossings: Array, shift: Array) -> Array:
    """(N, K, 3) rays, z = 1, at normalised distances (N, K) inwards of N crossings."""
    x, y = crossings[:, 2] / crossings[:, 4], crossings[:, 3] / crossings[:, 4]
    tx, ty = crossings[:, 5] - x * crossings[:, 7], crossings[:, 6] - y * crossings[:, 7]
    length = np.maximum(np.hypot(tx, ty), 1e-30)
    u = x[:, None] - shift * (ty / length)[:, None]
    v = y[:, None] + shift * (tx / length)[:, None]
    return np.stack([u, v, np.ones_like(u)], axis=-1)


def _from_points(points: Array, along: Array, rays: Array, z: Array) -> tuple[Array, Array]:
    """(N, K) distances inwards of N points, across the ray to each, and extra depths, metres.

    The inverse of ``strip_fit.begins_at``.

    Args:
        points: (N, 3), camera frame, and ``along``: (N, 3) unit, the direction of the edge.
        rays: (N, K, 3) to the places, and ``z``: (N, K), their depths; 0 means that of the point.
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
    """The values rounded to integers, padded to ``count`` rows."""
    packed = np.full((count, *values.shape[1:]), fill, dtype=dtype)
    packed[: len(values)] = np.rint(values)
    return packed


def _candidates(crossings: Array, mesh: Mesh, outline: int, inner: int) -> Array:
    """Crossings evenly spread over the edges, fewer where the mesh is less trusted."""
    weighted = crossings
    if mesh.face_trust is not None:
        weighted = crossings.copy()
        weighted[:, LENGTH] *= mesh.face_trust[crossings[:, FACE].astype(np.intp)]
        trusted = weighted[:, LENGTH] > 0.0
        crossings, weighted = crossings[trusted], weighted[trusted]
    return crossings[_chosen(weighted, _CANDIDATES * outline, _CANDIDATES * inner)]


def _some_pixels(pixels: Int32s, outline: int, inner: int) -> Int32s:
    """Pixels (M, 4) of ``edge_pixels``, evenly spread over the edges: outline, then the others."""
    chosen = _of_both(pixels[:, 3] > OUTLINE, pixels, np.ones(len(pixels)), outline, inner)
    return pixels[chosen]


def _chosen(crossings: Array, outline: int, inner: int) -> npt.NDArray[np.intp]:
    """Points evenly spread over the length of the edges: first the outline, then the others."""
    places = crossings[:, :2].astype(np.int32)
    return _of_both(crossings[:, KIND] > OUTLINE, places, crossings[:, LENGTH], outline, inner)


def _of_both(
    inside: npt.NDArray[np.bool_], places: Int32s, length: Array, outline: int, inner: int
) -> npt.NDArray[np.intp]:
    chosen = []
    for group, count in ((~inside, outline), (inside, inner)):
        members = np.flatnonzero(group)
        u, v = places[members, 0], places[members, 1]
        chosen.append(members[evenly_spread(u, v, length[members], count)])
    return np.concatenate(chosen)


@njit(cache=True, nogil=True, error_model="numpy")
def _free_runs(
    points: Array,
    focal: float,
    edges: npt.NDArray[np.bool_],
    nearness: Float32s,
    step: float,
    most: float,
) -> Array:
    """(N, 2) pixels along the image normal to the next edge, inwards and outwards.

    The first pixels hold the marks of the edge's own line. There a run ends where the body ends,
    or where another begins.
    """
    height, width = edges.shape
    runs = np.empty((points.shape[0], 2))
    for k in range(points.shape[0]):
        x, y, z = points[k, 2], points[k, 3], points[k, 4]
        # The tangent in the picture: d(x/z, y/z)
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
                if run >= _OWN_LINE_PX:
                    if edges[row, column]:
                        break
                elif way == 0:
                    if nearness[row, column] * (z + step) < 1.0:
                        break
                elif points[k, 8] == 0.0 and nearness[row, column] > 0.0:
                    break
                run += 0.25 if run < _OWN_LINE_PX else 0.5
            runs[k, way] = run
    return runs
