"""Two runs with one output: the second is refused and told who writes; a killed one blocks none."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.io import file_lock
from rendezview.io.file_lock import FolderLock
from rendezview.io.results import JsonLinesWriter
from rendezview.io.video_file import VideoWriter
from rendezview_ground.learn.jobs.stages import Shards
from rendezview_ground.simulate.bop_writer import BopSceneWriter

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="the holder's name is Linux's")

CAMERA = Camera.from_fov(64, 48, 1.0)
PICTURE = np.zeros((48, 64, 3), np.uint8)

# By what they write: a program that holds the lock until it is killed.
_WAIT = "\nprint('held', flush=True)\nimport time\ntime.sleep(600)"
_HOLD = {
    "log": """
from rendezview.io.results import JsonLinesWriter
writer = JsonLinesWriter(path)
writer.write({"a": 1})
""",
    "film.webm": """
import numpy as np
from rendezview.io.video_file import VideoWriter
video = VideoWriter(path, 10.0)
video.add(np.zeros((48, 64, 3), np.uint8))
""",
    "scene": """
import numpy as np
from rendezview.geometry.camera import Camera
from rendezview_ground.simulate.bop_writer import BopSceneWriter
scene = BopSceneWriter(path, Camera.from_fov(64, 48, 1.0))
""",
    "shards": """
from rendezview_ground.learn.jobs.stages import Shards
shards = Shards(path, {"other": "inputs"})
""",
}


def _log(path: Path) -> None:
    with JsonLinesWriter(path) as writer:
        writer.write({"b": 2})


def _film(path: Path) -> None:
    with VideoWriter(path, 10.0) as video:
        video.add(PICTURE)


def _scene(path: Path) -> None:
    with BopSceneWriter(path, CAMERA, overwrite=True) as scene:
        scene.add(0, PICTURE[..., 0], None, None)


def _shards(path: Path) -> None:
    with Shards(path, {"these": "inputs"}) as shards:
        shards.remove()


_WRITE: dict[str, Callable[[Path], None]] = {
    "log": _log, "film.webm": _film, "scene": _scene, "shards": _shards,
}  # fmt: skip


@contextmanager
def another_run(what: str, path: Path) -> Iterator[subprocess.Popen[str]]:
    program = f"from pathlib import Path\nimport sys\npath = Path(sys.argv[1])\n{_HOLD[what]}"
    command = [sys.executable, "-c", program + _WAIT, str(path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as run:
        try:
            assert run.stdout is not None
            assert run.stdout.readline() == "held\n"
            yield run
        finally:
            run.kill()


def files_of(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


@pytest.mark.parametrize("what", list(_HOLD))
def test_a_second_run_is_refused_by_name_and_one_that_was_killed_blocks_nobody(tmp_path, what):
    path = tmp_path / what
    with another_run(what, path) as run:
        before = files_of(tmp_path)
        with pytest.raises(RendezviewError) as refused:
            _WRITE[what](path)
        assert f"{path}: another run is writing it (process {run.pid}: -c " in str(refused.value)
        assert str(refused.value).endswith("): wait for it, or give another name")
        assert files_of(tmp_path) == before
        run.kill()
        run.wait()
    _WRITE[what](path)
    _WRITE[what](path)  # nor does one that has ended
    assert not [name for name in files_of(tmp_path) if "partial" in name]


def test_a_folder_is_for_one_until_it_is_released(tmp_path):
    lock = FolderLock(tmp_path / "new")
    with pytest.raises(RendezviewError, match=f"is writing it .process {os.getpid()}: "):
        FolderLock(tmp_path / "new")
    lock.release()
    lock.release()
    with FolderLock(tmp_path / "new"):
        assert files_of(tmp_path) == ["new"]


def test_a_folder_that_its_run_removes_as_the_next_one_opens_it_is_made_again(
    tmp_path, monkeypatch
):
    locked = file_lock.lock

    def late(descriptor: int) -> bool:
        monkeypatch.setattr(file_lock, "lock", locked)
        (tmp_path / "new").rmdir()
        return locked(descriptor)

    monkeypatch.setattr(file_lock, "lock", late)
    with FolderLock(tmp_path / "new"), pytest.raises(RendezviewError, match="is writing it"):
        FolderLock(tmp_path / "new")


def test_where_the_system_names_no_holder_it_is_another_run(tmp_path, monkeypatch):
    monkeypatch.setattr(file_lock, "_LOCKS", tmp_path / "absent")
    with FolderLock(tmp_path), pytest.raises(RendezviewError, match="writing it: wait"):
        FolderLock(tmp_path)
