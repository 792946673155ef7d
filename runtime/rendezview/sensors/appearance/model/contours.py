"""The sparse view model: for every view the contour points that refinement looks for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.geometry.pose import Array
from rendezview.sensors.appearance.model.container import check_shapes

OUTLINE, STEP, CREASE = 0, 1, 2  # against the sky, against a far surface, between two facets
# Kind of the rows that fill up a view with few points.
NO_POINT = 255  # Source: by construction, the largest byte

# Units of the stored integers. Source: by construction
POINT_UNIT = 1.0 / 32000.0  # of the target's radius: 6 µm on a body of 20 cm
RUN_UNIT = 1.0 / 256.0  # of the target's radius. Source: by construction, format of the model file
DIRECTION_UNIT = 1.0 / 127.0  # Source: by construction, a unit vector in signed bytes

# The edge profile along the normal of an edge is stored as a few surfaces, from outside to inside
# (the array ``strip``). The last surface has no end, the first of an inner edge no beginning; the
# first of an outline begins at the point. The beginnings of the others are stored as square
# roots, finest at the edge. Source: by construction, format of the model file
SURFACES = 5
# Of the target's radius: length of a profile. Source: by construction, 12 px at 196 px of radius
REACH_RADII = 12.0 / 196.0
START_UNIT = REACH_RADII / 127.0**2  # Source: by construction
DEPTH_UNIT = 1.0 / 127.0  # of the target's radius. Source: by construction
KINDS_OF_SURFACE = 256  # of a byte; 0 is the sky. Source: by construction


def packed_start(inside: Array) -> Array:
    """Places along the normal, of the target's radius, as they are kept."""
    roots: Array = np.sign(inside) * np.sqrt(np.abs(inside) / START_UNIT)
    return roots.clip(-127.0, 127.0)


@njit(cache=True, nogil=True, error_model="numpy")
def start_radii(kept: int) -> float:
    """A place along the normal inwards, of the target's radius, from how it is kept."""
    root = float(kept)
    return root * abs(root) * START_UNIT


def surfaces_of_cells(
    cells: npt.NDArray[np.uint8], kind: npt.NDArray[np.uint8]
) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.int8]]:
    """``strip`` and ``start`` of a model made earlier, which has eight cells of fixed depths."""
    outline = kind[..., None] == OUTLINE
    strip = np.where(outline, cells[..., [0, 1, 2, 4, 6]], cells[..., 2:7])
    begins = np.where(outline, [1.0, 2.0, 4.0, 8.0], [-1.5, 0.0, 1.5, 3.5]) / 196.0
    inside = np.rint(packed_start(begins)).astype(np.int8)
    return strip, np.stack([inside, np.zeros_like(inside)], axis=-1)


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
    strip: npt.NDArray[np.uint8]  # (S, V, N, SURFACES) kinds of surface; 0 the sky
    # (S, V, N, SURFACES − 1, 2) where all but the first begin: inwards of the point, and deeper
    start: npt.NDArray[np.int8]
    palette: npt.NDArray[np.float32]  # (KINDS_OF_SURFACE, 4) mean normal and albedo
    # (S, V, N) 0: the body, k: the parts of joint k − 1; None: nothing turns
    part: npt.NDArray[np.uint8] | None = None

    def check(self, views: int) -> None:
        """The arrays belong together.

        Raises:
            ValueError: they do not; which one is said.
        """
        shape = (len(self.shells_m), views, self.kind.shape[-1])
        check_shapes(
            "contours", self, point=(*shape, 3), tangent=(*shape, 3), kind=shape,
            run=(*shape, 2), strip=(*shape, SURFACES), start=(*shape, SURFACES - 1, 2),
            palette=(KINDS_OF_SURFACE, 4), **({} if self.part is None else {"part": shape}),
        )  # fmt: skip
        if not (len(self.shells_m) and np.all(self.shells_m > 0.0)):
            raise ValueError("contours.shells_m must hold positive distances")
