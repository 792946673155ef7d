"""Silhouettes of the sunlit part of a target: the result of a threshold in hard light."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rendezview.geometry.pose import Array
from rendezview.sensors.appearance.model.container import check_shapes

SHADOWED_BINS = 90  # 4° each. Source: by construction, format of the model file
# Of a stored reading, thousandths of sqrt(area).
READING_UNIT = 16.0  # Source: by construction, format of the model file


@dataclass(frozen=True, slots=True, eq=False)
class ShadowedSilhouettes:
    """L silhouettes of sunlit parts, each with its view and its Sun direction.

    The Sun is in one of S fixed directions of the target frame; shadows are cast.
    """

    suns: Array  # (S, 3) unit, towards the Sun, target frame
    sun: npt.NDArray[np.uint8]  # (L,) which
    view: npt.NDArray[np.uint16]  # (L,) of the lattice
    quat_wxyz: npt.NDArray[np.float32]  # (L, 4) centred_from_target: the sunlit centroid ahead
    readings: npt.NDArray[np.uint8]  # (L, SHADOWED_BINS) in READING_UNIT
    area_m2: npt.NDArray[np.float32]  # (L,) area_sr × range²
    offset_m: npt.NDArray[np.float32]  # (L, 2) view centre off the centroid's line of sight

    def check(self, views: int) -> None:
        """The arrays belong together.

        Raises:
            ValueError: they do not; which one is said.
        """
        count = len(self.sun)
        check_shapes(
            "lit", self, suns=(len(self.suns), 3), view=(count,), quat_wxyz=(count, 4),
            readings=(count, SHADOWED_BINS), area_m2=(count,), offset_m=(count, 2),
        )  # fmt: skip
        if count and (int(self.view.max()) >= views or int(self.sun.max()) >= len(self.suns)):
            raise ValueError("a shadowed silhouette refers to a view or a Sun that the model lacks")
