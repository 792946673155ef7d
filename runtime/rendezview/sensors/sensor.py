"""The contract that every sensor keeps.

The run loops and the service name a sensor by these protocols, so that the type checker holds each
to the contract.
"""

from __future__ import annotations

from typing import Protocol, TypeVar

from rendezview.sensors.observation import Observation

FrameT = TypeVar("FrameT", contravariant=True)
KnownT = TypeVar("KnownT", contravariant=True)
ObservationT = TypeVar("ObservationT", bound=Observation, covariant=True)


class Sensor(Protocol[FrameT, ObservationT]):
    """Takes frames in order of time, and answers each with an observation.

    A frame is a grey picture (H, W) uint8, a lit and a dark one, or the spots of each camera.
    An instance belongs to one sequence. Two threads may share it: calls run one after the other.
    """

    def update(self, time_s: float, frame: FrameT, /) -> ObservationT:
        """Look at the next frame.

        Raises:
            ValueError: the time is not finite, or not later than that of the frame before.
            RendezviewError: the frame is not one of this sensor's camera.
        """
        ...


class AidedSensor(Protocol[FrameT, KnownT, ObservationT]):
    """A `Sensor` that uses what others know of the frame.

    That is the direction to the Sun, a prior of the ring, or the control system's acceleration.
    """

    def update(self, time_s: float, frame: FrameT, known: KnownT | None = None, /) -> ObservationT:
        """As `Sensor.update`."""
        ...
