"""A sequence of frames through the ring sensor, and the log of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

from rendezview.geometry.camera import Camera
from rendezview.io.sequences.frame import Frame, GreyImage, Sequence
from rendezview.sensors.ring.detector import RingOptions
from rendezview.sensors.ring.observation import RingObservation
from rendezview.sensors.ring.sensor import RingPrior, RingSensor
from rendezview.sensors.run import observe
from rendezview.sensors.sensor import AidedSensor

Circles = tuple[tuple[float, float], ...]


def follow(
    sequence: Sequence,
    radius_m: float | None,
    *,
    options: RingOptions | None = None,
    prior: Callable[[Frame], RingPrior | None] | None = None,
    circles: Circles = (),
    independent: bool = False,
) -> Iterator[tuple[Frame, GreyImage | None, RingObservation]]:
    """One observation of each frame, in the order of the sequence.

    A picture that cannot be read has the status ``UNREADABLE``. Frames without times count as 1 s
    apart; where a frame is not later than the one before, the sensor forgets those so far.

    Args:
        sequence: the frames.
        radius_m: of the ring's edge; None: ellipses only.
        options: of the detector.
        prior: the prior of a frame.
        circles: known circles about the ring's axis, see ``DockingRing.circles``.
        independent: each on its own, no memory.
    """
    sensors: dict[Camera, RingSensor] = {}
    last_s: dict[Camera, float] = {}

    def look(frame: Frame, _: float, image: GreyImage) -> RingObservation:
        if frame.camera not in sensors:
            sensors[frame.camera] = RingSensor(frame.camera, radius_m, options, circles)
        before = last_s.get(frame.camera, -1.0)
        time_s = before + 1.0 if frame.time_s is None else frame.time_s
        if independent or time_s <= before:
            sensors[frame.camera].reset()
        last_s[frame.camera] = time_s
        sensor: AidedSensor[GreyImage, RingPrior, RingObservation] = sensors[frame.camera]
        known = prior(frame) if prior else None
        return replace(sensor.update(time_s, image, known), time_s=frame.time_s)

    return observe(sequence, look, RingObservation, ordered=False)


def record(frame: Frame, observation: RingObservation) -> dict[str, Any]:
    """One frame as the log of JSON lines stores it."""
    return (
        {"im_id": frame.im_id, "image": frame.name}
        | observation.record()
        | {"time_s": frame.time_s}
    )
