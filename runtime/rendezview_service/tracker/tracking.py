"""The tracker of one session: frames in, states out. The worker and replay run it."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Mapping
from dataclasses import asdict
from importlib import metadata
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.io.results import json_value
from rendezview.io.sequences.frame import GreyImage
from rendezview.sensors.appearance import AppearanceObservation, Recognizer, Tracker, ViewModel
from rendezview.sensors.appearance.edges.contour_at import contour_pixels
from rendezview.sensors.appearance.integrity.monitor import IntegrityOptions
from rendezview.sensors.appearance.region import Region
from rendezview.sensors.observation import Status
from rendezview_service.messages.frame_sensor_messages import TrajectoryRequest
from rendezview_service.messages.message_parts import MOST_TIME_S, PoseMessage
from rendezview_service.messages.messages import (
    CameraMessage,
    Contour,
    Fit,
    Phase,
    SessionRequest,
)
from rendezview_service.tracker.approach import ApproachMonitor
from rendezview_service.tracker.frame_sensors import FrameSensors
from rendezview_service.tracker.session_filter import SessionFilter
from rendezview_service.tracker.session_path import SessionPath

# A `State` as a dict. It is not validated, because it is made here for every frame.
StateDict = dict[str, Any]

# Keys of an observation's record that a state has as they are, in this order.
_OBSERVED = ("status", "reason", "pose", "covariance", "confidence", "score")
_VERSIONS = {name: metadata.version(name) for name in ("rendezview", "numpy", "numba")}
_OUTLINE_POINTS = 600  # of a silhouette that is drawn. Source: a chosen limit


def camera_of(message: CameraMessage) -> Camera:
    """The camera of a message.

    Raises:
        RendezviewError: the number of distortion coefficients is impossible.
    """
    try:
        return Camera(**message.model_dump(exclude={"checked"}))
    except ValueError as error:
        raise RendezviewError(f"camera: {error}") from None


def camera_message(camera: Camera, *, checked: bool = False) -> CameraMessage:
    """A camera as a message; ``checked``: what is odd about it is known."""
    keys = asdict(camera)
    del keys["doubts"]  # of its file
    return CameraMessage.model_validate(keys | {"checked": checked})


def session_notes(
    session: str, request: SessionRequest, target: str, model: Path, **more: str
) -> dict[str, str]:
    """What a tracker begins with: the metadata of a log.

    Args:
        model: its file, named by its hash.
        more: ``model_file``, its own name; ``first_frame``, the number of the first frame;
            ``forgotten``: ``yes`` if the session had a filter whose process ended; ``handover``,
            the last `Fused` state of that one, JSON, null without a pose; and others.
    """
    return {
        "session": session,
        "request": request.model_dump_json(),
        "target": target,
        "model_file": model.name,
        "model_sha256": model.stem,
        "versions": json.dumps(_VERSIONS),
        "opencv": cv2.__version__,
        **more,
    }


class SessionTracker:
    """A tracker with the session's other sensors, filter, path, names and counters.

    One thread uses it: the worker's, or that of replay.
    """

    def __init__(
        self,
        session: str,
        model: ViewModel,
        request: SessionRequest,
        notes: Mapping[str, str] | None = None,
        most_sensors: int | None = None,
        recognizer: Recognizer | None = None,
    ) -> None:
        """The tracker that a request describes; the request has a camera.

        Args:
            notes: its `session_notes`; with the same ones a replay repeats its run.
            most_sensors: beside the camera; None: any number.
            recognizer: of the model and the request's camera and trees, which several sessions
                may share; None: a new one.

        Raises:
            RendezviewError: the camera, the region, a sensor or the path is wrong.
        """
        if request.camera is None:
            raise RendezviewError("the session has no camera: give one")
        self.session = session
        self.model = model
        self.camera = camera_of(request.camera)
        self.sun_camera = request.sun_camera
        self._roi = request.roi  # until there is a pose
        if self._roi is not None:
            Region.of(self._roi, self.camera)  # a wrong one is said at once
        prior = None if request.prior is None else request.prior.pose
        recognizer = recognizer or Recognizer(model, self.camera, trees=request.trees)
        asked, integrity = request.integrity, None
        if asked is not None:
            integrity = IntegrityOptions(**asked.model_dump(exclude_none=True))
        self.tracker = Tracker(
            recognizer, prior, integrity=integrity, prior_posterior=request.prior_posterior
        )
        self._nodes = model.geodesic.nodes.tolist()
        self.sensors = FrameSensors(request, self.camera)
        fuses = request.sensors is not None and bool(request.sensors.fusion)
        notes = notes or {}
        about = notes.get("forgotten") == "yes", self.sensors.names, fuses, model.beam_mesh()
        self.filter = SessionFilter(request.fusion, most_sensors, *about)
        handover = json.loads(notes.get("handover", "null"))
        if handover is not None:
            self.filter.resume(handover)
        fits = None if request.sensors is None else request.sensors.trajectory
        ring = None if request.fusion is None else request.fusion.ring
        centre_m = model.centre_m if ring is None else np.array(ring.centre_m)
        self._path = SessionPath(fits, centre_m) if isinstance(fits, TrajectoryRequest) else None
        self._approach = ApproachMonitor(request.approach, request.fusion, model.centre_m)
        self.frames = 0  # tracked so far
        self.last_s = -math.inf  # of the last frame; -inf: none yet
        self._last_pose_s: float | None = None

    def track(
        self,
        image: GreyImage,
        time_s: float,
        received_unix_s: float,
        drops: int = 0,
        roi: list[float] | None = None,
    ) -> tuple[StateDict, AppearanceObservation]:
        """The state of a frame; the caller sets ``latency_ms`` and ``recorded``.

        Args:
            image: (H, W).
            time_s: of the frame.
            received_unix_s: when it arrived.
            drops: frames of the session that newer ones replaced, so far.
            roi: where in it the target is, as in `SessionRequest`; None: not told.

        Raises:
            RendezviewError: the time is not later than the last frame's, the image does not fit
                the camera, or the region lies outside. The tracker does not change then.
        """
        if not (abs(time_s) <= MOST_TIME_S and time_s > self.last_s):
            raise RendezviewError(
                f"time_s: {time_s} is not later than that of the last frame ({self.last_s}), or "
                "beyond 1e10: send frames in order of time"
            )
        if roi is not None:
            Region.of(roi, self.camera)
        start = time.perf_counter()
        if self.tracker.lost and (known := self.filter.expected(time_s)) is not None:
            self.tracker.expect(*known)
        region = self._roi if roi is None and self.tracker.prior is None else roi
        observation = self.tracker.update(time_s, image, self.sun_camera, region)
        track_ms = 1e3 * (time.perf_counter() - start)
        self.last_s = time_s
        if observation.pose is not None:
            self._last_pose_s, self._roi = time_s, None  # it may be elsewhere when it is lost
        state = self._state(observation, time_s, received_unix_s, track_ms)
        state["drops"] = drops
        if roi is not None:
            state["roi"] = roi
        clock = time.perf_counter()

        def lap(stage: str) -> None:
            nonlocal clock
            now = time.perf_counter()
            state["stage_ms"][stage] = 1e3 * (now - clock)
            clock = now

        fused = self.filter.track(observation)
        lap("filter")
        if self.sensors.names:
            number = self.frames + drops
            state |= self.sensors.look(image, time_s, number, fused, self.filter)
            fused = self.filter.state_at(time_s)
            lap("sensors")
        if self.filter.fuses:
            state["fused"] = fused
        if self._path is not None:
            state["trajectory"] = self._fitted(time_s, fused, observation)
            lap("trajectory")
        state["motion"], covariance = _motion(fused)
        state["approach"] = self._approach.state(time_s, state["motion"], covariance)
        self.frames += 1
        return state, observation

    def _state(
        self,
        observation: AppearanceObservation,
        time_s: float,
        received_unix_s: float,
        track_ms: float,
    ) -> StateDict:
        """The observation's record, and what only the session knows."""
        record = json_value(observation.record())
        pose = observation.pose
        rates = None if pose is None else self.tracker.rates
        fit = record["refinement"]
        return {
            "session": self.session,
            "frame": self.frames,
            "time_s": time_s,
            "received_unix_s": received_unix_s,
            "phase": self._phase(observation, time_s),
            **{name: record[name] for name in _OBSERVED},
            "range_m": None if pose is None else math.hypot(*pose.apply(self.model.centre_m)),
            "rates": None
            if rates is None
            else {"angular_rad_s": rates[0].tolist(), "linear_m_s": rates[1].tolist()},
            "candidates": record["candidates"],
            "fit": None if fit is None else {name: fit[name] for name in Fit.model_fields},
            "on_nodes": [
                {"index": node, "weight": weight, "direction": self._nodes[node]}
                for node, weight in zip(record["on_nodes"], record["weights"], strict=True)
            ],
            "stage_ms": record["stage_ms"],
            "track_ms": track_ms,
            "latency_ms": 0.0,
            "drops": 0,
            "recorded": False,
            **{name: record[name] for name in ("protection",) if name in record},
        }

    def _fitted(
        self, time_s: float, fused: StateDict, observation: AppearanceObservation
    ) -> StateDict | None:
        """The path, with a fused state only where it is more than a prediction."""
        assert self._path is not None
        if not self.filter.fuses:
            return self._path.update(time_s, None, observation)
        if self.filter.measured_s < time_s:
            fused = {"pose": None, "covariance": None}
        return self._path.update(time_s, fused, observation)

    def _phase(self, observation: AppearanceObservation, time_s: float) -> Phase:
        if observation.pose is not None:
            return Phase.TRACKING
        since_s = math.inf if self._last_pose_s is None else time_s - self._last_pose_s
        if since_s <= self.tracker.options.longest_prediction_s:
            return Phase.COASTING
        return Phase.SEARCHING


