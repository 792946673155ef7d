"""The model's data for a 3-D view: contour points and the view sphere."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from rendezview.geometry.pose import Array
from rendezview.sensors.appearance import ViewModel
from rendezview.sensors.appearance.judge.shading import SurfaceTables
from rendezview.sensors.appearance.model.contours import (
    DIRECTION_UNIT,
    NO_POINT,
    OUTLINE,
    POINT_UNIT,
)
from rendezview_service.messages.model_messages import Geometry

_CELLS = 48  # per target radius; each cell keeps at most one point. Source: chosen
_MOST_POINTS = 6000  # cells grow until no more are left. Source: a chosen limit
_DISC = 2.6  # radius over the median distance of the nearest point. Source: chosen by eye


def geometry(name: str, model: ViewModel) -> Geometry:
    """Contour points of all views, thinned, and the nodes and edges of the view sphere."""
    points, tangents, kinds = np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, dtype=np.uint8)
    cell = 1.0 / _CELLS
    contours = model.contours
    if contours is not None:
        shell = len(contours.shells_m) // 2
        kind = contours.kind[shell].ravel()
        used = kind != NO_POINT
        # Creases and steps first: they lie at fixed places, outlines move with the view.
        order = np.argsort(np.where(kind[used] == OUTLINE, 1, 0), kind="stable")
        kinds = kind[used][order]
        points = contours.point[shell].reshape(-1, 3)[used][order] * POINT_UNIT
        tangents = contours.tangent[shell].reshape(-1, 3)[used][order] * DIRECTION_UNIT
        while True:
            first = np.unique(np.floor(points / cell).astype(np.int32), axis=0, return_index=True)
            points, tangents, kinds = (part[first[1]] for part in (points, tangents, kinds))
            if len(points) <= _MOST_POINTS:
                break
            cell *= 1.25
    length = np.maximum(np.linalg.norm(tangents, axis=1, keepdims=True), 1e-9)
    sphere = model.geodesic
    surface, normals, albedo, disc_m = _surface(model)
    return Geometry(
        model=name,
        target_radius_m=model.target_radius_m,
        sphere_radius_m=model.sphere_radius_m,
        centre_m=model.centre_m.tolist(),
        nodes=np.round(sphere.nodes, 6).tolist(),
        edges=sphere.edges.tolist(),
        points_m=np.round(points * model.target_radius_m + model.centre_m, 5).tolist(),
        tangents=np.round(tangents / length, 4).tolist(),
        kinds=kinds.tolist(),
        spacing_m=cell * model.target_radius_m,
        surface_m=np.round(surface + model.centre_m, 4).tolist(),
        normals=np.round(normals, 2).tolist(),
        albedo=np.round(albedo, 2).tolist(),
        disc_m=disc_m,
    )


def _surface(model: ViewModel) -> tuple[Array, Array, Array, float]:
    """Points about the view centre, outward normals, albedo, and the radius of a disc."""
    if model.surface is None or len(model.surface.albedo) < 2:
        return np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), 0.0
    tables = SurfaceTables.of(model.surface, model.target_radius_m)
    count = len(tables.albedo)
    seen = np.unpackbits(tables.seen, axis=1, bitorder="little")[:, :count].astype(np.float64)
    towards = seen.T @ tables.nodes  # a stored normal points either way; it is seen from outside
    facing = np.sign(np.sum(tables.normal * towards, axis=1, keepdims=True))
    normals = np.where(facing < 0.0, -tables.normal, tables.normal)
    points = tables.point.T
    apart, _ = cKDTree(points).query(points, k=2)
    return points, normals, tables.albedo, _DISC * float(np.median(apart[:, 1]))
