"""Targets with joints: which faces turn, the mesh at an angle, a model of all configurations.

A configuration is a view model of the mesh at one angle of each joint. Between the configurations
the recognizer turns the contour points of the nearest one.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from rendezview.errors import RendezviewError
from rendezview.geometry.joint import Hinge, Joint, hinges_of
from rendezview.geometry.pose import Array
from rendezview.io.target import Target
from rendezview.sensors.appearance.model.view_model import ViewModel
from rendezview_ground.mesh.bounding_sphere import smallest_enclosing_sphere
from rendezview_ground.mesh.mesh import Mesh, load_mesh
from rendezview_ground.mesh.parts import faces_of
from rendezview_ground.mesh.triangles import random_points, twice_areas

STEP_RAD = math.radians(15.0)  # between configurations at most. Source: pose-joints (0.1)
_MOST_CONFIGURATIONS = 64  # of a model; each is as large as a model without joints
_UNSEEN_RADII = 0.003  # of the target's radius: a turn that moves the surface less shows nothing
_FAR_RADII = 2.0  # of the target's radius: an axis beyond is not the target's
_SAMPLES = 20_000  # points on a part's faces. Source: 1 % of a part's size between neighbours
_SPHERE_STEPS = 24  # angles at which the common bounding sphere is measured


def with_parts(mesh: Mesh, target: Target, unit: str | None = None) -> Mesh:
    """The target's mesh with the part of each face; the mesh itself without joints.

    Raises:
        RendezviewError: a joint has no faces, shares some with another, or its turn shows nothing.
    """
    if not target.joints:
        return mesh
    joints = [one.joint for one in target.joints]
    hinges, groups = hinges_of(joints), [parts for one in target.joints for parts in one.parts]
    for k, parts in enumerate(groups):
        for path in parts.meshes:
            mesh = _joined(mesh, load_mesh(path, unit or target.unit), k + 1)
    part = np.zeros(len(mesh.faces), np.uint8) if mesh.face_part is None else mesh.face_part.copy()
    for k, ((j, hinge), parts) in enumerate(zip(hinges, groups, strict=True)):
        chosen = faces_of(mesh, target, parts.nodes, parts.boxes_m, unit)
        if (chosen & (part > 0) & (part != k + 1)).any():
            raise RendezviewError(f"joint {joints[j].name!r} shares faces with another one")
        part[chosen] = k + 1
        _check(mesh, joints[j], hinge, part == k + 1)
    return replace(mesh, face_part=part)


def posed(mesh: Mesh, joints: Sequence[Joint], angles_rad: npt.ArrayLike) -> Mesh:
    """The mesh of ``with_parts`` with its joints at the angles (J,)."""
    angles = np.atleast_1d(np.asarray(angles_rad, dtype=np.float64))
    if mesh.face_part is None or not angles.any():
        return mesh
    vertices, faces = mesh.vertices_m, mesh.faces.copy()
    for k, (j, hinge) in enumerate(hinges_of(joints)):
        turning = mesh.face_part == k + 1
        own, number = np.unique(faces[turning], return_inverse=True)
        faces[turning] = (number.reshape(-1, 3) + len(vertices)).astype(faces.dtype)
        vertices = np.vstack([vertices, hinge.moved(mesh.vertices_m[own], float(angles[j]))])
    return replace(mesh, vertices_m=vertices, faces=faces)


def common_sphere(mesh: Mesh, joints: Sequence[Joint]) -> tuple[Array, float]:
    """Centre (3,) and radius (m) of a sphere around the mesh at all angles of its joints."""
    assert mesh.face_part is not None
    points = [mesh.vertices_m[np.unique(mesh.faces[mesh.face_part == 0])]]
    for k, (j, hinge) in enumerate(hinges_of(joints)):
        own = mesh.vertices_m[np.unique(mesh.faces[mesh.face_part == k + 1])]
        angles = np.linspace(joints[j].lowest_rad, joints[j].highest_rad, _SPHERE_STEPS + 1)
        points += [hinge.moved(own, float(angle)) for angle in angles]
    centre, radius = smallest_enclosing_sphere(np.vstack(points))
    # Between the angles a point swings out by the sagitta of its arc.
    widest = max((j.highest_rad - j.lowest_rad for j in joints), default=0.0) / _SPHERE_STEPS
    return centre, radius * (2.0 - math.cos(0.5 * widest))


def configuration_angles(joints: Sequence[Joint], step_rad: float = STEP_RAD) -> Array:
    """(K, J) angles of the configurations: all combinations of the joints' own.

    Raises:
        RendezviewError: there are too many.
    """
    each = [joint.configurations(step_rad) for joint in joints]
    count = math.prod(len(angles) for angles in each)
    if count > _MOST_CONFIGURATIONS:
        raise RendezviewError(
            f"the joints need {count} configurations, more than {_MOST_CONFIGURATIONS}: narrow "
            "limits_deg, give "
            "symmetry_deg, let parts share a joint, or take a larger --joint-step"
        )
    return np.array(list(itertools.product(*each)))


def model_of_configurations(
    configurations: Sequence[ViewModel], joints: Sequence[Joint], angles: Array
) -> ViewModel:
    """One model of the configurations at angles (K, J)."""
    own = [
        replace(configuration, joints=tuple(joints), angles_rad=angles[k].copy())
        for k, configuration in enumerate(configurations)
    ]
    return replace(own[0], configurations=tuple(own[1:]))


def _joined(mesh: Mesh, other: Mesh, part: int) -> Mesh:
    """Both, the faces of the other as a part."""
    before = np.zeros(len(mesh.faces), np.uint8) if mesh.face_part is None else mesh.face_part
    return Mesh(
        np.vstack([mesh.vertices_m, other.vertices_m]),
        np.vstack([mesh.faces, other.faces + len(mesh.vertices_m)]).astype(np.int32),
        np.vstack([mesh.face_rgb, other.face_rgb]),
        (*mesh.notes, *other.notes),
        np.concatenate([before, np.full(len(other.faces), part, np.uint8)]),
    )


def _check(mesh: Mesh, joint: Joint, hinge: Hinge, turning: npt.NDArray[np.bool_]) -> None:
    """A hinge of a joint has faces, its axis is near the target, and its turn can be seen.

    Raises:
        RendezviewError: one of these does not hold.
    """
    centre_m, radius_m = mesh.bounding_sphere
    if not turning.any():
        raise RendezviewError(f"joint {joint.name!r}: no face of the mesh is one of its parts")
    if turning.all():
        raise RendezviewError(f"joint {joint.name!r}: all faces turn: that is the pose, no joint")
    aside = np.cross(hinge.axis, centre_m - hinge.origin_m)
    if np.linalg.norm(aside) > _FAR_RADII * radius_m:
        raise RendezviewError(
            f"joint {joint.name!r}: its axis passes {np.linalg.norm(aside):.3g} m from the middle "
            f"of a target of {radius_m:.3g} m radius: correct origin_m (metres, target frame)"
        )
    surface, samples = cKDTree(_points_on(mesh, turning)), _points_on(mesh, turning, seed=1)
    span = (joint.period_rad or joint.highest_rad - joint.lowest_rad) / 2.0
    moved = hinge.moved(samples, min(span, math.radians(40.0)))
    sampled = float(surface.query(samples)[0].max())  # two samplings of the same surface
    farthest = float(surface.query(moved)[0].max()) - sampled
    if farthest < _UNSEEN_RADII * radius_m:
        raise RendezviewError(
            f"joint {joint.name!r} cannot be observed: a turn of its parts about the axis moves "
            f"their surface by {max(farthest, 0.0):.2g} m at most"
        )


def _points_on(mesh: Mesh, chosen: npt.NDArray[np.bool_], seed: int = 0) -> Array:
    """(N, 3) points on the chosen faces (F,), evenly by area, and their corners."""
    corners = mesh.vertices_m[mesh.faces[chosen]]
    rng = np.random.default_rng(seed)
    spread, _ = random_points(corners, twice_areas(corners), _SAMPLES, rng)
    return np.vstack([spread, corners.reshape(-1, 3)])
