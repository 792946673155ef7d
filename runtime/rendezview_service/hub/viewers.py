"""Live streams for Foxglove, Rerun and ROS 2: each session's poses, pictures and numbers.

The first two packages have servers of their own, without tokens: they listen on this machine only,
unless a setting says otherwise.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import os
import socket
import subprocess
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

from rendezview.errors import RendezviewError, optional
from rendezview_service.client.messages import pose_of_state
from rendezview_service.hub.child_program import end
from rendezview_service.hub.health import info_of
from rendezview_service.hub.rerun_recorder import RerunRecorder
from rendezview_service.hub.ros_viewer import RosViewer
from rendezview_service.hub.sessions import Session
from rendezview_service.hub.watching import Watcher
from rendezview_service.messages.messages import SessionInfo
from rendezview_service.settings import Settings
from rendezview_service.tracker.tracking import camera_of

log = logging.getLogger("rendezview_service")

_SERVER_START_S = 30.0  # s; a program that is read from the disk. Source: a chosen limit
_SERVER_END_S = 3.0  # s, for a program to end, then it is killed. Source: chosen
_RATE_HZ, _WIDTH_PX = 15.0, 640  # of what is sent. Source: chosen
_AXES_M = 1.0  # of the fused pose. Source: chosen
_CONTOUR_COLOUR = {"r": 0.35, "g": 0.88, "b": 1.0, "a": 1.0}  # as on the page. Source: chosen
# In its package. Source: `rerun_cli/__main__.py` of rerun-sdk 0.41
_RERUN_PLACES = ("rerun", "rerun.exe", "Rerun.app/Contents/MacOS/Rerun")

Json = dict[str, Any]
_NEEDS = "a live stream needs"


class Viewers:
    """The servers that the settings ask for."""

    def __init__(self, settings: Settings) -> None:
        """None runs yet: see `start`."""
        self._settings = settings
        self._viewers: list[FoxgloveViewer | RerunViewer | RosViewer] = []
        self._lock = threading.Lock()  # a close waits for the start

    def start(self) -> None:
        """Start them, which takes seconds.

        Raises:
            RendezviewError: a package is missing, or a port is taken.
        """
        host, settings = self._settings.viewer_host, self._settings
        try:
            with self._lock:
                if settings.foxglove_port is not None:
                    self._viewers.append(FoxgloveViewer(host, settings.foxglove_port))
                if settings.rerun_port is not None:
                    self._viewers.append(RerunViewer(host, settings.rerun_port))
                if settings.ros_endpoint is not None:
                    self._viewers.append(RosViewer(settings.ros_endpoint))
        except (OSError, RuntimeError, subprocess.SubprocessError) as error:
            raise RendezviewError(f"a live stream does not start: {error}") from None

    @property
    def any(self) -> bool:
        """Whether there is one."""
        return bool(self._viewers)

    async def follow(self, session: Session) -> None:
        """Show a session until it ends."""
        watcher = Watcher(_RATE_HZ, _WIDTH_PX, contour=True, silhouette=False)
        session.watchers.add(watcher)
        try:
            async for text, stamped in watcher.messages():
                await asyncio.to_thread(self._show, info_of(session), text, stamped[8:])
        finally:
            session.watchers.discard(watcher)

    def _show(self, info: SessionInfo, text: bytes, picture: bytes) -> None:
        message = json.loads(text)
        for viewer in self._viewers:
            try:
                viewer.show(info, message, picture)
            except Exception:  # of a package that must not end the service
                log.exception("a live stream failed")

    def close(self) -> None:
        """End the servers."""
        with self._lock:
            while self._viewers:
                self._viewers.pop().close()


class FoxgloveViewer:
    """A WebSocket for Foxglove: the topics of a log, after the session's name."""

    def __init__(self, host: str, port: int) -> None:
        with optional(_NEEDS, "viewers"):
            import foxglove
            from foxglove import messages
        self._send, self._types = foxglove.log, messages
        self._server = foxglove.start_server(name="rendezview", host=host, port=port)

    def show(self, info: SessionInfo, message: Json, picture: bytes) -> None:
        """A `WatchState` and its JPEG, or nothing."""
        send, types, state, at = self._send, self._types, message["state"], f"/{info.id}"
        camera, target = f"{info.id}/camera", f"{info.id}/target"
        now = types.Timestamp.from_epoch_secs(state["received_unix_s"])
        send(f"{at}/state", state)
        if info.flight is not None:
            send(f"{at}/flight", info.flight.model_dump(mode="json"))
        poses = {"pose": state["pose"], "fused": (state.get("fused") or {}).get("pose")}
        for name, pose in poses.items():
            if pose is not None:
                place, turn = self._place_and_turn(pose)
                there = types.Pose(position=place, orientation=turn)
                posed = types.PoseInFrame(timestamp=now, frame_id=camera, pose=there)
                send(f"{at}/target/{name}", posed)
        if state["pose"] is not None:
            place, turn = self._place_and_turn(state["pose"])
            frames = {"parent_frame_id": camera, "child_frame_id": target}
            moved = types.FrameTransform(timestamp=now, translation=place, rotation=turn, **frames)
            send(f"{at}/tf", moved)
        if picture:
            stamped = {"timestamp": now, "frame_id": camera}
            image = types.CompressedImage(data=picture, format="jpeg", **stamped)
            send(f"{at}/camera/image", image)
            scale, drawn = _WIDTH_PX / max(info.camera.width, _WIDTH_PX), []
            if message["contour"] is not None:
                points = message["contour"]["points_px"]
                contour = types.PointsAnnotation(
                    timestamp=now,
                    type=types.PointsAnnotationType.Points,
                    points=[types.Point2(x=scale * u, y=scale * v) for u, v in points],
                    outline_color=types.Color(**_CONTOUR_COLOUR),
                    thickness=2.0,
                )
                drawn.append(contour)
            send(f"{at}/camera/contour", types.ImageAnnotations(points=drawn))

    def _place_and_turn(self, pose: dict[str, list[float]]) -> tuple[Any, Any]:
        place = dict(zip("xyz", pose["translation_m"], strict=True))
        turn = dict(zip("wxyz", pose["quat_wxyz"], strict=True))
        return self._types.Vector3(**place), self._types.Quaternion(**turn)

    def close(self) -> None:
        """End the server."""
        self._server.stop()


