"""Edge profiles: the surfaces beside an edge, as seen from a pose.

The model stores the surfaces beside an edge as one of its views shows them, with their depths.
At another pose a surface begins at the projection of the stored place, unless it is hidden.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.geometry.pose import Array
from rendezview.geometry.so3 import rotate_back_into
from rendezview.sensors.appearance.model.contours import (
    DEPTH_UNIT,
    SURFACES,
    start_radii,
)
from rendezview.sensors.appearance.model.view_tables import ProjectedEdge, Two

Kinds = npt.NDArray[np.uint8]
Starts = npt.NDArray[np.int8]


class ViewAtPose(NamedTuple):
    """One view of the model, and the pose that its edges are looked for at."""

    eye: Array  # (3,) the camera of the model's view, target axes at the view centre
    radius_m: float  # of the target
    rotation: Array  # (3, 3) of the pose
    centre: Array  # (3,) of the view centre, camera frame
    sunward: Array  # (3,) to the Sun, target axes, or zero
    shade: Array  # (K,) brightness of each kind of surface


class ProfileScratch(NamedTuple):
    """Arrays of one edge's expected profile, used again for the next."""

    depths: Array  # (SURFACES,) where its steps lie, pixels inwards
    levels: Array  # (SURFACES,) their heights, grey levels
    places: Array  # (SURFACES,) where its surfaces begin, pixels inwards
    axes: Array  # (6,) of ``edge_axes``
    away: Array  # (3,) unit, from the camera of the model's view


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def view_at_pose(
    eye: Array, radius_m: float, rotation: Array, centre: Array, sun: Array, shade: Array
) -> ViewAtPose:
    """A view of the model at a pose; ``sun``: (3,) direction to the Sun, camera frame, or zero."""
    sunward = np.empty(3)
    rotate_back_into(rotation, sun, sunward)
    return ViewAtPose(eye, radius_m, rotation, centre, sunward, shade)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def profile_scratch() -> ProfileScratch:
    """New arrays."""
    return ProfileScratch(
        np.empty(SURFACES), np.empty(SURFACES), np.empty(SURFACES), np.empty(6), np.empty(3)
    )


