"""The sparse view model: for every view the contour points that refinement looks for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rendezview.pose import Array

OUTLINE, STEP, CREASE = 0, 1, 2  # against the sky, against a far surface, between two facets
NO_POINT = 255  # kind of the rows that fill up a view with few points

POINT_UNIT = 1.0 / 32000.0  # of the target's radius: 6 µm on a body of 20 cm
RUN_UNIT = 1.0 / 256.0  # of the target's radius
DIRECTION_UNIT = 1.0 / 127.0


@dataclass(frozen=True, slots=True, eq=False)
class Contours:
    """Contour points of V views from S distances, N each, outline first; compact integers.

    Target frame, the view centre at the origin. The views' directions are those of the
    model's lattice.
    """

    shells_m: Array  # (S,) distance of the views from the view centre, rising
    point: npt.NDArray[np.int16]  # (S, V, N, 3) in POINT_UNIT
    tangent: npt.NDArray[np.int8]  # (S, V, N, 3) along the edge, the outside on its right
    normal: npt.NDArray[np.int8]  # (S, V, N, 3) of the facet seen at the edge
    kind: npt.NDArray[np.uint8]  # (S, V, N)
    run: npt.NDArray[np.uint8]  # (S, V, N, 2) to the next edge inwards and outwards, RUN_UNIT

    def check(self, views: int) -> None:
        """The arrays belong together.

        Raises:
            ValueError: they do not; which one is said.
        """
        shape = (len(self.shells_m), views, self.kind.shape[-1])
        wanted: dict[str, tuple[int, ...]] = {
            "point": (*shape, 3),
            "tangent": (*shape, 3),
            "normal": (*shape, 3),
        }
        wanted |= {"kind": shape, "run": (*shape, 2)}
        for name, size in wanted.items():
            if getattr(self, name).shape != size:
                found = getattr(self, name).shape
                raise ValueError(f"contours.{name} has shape {found} instead of {size}")
        if not (len(self.shells_m) and np.all(self.shells_m > 0.0)):
            raise ValueError("contours.shells_m must hold positive distances")
