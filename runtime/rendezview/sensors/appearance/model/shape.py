"""The shape that the craft carries: a light mesh, and the turns that nearly map it onto itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rendezview.geometry.pose import Array
from rendezview.sensors.appearance.model.container import check_shapes

# σ of the mesh's surface about the shape's, of the target's radius. Source: half the tolerance by
# which training simplifies it
SHAPE_RELIEF = 1.0 / 720.0


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """A mesh to draw poses with, and K near-symmetries; target axes, the view centre at the origin.

    A near-symmetry x → turn x + shift maps much of the surface onto the surface. Its turn is a
    rotation, or a rotation with a reflection: from afar, the mirror image of a pose across the
    picture plane has the same outline.
    """

    vertices_m: npt.NDArray[np.float32]  # (V, 3)
    faces: npt.NDArray[np.int32]  # (F, 3)
    albedo: npt.NDArray[np.uint8]  # (F,) in ALBEDO_UNIT
    turns: Array  # (K, 3, 3) in O(3)
    shifts_m: Array  # (K, 3)
    alike: Array  # (K,) share of the surface that falls onto the surface, 0 … 1

    def check(self) -> None:
        """The arrays belong together.

        Raises:
            ValueError: they do not; which one is said.
        """
        count = len(self.alike)
        check_shapes(
            "shape", self, vertices_m=(len(self.vertices_m), 3), faces=(len(self.faces), 3),
            albedo=(len(self.faces),), turns=(count, 3, 3), shifts_m=(count, 3), alike=(count,),
        )  # fmt: skip
        if len(self.faces) == 0 or self.faces.min() < 0 or self.faces.max() >= len(self.vertices_m):
            raise ValueError("shape.faces names vertices that are not there")
