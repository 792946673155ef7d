"""Where parallel rays meet a mesh first."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.geometry.pose import Array

_LEAST_VOLUME = 1e-15  # m³ of ray and edges; below it the ray is in the plane. Source: rounding


@njit(cache=True, nogil=True, error_model="numpy")
def first_hits(
    corners: Array, centres: Array, radii: Array, starts: Array, direction: Array
) -> tuple[Array, npt.NDArray[np.int64]]:
    """Distance along each of K parallel rays to the nearest face, and which face it is.

    T. Möller and B. Trumbore, Fast, minimum storage ray/triangle intersection, Journal of Graphics
    Tools 2(1), 1997. Both sides of a face stop a ray.

    Args:
        corners: (F, 3, 3) of the faces.
        centres: (F, 3); radii: (F,) of a sphere around each face.
        starts: (K, 3), the first in the middle of the others.
        direction: (3,) unit.

    Returns:
        (K,) distances, infinite where a ray meets nothing, and (K,) faces, −1 there.
    """
    count = len(starts)
    distances, faces = np.full(count, np.inf), np.full(count, -1)
    spread = 0.0
    for k in range(1, count):
        off = 0.0
        for i in range(3):
            off += (starts[k, i] - starts[0, i]) ** 2
        spread = max(spread, np.sqrt(off))
    across, lifted = np.empty(3), np.empty(3)
    one, two, away = np.empty(3), np.empty(3), np.empty(3)
    for f in range(len(corners)):
        along, square = 0.0, 0.0
        for i in range(3):
            off = centres[f, i] - starts[0, i]
            along += off * direction[i]
            square += off * off
        near = radii[f] + spread
        if square - along * along > near * near:
            continue
        for i in range(3):
            one[i] = corners[f, 1, i] - corners[f, 0, i]
            two[i] = corners[f, 2, i] - corners[f, 0, i]
        volume = 0.0
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            across[i] = direction[j] * two[k] - direction[k] * two[j]
            volume += one[i] * across[i]
        if abs(volume) < _LEAST_VOLUME:
            continue
        for ray in range(count):
            u, v, distance = 0.0, 0.0, 0.0
            for i in range(3):
                away[i] = starts[ray, i] - corners[f, 0, i]
                u += away[i] * across[i]
            for i in range(3):
                j, k = (i + 1) % 3, (i + 2) % 3
                lifted[i] = away[j] * one[k] - away[k] * one[j]
                v += direction[i] * lifted[i]
                distance += two[i] * lifted[i]
            u, v, distance = u / volume, v / volume, distance / volume
            if u >= 0.0 and v >= 0.0 and u + v <= 1.0 and 0.0 < distance < distances[ray]:
                distances[ray], faces[ray] = distance, f
    return distances, faces
