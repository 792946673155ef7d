"""The angles of a target's joints, as an observation and the tracker carry them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from rendezview.geometry.joint import Joint
from rendezview.geometry.pose import Array


@dataclass(frozen=True, slots=True, eq=False)
class JointAngles:
    """The angles that were found with a pose."""

    joints: tuple[Joint, ...]
    angles_rad: Array  # (J,)
    covariance: Array  # (6 + J, 6 + J) of the pose, as the observation's, then of the angles

    @property
    def sigma_rad(self) -> Array:
        """(J,) one σ of each angle."""
        return np.sqrt(np.maximum(np.diag(self.covariance)[6:], 0.0))

    def record(self) -> dict[str, Any]:
        """As in a line of JSON: angle and σ of each joint by name, and the whole covariance."""
        return {
            "names": [joint.name for joint in self.joints],
            "angles_deg": np.rad2deg(self.angles_rad),
            "sigma_deg": np.rad2deg(self.sigma_rad),
            "covariance": self.covariance,
        }
