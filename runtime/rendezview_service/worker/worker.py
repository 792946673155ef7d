"""The worker process: ``python -m rendezview_service.worker.worker``, started by the service.

It holds the trackers and logs of some sessions and handles one input at a time. A crash here ends
these, but not the service. When the service ends, the worker completes its logs and ends too.
"""

from __future__ import annotations

import contextlib
import faulthandler
import gc
import logging
import mmap
import os
import select
import signal
import socket
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from pydantic_core import to_json

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.io.sequences.frame import GreyImage
from rendezview.sensors.appearance import AppearanceObservation
from rendezview_service.json_logging import set_up_logging
from rendezview_service.logs.recording import RECORDED, LogWriter
from rendezview_service.messages.frames import read_frame
from rendezview_service.messages.messages import SessionRequest
from rendezview_service.messages.wire import Header, pack, receive
from rendezview_service.settings import Settings
from rendezview_service.tracker.tracking import (
    SessionTracker,
    StateDict,
    contour_shown,
    silhouette_px,
)
from rendezview_service.worker.worker_models import Sight, WorkerModels

JPEG_QUALITY = 80  # 0 … 100, of pictures for watchers. Source: chosen
# s of processor time to decode a frame, and more for each pixel. Source: a chosen limit
_DECODING_S, _DECODING_PIXEL_S = 0.1, 50e-9
_LOOK_S, _LOOK_ENDING_S = 0.5, 0.01  # s, between looks at logs, and at those that end
# s, between messages with the progress; to complete the logs at the end. Source: chosen
_TELL_S, _COMPLETE_S = 1.0, 30.0
_HEADER_KEYS = ("session", "frame", "time_s", "status", "phase", "track_ms")
log = logging.getLogger("rendezview_service.worker.worker")


@dataclass(slots=True)
class _WorkerSession:
    tracker: SessionTracker
    log: LogWriter | None
    sight: Sight
    last: tuple[GreyImage, StateDict, AppearanceObservation] | None = None  # frame and answer
    reported: Header | None = None  # how recording goes, as last sent