_STEP_GREY = 5.0  # grey levels; smaller steps are left out. Source: commit 59eb67e
# grey levels; a profile with less has no edge. Source: by hand, seeds of docs/notes/refinement.md
LEAST_CONTRAST = 4.0
FAR_PX = 99.0  # px; where the first surface of an inner edge begins. Source: by construction
# px; a surface moves no more than this and three times its place. Source: by hand, seeds of
# docs/notes/refinement.md
SLACK_PX = 3.0


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def edge_axes(
    eye: Array, x: float, y: float, z: float, tangent: npt.NDArray[np.int8], out: Array
) -> None:
    """Unit vectors normal to the edge at a point seen from ``eye``, target axes, into ``out`` (6,).

    The first (3,) points to the camera, the second (3,) outwards in the picture.
    """
    w0, w1, w2 = eye[0] - x, eye[1] - y, eye[2] - z
    t0, t1, t2 = float(tangent[0]), float(tangent[1]), float(tangent[2])
    o0, o1, o2 = t2 * w1 - t1 * w2, t0 * w2 - t2 * w0, t1 * w0 - t0 * w1
    along = (w0 * t0 + w1 * t1 + w2 * t2) / (t0 * t0 + t1 * t1 + t2 * t2 + 1e-9)
    w0, w1, w2 = w0 - along * t0, w1 - along * t1, w2 - along * t2
    inverse = 1.0 / (np.sqrt(w0 * w0 + w1 * w1 + w2 * w2) + 1e-30)
    out[0], out[1], out[2] = w0 * inverse, w1 * inverse, w2 * inverse
    inverse = 1.0 / (np.sqrt(o0 * o0 + o1 * o1 + o2 * o2) + 1e-30)
    out[3], out[4], out[5] = o0 * inverse, o1 * inverse, o2 * inverse


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def project_start(
    x: float, y: float, z: float, inside: float, deeper: float, eye: Array, axes: Array,
    rotation: Array, centre: Array,
) -> Two:  # fmt: skip
    """Where a surface beside the point (x, y, z) begins in the picture, normalised (x, y).

    In the model's view it begins ``inside`` metres inwards of the point and ``deeper`` metres
    beyond it.

    Args:
        eye: (3,) the camera of that view, target axes at the view centre.
        axes: (6,) of ``edge_axes`` from there.
        rotation, centre: of the pose, camera frame.
    """
    ax, ay, az = x - eye[0], y - eye[1], z - eye[2]
    more = 1.0 + deeper / np.sqrt(ax * ax + ay * ay + az * az)
    bx = eye[0] + more * (ax - inside * axes[3])
    by = eye[1] + more * (ay - inside * axes[4])
    bz = eye[2] + more * (az - inside * axes[5])
    u = rotation[0, 0] * bx + rotation[0, 1] * by + rotation[0, 2] * bz + centre[0]
    v = rotation[1, 0] * bx + rotation[1, 1] * by + rotation[1, 2] * bz + centre[1]
    w = rotation[2, 0] * bx + rotation[2, 1] * by + rotation[2, 2] * bz + centre[2]
    inverse = 1.0 / w
    return u * inverse, v * inverse


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def in_shadow(wide: float, rise: float, sunward: Array, axes: Array, away: Array) -> bool:
    """Whether a wall at the inner end of a surface casts its shadow over all of the surface.

    Args:
        wide, rise: width of the surface and height of the wall, in one unit.
        sunward: (3,) to the Sun, or 0.
        axes: (6,) of ``edge_axes``, and ``away``: (3,) unit, from the camera of the model's view.
    """
    over = -(sunward[0] * axes[3] + sunward[1] * axes[4] + sunward[2] * axes[5])
    up = -(sunward[0] * away[0] + sunward[1] * away[1] + sunward[2] * away[2])
    return rise > 0.0 and over > 0.0 and rise * over > wide * max(up, 0.0)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def profile_steps(
    outline: bool, strip: Kinds, shade: Array, places: Array, shaded: bool, depths: Array,
    levels: Array,
) -> int:  # fmt: skip
    """Depths and steps in brightness of an edge profile; how many.

    A surface that would begin where it has ended is hidden by the next.

    Args:
        outline: whether it is an outline; the first level of an inner edge is left out, since it
            is the background.
        strip: (SURFACES,) kinds, from outside to inside.
        shade: (K,) brightness of each kind.
        places: (SURFACES,) where each begins, pixels inwards; an inner edge's first: far outside.
        shaded: whether the first lies in the shadow of a wall at its end.
        depths, levels: (SURFACES,) get the steps.
    """
    steps, before = 0, 0.0
    if not outline:
        before = shade[strip[0]]
    for k in range(0 if outline else 1, SURFACES):
        if k + 1 < SURFACES and places[k + 1] <= places[k]:
            continue
        level = 0.0 if k == 0 and shaded else shade[strip[k]]
        if (outline and steps == 0) or abs(level - before) > _STEP_GREY:
            depths[steps], levels[steps] = places[k], level - before
            steps += 1
            before = level
    return steps


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def _places_into(
    px: float, py: float, pz: float, edge: ProjectedEdge, outline: bool, start: Starts,
    body_px: float, view: ViewAtPose, axes: Array, places: Array,
) -> None:  # fmt: skip
    """Fill ``places`` (SURFACES,): where the surfaces beside an edge begin, pixels inwards.

    Args:
        px, py, pz: the edge's point, target axes at the view centre, m.
        edge: its projection.
        start: (SURFACES − 1, 2) as in ``Contours``.
        body_px: the target's radius at the edge's depth.
        axes: (6,) of ``edge_axes``.
    """
    places[0] = 0.0 if outline else -FAR_PX
    for k in range(1, SURFACES):
        inside = start_radii(start[k - 1, 0])
        deeper = start[k - 1, 1] * DEPTH_UNIT
        x, y = project_start(
            px, py, pz, inside * view.radius_m, deeper * view.radius_m, view.eye, axes,
            view.rotation, view.centre,
        )  # fmt: skip
        projected = -(edge.gx * (x - edge.x) + edge.gy * (y - edge.y))
        inside *= body_px
        far = 3.0 * abs(inside) + SLACK_PX
        places[k] = min(max(projected, inside - far), inside + far)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def expected_profile(
    px: float, py: float, pz: float, tangent: npt.NDArray[np.int8], edge: ProjectedEdge,
    outline: bool, strip: Kinds, start: Starts, body_px: float, view: ViewAtPose,
    scratch: ProfileScratch,
) -> int:  # fmt: skip
    """The steps in brightness that the model expects beside an edge, into ``scratch``; how many.

    0 where none is high enough to see. The arguments are those of ``_places_into``; ``tangent``
    and ``strip`` are as in ``Contours``.
    """
    eye, axes, away = view.eye, scratch.axes, scratch.away
    edge_axes(eye, px, py, pz, tangent, axes)
    _places_into(px, py, pz, edge, outline, start, body_px, view, axes, scratch.places)
    shaded = False
    if outline:
        x, y, z = px - eye[0], py - eye[1], pz - eye[2]
        length = np.sqrt(x * x + y * y + z * z)
        away[0], away[1], away[2] = x / length, y / length, z / length
        rise = -start[0, 1] * DEPTH_UNIT
        shaded = in_shadow(start_radii(start[0, 0]), rise, view.sunward, axes, away)
    steps = profile_steps(
        outline, strip, view.shade, scratch.places, shaded, scratch.depths, scratch.levels
    )
    contrast = 0.0
    for step in range(steps):
        contrast = max(contrast, abs(scratch.levels[step]))
    return steps if contrast > LEAST_CONTRAST else 0
