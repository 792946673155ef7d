"""Spheres of views around a port, for a camera closer than the whole target allows."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rendezview.geometry.camera import Camera
from rendezview.geometry.geodesic import Geodesic
from rendezview.geometry.pose import Array
from rendezview.io.target import DockingRing
from rendezview_ground.learn.options import TrainingOptions, ViewGeometry

# Of the target's radius, of the first sphere; each next one is a third of it, while it encloses
# the port. Source: close-in (0.1), seed 1: from 10 m to 1 m the errors of the client's axis
# are 0.04° at most, with one sphere of 2 m they are 0.3° at 10 m
_FIRST_RADII = 2.0 / 3.0
_NEXT = 1.0 / 3.0
_PORT_RADII = 2.0  # of its radius: what a sphere shows of the face around a port. Source: as above
# Of a sphere's radius, distances of its views: even in 1 / distance to a fifth of the sphere, as a
# camera between two of them sees. They meet those of the next sphere. Source: as above
_SHELLS = (0.5, 0.65, 0.85, 1.1, 1.4, 1.75)
_HALF_RAD = np.deg2rad(40.0)  # half the width of a view without a camera. Source: chosen, wide


@dataclass(frozen=True, slots=True, eq=False)
class NearViews:
    """The views of one sphere, which are to be drawn."""

    geometry: ViewGeometry  # with the sphere's centre and radius
    directions: Array  # (V, 3) unit, from the centre
    shells_m: Array  # (S,) distances from the centre


def near_spheres(
    whole: ViewGeometry, options: TrainingOptions, port: DockingRing, camera: Camera | None
) -> list[NearViews]:
    """Spheres around a port's centre, the largest first; views within a cone about its axis."""
    directions = Geodesic.of_order(options.order + 1).nodes
    axis = port.axis / np.linalg.norm(port.axis)
    cosines = directions @ axis
    least = min(np.cos(options.near_cone_rad), float(np.sort(cosines)[-_LEAST_VIEWS]))
    directions = np.ascontiguousarray(directions[cosines >= least])
    half_rad = _HALF_RAD if camera is None else min(_HALF_RAD, _corner_rad(camera))
    spheres = []
    radius_m = _FIRST_RADII * whole.target_radius_m
    while radius_m >= _PORT_RADII * port.radius_m:
        geometry = replace(
            whole, centre_m=port.centre_m, target_radius_m=radius_m, near_half_rad=half_rad
        )
        spheres.append(NearViews(geometry, directions, radius_m * np.array(_SHELLS)))
        radius_m *= _NEXT
    return spheres


def _corner_rad(camera: Camera) -> float:
    """Angle from the boresight to the farthest corner of the picture."""
    right, low = camera.width - 1.0, camera.height - 1.0
    rays = camera.rays(np.array([[0.0, 0.0], [right, 0.0], [0.0, low], [right, low]]))
    cosines = rays[:, 2] / np.linalg.norm(rays, axis=1)
    return float(np.arccos(cosines.min()))


_LEAST_VIEWS = 7  # of a coarse lattice: the one next to the axis and those around it
