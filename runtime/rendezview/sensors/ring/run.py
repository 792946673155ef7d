"""A sequence of frames through the ring sensor, and the log of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.io.sequences.frame import Frame, GreyImage, Sequence
from rendezview.sensors.observation import Status
from rendezview.sensors.ring.detector import RingOptions
from rendezview.sensors.ring.sensor import RingObservation, RingPrior, RingSensor


def follow(
    sequence: Sequence,
    radius_m: float | None,
    *,
    options: RingOptions | None = None,
    prior: Callable[[Frame], RingPrior | None] | None = None,
    independent: bool = False,
) -> Iterator[tuple[Frame, GreyImage | None, RingObservation]]:
    """One reading a frame, in order; a picture that cannot be read says so and is passed.

    Args:
        sequence: the frames.
        radius_m: of the ring's edge; None: ellipses only.
        options: of the detector.
        prior: what is known of a frame.
        independent: each on its own, no memory.
    """
    sensors: dict[Camera, RingSensor] = {}
    for frame in sequence:
        if frame.camera not in sensors:
            sensors[frame.camera] = RingSensor(frame.camera, radius_m, options)
        sensor = sensors[frame.camera]
        if independent:
            sensor.reset()
        try:
            image = frame.read()
        except RendezviewError as error:
            yield frame, None, RingObservation(Status.UNREADABLE, str(error))
            continue
        yield frame, image, sensor.update(image, prior(frame) if prior else None)


def record(frame: Frame, reading: RingObservation) -> dict[str, Any]:
    """One frame as it stands in the log of JSON lines."""
    return {
        "im_id": frame.im_id,
        "image": frame.name,
        "time_s": frame.time_s,
        "status": str(reading.status),
        "reason": reading.reason,
        "ellipses": [
            {
                "centre_px": edge.ellipse.centre_px,
                "semi_axes_px": edge.ellipse.semi_axes_px,
                "angle_rad": edge.ellipse.angle_rad,
                "covariance": edge.ellipse.covariance,
                "arc_deg": edge.arc_deg,
                "score": edge.score,
                "family": edge.family,
                "contrast_grey": edge.contrast_grey,
            }
            for edge in reading.edges
        ],
        "ellipse": reading.edge,
        "poses": [
            {
                "centre_m": pose.centre_m,
                "axis": pose.axis,
                "covariance": pose.covariance,
                "chosen": reading.choice is not None and reading.choice.index == k,
                "reason": None if reading.choice is None else reading.choice.reason,
            }
            for k, pose in enumerate(reading.poses)
        ],
        "stage_ms": reading.stage_ms,
    }
