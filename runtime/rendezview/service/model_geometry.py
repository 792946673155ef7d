"""The model's data for a 3-D view: contour points and the view sphere."""

from __future__ import annotations

import numpy as np

from rendezview.sensors.appearance import ViewModel
from rendezview.sensors.appearance.edges.contours import (
    DIRECTION_UNIT,
    NO_POINT,
    OUTLINE,
    POINT_UNIT,
)
from rendezview.service.model_messages import Geometry

_CELLS = 48  # per target radius; each cell keeps at most one point. Source: chosen
_MOST_POINTS = 6000  # cells grow until no more are left. Source: a chosen limit


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
    )