class WorkerProcess:
    """Answers the service's requests."""

    def __init__(self, connection: socket.socket, memory: Any, settings: Settings) -> None:
        self._connection, self._settings = connection, settings
        self._memory = memoryview(memory)
        self._models = WorkerModels(self._tell)
        self._sessions: dict[str, _WorkerSession] = {}
        self._ending: list[tuple[Header, LogWriter]] = []  # requests to close, and logs
        self._reported_s = self._looked_s = 0.0

    def run(self) -> None:
        """Answer until the service ends or asks to quit."""
        gc.freeze()
        self._send({"kind": "ready"})
        coming = select.poll()  # `select.select` takes no descriptor above 1023
        coming.register(self._connection, select.POLLIN)
        try:
            while True:
                if coming.poll(1e3 * (_LOOK_ENDING_S if self._ending else _LOOK_S)):
                    message = receive(self._connection)
                    if message is None or not self._answer(message[0]):
                        break
                self._look_at_logs()
        finally:
            logs = [session.log for session in self._sessions.values() if session.log is not None]
            for writer in logs:
                writer.end()
            until_s = time.monotonic() + _COMPLETE_S
            for writer in (*logs, *(writer for _, writer in self._ending)):
                writer.close(max(0.0, until_s - time.monotonic()))

    def _look_at_logs(self) -> None:
        """Report logs that are complete, and disks that fail while no frame comes."""
        for request, writer in [one for one in self._ending if one[1].is_ended]:
            self._ending.remove((request, writer))
            self._done(request)
        now_s = time.monotonic()
        if now_s - self._looked_s < _LOOK_S:
            return
        self._looked_s = now_s
        for name, session in self._sessions.items():
            before = session.reported
            if session.log is not None and _report(session) != before:
                self._send({"kind": "recording", "session": name, **(session.reported or {})})

    def _answer(self, request: Header) -> bool:
        try:
            if request["kind"] == "frame":
                self._frame(request)
            elif request["kind"] == "show":
                self._extras(request["extras"], self._sessions[request["session"]])
            elif request["kind"] == "measure":
                self._measure(request)
            elif request["kind"] == "open":
                self._done(request, **self._open(request))
            elif request["kind"] == "warm":
                self._models.load_loops(sensors=request["sensors"])
                self._done(request, compiled=self._models.compiled)
            elif request["kind"] == "read":
                self._models.model(Path(request["model_path"]))
                self._done(request)
            elif request["kind"] == "prepare":
                self._models.prepare([Sight.of(one) for one in request["sights"]])
                self._drop_unused()
                self._done(request)
            elif request["kind"] == "close":
                self._close(request)
            elif request["kind"] == "quit":
                return False
        except RendezviewError as error:
            self._send(_fault(request, str(error)))
        except Exception:
            # An error in one frame must not end the other sessions of this process.
            log.exception("a request failed")
            message = "the service has an internal error: see its log"
            self._send(_fault(request, message) | {"internal": True})
        return True

    def _tell(self, loops: int) -> None:
        """Say how many loops are compiled, once a second."""
        if time.monotonic() - self._reported_s > _TELL_S:
            self._reported_s = time.monotonic()
            self._send({"kind": "progress", "loops": loops})

    def _open(self, request: Header) -> Header:
        notes, options, sight = request["notes"], self._settings, Sight.of(request["sight"])
        asked = SessionRequest.model_validate_json(notes["request"])
        self._models.load_loops(sensors=asked.sensors is not None and asked.sensors.any)
        try:
            model, recognizer = self._models.model(sight.model), self._models.recognizer(sight)
            name = request["session"]
            tracker = SessionTracker(name, model, asked, notes, options.sensors, recognizer)
            writer = None
            if request["log_path"] is not None:
                whole = options.record_model and options.record_images
                content = sight.model.read_bytes() if whole else None
                place = Path(request["log_path"])
                writer = LogWriter(place, tracker.camera, notes, content, options)
            session = _WorkerSession(tracker, writer, sight)
            self._sessions[name] = session
        finally:
            self._drop_unused()
        return _report(session)

    def _frame(self, request: Header) -> None:
        session = self._sessions[request["session"]]
        tracker = session.tracker
        content = self._memory[: request["length"]]
        with decoding_time(tracker.camera):
            image = read_frame(content, tracker.camera)
        time_s = request["time_s"]
        state, observation = tracker.track(
            image, time_s, request["received_unix_s"], request["drops"], request["roi"]
        )
        state["frame"] += request["first_frame"]
        if session.log is not None:
            state["recorded"], state["record"] = True, RECORDED
        state["model_sha256"] = session.sight.model.stem
        state["latency_ms"] = 1e3 * (time.monotonic() - request["received_s"])
        text = to_json(state, inf_nan_mode="null")
        if session.log is not None:
            state["record"] = session.log.write(state, text, content)
            if state["record"] != RECORDED:
                state["recorded"] = False
                text = to_json(state, inf_nan_mode="null")
        more = request["extras"]
        answer: Header = {
            "kind": "state",
            **{name: state[name] for name in _HEADER_KEYS},
            "done": not more,
            "alarms": [] if state["approach"] is None else state["approach"]["alarms"],
            "starts": tracker.filter.starts,
        }
        if tracker.filter.fuses:
            answer["sensors"] = tracker.filter.health()
            answer["own"] = tracker.sensors.names
        self._send(answer | _report(session), text)
        session.last = image, state, observation
        if more:
            self._extras(more, session)

    def _measure(self, request: Header) -> None:
        """Lines of another sensor: all are checked, then each is taken; then they are logged."""
        session = self._sessions[request["session"]]
        tracker, sensor = session.tracker, request["sensor"]
        text = bytes(self._memory[: request["length"]])
        most_lines = self._settings.measurement_lines
        lines = tracker.filter.check(sensor, text, tracker.last_s, request["waited_s"], most_lines)
        logged, verdicts, marks = [], [], None
        fused: StateDict | None = None
        for line in lines:
            order = tracker.filter.lines
            verdict, fused = tracker.filter.take(sensor, line)
            verdicts.append(verdict)
            marks = line.marks or marks
            logged.append(
                {
                    "session": tracker.session,
                    "order": order,
                    "frame": request["first_frame"] + tracker.frames,
                    "sensor": sensor,
                    "received_unix_s": request["received_unix_s"],
                    "record": line.record,
                    "verdict": verdict,
                    "fused": fused,
                }
            )
        record = None if session.log is None else session.log.write_measurements(logged)
        answer_body = {
            "type": "measured",
            "session": tracker.session,
            "sensor": sensor,
            "verdicts": verdicts,
            "fused": fused,
            "recorded": record == RECORDED,
            "record": record,
        }
        answer: Header = {
            "kind": "measured",
            "session": tracker.session,
            "accepted": sum(v is not None and v["accepted"] for v in verdicts),
            "lines": len(lines),
            "sensors": tracker.filter.health(),
            "marks": marks,
            "done": True,
        }
        self._send(answer | _report(session), to_json(answer_body, inf_nan_mode="null"))

    def _extras(self, more: Header, session: _WorkerSession) -> None:
        """What watchers asked for of the last frame. Its sender already has its answer."""
        assert session.last is not None
        tracker, (image, state, observation) = session.tracker, session.last
        contour, joints = None, observation.joints
        if more["contour"]:
            angles_rad = None if joints is None else joints.angles_rad
            contour = contour_shown(tracker.model, tracker.camera, state, angles_rad)
        outlines = silhouette_px(observation) if more["silhouette"] else None
        picture = jpeg(image, more["width"]) if more["width"] else b""
        header: Header = {
            "kind": "extras",
            "session": tracker.session,
            "frame": state["frame"],
            "contour": None if contour is None else contour.model_dump(),
            "silhouette_px": outlines,
            "done": True,
        }
        self._send(header, picture)

    def _close(self, request: Header) -> None:
        session = self._sessions.pop(request["session"], None)
        if session is not None and session.log is not None:
            session.log.end()
            self._ending.append((request, session.log))
        else:
            self._done(request)
        del session  # its memory is free before the next line
        self._drop_unused()

    def _done(self, request: Header, **more: Any) -> None:
        """Answer a request other than an input."""
        self._send({"kind": "done", "to": request["number"], **more})

    def _drop_unused(self) -> None:
        self._models.keep({session.sight for session in self._sessions.values()})

    def _send(self, header: Header, content: bytes = b"") -> None:
        with contextlib.suppress(ConnectionError):  # the next `receive` finds the service gone
            self._connection.sendall(pack(header, content))


