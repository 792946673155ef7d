"""Hard shadows: a shadow map, which holds the surfaces nearest to the Sun."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from rendezview.geometry.pose import Array
from rendezview.geometry.zbuffer import Float32s, Int32s, draw_parallel, empty_buffers
from rendezview_ground.mesh.directions import axes_towards

_MARGIN_TEXELS = 2.0  # texels around the map, so that every lookup finds its neighbours


@dataclass(frozen=True, slots=True, eq=False)
class ShadowMap:
    """Nearest surface to the Sun on a grid across its direction."""

    nearness: Float32s  # (h, w) metres sunward of the origin's plane; 0: empty
    owner: Int32s  # (h, w) the face there
    axes: Array  # (3, 3) rows right, down, sunward in the camera frame
    origin_m: Array  # (3,) camera-frame point of sample (0, 0) at nearness 0
    texel_m: float

    @classmethod
    def empty(cls) -> ShadowMap:
        """A map that shades nothing."""
        return cls(*empty_buffers(1, 1), np.eye(3), np.zeros(3), 1.0)


def shadow_map(
    vertices: Array,
    faces: Int32s,
    sun: Array,
    visible: tuple[Float32s, Int32s],
    intrinsics: tuple[float, float, float, float],
    incidence: Array,
    texels_max: int,
) -> ShadowMap:
    """Map of everything that may shade the visible surfaces, in the camera frame.

    It spans the visible sunlit points only, so that a close-up is as sharp as a distant view. A
    point and the surface that shades it have the same place on the map.

    Args:
        visible: nearness (1/z) and owner of the samples of the picture.
        intrinsics: fx, fy, cx, cy of those samples.
        lit: (F,) cosine of the Sun's incidence on each face, 0 for a dark one.
        texels_max: limit of either side; texels are otherwise as small as samples.
    """
    axes = axes_towards(sun)
    bounds = _visible_bounds(*visible, *intrinsics, incidence, axes)
    left, top, right, bottom, z_min = bounds
    if not left <= right:
        return ShadowMap.empty()
    size_m = max(right - left, bottom - top, 1e-6)
    finest_m = z_min / max(intrinsics[0], intrinsics[1])
    texel_m = max(finest_m, size_m / (texels_max - 2.0 * _MARGIN_TEXELS), 1e-9)
    width, height = (
        math.ceil(side / texel_m + 2.0 * _MARGIN_TEXELS) for side in (right - left, bottom - top)
    )
    on_map = vertices @ axes.T
    # Nearness must be positive on the whole target, wherever it is.
    depth_m = on_map[:, 2].min() - 0.01 * max(float(np.ptp(on_map[:, 2])), texel_m)
    corner = np.array([left, top, depth_m]) - np.array([1.0, 1.0, 0.0]) * _MARGIN_TEXELS * texel_m
    on_map -= corner
    on_map[:, :2] /= texel_m
    nearness, owner = empty_buffers(height, width)
    draw_parallel(np.ascontiguousarray(on_map), faces, nearness, owner)
    return ShadowMap(nearness, owner, axes, corner @ axes, texel_m)


@njit(cache=True, nogil=True, error_model="numpy")
def _visible_bounds(
    nearness: Float32s, owner: Int32s, fx: float, fy: float, cx: float, cy: float, incidence: Array,
    axes: Array,
) -> tuple[float, float, float, float, float]:  # fmt: skip
    """Extent of the visible sunlit samples across the Sun's direction, and their least z."""
    left, top, z_min = math.inf, math.inf, math.inf
    right, bottom = -math.inf, -math.inf
    for i in range(nearness.shape[0]):
        for j in range(nearness.shape[1]):
            face = owner[i, j]
            if face < 0 or incidence[face] <= 0.0:
                continue
            z = 1.0 / nearness[i, j]
            x, y = z * (j - cx) / fx, z * (i - cy) / fy
            u = axes[0, 0] * x + axes[0, 1] * y + axes[0, 2] * z
            v = axes[1, 0] * x + axes[1, 1] * y + axes[1, 2] * z
            left, right = min(left, u), max(right, u)
            top, bottom = min(top, v), max(bottom, v)
            z_min = min(z_min, z)
    return left, top, right, bottom, z_min
