"""Shadowed silhouettes: outlines of the sunlit parts of the target, for poses in hard light."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy.spatial.transform import Rotation

from rendezview.geometry.geodesic import Geodesic
from rendezview.geometry.pose import Array
from rendezview.geometry.zbuffer import Float32s, Int32s, draw_parallel, empty_buffers
from rendezview.sensors.appearance.model.shadowed_silhouettes import READING_UNIT, SHADOWED_BINS
from rendezview.sensors.appearance.model.signature import Signature
from rendezview.sensors.appearance.outline.silhouette import outlines_of_mask
from rendezview_ground.learn.options import ViewGeometry
from rendezview_ground.learn.views.drawn_view import draw_view
from rendezview_ground.learn.views.views import plane_rays
from rendezview_ground.mesh.directions import axes_towards
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.render.crossings import face_normals
from rendezview_ground.render.projection import SurfaceRenderer

_SUN_ORDER = 1  # of the sphere of Sun directions: 42 of them, 32° apart
_MAP_TEXELS = 256  # width of a shadow map
_PICTURE_PX = 128  # px; width of the drawn view
_BORDER_PX = 2.0  # px around the target in the picture
_RANGE_RADII = 1.5  # sphere radii; between the nearest and the far views
_PHASES_RAD = (np.deg2rad(20.0), np.deg2rad(85.0))  # below, nearly the whole silhouette is sunlit
_LEAST_COSINE = 0.06  # of the Sun's incidence; a flatter face stays below the threshold
_LEAST_SHARE = 0.08  # of the silhouette; a smaller sunlit part is left out
_LEAST_OUTLINE = 10  # points; a shorter outline is a speck
_LEAST_BORDER = 4  # px; a shorter border has fewer points. Source: three pixels have 8 sides
_SMOOTH_BINS = 3  # bins of a signature


@dataclass(frozen=True, slots=True, eq=False)
class SunMaps:
    """Shadow maps of the target from fixed directions."""

    suns: Array  # (S, 3)
    axes: Array  # (S, 3, 3) rows right, down, sunward
    corner: Array  # (3,) on those axes: place of sample (0, 0) at nearness 0
    texel_m: float
    nearness: npt.NDArray[np.float32]  # (S, M, M)


def sun_maps(mesh: Mesh, geometry: ViewGeometry) -> SunMaps:
    """Shadow maps for all Sun directions, with the view centre at the origin."""
    suns = Geodesic.of_order(_SUN_ORDER).nodes
    vertices = mesh.vertices_m - geometry.centre_m
    faces = np.ascontiguousarray(mesh.faces, dtype=np.int32)
    radius = 1.01 * geometry.target_radius_m
    texel = 2.0 * radius / (_MAP_TEXELS - 2)
    axes, nearness = [], []
    for sun in suns:
        basis = axes_towards(sun)
        on_map = vertices @ basis.T + np.array([radius, radius, 1.01 * radius])
        on_map[:, :2] /= texel
        near, owner = empty_buffers(_MAP_TEXELS, _MAP_TEXELS)
        draw_parallel(np.ascontiguousarray(on_map), faces, near, owner)
        axes.append(basis)
        nearness.append(near)
    corner = np.array([-radius, -radius, -1.01 * radius])
    return SunMaps(suns, np.stack(axes), corner, texel, np.stack(nearness))


def shadowed_silhouettes(
    mesh: Mesh,
    maps: SunMaps,
    geometry: ViewGeometry,
    view: int,
    direction: Array,
    renderer: SurfaceRenderer | None = None,
) -> dict[str, npt.NDArray[Any]]:
    """Shadowed silhouettes of one view, for all Sun directions.

    Args:
        view: number of the view in the lattice.
        direction: (3,) unit, from the view centre to the camera.
        renderer: of the mesh, see ``draw_view``.

    Returns:
        The fields of `ShadowedSilhouettes` except ``suns``.
    """
    range_m = _RANGE_RADII * geometry.sphere_radius_m
    drawn = draw_view(mesh, geometry, direction, range_m, _PICTURE_PX, _BORDER_PX, renderer)
    rotation, nearness, owner = drawn.rotation, drawn.nearness, drawn.owner
    focal, middle = drawn.focal, drawn.middle
    normals = face_normals(drawn.vertices, drawn.faces)
    phase = np.arccos(np.clip(maps.suns @ direction, -1.0, 1.0))
    chosen = np.flatnonzero((phase >= _PHASES_RAD[0]) & (phase <= _PHASES_RAD[1]))
    pixels, places, facing = _shown(nearness, owner, focal, middle, range_m, rotation, normals)
    rows: list[tuple[int, Array, npt.NDArray[np.float32], float, Array]] = []
    mask = np.empty((_PICTURE_PX, _PICTURE_PX), dtype=np.uint8)
    for sun in chosen:
        lit = _light(
            pixels, places, facing, maps.suns[sun], maps.axes[sun], maps.corner, maps.texel_m,
            maps.nearness[sun], mask,
        )  # fmt: skip
        if lit < _LEAST_SHARE * len(places):
            continue
        outlines = [
            plane_rays(points, focal, middle, middle)
            for points in outlines_of_mask(mask, _LEAST_BORDER)
            if len(points) >= _LEAST_OUTLINE
        ]
        signature = Signature.of_outlines(outlines, SHADOWED_BINS, _SMOOTH_BINS)
        if signature is None:
            continue
        centre = signature.centred_from_camera @ np.array([0.0, 0.0, range_m])
        offset = centre[:2] / centre[2] * range_m
        attitude = signature.centred_from_camera @ rotation
        rows.append(
            (int(sun), attitude, signature.readings, signature.area_sr * range_m**2, offset)
        )
    attitudes = np.array([r[1] for r in rows]).reshape(-1, 3, 3)
    quaternions = np.zeros((0, 4))
    if len(rows):
        quaternions = Rotation.from_matrix(attitudes).as_quat()[:, [3, 0, 1, 2]]
    readings = np.array([r[2] for r in rows]).reshape(-1, SHADOWED_BINS)
    return {
        "sun": np.array([r[0] for r in rows], dtype=np.uint8),
        "view": np.full(len(rows), view, dtype=np.uint16),
        "quat_wxyz": quaternions.astype(np.float32),
        "readings": np.minimum(np.rint(readings / READING_UNIT), 255).astype(np.uint8),
        "area_m2": np.array([r[3] for r in rows], dtype=np.float32),
        "offset_m": np.array([r[4] for r in rows]).reshape(-1, 2).astype(np.float32),
    }


def _shown(
    nearness: Float32s, owner: Int32s, focal: float, middle: float, range_m: float,
    rotation: Array, normals: Array,
) -> tuple[Int32s, Array, Array]:  # fmt: skip
    """Pixels (N, 2) row, column of the target; their places and normals (N, 3).

    Places are seen from the view centre, and both are in the target's axes.
    """
    row, column = np.nonzero(owner >= 0)
    z = 1.0 / nearness[row, column].astype(np.float64)
    x, y, z = z * (column - middle) / focal, z * (row - middle) / focal, z - range_m
    a, b, c = normals[owner[row, column]].T
    places = np.stack([r[0] * x + r[1] * y + r[2] * z for r in rotation.T], axis=1)
    facing = np.stack([r[0] * a + r[1] * b + r[2] * c for r in rotation.T], axis=1)
    return np.stack([row, column], axis=1).astype(np.int32), places, facing


@njit(cache=True, nogil=True, error_model="numpy")
def _light(
    pixels: Int32s, places: Array, facing: Array, sun: Array, axes: Array, corner: Array,
    texel_m: float, sunward: Float32s, mask: npt.NDArray[np.uint8],
) -> int:  # fmt: skip
    """Mask of the sunlit pixels: their faces look towards the Sun, and nothing shades them.

    Returns:
        How many there are.
    """
    side = sunward.shape[0]
    slack = 3.0 * texel_m
    mask[:] = 0
    count = 0
    for n in range(len(places)):
        incidence = facing[n, 0] * sun[0] + facing[n, 1] * sun[1] + facing[n, 2] * sun[2]
        if incidence <= _LEAST_COSINE:
            continue
        x, y, z = places[n, 0], places[n, 1], places[n, 2]
        u = axes[0, 0] * x + axes[0, 1] * y + axes[0, 2] * z - corner[0]
        v = axes[1, 0] * x + axes[1, 1] * y + axes[1, 2] * z - corner[1]
        w = axes[2, 0] * x + axes[2, 1] * y + axes[2, 2] * z - corner[2]
        column, row = int(np.rint(u / texel_m)), int(np.rint(v / texel_m))
        # A sloping face rises above its own texel by the slope.
        free = w + slack + texel_m / max(incidence, 0.1)
        on_map = 0 <= column < side and 0 <= row < side
        if not (on_map and sunward[row, column] > free):
            mask[pixels[n, 0], pixels[n, 1]] = 255
            count += 1
    return count
