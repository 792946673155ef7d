"""Faults of disks, files and processes under the writer of a log.

Of test_log_faults.py, and by the hundred of experiment service-faults.
"""

from __future__ import annotations

import errno
import json
import mmap
import os
import shutil
import signal
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np

from rendezview.geometry.camera import Camera
from rendezview_service.logs.log_repair import mend
from rendezview_service.logs.recording import RECORDED, LogWriter
from rendezview_service.logs.replay import read_log
from rendezview_service.settings import Settings

_CAMERA = Camera.from_fov(64, 48, 0.7)
_PICTURE = np.random.default_rng(0).integers(0, 256, 64 * 48, np.uint8).tobytes()
_TOLD_S = 2.0  # s, in which a fault of a file must be told
_SECOND = 1_000_000  # first frame of a second writer
_FSYNCS, _WRITES, _HANGS, _ENDS = range(4)  # bytes of the memory that both processes see

# What somebody does to a file takes what was in it; the other faults take nothing.
_TAKES: dict[str, Callable[[Path], object]] = {
    "file removed": lambda path: path.unlink(),
    "folder removed": lambda path: shutil.rmtree(path.parent),
    "file truncated": lambda path: os.truncate(path, 0),
    "file replaced": lambda path: Path(shutil.copy(os.devnull, path.with_name("x"))).replace(path),
    "file moved away": lambda path: path.rename(path.parent.parent / "away"),
}
KINDS = (
    "kill",
    "fsync fails",
    "disk full",
    "disk hangs",
    "stopped",
    "second writer",
    "bit",
    *_TAKES,
)


def _write(path: Path, first: int, told: int, memory: mmap.mmap) -> None:
    """A process that records until it may end, and reports each frame that is acknowledged."""
    fsync, writev = os.fsync, os.writev

    def failing(call: Callable[..., int | None], place: int, error: int) -> Callable[..., object]:
        def called(*about: object) -> object:
            while memory[_HANGS]:
                time.sleep(0.005)
            if memory[place]:
                memory[place] -= 1
                raise OSError(error, os.strerror(error))
            return call(*about)

        return called

    os.fsync = failing(fsync, _FSYNCS, errno.EIO)  # type: ignore[assignment]
    os.writev = failing(writev, _WRITES, errno.ENOSPC)  # type: ignore[assignment]
    writer, k, was_told = LogWriter(path, _CAMERA, {}, None, Settings()), first, False
    while not memory[_ENDS]:
        state = {"frame": k, "time_s": 0.1 * k, "received_unix_s": 1.7e9 + k, "pose": None}
        if writer.write(state, json.dumps(state).encode(), _PICTURE) == RECORDED:
            os.write(told, f"{k} ".encode())
        if writer.status.faults and not was_told:
            was_told = True
            os.write(told, b"told ")
        k += 1
        time.sleep(0.002)
    writer.close()


def _start(path: Path, first: int) -> tuple[int, int, mmap.mmap]:
    memory = mmap.mmap(-1, 4)
    read, told = os.pipe()
    if (pid := os.fork()) == 0:
        try:
            _write(path, first, told, memory)
        finally:
            os._exit(0)
    os.close(told)
    os.set_blocking(read, False)
    return pid, read, memory


def _reported(read: int) -> str:
    try:
        return os.read(read, 1 << 20).decode()
    except BlockingIOError:
        return ""


def _kept(folder: Path) -> Counter[int]:
    """The frames of all files, each on its own, mended as the next service does."""
    found: Counter[int] = Counter()
    for path in sorted(folder.glob("*.mcap")):
        if path.stat().st_size:
            mend(path)
    for path in sorted(folder.glob("*.mcap")):
        repaired = path.with_name(f"{path.stem}.recovered.mcap")  # beside the damaged one
        if path.stat().st_size and not repaired.exists():
            log = read_log(path)
            log.parts[1:] = []
            found.update(frame.state["frame"] for frame in log.frames() if frame.state)
    return found


