"""Where the edges of a model are in the picture at a pose, for drawing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rendezview.geometry.camera import Camera
from rendezview.geometry.joint import apart, hinges_of
from rendezview.geometry.pose import Array, Pose
from rendezview.sensors.appearance.edges.alignment import nearest_views
from rendezview.sensors.appearance.edges.network import Box
from rendezview.sensors.appearance.model.contours import DIRECTION_UNIT, NO_POINT, POINT_UNIT
from rendezview.sensors.appearance.model.view_model import ViewModel

_FARTHEST_PX = 1e5  # from the picture, of a point that is kept. Source: a chosen limit
_STEP_RADII = 0.01  # of the target's radius, along an edge, for its direction. Source: chosen

NOWHERE: Box = (-1.0, -1.0, -1.0, -1.0)  # Source: by construction


@dataclass(frozen=True, slots=True, eq=False)
class ContourPixels:
    """Contour points of the view nearest to a pose, in the picture."""

    points_px: Array  # (N, 2)
    directions: Array  # (N, 2) unit, along the edge; zero where it points at the camera
    kinds: npt.NDArray[np.uint8]  # (N,) OUTLINE, STEP or CREASE


def contour_pixels(
    model: ViewModel, camera: Camera, pose: Pose, angles_rad: Array | None = None
) -> ContourPixels | None:
    """The contour of a model at ``camera_from_target``; None if the model has no contour points.

    ``angles_rad``: (J,) of the joints of a target that has any; ``None``: of the first.
    """
    if angles_rad is not None:
        model = model.configuration_at(angles_rad)
    contours = model.contours
    if contours is None:
        return None
    centre = pose.apply(model.centre_m)
    nearest = np.zeros(1, dtype=np.int64)
    rotation = pose.rotation.copy()  # numba compiles a copy for read-only arrays
    shell = nearest_views(model.lattice.nodes, contours.shells_m, rotation, centre, nearest)
    view = nearest[0]
    kinds = contours.kind[shell, view]
    used = kinds != NO_POINT
    radius_m = model.target_radius_m
    points_m = contours.point[shell, view][used] * (POINT_UNIT * radius_m)
    tangents = contours.tangent[shell, view][used] * DIRECTION_UNIT
    if angles_rad is not None and contours.part is not None:
        part = contours.part[shell, view][used]
        off_rad = apart(model.joints, angles_rad, model.angles_rad)
        for number, (k, hinge) in enumerate(hinges_of(model.joints)):
            own, angle = part == number + 1, float(off_rad[k])
            points_m[own] = hinge.moved(points_m[own] + model.centre_m, angle) - model.centre_m
            tangents[own] = tangents[own] @ hinge.turn(angle).T
    places_m = points_m @ pose.rotation.T + centre
    points_px = camera.project(places_m)
    beyond_px = camera.project(places_m + _STEP_RADII * radius_m * (tangents @ pose.rotation.T))
    inside = np.isfinite(points_px).all(axis=1) & (np.abs(points_px) < _FARTHEST_PX).all(axis=1)
    along = np.nan_to_num(beyond_px - points_px)
    length = np.linalg.norm(along, axis=1, keepdims=True)
    directions = np.divide(along, length, out=np.zeros_like(along), where=length > 0.0)
    return ContourPixels(points_px[inside], directions[inside], kinds[used][inside])


def target_box(model: ViewModel, camera: Camera, pose: Pose) -> Box:
    """Left, top, right, bottom, px, of the target at a pose: of the contour of its nearest view.

    All −1, outside the picture, where nothing of it is ahead of the camera.
    """
    contours, nearest = model.contours, np.zeros(1, dtype=np.int64)
    if contours is None:
        return NOWHERE
    centre = pose.apply(model.centre_m)
    rotation = pose.rotation.copy()  # numba compiles a copy for read-only arrays
    shell = nearest_views(model.lattice.nodes, contours.shells_m, rotation, centre, nearest)
    exists = contours.kind[shell, nearest[0]] != NO_POINT
    points = contours.point[shell, nearest[0]][exists] * (POINT_UNIT * model.target_radius_m)
    in_camera = points @ pose.rotation.T + centre
    px = np.asarray(camera.project(in_camera[in_camera[:, 2] > 0.0]))
    if not len(px) or not np.isfinite(px).all():
        return NOWHERE
    left, top, right, bottom = (float(v) for v in (*px.min(0), *px.max(0)))
    return left, top, right, bottom
