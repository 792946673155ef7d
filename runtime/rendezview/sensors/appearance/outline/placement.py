"""From a match to space: a point for each active node, and one pose with its covariance."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.geometry.pose import Array, Pose, minimal_rotation
from rendezview.geometry.so3 import about_origin
from rendezview.sensors.appearance.model.signature import Signature, twist
from rendezview.sensors.appearance.model.view_model import HeldOut, ViewModel
from rendezview.sensors.appearance.outline.votes import Match


def node_points(model: ViewModel, match: Match, signature: Signature) -> Array:
    """(K, 3) m, target frame: where each active node puts the camera (eq. 4a)."""
    nodes = match.active_nodes
    range_m = range_from_area(
        model, model.views.area_m2[nodes], model.views.area_slope[nodes], signature.area_sr
    )
    return np.asarray(model.centre_m + range_m[:, None] * model.geodesic.nodes[nodes])


def range_from_area(model: ViewModel, area_m2: Array, slope: Array, area_sr: float) -> Array:
    """Range of the view centre from the silhouette's area (Cleghorn & Sternberg, eq. 4a).

    The paper's ``d_ref sqrt(A_ref/A_obs) f_image/f_reference`` with both areas in
    steradians, where the focal lengths cancel. ``area_sr × range²`` of a view at range r
    is ``area_m2 (1 + slope (R/r − 1))``: the near side of a target looms at close range,
    which the paper's weak perspective leaves out. ``slope = 0`` gives eq. 4a as printed.

    Args:
        model: for its sphere radius R.
        area_m2: (K,) ``area_sr × R²`` of each view at the sphere radius.
        slope: (K,) perspective of each view.
        area_sr: observed area.
    """
    range_m = np.empty(len(area_m2))
    _ranges(area_m2, slope, area_sr, model.sphere_radius_m, range_m)
    return range_m


@njit(cache=True, nogil=True, error_model="numpy")
def _ranges(area_m2: Array, slope: Array, area_sr: float, radius_m: float, range_m: Array) -> None:
    """``range_from_area`` into (K,)."""
    for k in range(len(range_m)):
        range_m[k] = np.sqrt(area_m2[k] / area_sr)
        for _ in range(4):
            # The linear model does not hold far inside the sphere; bound it there.
            loom = max(1.0 + slope[k] * (radius_m / range_m[k] - 1.0), 0.1)
            range_m[k] = np.sqrt(area_m2[k] * loom / area_sr)


def place(model: ViewModel, match: Match, signature: Signature) -> tuple[Pose, Array]:
    """``camera_from_target`` of a match and its (6, 6) covariance."""
    views = model.views
    near, share = _views_around(model, match.direction)
    attitude = match.centred_from_target
    range_m = float(
        range_from_area(
            model,
            np.array([share @ views.area_m2[near]]),
            np.array([share @ views.area_slope[near]]),
            signature.area_sr,
        )[0]
    )
    # The view centre is off the centroid's line of sight by each view's offset, rolled.
    rolls = twist(attitude, views.centred_from_target[near])
    line = np.append(share @ turned_offsets(views.offset_m[near], rolls) / range_m, 1.0)
    line /= np.sqrt(line @ line)
    # The trees vote for the direction from the view centre; turn the attitude to show it there.
    attitude = attitude @ minimal_rotation(match.direction, -attitude.T @ line)
    camera_from_centred = signature.centred_from_camera.T
    rotation = camera_from_centred @ attitude
    centre = camera_from_centred @ (range_m * line)
    pose = Pose(rotation, centre - rotation @ model.centre_m)
    return pose, covariance_of_place(model, model.held_out, pose)


def turned_offsets(offset_m: Array, roll_rad: Array | float) -> Array:
    """Offsets (…, 2) of view centres off the centroid's line of sight, as views at rolls (…)."""
    c, s = np.cos(roll_rad), np.sin(roll_rad)
    x, y = offset_m[..., 0], offset_m[..., 1]
    return np.stack([c * x - s * y, s * x + c * y], axis=-1)


def _views_around(model: ViewModel, direction: Array) -> tuple[npt.NDArray[np.intp], Array]:
    """The views around a direction and their shares, which fall to 0 at 1.5 half edges."""
    lattice = model.lattice
    reach = 1.5 * lattice.mean_edge_rad
    near = lattice.within(direction, reach)
    share = np.maximum(lattice.nodes[near] @ direction - np.cos(reach), 1e-9)
    return near, share / share.sum()


def covariance_of_place(model: ViewModel, errors: HeldOut, pose: Pose) -> Array:
    """(6, 6) from errors as on held-out views: direction, roll, range and bearing.

    A turn of the target about its view centre moves its frame's origin too, so rotation
    and translation are correlated through the arm between the two.
    """
    centre = pose.apply(model.centre_m)
    along = np.outer(centre, centre) / (centre @ centre)
    across = np.eye(3) - along
    bearing_m = errors.bearing_rad * model.sphere_radius_m
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = errors.direction_rad**2 * across + errors.roll_rad**2 * along
    covariance[3:, 3:] = bearing_m**2 * across
    covariance[3:, 3:] += errors.range_fraction**2 * (centre @ centre) * along
    return about_origin(covariance, pose.rotation @ model.centre_m)
