"""Views of a part of the target, for a camera closer than the whole sphere of views.

Smaller spheres of views (Cleghorn and Sternberg, 1991: "a smaller sphere, which encloses a part of
the target"), around a port's centre, with directions about its axis only.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from rendezview.geometry.pose import Array, Pose
from rendezview.sensors.appearance.model.contours import Contours

_BEYOND = 1.15  # of a first and last distance: the views still serve. Source: spacing of the shells
_CONTOURS = tuple(f.name for f in fields(Contours))


@dataclass(frozen=True, slots=True, eq=False)
class NearSphere:
    """A sphere of views that encloses a part of the target; the view centre is its middle."""

    centre_m: Array  # (3,) view centre, target frame
    radius_m: float  # of the part that the views show
    directions: Array  # (V, 3) unit, from the view centre to the camera, target frame
    contours: Contours  # of the V views

    def serves(self, pose: Pose) -> bool:
        """Whether a camera_from_target looks from one of the views' distances and directions."""
        centre = pose.apply(self.centre_m)
        distance_m = float(np.linalg.norm(centre))
        shells_m = self.contours.shells_m
        if not shells_m[0] / _BEYOND < distance_m < shells_m[-1] * _BEYOND or centre[2] <= 0.0:
            return False
        eye = -(pose.rotation.T @ centre) / distance_m
        return bool(np.max(self.directions @ eye) > self._closeness)

    @property
    def _closeness(self) -> float:
        """Cosine of the angle from a view within which the view serves: their spacing."""
        cosines = self.directions @ self.directions[0]
        return float(np.max(cosines[cosines < 1.0 - 1e-9], initial=-1.0))

    def check(self) -> None:
        """The arrays belong together.

        Raises:
            ValueError: they do not; which one is said.
        """
        if self.centre_m.shape != (3,) or self.directions.shape[1:] != (3,):
            raise ValueError("a sphere of near views has no centre or no directions")
        if not self.radius_m > 0.0:
            raise ValueError(f"a sphere of near views has the radius {self.radius_m}")
        self.contours.check(len(self.directions))

    def header(self) -> dict[str, Any]:
        """What the header of a model file holds of it."""
        return {"centre_m": self.centre_m.tolist(), "radius_m": self.radius_m}

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """The arrays of a model file, by name."""
        of_views = {name: getattr(self.contours, name) for name in _CONTOURS}
        return {"directions": self.directions} | {
            name: array for name, array in of_views.items() if array is not None
        }

    @classmethod
    def stored(
        cls, header: Mapping[str, Any], arrays: Mapping[str, npt.NDArray[Any]]
    ) -> NearSphere:
        """The inverse of ``header`` and ``arrays``."""
        contours = {name: array for name, array in arrays.items() if name != "directions"}
        return cls(
            np.array(header["centre_m"], dtype=np.float64),
            float(header["radius_m"]),
            arrays["directions"],
            Contours(**contours),
        )
