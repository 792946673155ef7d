"""Sources in a process of their own, so that a decoder that crashes or hangs takes nothing with it.

``python -m rendezview_service.hub.source_process DESCRIPTOR SOURCE CAMERA`` reads one; the service
starts it by `open_apart`.
"""

from __future__ import annotations

import contextlib
import json
import os
import resource
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import asdict

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview_service.hub.sources import RECONNECT_S, Source, SourceFrame, open_source
from rendezview_service.messages.wire import Header, pack, receive

_OPEN_S = 120.0  # s, to open a source; a bag may have to be indexed. Source: a chosen limit
_SILENT_S = 60.0  # s, for the next frame of a file. Source: a chosen limit
_END_S = 2.0  # s, for the end of the process. Source: a chosen limit
_MOST_BYTES = 8_000_000_000  # of addresses of the process. Source: a chosen limit


def open_apart(text: str, camera: Camera | None) -> Source:
    """A source as `open_source`, whose decoder runs in a process of its own.

    Raises:
        RendezviewError: as `open_source`.
    """
    reader = _Reader(text, camera)
    opened = reader.opened
    given = None if opened["camera"] is None else Camera(**_camera_keys(opened["camera"]))
    notes = tuple(opened["notes"])
    return Source(opened["name"], given, opened["live"], reader.frames, reader.close, notes)


class _Reader:
    """The process of one source; started again if it ends, and the source is live."""

    def __init__(self, text: str, camera: Camera | None) -> None:
        self._text, self._camera = text, camera
        self._closed = False
        self._start()

    def _start(self) -> None:
        ours, theirs = socket.socketpair()
        camera = json.dumps(None if self._camera is None else asdict(self._camera))
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-m", __name__, str(theirs.fileno()), self._text, camera],
                pass_fds=(theirs.fileno(),),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                env=os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
            )
        self._connection = ours
        opened = self._receive(_OPEN_S)
        if opened is None or opened[0]["kind"] == "fault":
            why = str(opened[0]["error"]) if opened is not None else f"{self._text}: {self._end()}"
            self._stop_process()
            raise RendezviewError(why)
        self.opened = opened[0]

    def _receive(self, timeout_s: float | None) -> tuple[Header, bytes] | None:
        """The next message; None: the process has ended, or is ended, because it is silent."""
        self._connection.settimeout(timeout_s)
        try:
            return receive(self._connection)
        except TimeoutError:
            self._process.kill()
        except OSError:
            pass  # closed by another thread
        return None

    def _end(self) -> str:
        """Why the process has ended; one that cannot end is ended."""
        try:
            code = self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            code = -signal.SIGKILL
        if code == -signal.SIGKILL:
            return "its decoder did not answer"
        if code < 0:
            return f"its decoder ended ({signal.Signals(-code).name})"
        return f"its decoder ended (code {code})"

    def close(self) -> None:
        """End the process for good."""
        self._closed = True
        self._stop_process()

    def _stop_process(self) -> None:
        with contextlib.suppress(OSError):
            self._connection.shutdown(socket.SHUT_RDWR)
        self._connection.close()
        self._process.kill()
        with contextlib.suppress(subprocess.TimeoutExpired):  # a driver may keep it for ever
            self._process.wait(_END_S)

    def frames(self, stop: threading.Event) -> Iterator[SourceFrame | RendezviewError]:
        """Frames and faults.

        Raises:
            RendezviewError: the source cannot go on.
        """
        live, name = self.opened["live"], self.opened["name"]
        while not stop.is_set():
            yield from self._once(None if live else _SILENT_S)
            if self._closed or stop.is_set() or self._ended:
                return
            why = f"{name}: {self._end()}"
            if not live:
                raise RendezviewError(why)
            yield RendezviewError(f"{why}; starting again")
            if stop.wait(RECONNECT_S):
                return
            self._stop_process()
            with contextlib.suppress(RendezviewError):
                self._start()

    _ended = False  # the process said so

    def _once(self, silent_s: float | None) -> Iterator[SourceFrame | RendezviewError]:
        with contextlib.suppress(OSError):
            self._connection.sendall(pack({"kind": "go"}))
        while (message := self._receive(silent_s)) is not None:
            header, content = message
            if header["kind"] == "frame":
                yield SourceFrame(header["time_s"], content)
            elif header["kind"] == "refused":
                yield RendezviewError(header["error"])
            else:
                self._ended = True
                if header["error"] is not None:
                    raise RendezviewError(header["error"])
                return


def _camera_keys(opened: Header) -> Header:
    return opened | {"distortion": tuple(opened["distortion"])}


def main() -> None:
    """Read one source; the service says when to begin."""
    for sent in (signal.SIGINT, signal.SIGTERM):
        signal.signal(sent, signal.SIG_IGN)  # for the service, which closes the connection
    resource.setrlimit(resource.RLIMIT_AS, (_MOST_BYTES, _MOST_BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    quiet = os.open(os.devnull, os.O_WRONLY)
    os.dup2(quiet, 2)  # decoders write there
    connection = socket.socket(fileno=int(sys.argv[1]))
    given = json.loads(sys.argv[3])
    camera = None if given is None else Camera(**_camera_keys(given))

    def send(header: Header, content: bytes = b"") -> None:
        connection.sendall(pack(header, content))

    try:
        source = open_source(sys.argv[2], camera)
    except RendezviewError as error:
        send({"kind": "fault", "error": str(error)})
        return
    opened = None if source.camera is None else asdict(source.camera)
    about = {"name": source.name, "camera": opened, "live": source.live, "notes": source.notes}
    send({"kind": "opened"} | about)
    if receive(connection) is None:
        return

    def until_gone() -> None:
        receive(connection)
        os._exit(0)

    threading.Thread(target=until_gone, daemon=True).start()
    try:
        for frame in source.frames(threading.Event()):
            if isinstance(frame, RendezviewError):
                send({"kind": "refused", "error": str(frame)})
            else:
                send({"kind": "frame", "time_s": frame.time_s}, frame.content)
        send({"kind": "end", "error": None})
    except RendezviewError as error:
        send({"kind": "end", "error": str(error)})
    except OSError:
        pass  # the service is gone


if __name__ == "__main__":
    main()
