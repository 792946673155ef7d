"""What sessions get that do not say it themselves: camera, docking ring, approach, recording."""

from __future__ import annotations

import math
from collections import Counter
from pathlib import Path

import numpy as np
from pydantic import TypeAdapter

from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Array
from rendezview.io.bundled import find_target
from rendezview.io.camera_files import load_camera
from rendezview.io.files import checked, read_toml
from rendezview.io.plausible import camera_doubts
from rendezview.io.target import DockingRing, Reflector
from rendezview.trajectory import Plan, Shape, plan_of, read_plan
from rendezview_service.hub.model_store import StoredModel
from rendezview_service.messages.approach_messages import ApproachRequest, PortMessage, WayPoint
from rendezview_service.messages.frame_sensor_messages import FrameSensorsRequest, TrajectoryRequest
from rendezview_service.messages.fusion_messages import (
    MOST_CIRCLES,
    MOST_OF_GROUP,
    MOST_REFLECTORS,
    FusionRequest,
)
from rendezview_service.messages.messages import CameraMessage, SessionRequest
from rendezview_service.settings import Settings
from rendezview_service.tracker.tracking import camera_message, camera_of

_APPROACH = TypeAdapter(ApproachRequest)
_PLAN_POINTS = 500  # of a plan that is drawn and compared. Source: chosen
_PLAN_S = 86_400.0  # s, of a plan without an end. Source: chosen


class SessionDefaults:
    """The service's camera, ring and approach."""

    def __init__(self, settings: Settings) -> None:
        """Reads the files that the settings name.

        Raises:
            RendezviewError: one is missing or wrong.
        """
        self._settings = settings
        self.camera = None if settings.camera is None else load_camera(settings.camera)
        self._target = None if settings.target is None else _known_of_file(settings.target)
        self._approach = None
        if settings.approach is not None:
            content = read_toml(settings.approach, "an approach")
            self._approach = checked(_APPROACH, content, str(settings.approach))
        self._plan_file = None if settings.plan is None else read_plan(settings.plan)
        self._plan = None
        if self._plan_file is not None:
            self._plan = plan_of(self._plan_file, str(settings.plan))

    def _camera(self, request: SessionRequest) -> CameraMessage:
        """The camera of a request, or the service's; doubts about it are in the request's notes.

        Raises:
            RendezviewError: there is none, or its frames are too large.
        """
        camera = request.camera
        if camera is None and self.camera is not None:
            camera = camera_message(self.camera)  # questioned when its file was read
            request.notes.extend(self.camera.doubts)
        elif camera is not None and not camera.checked:
            meant = '"checked": true in the camera if it is meant'
            found = camera_doubts(camera_of(camera))
            request.notes.extend(f"camera: {doubt.what} ({meant})" for doubt in found)
        if camera is None:
            raise RendezviewError("the session has no camera: give one")
        most = self._settings.frame_bytes
        if camera.width * camera.height > most:
            raise RendezviewError(
                f"camera: frames of {camera.width} × {camera.height} are larger than the setting "
                f"frame_bytes ({most} bytes)"
            )
        return camera

    def filled(self, request: SessionRequest, name: str, stored: StoredModel) -> SessionRequest:
        """A request with all that it leaves to the service and to the model.

        Raises:
            RendezviewError: something is missing or impossible.
        """
        settings = self._settings
        records = settings.record is not None and settings.record_all
        more: dict[str, object] = {
            "id": name,
            "model": stored.name,
            "camera": self._camera(request),
            "record": records if request.record is None else request.record,
        }
        if more["record"] and settings.record is None:
            raise RendezviewError("record: the service writes no logs: start it with --record")
        fusion = request.fusion or FusionRequest()
        known = self._target
        if known is None:
            known = _known_of(*stored.known)
        ring, reflectors = fusion.ring or known.ring, fusion.reflectors or known.reflectors
        fusion = fusion.model_copy(update={"ring": ring, "reflectors": reflectors})
        if request.fusion is not None or fusion.ring is not None or fusion.reflectors:
            more["fusion"] = fusion
        more["sensors"] = self._sensors_of(request.sensors or FrameSensorsRequest(), fusion)
        if request.approach is None and self._approach is not None:
            more["approach"] = self._approach
        return self._planned(request.model_copy(update=more), stored)

    def _sensors_of(self, asked: FrameSensorsRequest, fusion: FusionRequest) -> FrameSensorsRequest:
        """What runs on the frames, nothing left open.

        Raises:
            RendezviewError: the session lacks what a sensor needs.
        """
        ring = fusion.ring is not None if asked.ring is None else asked.ring
        if ring and fusion.ring is None:
            raise RendezviewError("sensors: ring: which ring? Give fusion.ring or --target")
        lights = asked.reflectors != "off"
        if lights and not fusion.reflectors:
            raise RendezviewError(
                "sensors: reflectors: which ones? Give fusion.reflectors or --target"
            )
        return FrameSensorsRequest(
            ring=ring,
            reflectors=asked.reflectors,
            trajectory=self._path_of(asked.trajectory, ring),
            fusion=ring or lights if asked.fusion is None else asked.fusion,
        )

    def _path_of(
        self, asked: TrajectoryRequest | bool | None, ring: bool
    ) -> TrajectoryRequest | bool:
        """The path that is fitted; False: none.

        Raises:
            RendezviewError: it has neither a shape nor a plan.
        """
        known = self._plan_file is not None or ring
        if asked is False or (asked is None and not known):
            return False
        path = asked if isinstance(asked, TrajectoryRequest) else TrajectoryRequest()
        if path.plan is None:
            path = path.model_copy(update={"plan": self._plan_file})
        if path.plan is None and path.shape is None:
            if not ring:
                raise RendezviewError(
                    "sensors: trajectory: what path is flown? Give a shape or a plan"
                )
            path = path.model_copy(update={"shape": Shape.VBAR})
        return path

    def _planned(self, request: SessionRequest, stored: StoredModel) -> SessionRequest:
        """A request with the service's plan, if it has none of its own."""
        approach = request.approach or ApproachRequest()
        if self._plan is None or approach.plan:
            return request
        points = way_points(self._plan, stored.centre_m)
        return request.model_copy(update={"approach": approach.model_copy(update={"plan": points})})


