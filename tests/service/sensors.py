"""Made-up lines of other sensors."""

from __future__ import annotations

import json

import numpy as np

from rendezview.geometry.pose import Pose
from rendezview.io.results import json_line
from rendezview.io.target import DockingRing
from rendezview.sensors.observation import Observation, Status

RING = DockingRing(np.array([0.1, -0.2, 0.3]), np.array([0.0, 0.6, 0.8]), 0.5)
SIGMA_M, SIGMA_RAD = 0.01, 0.01


class Sensors:
    """Lines of a ring detector, a ranger and a second pose sensor at a true pose."""

    def __init__(self, seed: int = 0) -> None:
        self.rng = np.random.default_rng(seed)

    def ring(self, time_s, truth, offset_m=0.0):
        centre = truth.apply(RING.centre_m) + SIGMA_M * self.rng.normal(size=3)
        axis = truth.rotation @ RING.axis + SIGMA_RAD * self.rng.normal(size=3)
        covariance = np.diag([SIGMA_M**2] * 3 + [SIGMA_RAD**2] * 2)
        pose = {"centre_m": centre + offset_m, "axis": axis / np.linalg.norm(axis)}
        edge = {"centre_px": [200.0, 180.5], "semi_axes_px": [40.0, 30.0], "angle_rad": 0.5}
        return plain(
            {
                "time_s": time_s, "status": "ok", "ellipses": [edge], "ellipse": 0,
                "poses": [pose | {"covariance": covariance}],
            }
        )  # fmt: skip

    def range(self, time_s, truth):
        normal = truth.rotation @ RING.axis
        distance = normal @ truth.apply(RING.centre_m) / normal[2]
        return {"time_s": time_s, "range_m": distance + 0.02 * self.rng.normal(), "sigma_m": 0.02}

    def pose(self, time_s, truth, offset_m=0.0):
        sigma = np.array([0.01] * 3 + [0.02] * 3)
        seen = truth.perturbed(sigma * self.rng.normal(size=6) + [0, 0, 0, offset_m, 0, 0])
        spots = [{"x_px": 100.0, "y_px": 120.5, "reflector": "left"}]
        return plain(
            {"time_s": time_s, "pose": seen, "covariance": np.diag(sigma**2), "spots": spots}
        )


def observed(time_s: float, pose: Pose) -> Observation:
    """What the camera's own recognizer gives."""
    return Observation(Status.OK, time_s=time_s, pose=pose, covariance=1e-4 * np.eye(6))


def plain(record):
    """A record as it is after JSON."""
    return json.loads(json_line(record))
