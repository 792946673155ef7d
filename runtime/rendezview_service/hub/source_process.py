"""Sources in a process of their own, so that a decoder that crashes or hangs takes nothing with it.

``python -m rendezview_service.hub.source_process DESCRIPTOR SOURCE CAMERA`` reads one; the service
starts it by `SourceProcess`.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import resource
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview_service.hub.inputs import SOURCE
from rendezview_service.hub.sessions import Session
from rendezview_service.hub.sources import RECONNECT_S, SourceFrame, open_source
from rendezview_service.messages.wire import Header, pack, receive

_OPEN_S = 120.0  # s, to open a source; a bag may have to be indexed. Source: a chosen limit
_SILENT_S = 60.0  # s, for the next frame of a file. Source: a chosen limit
# s, between frames of a file; longer gaps are shortened. Source: a chosen limit.
_LONGEST_PAUSE_S = 10.0
_END_S = 2.0  # s, for the end of the process. Source: a chosen limit
_MOST_BYTES = 8_000_000_000  # of addresses of the process. Source: a chosen limit


class SourceProcess:
    """A source as `open_source`, decoded in a process of its own.

    If that ends, it is started again for a live source. A thread gives the frames to a session.
    """

    def __init__(self, text: str, camera: Camera | None) -> None:
        """Start it.

        Raises:
            RendezviewError: as `open_source`.
        """
        self._text, self._given = text, camera
        self._stop = threading.Event()
        self._ended = False  # the process said so
        opened = self._start()
        known = opened["camera"]
        self.name: str = opened["name"]
        self.camera = None if known is None else Camera(**known)
        self.live: bool = opened["live"]
        self.notes: list[str] = opened["notes"]

    def _start(self) -> Header:
        ours, theirs = socket.socketpair()
        camera = json.dumps(None if self._given is None else asdict(self._given))
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
        return opened[0]

    def _receive(self, timeout_s: float | None) -> tuple[Header, bytes] | None:
        """The next message; None: the process has ended, or is ended, because it is silent."""
        try:
            self._connection.settimeout(timeout_s)
            return receive(self._connection)
        except TimeoutError:
            self._process.kill()
        except OSError:
            pass  # closed by another thread, or not started again
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
        """End it for good."""
        self._stop.set()
        self._stop_process()

    def _stop_process(self) -> None:
        with contextlib.suppress(OSError):
            self._connection.shutdown(socket.SHUT_RDWR)
        self._connection.close()
        self._process.kill()
        with contextlib.suppress(subprocess.TimeoutExpired):  # a driver may keep it for ever
            self._process.wait(_END_S)

    def frames(self) -> Iterator[SourceFrame | RendezviewError]:
        """Frames and faults, until it is closed.

        Raises:
            RendezviewError: the source cannot go on.
        """
        while not self._stop.is_set():
            yield from self._once(None if self.live else _SILENT_S)
            if self._stop.is_set() or self._ended:
                return
            why = f"{self.name}: {self._end()}"
            if not self.live:
                raise RendezviewError(why)
            yield RendezviewError(f"{why}; starting again")
            if self._stop.wait(RECONNECT_S):
                return
            self._stop_process()
            with contextlib.suppress(RendezviewError):
                self._start()
        self._stop_process()  # of a start beside `close`, too

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

    def feed(self, session: Session, speed: float) -> None:
        """Give the frames to a session, from now on.

        Args:
            speed: of files, as a multiple of their own rate; 0: without pauses.
        """
        about = session, speed, asyncio.get_running_loop().call_soon_threadsafe
        threading.Thread(target=self._feed, args=about, name="source", daemon=True).start()

    def _feed(self, session: Session, speed: float, call: Callable[..., object]) -> None:
        reason: str | None = None
        try:
            last_s: float | None = None
            due_s = time.monotonic()
            for frame in self.frames():
                if self._stop.is_set():
                    break
                if isinstance(frame, RendezviewError):
                    call(session.note_fault, str(frame))
                    continue
                if not self.live and speed > 0.0:
                    if last_s is not None and frame.time_s is not None:
                        pause_s = (frame.time_s - last_s) / speed
                        due_s += min(max(pause_s, 0.0), _LONGEST_PAUSE_S)
                    last_s = frame.time_s
                    if self._stop.wait(max(0.0, due_s - time.monotonic())):
                        break
                self._give(session, frame, call)
        except RendezviewError as error:
            reason = str(error)
        except RuntimeError:
            return  # the loop is closed: the service has ended
        if not self._stop.is_set():
            call(session.source_ended, reason)

    def _give(self, session: Session, frame: SourceFrame, call: Callable[..., object]) -> None:
        done = threading.Event()
        taken = session.input([frame.content], frame.time_s, lambda _: done.set(), sender=SOURCE)
        call(session.replace, taken)
        while not (self.live or self._stop.is_set() or done.is_set()):
            done.wait(0.5)


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
    camera = None if given is None else Camera(**given)

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
        for frame in source.frames:
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
