"""The log of a session as the service sees it: its parts, and how recording goes."""

from __future__ import annotations

import logging
import secrets
from datetime import UTC, datetime
from pathlib import Path

from rendezview_service.logs.log_repair import LogPart
from rendezview_service.messages.messages import Recording, RecordingState

log = logging.getLogger("rendezview_service")


def log_path(place: Path, session: str, *, first: bool) -> Path:
    """The file of a new log, in a folder; a file (*.mcap) that was asked for is the first one's."""
    if place.suffix != ".mcap":
        return place / f"{session}-{datetime.now(UTC):%Y%m%dT%H%M%S}.mcap"
    return place if first else place.with_name(f"{place.stem}-{session}{place.suffix}")


class SessionLog:
    """Files that the workers of one session have written."""

    def __init__(self, session: str) -> None:
        """A log that has no part yet."""
        self.id = secrets.token_hex(8)  # common to its parts
        self.base: Path | None = None  # path of its first part
        self.recording = Recording(state=RecordingState.OFF)
        self._session = session
        self._paths: list[Path] = []
        self._earlier: list[Path] = []  # of them, those of workers before
        self._earlier_lost = 0

    def resume(self, log_id: str, base: Path | None, paths: list[Path]) -> None:
        """Continue a log whose parts another service has written."""
        self.id, self.base, self._paths = log_id, base, list(paths)

    def moved(self) -> int:
        """Another worker continues; the number of states that waited for the disk: all lost."""
        lost = self.recording.pending
        self._earlier, self._earlier_lost = list(self._paths), self.recording.lost + lost
        return lost

    def update(self, paths: list[str], recording: Recording) -> None:
        """The files that a worker has written, and how that goes."""
        changed = recording.state is not self.recording.state
        failed = recording.state is RecordingState.FAILED
        if changed and (self._paths or failed):
            level, reason = logging.ERROR if failed else logging.INFO, recording.reason
            about = {"session": self._session, "state": str(recording.state), "reason": reason}
            log.log(level, "recording", extra=about)
        lost = self._earlier_lost + recording.lost
        self.recording = recording.model_copy(update={"lost": lost})
        self._paths = [*self._earlier, *map(Path, paths)]

    @property
    def parts(self) -> list[LogPart]:
        """Its files in order, the last one up to its last frame."""
        if not self._paths:
            return []
        *before, last = self._paths
        return [*map(LogPart, before), LogPart(last, self.recording.size_bytes or None)]
