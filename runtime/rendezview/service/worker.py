"""A process that tracks: ``python -m rendezview.service.worker``, started by the service.

It holds the trackers and logs of some sessions and looks at one frame at a time. A crash in
here, of a decoder say, ends some sessions' trackers but not the service. When the service goes
away, the logs are completed and the process ends.
"""

from __future__ import annotations

import contextlib
import faulthandler
import gc
import hashlib
import json
import logging
import os
import signal
import socket
import sys
import time
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from pydantic_core import to_json

from rendezview.errors import RendezviewError
from rendezview.io.sequences.frame import GreyImage
from rendezview.sensors.appearance import AppearanceObservation, ViewModel
from rendezview.service.frames import read_frame
from rendezview.service.logs import set_up_logging
from rendezview.service.messages import Contour, SessionRequest
from rendezview.service.recording import LogWriter, RecordingOptions
from rendezview.service.tracking import Follower, StateDict, contour_at, silhouette_px, warm_up
from rendezview.service.wire import Header, mapped, pack, receive

JPEG_QUALITY = 80
_TOLD = ("session", "frame", "time_s", "status", "phase", "track_ms")
log = logging.getLogger("rendezview.service.worker")


@dataclass(slots=True)
class _Session:
    follower: Follower
    log: LogWriter | None


class Worker:
    """Answers the service's requests."""

    def __init__(self, connection: socket.socket, memory: Any) -> None:
        self._connection = connection
        self._memory = memoryview(memory)
        self._models: dict[str, ViewModel] = {}
        self._sessions: dict[str, _Session] = {}
        self._compiled = 0  # loops; see `warm_up`

    def run(self) -> None:
        """Until the service goes away or says so."""
        gc.freeze()
        self._send({"kind": "ready"})
        try:
            while (message := receive(self._connection)) is not None:
                if not self._answer(message[0]):
                    break
        finally:
            for session in self._sessions.values():
                if session.log is not None:
                    session.log.close()

    def _answer(self, request: Header) -> bool:
        try:
            if request["kind"] == "frame":
                self._frame(request)
            elif request["kind"] == "measure":
                self._measure(request)
            elif request["kind"] == "open":
                self._send({"kind": "opened", "session": request["session"], **self._open(request)})
            elif request["kind"] == "warm":
                self._model(Path(request["model_path"]))
                self._send(
                    {"kind": "opened", "session": request["session"], "compiled": self._compiled}
                )
            elif request["kind"] == "close":
                self._close(request)
            elif request["kind"] == "quit":
                return False
        except RendezviewError as error:
            self._send(_fault(request, str(error)))
        except Exception:
            # One frame's misfortune must not take the other sessions of this process along.
            log.exception("a request failed")
            told = "this met an error of the service itself; its log says which"
            self._send(_fault(request, told) | {"internal": True})
        return True

    def _model(self, path: Path) -> ViewModel:
        """A model, read once, and all that it needs compiled."""
        key = str(path)
        if key not in self._models:
            self._models[key] = ViewModel.load(path)
            self._compiled += warm_up(self._models[key])
        return self._models[key]

    def _open(self, request: Header) -> Header:
        asked = SessionRequest.model_validate(request["request"])
        path = Path(request["model_path"])
        model = self._model(path)
        follower = Follower(
            request["session"], model, asked, request["sensors"], request["forgotten"]
        )
        writer = None
        if request["log_path"] is not None:
            options = RecordingOptions(**request["recording"])
            content = path.read_bytes() if request["log_model"] and options.images else None
            notes = session_notes(request["session"], asked, model.name, path)
            notes["forgotten"] = "yes" if request["forgotten"] else "no"
            place = Path(request["log_path"])
            writer = LogWriter(place, follower.camera, notes, content, options)
        self._sessions[request["session"]] = _Session(follower, writer)
        written = None if writer is None else str(writer.path)
        return {"recording": _recording(writer), "log_path": written}

    def _frame(self, request: Header) -> None:
        session = self._sessions[request["session"]]
        follower = session.follower
        content = self._memory[: request["length"]]
        image = read_frame(content, follower.camera)
        time_s = request["time_s"]
        state, observation = follower.look(image, time_s, request["received_unix_s"])
        state["frame"] += request["first_frame"]
        state["drops"] = request["drops"]
        state["recorded"] = session.log is not None
        state["latency_ms"] = 1e3 * (time.monotonic() - request["received_s"])
        text = to_json(state, inf_nan_mode="null")
        if session.log is not None and not session.log.write(state, text, content):
            state["recorded"] = False
            text = to_json(state, inf_nan_mode="null")
        more = request["extras"]
        answer: Header = {
            "kind": "state",
            **{name: state[name] for name in _TOLD},
            "done": not more,
        }
        if follower.filter.running:
            answer["sensors"] = follower.filter.health()
        if session.log is not None:
            answer["recording"] = _recording(session.log)
            answer["log_path"] = str(session.log.path)
        self._send(answer, text)
        if more:
            self._extras(more, follower, image, state["frame"], observation)

    def _measure(self, request: Header) -> None:
        """Lines of another sensor: all checked, then taken one by one, logged, answered."""
        session = self._sessions[request["session"]]
        follower, sensor = session.follower, request["sensor"]
        text = bytes(self._memory[: request["length"]])
        lines = follower.filter.check(
            sensor, text, follower.last_s, request["waited_s"], request["most_lines"]
        )
        logged, verdicts, marks = [], [], None
        fused: StateDict | None = None
        for line in lines:
            order = follower.filter.lines
            verdict, fused = follower.filter.take(sensor, line)
            verdicts.append(verdict)
            marks = line.marks or marks
            logged.append(
                {
                    "session": follower.session,
                    "order": order,
                    "frame": request["first_frame"] + follower.frames,
                    "sensor": sensor,
                    "received_unix_s": request["received_unix_s"],
                    "record": line.record,
                    "verdict": verdict,
                    "fused": fused,
                }
            )
        told = {
            "type": "measured",
            "session": follower.session,
            "sensor": sensor,
            "verdicts": verdicts,
            "fused": fused,
            "recorded": session.log is not None and session.log.write_measurements(logged),
        }
        answer: Header = {
            "kind": "measured",
            "session": follower.session,
            "accepted": sum(v is not None and v["accepted"] for v in verdicts),
            "lines": len(lines),
            "sensors": follower.filter.health(),
            "marks": marks,
            "done": True,
        }
        if session.log is not None:
            answer["recording"] = _recording(session.log)
            answer["log_path"] = str(session.log.path)
        self._send(answer, to_json(told, inf_nan_mode="null"))

    def _extras(
        self,
        more: Header,
        follower: Follower,
        image: GreyImage,
        frame: int,
        observation: AppearanceObservation,
    ) -> None:
        """What watchers asked for; the frame's sender has been answered already."""
        contour: Contour | None = None
        if more["contour"] and observation.pose is not None:
            contour = contour_at(follower.model, follower.camera, observation.pose)
        outlines = silhouette_px(observation) if more["silhouette"] else None
        picture = jpeg(image, more["width"]) if more["width"] else b""
        header: Header = {
            "kind": "extras",
            "session": follower.session,
            "frame": frame,
            "contour": None if contour is None else contour.model_dump(),
            "silhouette_px": outlines,
            "done": True,
        }
        self._send(header, picture)

    def _close(self, request: Header) -> None:
        session = self._sessions.pop(request["session"], None)
        recording = None
        if session is not None and session.log is not None:
            session.log.close()
            recording = _recording(session.log)
        self._send({"kind": "closed", "session": request["session"], "recording": recording})

    def _send(self, header: Header, content: bytes = b"") -> None:
        with contextlib.suppress(ConnectionError):  # gone: the next `receive` says so
            self._connection.sendall(pack(header, content))


