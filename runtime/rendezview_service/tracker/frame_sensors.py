"""The ring and the reflector sensor of one session, on the frames that the tracker sees too.

The order of a frame is that of the commands: the camera's pose is fused, the fused state is the
ring's prior (as ``rendezview ring --track`` takes it from a log of ``fuse``), then the readings are
fused. What a sensor measures goes to the filter as from the command's log.
"""

from __future__ import annotations

import numpy as np

from rendezview.geometry.camera import Camera
from rendezview.io.results import json_value
from rendezview.io.sequences.frame import GreyImage
from rendezview.io.target import DockingRing, Reflector, Target
from rendezview.sensors.beacons import LitDark, ReflectorSensor, patterns_of
from rendezview.sensors.ring import RingPrior, RingSensor
from rendezview.sensors.ring.observation import RingObservation
from rendezview.sensors.ring.prior_log import prior_of_pose
from rendezview_service.messages.fusion_messages import FusionRequest
from rendezview_service.messages.messages import SessionRequest
from rendezview_service.tracker.sensor_lines import Json, context_of, pose_of_fused
from rendezview_service.tracker.session_filter import SessionFilter

RING, REFLECTORS = "ring", "reflectors"  # names of the session's own sensors
_ELLIPSE = ("centre_px", "semi_axes_px", "angle_rad")


class FrameSensors:
    """The sensors beside the tracker that read each frame of a session."""

    def __init__(self, request: SessionRequest, camera: Camera) -> None:
        """The sensors that a request asks for.

        Raises:
            RendezviewError: the reflectors make no pattern.
        """
        asked, known = request.sensors, request.fusion or FusionRequest()
        self.names: list[str] = []  # of the sensors that run
        self._ring: tuple[RingSensor, DockingRing] | None = None
        self._reflectors: ReflectorSensor | None = None
        self._pairs = False
        self._lit: tuple[int, float, GreyImage] | None = None  # waits for its dark frame
        if asked is not None and asked.ring:
            ring = context_of(known).ring
            assert ring is not None
            self._ring = RingSensor(camera, ring.radius_m, circles=ring.circles), ring
            self.names.append(RING)
        if asked is not None and asked.reflectors != "off":
            self._reflectors = ReflectorSensor(camera, patterns_of(_target(known)))
            self._pairs = asked.reflectors == "pairs"
            self.names.append(REFLECTORS)

    def look(
        self, image: GreyImage, time_s: float, number: int, known: Json, fusing: SessionFilter
    ) -> Json:
        """The readings of a frame, by sensor; they go to the filter if it runs.

        Args:
            image: (H, W) of the frame.
            time_s: of the frame.
            number: of the frame among all that were sent: which of a pair it is.
            known: the `Fused` state at the frame, by what came before.
            fusing: the session's filter.
        """
        readings: Json = {}
        if self._reflectors is not None:
            readings[REFLECTORS] = self._reflect(self._reflectors, image, time_s, number, fusing)
        if self._ring is not None:
            sensor, ring = self._ring
            observation = sensor.update(time_s, image, _prior(known, ring))
            verdict = fusing.add(RING, "ring", observation.measurement(RING, ring=ring))
            readings[RING] = ring_record(observation) | {"verdict": verdict}
        return readings

    def _reflect(
        self, sensor: ReflectorSensor, image: GreyImage, time_s: float, number: int,
        fusing: SessionFilter,
    ) -> Json | None:  # fmt: skip
        """None for a lit frame that waits for its dark one."""
        frames = LitDark(image)
        if self._pairs:
            lit, self._lit = self._lit, None
            if number % 2 == 0:
                self._lit = number, time_s, image.copy()  # the frame's own memory is used again
                return None
            if lit is None or lit[0] != number - 1:
                return None  # the lit one was dropped
            _, time_s, bright = lit
            frames = LitDark(bright, image)
        observation = sensor.update(time_s, frames)
        verdict = fusing.add(REFLECTORS, "pose", observation.measurement(REFLECTORS))
        record: Json = json_value(observation.record())
        del record["stage_ms"]
        record["spots"] = [spot for spot in record["spots"] if spot["reflector"] is not None]
        return record | {"verdict": verdict}


def ring_record(observation: RingObservation) -> Json:
    """The line of ``rendezview ring`` without the ellipses that are not the ring's."""
    line: Json = json_value(observation.record())

    def ellipse(index: int | None) -> Json | None:
        if index is None:
            return None
        return {name: line["ellipses"][index][name] for name in _ELLIPSE}

    return {
        "status": line["status"],
        "reason": line["reason"],
        "ellipse": ellipse(line["ellipse"]),
        "poses": line["poses"],
        "candidates": [
            {"ellipse": ellipse(each["ellipse"]), "poses": each["poses"]}
            for each in line["candidates"]
        ],
    }


def _prior(known: Json, ring: DockingRing) -> RingPrior | None:
    """What a `Fused` state tells of the ring; None without a pose."""
    found = pose_of_fused(known)
    if found is None:
        return None
    try:
        return prior_of_pose(*found, ring)
    except ValueError:  # no variance along the line of sight: the state is of no use
        return None


def _target(known: FusionRequest) -> Target:
    reflectors = []
    for one in known.reflectors:
        normal = np.array(one.normal)
        place = np.array(one.position_m)
        normal /= np.linalg.norm(normal)
        sigma_m = one.position_sigma_m
        reflectors.append(Reflector(one.name, one.group, place, normal, one.diameter_m, sigma_m))
    return Target("session", "", None, None, reflectors=tuple(reflectors))