def _motion(fused: StateDict) -> tuple[StateDict, npt.NDArray[np.float64] | None]:
    """The `Motion` of a `Fused` state, and the covariance (12, 12)."""
    covariance = None if fused["covariance"] is None else np.array(fused["covariance"])
    motion = {name: fused[name] for name in ("status", "reason", "pose", "rates")}
    motion["covariance"] = motion["angular_sigma_rad_s"] = motion["linear_sigma_m_s"] = None
    if covariance is not None:
        sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0)).tolist()
        motion["covariance"] = covariance[:6, :6].tolist()
        motion["angular_sigma_rad_s"], motion["linear_sigma_m_s"] = sigma[6:9], sigma[9:]
    return motion, covariance


def shown_pose(state: StateDict) -> tuple[PoseMessage | None, bool]:
    """The pose that is drawn over a frame, and whether it is only predicted.

    Where the camera gave none it is the filter's, of other sensors or while it coasts.
    """
    pose, motion = state["pose"], state.get("motion") or {}
    fused = (state.get("fused") or {}).get("status") == Status.TRACKING
    by_filter = pose is None and (fused or state["phase"] == Phase.COASTING)
    if by_filter:
        pose = motion.get("pose")
    if pose is None:
        return None, False
    return PoseMessage.model_validate(pose), by_filter and not fused