def session_notes(
    session: str, request: SessionRequest, model_name: str, model_path: Path
) -> dict[str, str]:
    """What a log says of its session, for replay."""
    return {
        "session": session,
        "request": request.model_dump_json(),
        "target": model_name,
        "model_file": model_path.name,
        "model_sha256": hashlib.sha256(model_path.read_bytes()).hexdigest(),
        "versions": json.dumps(
            {name: metadata.version(name) for name in ("rendezview", "numpy", "numba")}
        ),
        "opencv": cv2.__version__,
    }


def jpeg(image: GreyImage, width: int) -> bytes:
    """A frame for looking at, at most so wide."""
    shown = image
    if image.shape[1] > width:
        height = max(1, round(image.shape[0] * width / image.shape[1]))
        shown = np.asarray(
            cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8
        )
    return bytes(cv2.imencode(".jpg", shown, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1])


def _fault(request: Header, error: str) -> Header:
    return {
        "kind": "fault",
        "of": request["kind"],
        "session": request.get("session"),
        "error": error,
    }


def _recording(writer: LogWriter | None) -> Header | None:
    return None if writer is None else writer.status.model_dump(mode="json")


def main() -> None:
    """Started with the descriptors of the connection and of the memory, and its size."""
    # Signals to the whole group are the service's: it tells us when to end. Should it be gone,
    # so is the connection.
    for sent in (signal.SIGINT, signal.SIGTERM):
        signal.signal(sent, signal.SIG_IGN)
    cv2.setNumThreads(1)  # one core a worker
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    # Decoders write to the standard error as they like; the log of the service is JSON lines.
    sys.stderr = os.fdopen(os.dup(2), "w", buffering=1)
    faulthandler.enable(sys.stderr)
    quiet = os.open(os.devnull, os.O_WRONLY)
    os.dup2(quiet, 2)
    os.close(quiet)
    set_up_logging("info")
    connection, memory, size = (int(argument) for argument in sys.argv[1:4])
    Worker(socket.socket(fileno=connection), mapped(memory, size)).run()


if __name__ == "__main__":
    main()
