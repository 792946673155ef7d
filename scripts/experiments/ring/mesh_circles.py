"""Circular edges of a mesh: rings of vehicles whose CAD model does not name them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import trimesh
from rendezview.training.mesh import Mesh
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

_SHARP_RAD = math.radians(30.0)  # between the faces of an edge
_LEAST_SIDES = 30  # of the polygon: its mean radius is then within 0.2 % of its corners'
_ROUND = 0.01  # of the radius, largest distance from the circle
_AHEAD = 0.3  # of the radius; nothing of the vehicle before a ring by more
_LEAST_SHARE = 0.02  # of the vehicle's radius; smaller circles are details


@dataclass(frozen=True, eq=False)
class MeshCircle:
    """A circle with the outward axis."""

    centre_m: np.ndarray
    axis: np.ndarray
    radius_m: float
    # Others about the same axis, as `DockingRing.circles`
    circles: tuple[tuple[float, float], ...] = ()


def rings_of(mesh: Mesh) -> list[MeshCircle]:
    """Circular sharp edges with nothing of the vehicle before them; of several the outermost."""
    found = []
    every = _circles(mesh)
    for circle in every:
        for axis in (circle.axis, -circle.axis):
            off = mesh.vertices_m - circle.centre_m
            height = off @ axis
            beside = np.linalg.norm(off - np.outer(height, axis), axis=1)
            if height[beside < 1.5 * circle.radius_m].max() < _AHEAD * circle.radius_m:
                found.append(MeshCircle(circle.centre_m, axis, circle.radius_m))
    found.sort(key=lambda c: -c.radius_m)
    kept: list[MeshCircle] = []
    for one in found:
        if not any(
            np.linalg.norm(one.centre_m - other.centre_m) < other.radius_m
            and one.axis @ other.axis > 0.99
            for other in kept
        ):
            kept.append(replace(one, circles=_about(one, every)))
    return kept


def _about(ring: MeshCircle, every: list[MeshCircle]) -> tuple[tuple[float, float], ...]:
    """Circles about a ring's axis, not more than a radius behind it: height and radius."""
    found = []
    for other in every:
        off = other.centre_m - ring.centre_m
        height = float(off @ ring.axis)
        beside = float(np.linalg.norm(off - height * ring.axis))
        aligned = abs(float(other.axis @ ring.axis)) > 0.999
        itself = abs(height) + abs(other.radius_m - ring.radius_m) < 1e-9
        if aligned and beside < 0.01 * ring.radius_m and height > -ring.radius_m and not itself:
            found.append((height, other.radius_m))
    return tuple(found)


def _circles(mesh: Mesh) -> list[MeshCircle]:
    body = trimesh.Trimesh(mesh.vertices_m, mesh.faces, process=False)
    body.merge_vertices(merge_tex=True, merge_norm=True)
    edges, count = np.unique(np.sort(body.edges, axis=1), axis=0, return_counts=True)
    sharp = body.face_adjacency_edges[body.face_adjacency_angles > _SHARP_RAD]
    sharp = np.vstack([sharp, edges[count == 1]])
    size = len(body.vertices)
    joined = coo_matrix((np.ones(len(sharp)), (sharp[:, 0], sharp[:, 1])), shape=(size, size))
    label = connected_components(joined, directed=False)[1]
    circles = []
    for part in np.flatnonzero(np.bincount(label) >= _LEAST_SIDES):
        circle = _fitted(np.asarray(body.vertices[label == part]))
        if circle is not None and circle.radius_m > _LEAST_SHARE * mesh.bounding_sphere[1]:
            circles.append(circle)
    return circles


def _fitted(points: np.ndarray) -> MeshCircle | None:
    middle = points.mean(axis=0)
    across, along, normal = np.linalg.svd(points - middle, full_matrices=False)[2]
    flat = (points - middle) @ np.stack([across, along], axis=1)
    system = np.column_stack([2.0 * flat, np.ones(len(flat))])
    x, y, rest = np.linalg.lstsq(system, (flat**2).sum(axis=1), rcond=None)[0]
    radius = math.sqrt(rest + x * x + y * y)
    out = np.abs(np.hypot(*(flat - (x, y)).T) - radius).max()
    lift = np.abs((points - middle) @ normal).max()
    if max(out, lift) > _ROUND * radius:
        return None
    angles = np.sort(np.arctan2(*(flat - (x, y)).T))
    gaps = np.diff(np.append(angles, angles[0] + math.tau))
    if gaps.max() > 3.0 * math.tau / _LEAST_SIDES:
        return None
    radius *= mean_of_polygon(int(np.count_nonzero(gaps > 0.2 * gaps.max())))
    return MeshCircle(middle + x * across + y * along, normal, radius)


def mean_of_polygon(sides: int) -> float:
    """Mean radius of a regular polygon over that of its corners: an ellipse is fitted at this."""
    half = math.pi / sides
    return 1.0 - half * half / 3.0
