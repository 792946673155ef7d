"""The observation: what every sensor returns for one frame."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass, field
from enum import StrEnum
from typing import Any

import numpy as np

from rendezview.geometry.pose import Array, Pose
from rendezview.io.results import json_value
from rendezview.io.target import DockingRing
from rendezview.sensors.measurement import Measurement, PoseMeasurement


class Status(StrEnum):
    """Outcome of one frame, for every sensor and for the filter.

    All but ``OK`` and ``TRACKING`` come with a reason in words.
    """

    OK = "ok"  # a pose (a ring without a radius: an ellipse)
    UNREADABLE = "unreadable"  # the frame could not be read
    AMBIGUOUS = "ambiguous"  # several poses fit, none is chosen
    LOST = "lost"  # a pose was found or expected, but the frame does not confirm it
    # Silhouettes
    EMPTY = "empty"  # nothing stands out from the background
    FULL = "full"  # the target, or the glare, fills the frame
    BORDER = "border"  # the silhouette touches the border of the picture
    SMALL = "small"  # too few pixels for a signature
    RIVALS = "rivals"  # several bodies, and nothing to choose by
    UNRECOGNIZED = "unrecognized"  # a silhouette, but no node is active
    # Rings, reflectors, lights
    NOT_FOUND = "not found"  # no ellipse is the ring's; no three spots are the target
    NO_SPOTS = "no spots"  # fewer than three spots stand out
    CROWDED = "crowded"  # more spots than can be searched
    PARTIAL = "partial"  # too few reflectors or lights for a pose of their own
    UNCONFIRMED = "unconfirmed"  # found once; a second reading must agree
    FEW_LIGHTS = "few-lights"  # too few lights for a pose
    DISAGREE = "disagree"  # the lights are not the target's, or more than two are false
    # The filter
    WAITING = "waiting"  # no sensor has given a whole pose yet
    STARTING = "starting"  # a first pose, not confirmed yet
    TRACKING = "tracking"
    COASTING = "coasting"  # no accepted measurement: the rates carry the state on


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Observation:
    """The result of one sensor on one frame: a pose with its covariance, or the reason for none.

    Each sensor adds its own fields in a subclass, and overrides `record` to add them to the line.
    """

    status: Status
    reason: str | None = None
    _: KW_ONLY
    time_s: float | None = None  # when the light fell on the sensor; None: a single frame
    pose: Pose | None = None  # camera_from_target
    covariance: Array | None = None  # (6, 6) rotation vector rad, translation m; camera frame, left
    # (6, 6) of the covariance that all readings of a run have in common; None: not known
    common: Array | None = None
    confidence: float | None = None  # probability that the pose is right, 0 … 1, where it is known
    stage_ms: dict[str, float] = field(default_factory=dict)  # computing time by stage

    def measurement(
        self, sensor: str, *, ring: DockingRing | None = None, mount: Pose | None = None
    ) -> Measurement | None:
        """The filter's measurement from this observation; ``None`` where there is none.

        Args:
            sensor: name of the sensor; the filter keeps biases and trust by it.
            ring: where the ring is on the target; only rings need it.
            mount: ``sensor_from_camera``, where the sensor is not at the filter's camera.

        Raises:
            ValueError: the observation has no time, or a ring is not given where it is needed.
        """
        if self.pose is None or self.covariance is None:
            return None
        if self.time_s is None:
            raise ValueError(f"{sensor}: an observation without a time cannot be fused")
        taken = PoseMeasurement(self.time_s, sensor, self.pose, self.covariance, self.common)
        return taken if mount is None else taken.in_camera(mount)

    @property
    def range_m(self) -> float | None:
        """Distance of the target's origin from the camera; None without a pose."""
        return None if self.pose is None else float(np.linalg.norm(self.pose.translation_m))

    def as_dict(self) -> dict[str, Any]:
        """`record` in the types that JSON has."""
        values: dict[str, Any] = json_value(self.record())
        return values

    def __repr__(self) -> str:
        """A line: what a person wants to know of it."""
        known = {
            "reason": self.reason,
            "time_s": self.time_s,
            "range_m": None if self.range_m is None else round(self.range_m, 6),
            "confidence": None if self.confidence is None else round(self.confidence, 4),
        }
        said = "".join(f", {name}={value!r}" for name, value in known.items() if value is not None)
        return f"{type(self).__name__}({self.status.value!r}{said})"

    def record(self) -> dict[str, Any]:
        """The observation as its line of JSON: the same in logs, service and results."""
        return {
            "time_s": self.time_s,
            "status": str(self.status),
            "reason": self.reason,
            "pose": self.pose,
            "covariance": self.covariance,
            "stage_ms": self.stage_ms,
        }
