"""Light on the visible samples: the inner loop of the shaded renderer.

Both functions share a file because numba's cache sees a change of a function's own
file, not of the functions it calls in another.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def _sunlight(point, normals, face, nearness, owner, axes, origin, texel):  # type: ignore[no-untyped-def]
    """Share of the Sun seen from a point of a face: four texels compared, weighted bilinearly.

    Each texel is compared with the *plane of the face* there, so that a slope does
    not shade itself and no lift shifts the shadow; what stands out of that plane by
    less than two texels (the other side of a fold) does not count.
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
    # n · p = const, so ∂w/∂x = −nx / nw; a grazing face gets next to no light anyway.
    nw = max(nw, 0.03)
    w_per_x, w_per_y = -texel * nx / nw, -texel * ny / nw
    right, down = x - column, y - row
    light = 0.0
    for i in range(2):
        for j in range(2):
            plane = w + w_per_x * (j - right) + w_per_y * (i - down) + 2.0 * texel
            if nearness[row + i, column + j] <= plane or owner[row + i, column + j] == face:
                light += (down if i else 1.0 - down) * (right if j else 1.0 - right)
    return light


@njit(cache=True, nogil=True)
def shade_samples(  # type: ignore[no-untyped-def]
    nearness, owner, samples, fx, fy, cx, cy, normals, diffuse, sun_cosine, glow,
    specular, shininess, sun, shadow_nearness, shadow_owner, axes, origin, texel,
    radiance, coverage, depth,
):  # fmt: skip
    """Light every covered sample and average the samples of each pixel."""
    point = np.empty(3)
    has_shadows = shadow_nearness.shape[0] > 1
    share = 1.0 / (samples * samples)
    faintest = 1e-4 ** (1.0 / max(shininess, 1e-3))  # highlights below 1e-4 are not computed
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
                        # Blinn–Phong: the half vector between the Sun and the camera.
                        length = math.sqrt(point[0] ** 2 + point[1] ** 2 + point[2] ** 2)
                        half_n, half_2 = 0.0, 0.0
                        for k in range(3):
                            half = sun[k] - point[k] / length
                            half_n += half * normals[face, k]
                            half_2 += half * half
                        half_n /= math.sqrt(half_2 + 1e-30)  # the Sun dead behind: no half vector
                        if half_n > faintest:
                            lit += specular * sun_cosine[face] * half_n**shininess
                    light_sum += light * lit
            if count:
                radiance[row, column] = light_sum * share
                coverage[row, column] = count * share
                depth[row, column] = z_sum / count
