"""The observation of the recognizer, and the clock of its stages."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from rendezview.geometry.pose import Array, Pose
from rendezview.io.target import DockingRing
from rendezview.sensors.appearance.edges.confidence import Found
from rendezview.sensors.appearance.joint_angles import JointAngles
from rendezview.sensors.appearance.outline.signature import Signature
from rendezview.sensors.appearance.outline.silhouette import Silhouette
from rendezview.sensors.measurement import Measurement
from rendezview.sensors.observation import Observation, Status
from rendezview.sensors.protection import Protection

# merit; two poses nearer to each other explain a frame equally well. Source: by hand, seeds of
# docs/notes/refinement.md
CLOSE_MARGIN = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class AppearanceObservation(Observation):
    """A pose by appearance, with the active nodes; or the reason for none."""

    _: KW_ONLY
    active_nodes: npt.NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, dtype=np.intp))
    weights: Array = field(default_factory=lambda: np.zeros(0))  # (K,) trust in each active node
    # (K, 3) m, target frame: where each active node puts the camera; none without a pose
    points_m: Array = field(default_factory=lambda: np.zeros((0, 3)))
    # Where views between the nodes put the camera (J, 3), and weights (J,). It takes a
    # millisecond, so it is computed when the cloud is asked for.
    interpolated: Callable[[], tuple[Array, Array]] | None = None
    silhouette: Silhouette | None = None
    signature: Signature | None = None
    found: Found | None = None  # the best refined pose and its rival, given or not
    joints: JointAngles | None = None  # of a target with joints, with its pose
    protection: Protection | None = None  # of the pose, where the tracker watches its integrity

    @property
    def cloud(self) -> tuple[Array, Array]:
        """Points (K, 3) m of the camera, target frame, and the trust in each (K,).

        They are interpolated between the nodes where the model allows it, else those of the
        active nodes. There are none without a pose.
        """
        if self.interpolated is not None and len(self.points_m):
            return self.interpolated()
        return self.points_m, self.weights[: len(self.points_m)]

    @property
    def candidates(self) -> tuple[Pose, ...]:
        """Poses that fit but are not given: not confident enough, or two that fit equally well."""
        if self.found is None or self.status is Status.OK:
            return ()
        rival = self.found.rival
        close = rival is not None and self.found.margin < CLOSE_MARGIN
        return (self.found.best.pose, *((rival.pose,) if rival and close else ()))

    @property
    def score(self) -> float:
        """The confidence of a refined pose; else the agreement of the trees, the sum of weights."""
        return float(self.weights.sum()) if self.confidence is None else self.confidence

    def measurement(
        self, sensor: str, *, ring: DockingRing | None = None, mount: Pose | None = None
    ) -> Measurement | None:
        """See ``Observation.measurement``; a pose with an alarm is none."""
        if self.protection is not None and self.protection.alarm:
            return None
        return Observation.measurement(self, sensor, ring=ring, mount=mount)

    def record(self) -> dict[str, Any]:
        """The observation as its line of JSON."""
        line = Observation.record(self)
        stage_ms = line.pop("stage_ms")  # the last key of the line
        return line | {
            "score": self.score,
            "confidence": self.confidence,
            "candidates": list(self.candidates),
            "refinement": self._refinement(),
            **({} if self.protection is None else {"protection": self.protection.record()}),
            "on_nodes": self.active_nodes,
            "weights": self.weights,
            "points_m": self.points_m,
            **({} if self.joints is None else {"joints": self.joints.record()}),
            "stage_ms": stage_ms,
        }

    def _refinement(self) -> dict[str, float] | None:
        """Scores of the best refined pose, whether it is accepted or not."""
        if self.found is None:
            return None
        best = self.found.best
        return {
            "outline": best.outline,
            "inner": best.inner,
            "seen": best.visible,
            "residual_px": best.residual_px,
            "excess": self.found.overshoot,
            "margin": self.found.margin,
        }


@dataclass(slots=True)
class StageClock:
    """Computing time of each stage of one frame, summed over its turns."""

    stage_ms: dict[str, float] = field(default_factory=dict)
    _last_s: float = field(default_factory=time.perf_counter)

    def lap(self, stage: str) -> None:
        """Count the time since the last lap for a stage."""
        now_s = time.perf_counter()
        self.stage_ms[stage] = self.stage_ms.get(stage, 0.0) + 1e3 * (now_s - self._last_s)
        self._last_s = now_s
