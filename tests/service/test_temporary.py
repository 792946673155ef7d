"""Temporary folders go with their process, or with the next one where it was killed."""

from __future__ import annotations

import gc
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from rendezview_service.logs.log_lock import TemporaryFolder

_MAKE = """
import sys
from rendezview_service.logs.log_lock import TemporaryFolder
made = TemporaryFolder("rendezview-models-")
(made.path / "model.rvm").write_bytes(b"1")
print(made.path, flush=True)
sys.stdin.read()
"""


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The system's folder of temporary files, here and in new processes."""
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path


def maker() -> tuple[subprocess.Popen[str], Path]:
    """A process with a folder, and the folder."""
    command = [sys.executable, "-c", _MAKE]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    process = subprocess.Popen(command, text=True, **pipes)
    assert process.stdout is not None
    return process, Path(process.stdout.readline().strip())


def test_a_folder_goes_with_its_process(home: Path) -> None:
    process, folder = maker()
    assert (folder / "model.rvm").exists()
    process.communicate()
    assert list(home.iterdir()) == []


def test_what_a_killed_process_left_goes_with_the_next_and_what_is_held_stays(home: Path) -> None:
    living, held = maker()
    killed, left = maker()
    killed.kill()
    killed.communicate()
    foreign = home / "rendezview-models-of-another-program"
    foreign.mkdir()
    assert left.exists()
    made = TemporaryFolder("rendezview-models-")
    assert set(home.iterdir()) == {held, foreign, made.path}
    other = TemporaryFolder("rendezview-job-")
    other.remove()
    assert not other.path.exists()
    path = made.path
    del made
    gc.collect()
    assert not path.exists()
    living.communicate()
    assert set(home.iterdir()) == {foreign}
