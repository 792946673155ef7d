"""The folder of the logs: names of parts, unfinished logs repaired, old logs removed.

``python -m rendezview_service.logs.log_folder FOLDER`` repairs the service's own unfinished logs;
the service starts it once it listens. Logs that are being written are locked, and so is the folder
while it is looked through: several services can share one.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from rendezview.errors import RendezviewError
from rendezview_service.logs.log_file import is_finished, is_own, own_notes
from rendezview_service.logs.log_index import last_ns
from rendezview_service.logs.log_lock import folder_lock
from rendezview_service.logs.log_repair import RECOVERED, locked, mend

log = logging.getLogger("rendezview_service")

_SUFFIX = ".mcap"
_UNFINISHED = re.compile(r"\..+\.[0-9a-f]{8,12}\.tmp")  # a file that is being written
_UNFINISHED_S = 3600.0  # s, since its last write: then who wrote it has ended. Source: chosen
_REMOVE_EVERY_S = 60.0  # s, between looks for old logs. Source: chosen


def part_path(base: Path, number: int) -> Path:
    """The file of a part, counted from 1, of the log whose first part is ``base``."""
    return base if number == 1 else base.with_name(f"{base.stem}-{number}{base.suffix}")


def free_number(base: Path, least: int = 1) -> int:
    """The number of a new part: after all that are there, and at least ``least``."""
    names = re.compile(
        rf"{re.escape(base.stem)}(?:-(\d+))?(?:{RECOVERED})?{re.escape(base.suffix)}"
    )
    taken = [
        int(match[1] or 1)
        for entry in base.parent.glob(f"*{base.suffix}")
        if (match := names.fullmatch(entry.name))
    ]
    return max([least, *(number + 1 for number in taken)])


Parts = dict[str, dict[int, Path]]  # files by log, and by the number of the part


def parts_in(folder: Path) -> Parts:
    """The service's own files in a folder; of several that are one part, the first by name."""
    found: Parts = {}
    for path in sorted(folder.glob(f"*{_SUFFIX}")):
        with contextlib.suppress(RendezviewError, OSError, ValueError, KeyError):
            notes = own_notes(path)
            found.setdefault(notes["log"], {}).setdefault(int(notes.get("part", 1)), path)
    return found


def parts_from(path: Path, notes: dict[str, str], known: Parts | None = None) -> list[Path]:
    """A log, of these notes, and its later parts in the folder; a later part stands alone.

    Args:
        known: the files of its folder; None: they are looked for.
    """
    log, number = notes.get("log", ""), int(notes.get("part", 1))
    others = (parts_in(path.parent) if known is None else known).get(log, {})
    if any(other < number for other in others):
        return [path]
    return [path, *(others[other] for other in sorted(others) if other != number)]


def mend_folder(folder: Path) -> Iterator[dict[str, object]]:
    """Repair the service's own unfinished logs that nobody writes; what was done, log by log.

    Copies that a repair left when it was killed are removed.
    """
    for path in folder.iterdir():
        with contextlib.suppress(OSError):
            old = time.time() - path.stat().st_mtime > _UNFINISHED_S
            if old and _UNFINISHED.fullmatch(path.name):
                path.unlink()
    for path in sorted(folder.glob(f"*{_SUFFIX}")):
        try:
            if is_finished(path) or not is_own(path):
                continue
            mended = mend(path)
        except (RendezviewError, OSError) as error:
            yield {"log": path.name, "reason": str(error)}
            continue
        if mended is not None:
            yield {
                "log": path.name,
                "into": mended.path.name,
                "cut_bytes": mended.cut_bytes,
                "damaged_bytes": mended.damaged_bytes,
            }


def last_unix_s(path: Path) -> float:
    """The time of a log's last frame by its own clock; without one, of its last write.

    Raises:
        OSError: it cannot be read.
    """
    with open(path, "rb") as file:
        last = last_ns(file) if is_finished(path) else None
        return os.fstat(file.fileno()).st_mtime if last is None else 1e-9 * last


def _own_logs(folder: Path) -> list[tuple[float, int, Path]]:
    """Last time, size and path of the service's own logs, the oldest first."""
    found = []
    for path in folder.glob(f"*{_SUFFIX}"):
        with contextlib.suppress(OSError):
            if is_own(path):
                found.append((last_unix_s(path), path.stat().st_size, path))
    return sorted(found)


def remove_old(folder: Path, most_bytes: int, most_s: float, now_s: float) -> list[Path]:
    """Remove the service's oldest logs, until what is left is small and recent enough.

    Logs that are being written, and files of other programs, stay.

    Args:
        most_bytes: of all own logs together; 0: any size.
        most_s: since the last frame; 0: any age.
        now_s: since 1970.
    """
    with folder_lock(folder) as ours:
        if not ours:
            return []
        logs = _own_logs(folder)
        total = sum(size for _, size, _ in logs)
        removed = []
        for written_s, size, path in logs:
            too_much = most_bytes > 0 and total > most_bytes
            too_old = most_s > 0.0 and now_s - written_s > most_s
            if not too_much and not too_old:
                continue
            with contextlib.suppress(OSError, RendezviewError), locked(path):
                path.unlink()
                removed.append(path)
                total -= size
        return removed


async def keep_logs(folder: Path, most_bytes: int, most_s: float) -> None:
    """Repair logs that an earlier run left cut off, in another process; then remove old ones."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "rendezview_service.logs.log_folder", str(folder)),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
    )
    try:
        assert process.stdout is not None
        async for line in process.stdout:
            done = json.loads(line)
            log.warning("log not mended" if "reason" in done else "log mended", extra=done)
        await process.wait()
    finally:
        if process.returncode is None:
            process.kill()
    # Later steps of the system's clock do not count, and neither does a wrong one at the start: it
    # is not trusted to be ahead of the newest log.
    last_s = [at_s for at_s, *_ in await asyncio.to_thread(_own_logs, folder)]
    offset_s = min([time.time(), *last_s[-1:]]) - time.monotonic()
    while most_bytes or most_s:
        try:
            now_s = offset_s + time.monotonic()
            for path in await asyncio.to_thread(remove_old, folder, most_bytes, most_s, now_s):
                log.warning("log removed", extra={"log": path.name})
        except OSError as error:
            log.error("old logs cannot be removed", extra={"reason": str(error)})
        await asyncio.sleep(_REMOVE_EVERY_S)


def main() -> None:
    """Repair a folder's logs and print what was done, one JSON object a line."""
    os.nice(10)  # tracking has priority
    folder = Path(sys.argv[1])
    try:
        with folder_lock(folder) as ours:
            for done in mend_folder(folder) if ours else ():
                print(json.dumps(done), flush=True)
    except OSError as error:
        print(json.dumps({"log": folder.name, "reason": str(error)}))


if __name__ == "__main__":
    main()
