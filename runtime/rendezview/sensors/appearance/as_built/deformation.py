"""How a craft differs from its CAD model: a strain of all of it, and parts mounted aside."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from rendezview.geometry.pose import Array
from rendezview.sensors.appearance.as_built.parts import Part, members, part_slopes, remounted
from rendezview.sensors.appearance.as_built.strain import matrix_of, strain_names, strained
from rendezview.sensors.appearance.edges.measured import STRAINS, MeasuredEdges
from rendezview.sensors.appearance.model import ViewModel

_STRAINS = len(STRAINS)
_MOTION = 6  # of a part: rotation vector and shift. Source: by construction


@dataclass(frozen=True, slots=True, eq=False)
class Deformation:
    """A strain about the view centre, and the mounting of some parts."""

    strain: Array  # (6,) components, target axes
    parts: tuple[Part, ...] = ()

    @property
    def size(self) -> int:
        """Unknowns: of the strain, then of each part its turn (rad) and shift (m)."""
        return _STRAINS + _MOTION * len(self.parts)

    def of_part(self, k: int) -> slice:
        """Where the unknowns of a part are."""
        return slice(_STRAINS + _MOTION * k, _STRAINS + _MOTION * (k + 1))

    def after(self, step: Array) -> Deformation:
        """Changed by a step (size,)."""
        parts = tuple(part.after(step[self.of_part(k)]) for k, part in enumerate(self.parts))
        return Deformation(self.strain + step[:_STRAINS], parts)

    def change(self, step: Array, radius_m: float) -> float:
        """The largest change of a step; shifts as shares of the target's radius."""
        return float(np.abs(step / self._units(radius_m)).max())

    def model(
        self, original: ViewModel, shape_error: float = 0.0, covariance: Array | None = None
    ) -> ViewModel:
        """The model so deformed; see ``strained``."""
        strain = matrix_of(self.strain)
        made = strained(original, strain, covariance, shape_error)
        if not self.parts:
            return made
        mounted = {part.name: part.motion.tolist() for part in self.parts}
        made = replace(made, provenance=made.provenance | {"mounted": mounted})
        return remounted(made, original, self.parts, strain)

    def members(self, edges: MeasuredEdges, radius_m: float) -> npt.NDArray[np.intp]:
        """(N,) which part each edge is of; −1: of none."""
        return members(self.parts, edges, np.asarray(np.linalg.inv(self._stretch)), radius_m)

    def slopes(self, edges: MeasuredEdges, radius_m: float) -> Array:
        """(N, size) of the predicted edges: px per unit of strain, px/rad, px/m."""
        slopes = np.zeros((len(edges.weight), self.size))
        slopes[:, :_STRAINS] = edges.strain_slopes
        if not self.parts:
            return slopes
        of = self.members(edges, radius_m)
        for k, part in enumerate(self.parts):
            own = of == k
            moved = part_slopes(part, edges, self._stretch @ part.middle_m)
            slopes[own, self.of_part(k)] = moved[own]
        return slopes

    def told(self) -> str:
        """In words."""
        strain = zip(strain_names(), self.strain, strict=True)
        words = [f"{name} {100 * value:+.2f} %" for name, value in strain]
        for part in self.parts:
            turn_deg = np.rad2deg(np.linalg.norm(part.motion[:3]))
            words.append(f"{part.name} {turn_deg:.2f}° {1e3 * np.linalg.norm(part.move_m):.1f} mm")
        return ", ".join(words)

    @property
    def _stretch(self) -> Array:
        return np.asarray(np.eye(3) + matrix_of(self.strain))

    def _units(self, radius_m: float) -> Array:
        units = np.ones(self.size)
        for k in range(len(self.parts)):
            units[self.of_part(k)][3:] = radius_m
        return units