def fault(kind: str, rng: np.random.Generator, within_s: float) -> tuple[int, int, int, float]:
    """One fault: frames acknowledged, of them lost and doubled, and when it was told, s."""
    with tempfile.TemporaryDirectory() as work:
        folder = Path(work) / "logs"
        folder.mkdir()
        path = folder / "run.mcap"
        pid, read, memory = _start(path, 0)
        report, second, until_s = "", None, time.monotonic() + 20.0
        while len(report) < 40 and time.monotonic() < until_s:
            time.sleep(0.01)
            report += _reported(read)
        time.sleep(float(rng.uniform(0.0, 0.3)))
        began_s = time.monotonic()
        if kind in _TAKES:
            _TAKES[kind](path)
            before, after = report + _reported(read), ""
            while "told" not in after and time.monotonic() < began_s + 2 * within_s:
                time.sleep(0.02)
                after += _reported(read)
            lost_before = {int(word) for word in f"{before} {after}".partition("told")[0].split()}
            report = f"{before} {after}"
        else:
            lost_before = set()
        told_s = time.monotonic() - began_s if kind in _TAKES else 0.0
        if kind == "folder removed":
            folder.mkdir(exist_ok=True)
        memory[_FSYNCS], memory[_WRITES] = 3 * (kind == "fsync fails"), 40 * (kind == "disk full")
        if kind == "disk hangs":
            memory[_HANGS] = 1
            time.sleep(float(rng.uniform(0.1, 0.8)))
            memory[_HANGS] = 0
        elif kind == "stopped":
            os.kill(pid, signal.SIGSTOP)
            time.sleep(0.2)
            os.kill(pid, signal.SIGCONT)
        elif kind == "second writer":
            second = _start(path, _SECOND)
        time.sleep(float(rng.uniform(0.2, 0.6)))
        for each, theirs in ((pid, memory), *([] if second is None else [(second[0], second[2])])):
            if kind in ("kill", "bit") or rng.random() < 0.5:
                os.kill(each, signal.SIGKILL)
            theirs[_ENDS] = 1
            os.waitpid(each, 0)
        for end in (read, *([] if second is None else [second[1]])):
            while more := _reported(end):
                report += more
            os.close(end)
        acknowledged = {int(word) for word in report.split() if word != "told"}
        if kind == "bit":
            content = bytearray(path.read_bytes())
            content[int(rng.integers(len(content)))] ^= 1 << int(rng.integers(8))
            path.write_bytes(content)
        kept = _kept(folder)
        lost = len(acknowledged - set(kept) - lost_before)
        lost = max(0, lost - (kind == "bit"))  # the frame that it hits
        return len(acknowledged), lost, sum(count > 1 for count in kept.values()), told_s


def campaign(count: int, seed: int, within_s: float = _TOLD_S) -> bool:
    """So many faults of all kinds in turns, a line for each kind; whether nothing was lost.

    ``within_s``: in which a fault that takes what was in a file must be told.
    """
    rng = np.random.default_rng(seed)
    sums = {kind: np.zeros(4) for kind in KINDS}
    latest = dict.fromkeys(KINDS, 0.0)
    for k in range(count):
        kind = KINDS[k % len(KINDS)]
        acknowledged, lost, doubled, told_s = fault(kind, rng, within_s)
        sums[kind] += 1, acknowledged, lost, doubled
        latest[kind] = max(latest[kind], told_s)
    for kind, (faults, acknowledged, lost, doubled) in sums.items():
        told = f", told within {latest[kind]:.2f} s" if kind in _TAKES else ""
        print(f"{kind}: {faults:.0f} faults, {acknowledged:.0f} acknowledged, {lost:.0f} lost, "
              f"{doubled:.0f} doubled{told}")  # fmt: skip
    total = np.sum([*sums.values()], axis=0)
    print("all: {:.0f} faults, {:.0f} acknowledged, {:.0f} lost, {:.0f} doubled".format(*total))
    return not total[2:].any() and max(latest.values()) < within_s
