"""Points on the surface of the target, and the directions from which each is visible."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rendezview.geometry.geodesic import MAX_ORDER, Geodesic
from rendezview.sensors.appearance.model.container import check_shapes

ALBEDO_UNIT = 1.0 / 255.0  # Source: by construction, a byte


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """P points of the surface and which of S directions see each; compact integers.

    Target frame, the view centre at the origin. The directions are the nodes of a geodesic
    sphere; from each the target is seen from afar.
    """

    point: npt.NDArray[np.int16]  # (P, 3) in POINT_UNIT
    normal: npt.NDArray[np.int8]  # (P, 3) in DIRECTION_UNIT, either way
    albedo: npt.NDArray[np.uint8]  # (P,) in ALBEDO_UNIT
    seen: npt.NDArray[np.uint8]  # (S, P / 8) bits, the first point the lowest

    @property
    def sphere(self) -> Geodesic:
        """The directions."""
        return Geodesic.of_order(_order_of(len(self.seen)))

    def check(self) -> None:
        """The arrays belong together.

        Raises:
            ValueError: they do not; which one is said.
        """
        count = len(self.albedo)
        check_shapes(
            "surface", self, albedo=(count,), point=(count, 3), normal=(count, 3),
            seen=(len(self.seen), (count + 7) // 8),
        )  # fmt: skip
        _order_of(len(self.seen))


def _order_of(nodes: int) -> int:
    for order in range(MAX_ORDER + 1):
        if 10 * 4**order + 2 == nodes:
            return order
    raise ValueError(f"surface.seen has {nodes} directions, which no geodesic sphere has")