def approach_of(request: SessionRequest) -> ApproachRequest:
    """What the frames of a session are compared with; its docking ring is the port by default."""
    approach = request.approach or ApproachRequest()
    ring = None if request.fusion is None else request.fusion.ring
    if approach.port is None and ring is not None:
        port = PortMessage(centre_m=ring.centre_m, axis=ring.axis)
        return approach.model_copy(update={"port": port})
    return approach


def way_points(plan: Plan, middle_m: Array) -> list[WayPoint]:
    """Places of a plan, target frame; ``middle_m``: where it does not say what it aims at."""
    end_s = plan.end_s if math.isfinite(plan.end_s) else plan.start_s + _PLAN_S
    times_s = np.linspace(plan.start_s, end_s, _PLAN_POINTS)
    centre_m = middle_m if plan.centre_m is None else plan.centre_m
    return [
        WayPoint(
            time_s=float(time_s),
            position_m=(centre_m + plan.path_from_target(float(time_s)).T @ place).tolist(),
        )
        for time_s, place in zip(times_s, plan.places(times_s), strict=True)
    ]


def _known_of(ring: DockingRing | None, reflectors: tuple[Reflector, ...]) -> FusionRequest:
    """What a target file, or a model, says of ring and reflectors, as far as a session takes it."""
    groups = Counter(reflector.group for reflector in reflectors)
    few = [r.record() for r in reflectors if groups[r.group] <= MOST_OF_GROUP][:MOST_REFLECTORS]
    ring_record = None if ring is None else ring.record()
    if ring_record is not None:
        ring_record["circles"] = ring_record["circles"][:MOST_CIRCLES]
    return FusionRequest.model_validate({"ring": ring_record, "reflectors": few})


def _known_of_file(path: Path) -> FusionRequest:
    target = find_target(str(path))
    if target.docking_ring is None and not target.reflectors:
        raise RendezviewError(
            f"{path}: this target has neither docking_ring nor reflectors: add one, or do not give "
            "--target"
        )
    return _known_of(target.docking_ring, target.reflectors)
