"""Groups ellipses that are edges of one ring: circles about one axis, in or near one plane.

A nozzle, a dish or the end of a tank has one edge; a ring has several that are concentric and of
similar size. The number of edges, their visible arcs and their size order the ellipses of a frame
where nothing else is known.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rendezview.geometry.camera import Camera
from rendezview.sensors.ring.circle_pose import circles_of_shapes, shapes_of_circles

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

FULL_EDGES = 2.5  # full circles of a group that score 1. Source: by hand; see ring-accuracy
# Of the smallest edge's radius to the largest one's. Source: by hand; see ring-accuracy
LEAST_RATIO = 0.6
# Of the radius, how far centres may lie apart in the picture. Source: by hand; see ring-accuracy
_ASIDE = 0.04
_UNALIKE = 0.04  # difference of the shapes, relative. Source: by hand; see ring-accuracy


def concentric_groups(camera: Camera, shapes: Array, arcs_rad: Array) -> tuple[Ints, Array, Ints]:
    """Group numbers (K,), scores (K,) in 0 … 1 and the order (K,), best first.

    The score of a group is the visible arc of its edges, in full turns, times the size of its
    largest edge relative to the largest of the frame. Within a group the outermost edge
    comes first: its radius is the ring's.

    Args:
        camera: of the frame.
        shapes: (K, 5) shape vectors, px.
        arcs_rad: (K,) visible arc of each.
    """
    size = np.sqrt(shapes[:, 2] * shapes[:, 4] - shapes[:, 3] ** 2)  # of the circle of like area
    share = np.minimum(arcs_rad / (2.0 * np.pi), 1.0)
    group = _group(camera, shapes, size)
    worth = np.zeros(len(shapes))
    long = 0.5 * (shapes[:, 2] + shapes[:, 4]) + np.hypot(
        0.5 * (shapes[:, 2] - shapes[:, 4]), shapes[:, 3]
    )
    for number in range(int(group.max()) + 1):
        members = group == number
        visible = float(share[members].sum()) * float(long[members].max() / long.max())
        worth[members] = min(visible / FULL_EDGES, 1.0)
    order = np.lexsort((-size, group, -worth))
    return group, worth * (0.5 + 0.5 * share), order


def _group(camera: Camera, shapes: Array, size: Array) -> Ints:
    """(K,) numbers of groups: what the circles of a larger ellipse explain is in its group."""
    group = np.full(len(shapes), -1)
    centres, axes = circles_of_shapes(camera, shapes)
    near = 0.5 * (shapes[:, 2] + shapes[:, 4])
    number = 0
    for k in np.argsort(-size, kind="stable"):
        if group[k] >= 0:
            continue
        places, ways = (np.repeat(both[k], len(size), axis=0) for both in (centres, axes))
        expected = shapes_of_circles(camera, places, ways, np.tile(size / size[k], 2))
        off = np.abs(expected.reshape(2, -1, 5) - shapes)
        alike = np.hypot(off[..., 0], off[..., 1]) < _ASIDE * near + 0.5
        alike &= off[..., 2:].max(axis=2) < _UNALIKE * near + 0.5
        members = alike.any(axis=0) & (group < 0) & (size >= LEAST_RATIO * size[k])
        members[k] = True
        group[members] = number
        number += 1
    return group
