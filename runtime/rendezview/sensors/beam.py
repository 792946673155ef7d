"""What the beam of a ranger may meet: planes of the target, or its whole mesh."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rendezview.geometry.pose import Array
from rendezview.geometry.ray_cast import first_hits

# σ of the spot's place by which it must lie within its surface. Source: normal distribution, 95 %
_INSIDE = 2.0
# Cosine of beam and surface normal below which a range is not used. Source: by construction, 3°: 1
# mm of relief is 2 cm of range
_GRAZING = 0.05
# Of the rays around the beam: on ellipses of 1 and 2 σ of the spot. Source: by construction
_AROUND = np.array(
    [(r * math.cos(a), r * math.sin(a)) for r in (1, 2) for a in np.arange(8) * np.pi / 4]
)


class Met(NamedTuple):
    """A plane that stands for what a beam meets, target frame."""

    distance_m: float  # along the beam
    normal: Array  # (3,) unit
    relief_m: float  # σ of the real surface about the plane


@dataclass(frozen=True, slots=True, eq=False)
class BeamSurface:
    """A plane of the target that a ranger's beam may hit, with its extent and roughness.

    Raises:
        ValueError: no unit normal, or a length is negative.
    """

    point_m: Array  # (3,) target frame
    normal: Array  # (3,) unit, target frame
    relief_m: float = 0.0  # σ of the real surface about the plane; a bias while the spot stays
    inner_m: float = 0.0  # from the point to where it begins: a nozzle in its middle
    outer_m: float = math.inf  # from the point to where it ends

    def __post_init__(self) -> None:
        point, normal = (np.array(v, dtype=np.float64) for v in (self.point_m, self.normal))
        if point.shape != (3,) or not np.isfinite(point).all():
            raise ValueError(f"point_m must be three finite numbers, not {self.point_m}")
        if normal.shape != (3,) or not 0.0 < float(np.linalg.norm(normal)) < math.inf:
            raise ValueError(f"normal must be a vector (3,), not {self.normal}")
        if not (0.0 <= self.relief_m < math.inf and 0.0 <= self.inner_m < self.outer_m):
            raise ValueError(
                f"relief_m must not be negative, outer_m beyond inner_m: {self.relief_m}, "
                f"{self.inner_m}, {self.outer_m}"
            )
        object.__setattr__(self, "point_m", point)
        object.__setattr__(self, "normal", normal / np.linalg.norm(normal))

    def met(self, start_m: Array, beam: Array, spread: Array) -> Met | str:
        """Where a beam meets the plane; words if it does not, or not with certainty.

        Args:
            start_m, beam: (3,) origin and unit direction, target frame.
            spread: (3, 3) covariance of the spot's place, m², target frame.
        """
        slant = float(self.normal @ beam)
        if abs(slant) < _GRAZING:
            return "the beam grazes the surface"
        distance_m = float(self.normal @ (self.point_m - start_m)) / slant
        if not distance_m > 0.0:
            return "the surface would be behind the ranger"
        if self.inner_m > 0.0 or self.outer_m < math.inf:
            off = start_m + distance_m * beam - self.point_m
            from_point = float(np.sqrt(off @ off))
            margin_m = _INSIDE * float(np.sqrt(spread.diagonal().max()))
            if not self.inner_m + margin_m <= from_point <= self.outer_m - margin_m:
                return f"the beam may miss the surface: {from_point:.2g} m from its middle"
        return Met(distance_m, self.normal, self.relief_m)


@dataclass(frozen=True, slots=True, eq=False)
class BeamMesh:
    """The target's mesh: a beam is cast on it at the state, and beside it within the spot's σ."""

    vertices_m: Array  # (V, 3) target frame
    faces: npt.NDArray[np.int32]  # (F, 3)
    relief_m: float = 0.0  # σ of the real surface about the mesh
    corners: Array = field(init=False)  # (F, 3, 3)
    centres: Array = field(init=False)  # (F, 3) and
    radii: Array = field(init=False)  # (F,) of a sphere around each face

    def __post_init__(self) -> None:
        corners = np.asarray(self.vertices_m, dtype=np.float64)[self.faces]
        centres = 0.5 * (corners.min(axis=1) + corners.max(axis=1))
        object.__setattr__(self, "corners", corners)
        object.__setattr__(self, "centres", centres)
        radii = np.sqrt(((corners - centres[:, None]) ** 2).sum(axis=2).max(axis=1))
        object.__setattr__(self, "radii", radii)

    def met(self, start_m: Array, beam: Array, spread: Array) -> Met | str:
        """The plane that the beam meets, and how far the mesh around the spot is from it.

        Rays beside the beam, 1 and 2 σ of the spot away, show what else it may meet: a step of the
        surface within reach becomes relief.

        Args:
            start_m, beam: (3,) origin and unit direction, target frame.
            spread: (3, 3) covariance of the spot's place, m², target frame.
        """
        flat = np.eye(3) - np.outer(beam, beam)
        variances, axes = np.linalg.eigh(flat @ spread @ flat)
        arms = np.sqrt(np.maximum(variances[1:], 0.0)) * axes[:, 1:]  # across the beam
        around = _AROUND @ arms.T
        starts = np.vstack([start_m, start_m + around])
        distances, hit = first_hits(self.corners, self.centres, self.radii, starts, beam)
        if hit[0] < 0:
            return "the beam would miss the target"
        if (hit < 0).any():
            return "the beam may miss the target"
        one, two = self.corners[hit[0], 1:] - self.corners[hit[0], 0]
        normal = np.cross(one, two)
        normal /= math.sqrt(normal @ normal)
        slant = float(normal @ beam)
        if abs(slant) < _GRAZING:
            return "the beam grazes the surface"
        off = np.concatenate([[0.0], distances[1:] - distances[0] + (around @ normal) / slant])
        relief_m = math.hypot(self.relief_m, float(np.std(off)))
        return Met(float(distances[0] + np.mean(off)), normal, relief_m)
