"""Which ellipses are edges of one ring: circles about one axis, in or near one plane.

A nozzle, a dish or the end of a tank has one edge, a ring several that are concentric. That, and
how much of each edge is seen, orders the ellipses of a frame where nothing else is known.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rendezview.camera import Camera
from rendezview.ring.circle_pose import circle_poses
from rendezview.ring.ellipse import Ellipse

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

_FULL_EDGES = 3.0  # so many edges seen whole score 1
_LEAST_RATIO = 0.55  # of the smaller edge's radius to the larger one's
_ASIDE = 0.05  # of the radius, how far centres may lie apart in the picture
_UNALIKE = 0.05  # difference of the shapes, relative


def families(
    camera: Camera, shapes: Array, arcs_rad: Array
) -> tuple[Ints, Array, Ints]:
    """Family numbers (K,), scores (K,) and the order (K,), best first.

    Args:
        camera: of the frame.
        shapes: (K, 5) shape vectors, px.
        arcs_rad: (K,) what is seen of each.
    """
    count = len(shapes)
    size = np.sqrt(shapes[:, 2] * shapes[:, 4] - shapes[:, 3] ** 2)  # of the circle of like area
    share = np.minimum(arcs_rad / (2.0 * np.pi), 1.0)
    family = np.full(count, -1)
    by_size = np.argsort(-size)
    number = 0
    for k in by_size:
        if family[k] >= 0:
            continue
        family[k] = number
        predicted = _concentric(camera, shapes[k])
        for j in by_size:
            if family[j] < 0 and size[j] > _LEAST_RATIO * size[k]:
                if any(_alike(shape(size[j] / size[k]), shapes[j]) for shape in predicted):
                    family[j] = number
        number += 1
    score = np.zeros(count)
    for f in range(number):
        members = family == f
        score[members] = min(float(share[members].sum()) / _FULL_EDGES, 1.0)
    # In a family the outermost edge that is seen well comes first: its radius is the ring's.
    well = np.zeros(count, dtype=bool)
    for f in range(number):
        members = family == f
        well |= members & (share >= 0.6 * share[members].max())
    order = sorted(range(count), key=lambda k: (-score[k], family[k], not well[k], -size[k]))
    score = score * (0.5 + 0.5 * share)
    return family, score, np.array(order)


def _concentric(camera: Camera, shape: Array):  # type: ignore[no-untyped-def]
    """Functions of a ratio of radii: the pictures of circles concentric with that of ``shape``."""
    from rendezview.ring.circle_pose import shape_of_circle

    found = []
    for pose in circle_poses(camera, Ellipse.from_shape(shape), 1.0):
        found.append(
            lambda ratio, pose=pose: shape_of_circle(camera, pose.centre_m, pose.axis, ratio)
        )
    return found


def _alike(predicted: Array | None, shape: Array) -> bool:
    if predicted is None:
        return False
    size = 0.5 * (shape[2] + shape[4])
    apart = np.abs(predicted - shape)
    return bool(
        np.hypot(apart[0], apart[1]) < _ASIDE * size + 0.5 and apart[2:].max() < _UNALIKE * size + 0.5
    )
