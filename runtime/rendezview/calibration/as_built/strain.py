"""A strain of a model: its contour and surface points moved."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Array
from rendezview.sensors.appearance.edges.measured import STRAINS
from rendezview.sensors.appearance.model.contours import DIRECTION_UNIT, Contours
from rendezview.sensors.appearance.model.view_model import ViewModel

_INT16 = 32767  # Source: by construction, the largest stored coordinate


def strained(
    model: ViewModel, strain: Array, covariance: Array | None = None, shape_error: float = 0.0
) -> ViewModel:
    """The model with its points and sketches moved by a strain (3, 3) about the view centre.

    The outline's signatures and trees stay: they tell views apart, which strains of a few percent
    do not change.

    Args:
        model: any; its own shape error and an earlier calibration's covariance are replaced.
        strain: (3, 3) symmetric, target axes.
        covariance: (6, 6) of the strain, for the covariance of poses; None: exact.
        shape_error: σ of a strain that remains, see ``target.toml``.
    """
    if model.contours is None:
        raise RendezviewError("the model has no contour points: train it with contours")
    matrix = np.eye(3) + strain
    # Stored coordinates are shares of the radius; a larger target has a larger one.
    grown = max(float(np.linalg.eigvalsh(matrix).max()), 1.0)
    contours: Contours = replace(
        model.contours,
        point=_points(model.contours.point, matrix / grown),
        tangent=turned_directions(model.contours.tangent, matrix),
    )
    surface = model.surface
    if surface is not None:
        normal = turned_directions(surface.normal, np.linalg.inv(matrix).T)
        surface = replace(surface, point=_points(surface.point, matrix / grown), normal=normal)
    sketches = model.sketches
    if sketches is not None:
        sketches = sketches.deformed(matrix / grown)
    return replace(
        model,
        contours=contours,
        surface=surface,
        sketches=sketches,
        target_radius_m=grown * model.target_radius_m,
        shape_error=shape_error,
        shape_covariance=covariance,
        provenance=model.provenance | {"strain": strain.tolist()},
    )


def _points(points: npt.NDArray[np.int16], matrix: Array) -> npt.NDArray[np.int16]:
    return stored_points(points.astype(np.float32) @ matrix.T.astype(np.float32))


def stored_points(points: npt.NDArray[np.floating]) -> npt.NDArray[np.int16]:
    """Points in units of what is stored, rounded; beyond 1.02 radii they stay there."""
    return np.asarray(np.clip(np.rint(points), -_INT16, _INT16), dtype=np.int16)


def turned_directions(
    directions: npt.NDArray[np.int8], matrix: npt.NDArray[Any]
) -> npt.NDArray[np.int8]:
    """Stored directions (…, 3) mapped by a matrix (3, 3)."""
    moved = directions.astype(np.float32) @ matrix.T.astype(np.float32)
    length = np.linalg.norm(moved, axis=-1, keepdims=True)
    return np.asarray(np.rint(moved / np.maximum(length, 1e-6) / DIRECTION_UNIT), dtype=np.int8)


def matrix_of(strain: Array) -> Array:
    """(3, 3) of the components (6,)."""
    matrix = np.zeros((3, 3))
    for value, (a, b) in zip(strain, STRAINS, strict=True):
        matrix[a, b] = matrix[b, a] = value
    return matrix


def strain_names() -> list[str]:
    """``xx``, ``yy`` and so on, in the order of the components."""
    return [f"{'xyz'[a]}{'xyz'[b]}" for a, b in STRAINS]
