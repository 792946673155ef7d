"""The contract that every sensor keeps."""

from __future__ import annotations

from typing import Any, Protocol, TypeVar

from rendezview.sensors.observation import Observation

FrameT = TypeVar("FrameT", contravariant=True)
ObservationT = TypeVar("ObservationT", bound=Observation, covariant=True)


class Sensor(Protocol[FrameT, ObservationT]):
    """Takes frames in order of time, and answers each with an observation.

    A frame is a grey picture (H, W) uint8, a lit and a dark one, or the spots of each camera.
    An instance belongs to one sequence. Two threads may share it: calls run one after the other.
    """

    def update(self, time_s: float, frame: FrameT, /, *arguments: Any) -> ObservationT:
        """Look at the next frame.

        Raises:
            ValueError: the time is not finite, or not later than that of the frame before.
            RendezviewError: the frame is not one of this sensor's camera.
        """
        ...
