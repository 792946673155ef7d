"""A palette of the surfaces beside the edges of a target, like the colour palette of a picture."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rendezview.geometry.pose import Array
from rendezview.sensors.appearance.model.contours import KINDS_OF_SURFACE

Bytes = npt.NDArray[np.uint8]

# Weights relative to differences of albedo × normal, which sunlight shows. Differences of albedo
# show in ambient light, differences of the normal in the visible width of a facet.
_ALBEDO_WEIGHT, _NORMAL_WEIGHT = 0.3, 0.1


def packed_surfaces(normals: Array, albedo: Array) -> Bytes:
    """(…, 4) bytes of mean normals (…, 3), up to sign, and albedo (…); 0 means no surface."""
    way = np.where(normals @ [0.9, 0.37, 0.23] < 0.0, -1.0, 1.0)
    whole = np.concatenate(
        [normals * way[..., None] * 127.0 + 128.0, np.clip(albedo, 0.0, 1.0)[..., None] * 255.0], -1
    )
    return np.where(albedo[..., None] > 0.0, np.rint(whole), 0.0).astype(np.uint8)


def surface_palette(surfaces: Bytes) -> tuple[npt.NDArray[np.float32], Bytes]:
    """A palette of many surfaces, and the palette entry of each.

    The entry with the largest variance is split repeatedly, at the mean along its longest axis, as
    for colour palettes (Wan, Wong & Prusinkiewicz, 1988).

    Args:
        surfaces: (…, 4) of ``packed_surfaces``.

    Returns:
        (KINDS_OF_SURFACE, 4) mean normal, up to sign, and albedo of each entry; the first means no
        surface, with albedo 0. (…) the entry of each surface.
    """
    packed = np.ascontiguousarray(surfaces).view("<u4")[..., 0]
    distinct, which, count = np.unique(packed, return_inverse=True, return_counts=True)
    parts = distinct.view(np.uint8).reshape(-1, 4).astype(np.float64)
    normals, albedo = (parts[:, :3] - 128.0) / 127.0, parts[:, 3:] / 255.0
    features = np.hstack([albedo * normals, _ALBEDO_WEIGHT * albedo, _NORMAL_WEIGHT * normals])
    kind = (distinct > 0).astype(np.uint8)
    weight = count / max(int(count.sum()), 1)
    members = {1: np.flatnonzero(kind)}
    spread = {1: _spread(features[members[1]], weight[members[1]])}
    while len(spread) < KINDS_OF_SURFACE - 1:
        widest = max(spread, key=lambda k: (spread[k][0], -k))
        energy, axis, middle = spread[widest]
        if energy < 1e-12:
            break
        new = len(spread) + 1
        inside = members[widest]
        beyond = (features[inside] - middle) @ axis > 0.0
        members[widest], members[new] = inside[~beyond], inside[beyond]
        kind[members[new]] = new
        for k in (widest, new):
            spread[k] = _spread(features[members[k]], weight[members[k]])
    palette = np.zeros((KINDS_OF_SURFACE, 4), dtype=np.float32)
    for k, (_, _, middle) in spread.items():
        albedo = middle[3] / _ALBEDO_WEIGHT
        normal = middle[:3] / max(albedo, 1e-9)
        palette[k] = [*(normal / max(1.0, float(np.linalg.norm(normal)))), albedo]
    return palette, kind[which].reshape(surfaces.shape[:-1])


def _spread(features: Array, weight: Array) -> tuple[float, Array, Array]:
    """Largest variance of some surfaces, its axis, and their mean."""
    total = float(weight.sum())
    if total <= 0.0:
        return 0.0, np.zeros(7), np.zeros(7)
    middle = weight @ features / total
    apart = features - middle
    sizes, axes = np.linalg.eigh((apart * weight[:, None]).T @ apart)
    return float(sizes[-1]), axes[:, -1], middle
