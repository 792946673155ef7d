"""A video that the disk has no room for is an error, not a file that ends early."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

# A limit of the process' files stands for a full disk: writing fails in the same way.
_WRITE = """
import resource, sys
from pathlib import Path
import numpy as np
from rendezview.errors import RendezviewError
from rendezview.io.video_file import VideoWriter

resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]),) * 2)
noise = np.random.default_rng(0)
try:
    with VideoWriter(Path(sys.argv[1]), 10.0) as video:
        for _ in range(8):
            video.add(noise.integers(0, 255, (120, 160, 3), dtype=np.uint8))
except RendezviewError as error:
    print(error)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="limits of files are Linux's")
@pytest.mark.parametrize("suffix", [".webm", ".mp4", ".avi"])
@pytest.mark.parametrize("room", [20_000, 100_000_000])
def test_a_video_without_room_is_an_error(tmp_path: Path, suffix: str, room: int):
    path = tmp_path / f"run{suffix}"
    run = subprocess.run(
        [sys.executable, "-c", _WRITE, str(path), str(room)],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    fits = room > 20_000
    assert ("check the free space" in run.stdout) is not fits
    assert path.exists() is fits
    assert run.stderr == ""
