"""Measurements of a synthetic target that drifts and turns."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rendezview.fusion import (
    BeamSurface,
    Measurement,
    PoseMeasurement,
    RangeMeasurement,
    RingCandidate,
    RingMeasurement,
)
from rendezview.geometry.pose import Array, Pose
from rendezview.io.target import DockingRing

RING = DockingRing(np.array([-1.68, 0.1, -0.2]), np.array([-1.0, 0.0, 0.0]), 0.6)
PLANE = BeamSurface(RING.centre_m, RING.axis)
SIGMA = np.array([4e-3, 5e-3, 2e-3, 0.01, 0.01, 0.05])
MOVE = np.array([0.01, -0.02, -0.2])  # m/s
TURN = np.array([1e-3, -2e-3, 1.5e-3])  # rad/s


class World:
    """Truth and noisy sensors; every draw from one seed."""

    ring_of_target, plane, sigma, move, turn = RING, PLANE, SIGMA, MOVE, TURN

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.start = Pose(
            Rotation.from_rotvec([0.1, -1.5, 0.15]).as_matrix(), np.array([0.3, -0.5, 30.0])
        )

    def truth(self, time_s: float) -> Pose:
        return Pose(
            Rotation.from_rotvec(TURN * time_s).as_matrix() @ self.start.rotation,
            self.start.translation_m + MOVE * time_s,
        )

    @staticmethod
    def error(estimate: Pose, truth: Pose) -> Array:
        """(6,) perturbation from truth to estimate."""
        turn = Rotation.from_matrix(estimate.rotation @ truth.rotation.T).as_rotvec()
        return np.concatenate([turn, estimate.translation_m - truth.translation_m])

    def kinds(self, time_s: float) -> list[Measurement]:
        """One of each."""
        return [self.pose(time_s), self.ring(time_s), self.range(time_s)]

    def pose(
        self, time_s: float, offset: Array | None = None, sensor: str = "camera"
    ) -> PoseMeasurement:
        noise = SIGMA * self.rng.standard_normal(6)
        lie = np.zeros(6) if offset is None else offset
        return PoseMeasurement(
            time_s, sensor, self.truth(time_s).perturbed(noise + lie), np.diag(SIGMA**2)
        )

    def ring(self, time_s: float, sigma_m: float = 0.01, sigma_rad: float = 5e-3,
             offset_m: float = 0.0) -> RingMeasurement:  # fmt: skip
        truth = self.truth(time_s)
        centre = truth.apply(RING.centre_m) + sigma_m * self.rng.standard_normal(3)
        axis = truth.rotation @ RING.axis
        seen = axis + sigma_rad * self.rng.standard_normal(3)
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = sigma_m**2 * np.eye(3)
        covariance[3:, 3:] = sigma_rad**2 * (np.eye(3) - np.outer(axis, axis))
        candidate = RingCandidate(
            centre + np.array([offset_m, 0.0, 0.0]), seen / np.linalg.norm(seen), covariance
        )
        return RingMeasurement(time_s, "ring", (candidate,), RING)

    def range(self, time_s: float, sigma_m: float = 0.02) -> RangeMeasurement:
        truth = self.truth(time_s)
        normal = truth.rotation @ RING.axis
        distance = float(normal @ truth.apply(RING.centre_m)) / float(normal[2])
        noisy = distance + sigma_m * self.rng.standard_normal()
        return RangeMeasurement(time_s, "laser", noisy, sigma_m, (PLANE,))


@pytest.fixture
def make_world() -> type[World]:
    return World


@pytest.fixture
def world() -> World:
    return World(3)
