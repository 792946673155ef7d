"""Spots that are partly hidden: smaller beside their neighbours than they should be.

An edge that hides a part of a disc moves the middle of what is left, and makes it narrower across
the edge. The size tells by about how much, not which way.
"""

from __future__ import annotations

import numpy as np

from rendezview.geometry.pose import Array

# × ln(size) that is missing, × extent: by how much, one σ an axis, the middle has moved. Of 10 to
# 35 % hidden it moves by 2.6 to 3.3 of these. Source: experiment reflector-nees --kind "20 %"
_SHIFT = 2.2
# σ of ln(size) beside the neighbours', but for the noise: discs are not cut alike. Simulated ones
# scatter by 0.002. Source: a chosen limit
_SIZE_SIGMA = 0.006
# σ of ln(size) over that of the place, in sizes: simulated 0.7 to 0.8
_NOISE = 0.75  # Source: experiment reflector-nees --kind retro
_SURE = 2.5  # σ; 3.5 of the simulated scatter. Source: by construction, normal tail


def covered_px(sizes: Array, expected: Array, sigma: Array, blur_px: float) -> Array:
    """(K,) σ, px, of each spot's place by what may hide a part of it; 0 where nothing does.

    Args:
        sizes, expected: (K,) of the spots, and of their reflectors at the pose, px; three or more.
        sigma: (K,) px, of their places by noise.
        blur_px: σ of the optics and a pixel's width together.
    """
    missing = np.log(expected / sizes)
    missing = missing - np.median(missing)
    # Of a spot that is mostly blur, little of the size is the disc's.
    extent = np.sqrt(np.maximum(expected**2 - blur_px**2, (0.1 * expected) ** 2))
    disc = missing * (expected / extent) ** 2
    noise = np.median(sigma) / sizes  # a strange spot's own may be larger already
    doubt = np.hypot(_SIZE_SIGMA, _NOISE * noise) * (expected / extent) ** 2
    return np.where(disc > _SURE * doubt, _SHIFT * extent * disc, 0.0)
