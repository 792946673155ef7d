"""The observation of the recognizer, and the clock of its stages."""

from __future__ import annotations

import time
from dataclasses import KW_ONLY, dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from rendezview.geometry.pose import Array, Pose
from rendezview.io.target import DockingRing
from rendezview.sensors.appearance.judge.found import Found
from rendezview.sensors.appearance.model.joint_angles import JointAngles
from rendezview.sensors.appearance.model.signature import Signature
from rendezview.sensors.appearance.outline.reading import LateReading, OutlineReading
from rendezview.sensors.appearance.outline.silhouette import Silhouette
from rendezview.sensors.measurement import Measurement
from rendezview.sensors.observation import Observation, Status
from rendezview.sensors.protection import Protection

# merit; two poses nearer to each other explain a frame equally well. Source: by hand, seeds of
# docs/notes/refinement.md
CLOSE_MARGIN = 0.1


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class AppearanceObservation(Observation):
    """A pose by appearance, with the active nodes; or the reason for none."""

    _: KW_ONLY
    # Where edges gave the pose, the outline is read when one of its results is first asked for.
    # Until then it holds a part of the frame, before a bright sky the frame.
    outline: OutlineReading | LateReading = field(default_factory=OutlineReading)
    found: Found | None = None  # the best refined pose and its rival, given or not
    joints: JointAngles | None = None  # of a target with joints, with its pose
    protection: Protection | None = None  # of the pose, where the tracker watches its integrity

    @property
    def reading(self) -> OutlineReading:
        """What was read in the outline; in a thread of the asking, if it has not been yet."""
        return self.outline() if isinstance(self.outline, LateReading) else self.outline

    @property
    def silhouette(self) -> Silhouette | None:
        """Outlines of the target; None where none was found, or edges alone were looked at."""
        return self.reading.silhouette

    @property
    def signature(self) -> Signature | None:
        """Radial signature of the silhouette, if there is one."""
        return self.reading.signature

    @property
    def active_nodes(self) -> npt.NDArray[np.intp]:
        """(K,) nodes that recognise the view, ascending."""
        return self.reading.active_nodes

    @property
    def weights(self) -> Array:
        """(K,) trust in each active node."""
        return self.reading.weights

    @property
    def points_m(self) -> Array:
        """(K, 3) m, target frame: where each active node puts the camera; none without a pose."""
        return self.reading.points_m

    @property
    def cloud(self) -> tuple[Array, Array]:
        """Points (K, 3) m of the camera, target frame, and the trust in each (K,).

        They are interpolated between the nodes where the model allows it, else those of the
        active nodes. There are none without a pose.
        """
        reading = self.reading
        if reading.interpolated is not None and len(reading.points_m):
            return reading.interpolated()
        return reading.points_m, reading.weights[: len(reading.points_m)]

    @property
    def candidates(self) -> tuple[Pose, ...]:
        """Poses that fit but are not given: not confident enough, or two that fit equally well."""
        if self.found is None or self.status is Status.OK:
            return ()
        rival = self.found.rival
        close = rival is not None and self.found.margin < CLOSE_MARGIN
        return (self.found.best.pose, *((rival.pose,) if rival and close else ()))

    @property
    def certainty(self) -> float:
        """Probability 0 … 1 that the pose is no other one, however large its errors are."""
        return (self.confidence or 0.0) if self.found is None else self.found.certainty

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
        reading = self.reading  # its stages are counted too
        line = Observation.record(self)
        stage_ms = line.pop("stage_ms")  # the last key of the line
        return line | {
            "score": self.score,
            "confidence": self.confidence,
            "candidates": list(self.candidates),
            "refinement": self._refinement(),
            **({} if self.protection is None else {"protection": self.protection.record()}),
            "on_nodes": reading.active_nodes,
            "weights": reading.weights,
            "points_m": reading.points_m,
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
            "excess": best.overshoot,
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