def decoding_s(camera: Camera) -> float:
    """Processor time that decoding a frame may take."""
    return _DECODING_S + _DECODING_PIXEL_S * camera.width * camera.height


@contextlib.contextmanager
def decoding_time(camera: Camera) -> Iterator[None]:
    """Bound the processor time of decoding a frame: with more, the process ends.

    No code of this package can interrupt a decoder; the system can. The sessions of this process
    continue in another one within a fraction of a second.
    """
    signal.setitimer(signal.ITIMER_PROF, decoding_s(camera))
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)


def jpeg(image: GreyImage, width: int) -> bytes:
    """A frame as JPEG for display, at most ``width`` pixels wide."""
    shown = image
    if image.shape[1] > width:
        height = max(1, round(image.shape[0] * width / image.shape[1]))
        shown = np.asarray(
            cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8
        )
    return bytes(cv2.imencode(".jpg", shown, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1])


def _fault(request: Header, error: str) -> Header:
    return {"kind": "fault", "to": request.get("number"), "error": error}


def _report(session: _WorkerSession) -> Header:
    """How recording goes, and its files; nothing for a session without a log."""
    if session.log is None:
        return {}
    status, paths = session.log.status, session.log.paths
    session.reported = {
        "recording": status.model_dump(mode="json"),
        "log_paths": [str(path) for path in paths],
    }
    return session.reported


def main() -> None:
    """Arguments: descriptors of the connection and of the shared memory, its size, settings."""
    # Signals to the process group are for the service, which asks its workers to quit.
    for sent in (signal.SIGINT, signal.SIGTERM):
        signal.signal(sent, signal.SIG_IGN)
    cv2.setNumThreads(1)  # one core per worker
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    # Image decoders write to standard error; the log of the service must be JSON lines only.
    sys.stderr = os.fdopen(os.dup(2), "w", buffering=1)
    faulthandler.enable(sys.stderr)
    quiet = os.open(os.devnull, os.O_WRONLY)
    os.dup2(quiet, 2)
    os.close(quiet)
    set_up_logging("info")
    connection, memory, size = (int(argument) for argument in sys.argv[1:4])
    settings = Settings.model_validate_json(sys.argv[4])
    WorkerProcess(socket.socket(fileno=connection), mmap.mmap(memory, size), settings).run()


if __name__ == "__main__":
    main()