def contour_at(
    model: ViewModel,
    camera: Camera,
    pose: Pose,
    angles_rad: npt.NDArray[np.float64] | None = None,
    *,
    predicted: bool = False,
) -> Contour | None:
    """Contour points of the view nearest to a pose, projected; None if the model has none.

    ``angles_rad``: (J,) of the joints of a target that has any.
    """
    found = contour_pixels(model, camera, pose, angles_rad)
    if found is None:
        return None
    return Contour.model_construct(
        points_px=np.round(found.points_px, 1).tolist(),
        kinds=found.kinds.tolist(),
        predicted=predicted,
    )


def silhouette_px(observation: AppearanceObservation) -> list[list[list[float]]] | None:
    """The outlines of the silhouette, thinned for drawing."""
    if observation.silhouette is None:
        return None
    outlines: tuple[npt.NDArray[np.float64], ...] = observation.silhouette.outlines_px
    step = 1 + sum(len(o) for o in outlines) // _OUTLINE_POINTS
    return [np.round(o[::step], 1).tolist() for o in outlines]


def contour_shown(
    model: ViewModel,
    camera: Camera | None,
    state: StateDict,
    angles_rad: npt.NDArray[np.float64] | None = None,
) -> Contour | None:
    """Contour points at the pose that is drawn over a frame; None without one. See `contour_at`."""
    pose, predicted = shown_pose(state)
    if pose is None or camera is None:
        return None
    return contour_at(model, camera, pose.pose, angles_rad, predicted=predicted)
