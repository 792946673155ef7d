"""Light on the visible samples: the inner loop of the shaded renderer.

The functions share a file because numba's cache notices changes of a function's own file only.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from rendezview.geometry.pose import Array
from rendezview.geometry.zbuffer import Float32s, Int32s

_LEAST_SUN_COSINE = 0.03  # of a face; bounds the slope of its plane on the shadow map
_FOLD_TEXELS = 2.0  # texels; a surface that close above a face's plane does not shade it
_FAINTEST = 1e-4  # highlights below are not computed


@njit(cache=True, nogil=True, error_model="numpy")
def _sunlight(
    point: Array, normals: Array, face: int, nearness: Float32s, owner: Int32s, axes: Array,
    origin: Array, texel: float,
) -> float:  # fmt: skip
    """Share of the Sun visible from a point of a face: four texels, weighted bilinearly.

    Each texel is compared with the plane of the face, so that a slope does not shade itself and no
    offset shifts the shadow. Surfaces less than two texels above the plane, such as the other side
    of a fold, do not count.
    """
    height, width = nearness.shape
    x, y, w = 0.0, 0.0, 0.0
    nx, ny, nw = 0.0, 0.0, 0.0  # the normal on the map's axes
    for k in range(3):
        step = point[k] - origin[k]
        x += axes[0, k] * step
        y += axes[1, k] * step
        w += axes[2, k] * step
        nx += axes[0, k] * normals[face, k]
        ny += axes[1, k] * normals[face, k]
        nw += axes[2, k] * normals[face, k]
    x, y = x / texel, y / texel
    column, row = math.floor(x), math.floor(y)
    if column < 0 or row < 0 or column + 1 >= width or row + 1 >= height:
        return 1.0
    # n · p = const, so ∂w/∂x = −nx / nw. The bound affects grazing faces, which get little light.
    nw = max(nw, _LEAST_SUN_COSINE)
    w_per_x, w_per_y = -texel * nx / nw, -texel * ny / nw
    right, down = x - column, y - row
    light = 0.0
    for i in range(2):
        for j in range(2):
            plane = w + w_per_x * (j - right) + w_per_y * (i - down) + _FOLD_TEXELS * texel
            if nearness[row + i, column + j] <= plane or owner[row + i, column + j] == face:
                light += (down if i else 1.0 - down) * (right if j else 1.0 - right)
    return light


@njit(cache=True, nogil=True, error_model="numpy")
def _highlight(
    point: Array, normals: Array, face: int, sun: Array, shininess: float, faintest: float
) -> float:
    """Blinn–Phong highlight: (n · h)^shininess, h half-way between the Sun and the camera."""
    length = math.sqrt(point[0] ** 2 + point[1] ** 2 + point[2] ** 2)
    half_n, half_2 = 0.0, 0.0
    for k in range(3):
        half = sun[k] - point[k] / length
        half_n += half * normals[face, k]
        half_2 += half * half
    half_n /= math.sqrt(half_2 + 1e-30)  # with the Sun exactly behind there is no half vector
    if half_n > faintest:
        return float(half_n**shininess)
    return 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def shade_samples(
    nearness: Float32s, owner: Int32s, samples: int, fx: float, fy: float, cx: float, cy: float,
    normals: Array, diffuse: Array, sun_cosine: Array, glow: Array, specular: float,
    shininess: float, sun: Array, shadow_nearness: Float32s, shadow_owner: Int32s, axes: Array,
    origin: Array, texel: float, radiance: Float32s, coverage: Float32s, depth: Float32s,
) -> None:  # fmt: skip
    """Light every covered sample and average the samples of each pixel.

    Args:
        nearness: (H n, W n) 1/z of the samples, and ``owner``: their faces.
        samples: n, per pixel side; fx, fy, cx, cy are intrinsics of the samples.
        normals: (F, 3), with ``diffuse``, ``sun_cosine`` and ``glow`` (F,).
        sun: (3,) unit, towards the Sun.
        shadow_nearness: and the following: of a ``ShadowMap``.
        radiance: (H, W), with ``coverage`` and ``depth``: the results.
    """
    point = np.empty(3)
    has_shadows = shadow_nearness.shape[0] > 1
    share = 1.0 / (samples * samples)
    faintest = _FAINTEST ** (1.0 / max(shininess, 1e-3))
    for row in range(radiance.shape[0]):
        for column in range(radiance.shape[1]):
            light_sum, z_sum, count = 0.0, 0.0, 0
            for i in range(row * samples, (row + 1) * samples):
                for j in range(column * samples, (column + 1) * samples):
                    face = owner[i, j]
                    if face < 0:
                        continue
                    z = 1.0 / nearness[i, j]
                    count += 1
                    z_sum += z
                    light_sum += glow[face]
                    if sun_cosine[face] <= 0.0:
                        continue
                    point[0] = z * (j - cx) / fx
                    point[1] = z * (i - cy) / fy
                    point[2] = z
                    light = 1.0
                    if has_shadows:
                        light = _sunlight(
                            point, normals, face, shadow_nearness, shadow_owner,
                            axes, origin, texel,
                        )  # fmt: skip
                    if light <= 0.0:
                        continue
                    lit = diffuse[face]
                    if specular > 0.0:
                        shine = _highlight(point, normals, face, sun, shininess, faintest)
                        lit += specular * sun_cosine[face] * shine
                    light_sum += light * lit
            if count:
                radiance[row, column] = light_sum * share
                coverage[row, column] = count * share
                depth[row, column] = z_sum / count
