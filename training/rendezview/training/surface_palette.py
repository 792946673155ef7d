"""The few kinds of surface that lie beside the edges of a target: a palette, as of a picture."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rendezview.geometry.pose import Array
from rendezview.sensors.appearance.edges.contours import KINDS_OF_SURFACE

Bytes = npt.NDArray[np.uint8]

# Against a step in what the Sun lights, albedo times normal: one in albedo, which the light all
# around lights, and one in the normal, which tells how wide a facet is seen.
_ALBEDO_WEIGHT, _NORMAL_WEIGHT = 0.3, 0.1


def packed_surfaces(normals: Array, albedo: Array) -> Bytes:
    """(…, 4) bytes of mean normals (…, 3), either way round, and albedo (…): 0 is nothing."""
    way = np.where(normals @ [0.9, 0.37, 0.23] < 0.0, -1.0, 1.0)
    whole = np.concatenate(
        [normals * way[..., None] * 127.0 + 128.0, np.clip(albedo, 0.0, 1.0)[..., None] * 255.0], -1
    )
    return np.where(albedo[..., None] > 0.0, np.rint(whole), 0.0).astype(np.uint8)


def surface_palette(surfaces: Bytes) -> tuple[npt.NDArray[np.float32], Bytes]:
    """The kinds of a great many surfaces, and the kind of each.

    The kinds are split from one another in turn, always the one whose surfaces vary most, at
    the mean along its longest axis, as palettes of pictures are made (Wan, Wong & Prusinkiewicz,
    1988).

    Args:
        surfaces: (…, 4) of ``packed_surfaces``.

    Returns:
        (KINDS_OF_SURFACE, 4) mean normal, either way, and albedo of each kind; the first is
        nothing at all, albedo 0. (…) the kind of each surface.
    """
    packed = np.ascontiguousarray(surfaces).view("<u4")[..., 0]
    distinct, which, count = np.unique(packed, return_inverse=True, return_counts=True)
    parts = distinct.view(np.uint8).reshape(-1, 4).astype(np.float64)
    normals, albedo = (parts[:, :3] - 128.0) / 127.0, parts[:, 3:] / 255.0
    features = np.hstack([albedo * normals, _ALBEDO_WEIGHT * albedo, _NORMAL_WEIGHT * normals])
    kind = (distinct > 0).astype(np.uint8)
    weight = count / max(int(count.sum()), 1)
    spread = {1: _spread(features[kind == 1], weight[kind == 1])}
    while len(spread) < KINDS_OF_SURFACE - 1:
        widest = max(spread, key=lambda k: (spread[k][0], -k))
        energy, axis, middle = spread[widest]
        if energy < 1e-12:
            break
        new = len(spread) + 1
        inside = np.flatnonzero(kind == widest)
        kind[inside[(features[inside] - middle) @ axis > 0.0]] = new
        for k in (widest, new):
            members = kind == k
            spread[k] = _spread(features[members], weight[members])
    palette = np.zeros((KINDS_OF_SURFACE, 4), dtype=np.float32)
    for k, (_, _, middle) in spread.items():
        albedo = middle[3] / _ALBEDO_WEIGHT
        normal = middle[:3] / max(albedo, 1e-9)
        palette[k] = [*(normal / max(1.0, float(np.linalg.norm(normal)))), albedo]
    return palette, kind[which].reshape(surfaces.shape[:-1])


def _spread(features: Array, weight: Array) -> tuple[float, Array, Array]:
    """Energy of the variation of some surfaces, its longest axis, and their mean."""
    total = float(weight.sum())
    if total <= 0.0:
        return 0.0, np.zeros(7), np.zeros(7)
    middle = weight @ features / total
    apart = features - middle
    sizes, axes = np.linalg.eigh((apart * weight[:, None]).T @ apart)
    return float(sizes[-1]), axes[:, -1], middle
