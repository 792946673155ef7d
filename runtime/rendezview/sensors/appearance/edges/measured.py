"""The edges of one frame at an aligned pose, and what a strain of the model does to them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rendezview.geometry.pose import Array
from rendezview.sensors.appearance.edges.grey import points_of_slopes
from rendezview.sensors.appearance.edges.predicted import FOUND, RESIDUAL, STATE, WEIGHT

# Components of a symmetric strain, in the order of all arrays. Source: by construction
STRAINS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))

_LEAST_RMS_PX = 0.3  # px; no frame's edges fit better. Source: by construction


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredEdges:
    """N edges that were found, with robust weights."""

    rotation: Array  # (3, 3) camera_from_target
    centre_m: Array  # (3,) view centre, camera frame
    residual_px: Array  # (N,) along the edge's normal, outwards
    weight: Array  # (N,) with Tukey's
    pose_slopes: Array  # (N, 6) of the predicted edge: px per rad and m, left perturbation

    @classmethod
    def of(cls, edges: Array, cut_px: float, rotation: Array, centre_m: Array) -> MeasuredEdges:
        """Those rows of the measurements (M, COLUMNS) that count; beyond the cut none does."""
        inside = (edges[:, STATE] == FOUND) & (np.abs(edges[:, RESIDUAL]) < cut_px)
        rows = edges[inside]
        tukey = (1.0 - (rows[:, RESIDUAL] / cut_px) ** 2) ** 2
        return cls(
            rotation.copy(),
            centre_m.copy(),
            rows[:, RESIDUAL].copy(),
            rows[:, WEIGHT] * tukey,
            rows[:, :6].copy(),
        )

    @property
    def places_m(self) -> Array:
        """(N, 3) of the edges on the target, from the view centre, target axes."""
        places: Array = points_of_slopes(self.pose_slopes, self.rotation, self.centre_m)
        return places

    @property
    def strain_slopes(self) -> Array:
        """(N, 6) of the predicted edge, px per unit of each of ``STRAINS``, target axes."""
        q, j = self.places_m, self.pose_slopes[:, 3:] @ self.rotation
        return np.stack(
            [j[:, a] * q[:, b] + (j[:, b] * q[:, a] if a != b else 0.0) for a, b in STRAINS], axis=1
        )

    @property
    def information(self) -> Array:
        """(6, 6) of the pose as ``pose_slopes`` has it, edges taken as independent."""
        sigma2 = max(self.residual_rms_px, _LEAST_RMS_PX) ** 2
        return np.asarray((self.pose_slopes * (self.weight / sigma2)[:, None]).T @ self.pose_slopes)

    @property
    def residual_rms_px(self) -> float:
        """Root of the weighted mean square."""
        total = float(self.weight.sum())
        return float(np.sqrt(self.weight @ self.residual_px**2 / total)) if total > 0.0 else np.inf