class RerunViewer:
    """A gRPC server for the Rerun viewer; each session is an entity at the root.

    The server is the package's program: its function for a server in this process listens on all
    addresses, the program on the one that it is given.
    """

    def __init__(self, host: str, port: int) -> None:
        self._open = contextlib.ExitStack()
        with self._open:  # ends it all, unless it starts
            self._start(host, port)
            self._open = self._open.pop_all()

    def _start(self, host: str, port: int) -> None:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        with socket.socket(family) as trial:  # another program's listener would pass for it
            trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            trial.bind((host, port))
        program = [str(_rerun_program())]
        # The program reports its use to its makers, unless its own settings forbid it.
        home = self._open.enter_context(tempfile.TemporaryDirectory(prefix="rendezview-rerun-"))
        quiet: Any = {
            "env": os.environ | {"XDG_CONFIG_HOME": home},
            "stdin": subprocess.DEVNULL,
            "stdout": subprocess.DEVNULL,
            "stderr": subprocess.DEVNULL,
        }
        forbid = [*program, "analytics", "disable"]
        if subprocess.run(forbid, timeout=_SERVER_START_S, **quiet).returncode:
            raise OSError("Rerun's program fails: is its package whole?")
        import rerun as rr

        self._rr = rr
        at = "127.0.0.1" if host == "0.0.0.0" else "[::1]" if host == "::" else host
        self.address = f"rerun+http://{at}:{port}/proxy"
        server = subprocess.Popen(
            [*program, "--serve-grpc", "--bind", host, "--port", str(port)], **quiet
        )
        self._open.callback(end, server, _SERVER_END_S)
        self._stream = rr.RecordingStream("rendezview")
        _await_listener(server, at.strip("[]"), port)
        self._stream.connect_grpc(self.address)
        self._open.callback(self._stream.disconnect)
        self._begun: dict[str, RerunRecorder] = {}

    def show(self, info: SessionInfo, message: Json, picture: bytes) -> None:
        """A `WatchState` and its JPEG, or nothing."""
        rr, state = self._rr, message["state"]
        if info.id not in self._begun:
            self._begun[info.id] = RerunRecorder(rr, self._stream, f"/{info.id}", _AXES_M)
        shown = rr.EncodedImage(contents=picture, media_type="image/jpeg") if picture else None
        self._begun[info.id].show(
            state["frame"],
            state["received_unix_s"],
            state,
            pose_of_state(state),
            camera=camera_of(info.camera),
            picture=shown,
            scale=min(1.0, _WIDTH_PX / info.camera.width),
            contour_px=(message["contour"] or {"points_px": ()})["points_px"],
        )

    def close(self) -> None:
        """End the server."""
        self._open.close()


def _rerun_program() -> Path:
    """Rerun's own program: ``python -m rerun`` starts it as a child, which outlives its parent.

    Raises:
        OSError: it is not there.
        RendezviewError: the package is not installed.
    """
    with optional(_NEEDS, "viewers"):
        import rerun_cli
    folder = Path(rerun_cli.__file__).parent
    given = os.environ.get("RERUN_CLI_PATH")  # as the package has it
    places = [Path(given)] if given else [folder / place for place in _RERUN_PLACES]
    for path in places:
        if path.is_file():
            return path
    raise OSError(f"there is no {places[0]}: set RERUN_CLI_PATH to Rerun's program")


def _await_listener(server: subprocess.Popen[bytes], host: str, port: int) -> None:
    """Wait until the server listens.

    Raises:
        OSError: it ended, or does not listen in time.
    """
    until_s = time.monotonic() + _SERVER_START_S
    while server.poll() is None and time.monotonic() < until_s:
        try:
            socket.create_connection((host, port), 1.0).close()
        except OSError:
            time.sleep(0.05)
        else:
            return
    raise OSError(f"Rerun's server does not listen on {host}:{port}: is the port taken?")
