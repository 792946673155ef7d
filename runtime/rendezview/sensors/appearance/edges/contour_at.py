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
from rendezview.sensors.appearance.model.contours import (
    DIRECTION_UNIT,
    NO_POINT,
    POINT_UNIT,
    Contours,
)
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
    centre, radius_m = pose.apply(model.centre_m), model.target_radius_m
    used, points_m = nearest_points(model, contours, pose)
    tangents = contours.tangent[used] * DIRECTION_UNIT
    if angles_rad is not None and contours.part is not None:
        part = contours.part[used]
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
    return ContourPixels(points_px[inside], directions[inside], contours.kind[used][inside])


def nearest_points(
    model: ViewModel, contours: Contours, pose: Pose
) -> tuple[tuple[int, int, npt.NDArray[np.intp]], Array]:
    """Where the contour points of the view nearest to a pose are in the tables, and the points
    (N, 3) m from the view centre, target axes."""
    nearest = np.zeros(1, dtype=np.int64)
    centre = pose.apply(model.centre_m)
    rotation = pose.rotation.copy()  # numba compiles a copy for read-only arrays
    shell = nearest_views(model.lattice.nodes, contours.shells_m, rotation, centre, nearest)
    view = int(nearest[0])
    used = shell, view, np.flatnonzero(contours.kind[shell, view] != NO_POINT)
    return used, contours.point[used] * (POINT_UNIT * model.target_radius_m)


def target_box(model: ViewModel, camera: Camera, pose: Pose) -> Box:
    """Left, top, right, bottom, px, of the target at a pose: of the contour of its nearest view.

    All −1, outside the picture, where nothing of it is ahead of the camera.
    """
    if model.contours is None:
        return NOWHERE
    _, points_m = nearest_points(model, model.contours, pose)
    in_camera = points_m @ pose.rotation.T + pose.apply(model.centre_m)
    px = np.asarray(camera.project(in_camera[in_camera[:, 2] > 0.0]))
    if not len(px) or not np.isfinite(px).all():
        return NOWHERE
    left, top, right, bottom = (float(v) for v in (*px.min(0), *px.max(0)))
    return left, top, right, bottom
