"""The sparse view model: for every view the contour points that refinement looks for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.pose import Array

OUTLINE, STEP, CREASE = 0, 1, 2  # against the sky, against a far surface, between two facets
NO_POINT = 255  # kind of the rows that fill up a view with few points

POINT_UNIT = 1.0 / 32000.0  # of the target's radius: 6 µm on a body of 20 cm
RUN_UNIT = 1.0 / 256.0  # of the target's radius
DIRECTION_UNIT = 1.0 / 127.0

# What lies to both sides of an edge is kept in cells along its normal. Depths inside the edge at
# which they part, of the target's radius: an outline's strip starts at the edge itself, that of an
# inner edge outside of it. The last cell goes on, as does the first of an inner edge.
CELLS = 8
# Where the first surface inside an outline, its rim, ends within so many cells, the first cell
# ends there.
RIM_CELLS = 2
RIM_WIDTH_UNIT = 1.0 / 12000.0  # of the target's radius
RIM_DEPTH_UNIT = 1.0 / 127.0
OUTLINE_CELLS = np.array([0.0, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 11.0]) / 196.0
INNER_CELLS = np.array([-7.0, -3.5, -1.5, 0.0, 1.5, 3.5, 7.0]) / 196.0
KINDS_OF_SURFACE = 256


@njit(cache=True, nogil=True)
def cell_limits(outline, cell):  # type: ignore[no-untyped-def]
    """Depths inside its edge from which to which a cell of a strip goes, of the target's radius.

    The last goes on without end; it counts as long as the one before, as does the first of an
    inner edge.
    """
    if outline:
        near = OUTLINE_CELLS[cell]
        if cell == CELLS - 1:
            return near, 2.0 * near - OUTLINE_CELLS[cell - 1]
        return near, OUTLINE_CELLS[cell + 1]
    if cell == 0:
        return 2.0 * INNER_CELLS[0] - INNER_CELLS[1], INNER_CELLS[0]
    near = INNER_CELLS[cell - 1]
    if cell == CELLS - 1:
        return near, 2.0 * near - INNER_CELLS[cell - 2]
    return near, INNER_CELLS[cell]


@dataclass(frozen=True, slots=True, eq=False)
class Contours:
    """Contour points of V views from S distances, N each, outline first; compact integers.

    Target frame, the view centre at the origin. The views' directions are those of the
    model's lattice.
    """

    shells_m: Array  # (S,) distance of the views from the view centre, rising
    point: npt.NDArray[np.int16]  # (S, V, N, 3) in POINT_UNIT
    tangent: npt.NDArray[np.int8]  # (S, V, N, 3) along the edge, the outside on its right
    kind: npt.NDArray[np.uint8]  # (S, V, N)
    run: npt.NDArray[np.uint8]  # (S, V, N, 2) to the next edge inwards and outwards, RUN_UNIT
    rim: npt.NDArray[np.int8]  # (S, V, N, 2) width, and depth of its inner end; 0: no rim
    strip: npt.NDArray[np.uint8]  # (S, V, N, CELLS) kinds of surface along the normal; 0 the sky
    palette: npt.NDArray[np.float32]  # (KINDS_OF_SURFACE, 4) normal, either way, and albedo

    def check(self, views: int) -> None:
        """The arrays belong together.

        Raises:
            ValueError: they do not; which one is said.
        """
        shape = (len(self.shells_m), views, self.kind.shape[-1])
        wanted: dict[str, tuple[int, ...]] = {
            "point": (*shape, 3),
            "tangent": (*shape, 3),
        }
        wanted |= {"kind": shape, "run": (*shape, 2), "rim": (*shape, 2), "strip": (*shape, CELLS)}
        wanted |= {"palette": (KINDS_OF_SURFACE, 4)}
        for name, size in wanted.items():
            if getattr(self, name).shape != size:
                found = getattr(self, name).shape
                raise ValueError(f"contours.{name} has shape {found} instead of {size}")
        if not (len(self.shells_m) and np.all(self.shells_m > 0.0)):
            raise ValueError("contours.shells_m must hold positive distances")
