"""Builds ``visp.cpp`` and has ViSP's model-based tracker track frames.

ViSP is C++; Debian and Ubuntu have it: ``apt install g++ pkg-config libvisp-mbt-dev``.
"""

from __future__ import annotations

import shutil
import struct
import subprocess
import tempfile
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from experiments.peers.pipe import Array, Pipe
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose

Frame = npt.NDArray[np.uint8]
DRIVER = Path(__file__).with_suffix(".cpp")
PACKAGES = "g++ pkg-config libvisp-mbt-dev"
_LIBRARIES = ["-lvisp_mbt", "-lvisp_me", "-lvisp_klt", "-lvisp_core"]
# Edges are found a quarter of a pixel left and up of where they are; its camera is shifted alike.
_SHIFT_PX = -0.25
_HEADERS = "#include <visp3/mbt/vpMbGenericTracker.h>\n"


@dataclass(frozen=True, slots=True, eq=False)
class Tracked:
    """What ViSP said of a frame."""

    pose: Pose | None  # None where it threw
    thrown: str  # what, else nothing
    processor_s: float  # of track(), the median of the repeats
    wall_s: float
    points: int  # edge points in use


@cache
def missing() -> str | None:
    """Why ViSP cannot be driven here; ``None`` where it can."""
    cxx = _compiler()
    if cxx is None:
        return f"no C++ compiler here (apt: {PACKAGES})"
    try:
        words = [cxx, "-std=c++17", "-fsyntax-only", "-x", "c++", *_include(), "-"]
        done = subprocess.run(words, input=_HEADERS, capture_output=True, text=True, check=False)
    except OSError as error:
        return f"{cxx}: {error.strerror}"
    if done.returncode != 0:
        return f"no development files of it on this system (apt: {PACKAGES})"
    return None


def build(folder: Path) -> Path:
    """Compile the driver into a folder, optimised."""
    cxx = _compiler()
    assert cxx is not None, "no C++ compiler"
    program = folder / "visp_driver"
    words = [cxx, "-std=c++17", "-O3", "-Wall", "-Wextra", "-Werror", *_include(), str(DRIVER)]
    done = subprocess.run(
        [*words, *_LIBRARIES, "-o", str(program)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return program


class Visp(Pipe):
    """A running driver with one model (``cao``: the text) and camera; ends with the block.

    One thread: OpenMP's and OpenCV's others are kept from starting.
    """

    def __init__(
        self, program: Path, cao: str, camera: Camera, settings: dict[str, float] | None = None
    ) -> None:
        assert not np.any(camera.distortion), "the driver's camera has no distortion"
        self._folder = tempfile.TemporaryDirectory()
        path = Path(self._folder.name) / "model.cao"
        path.write_text(cao)
        centre = (camera.cx + _SHIFT_PX, camera.cy + _SHIFT_PX)
        numbers = (camera.width, camera.height, camera.fx, camera.fy, *centre)
        named = [f"{name}={value:.9g}" for name, value in (settings or {}).items()]
        one_thread = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "LC_ALL": "C"}
        command = [str(program), str(path), *(f"{n:.17g}" for n in numbers), *named]
        super().__init__(command, one_thread)

    def __exit__(self, *error: Any) -> None:
        super().__exit__(*error)
        self._folder.cleanup()

    def frame(self, image: Frame, prior: Pose, passes: int = 1, repeats: int = 1) -> Tracked:
        """Track one frame from a pose; each of ``passes`` goes on where the last ended."""
        return self._ask(b"F", struct.pack("2I", passes, repeats), _numbers(prior), image.tobytes())

    def start(self, image: Frame, pose: Pose) -> Tracked:
        """Begin a sequence at a frame of known pose."""
        return self._ask(b"S", _numbers(pose), image.tobytes())

    def next(self, image: Frame) -> Tracked:
        """Track the next frame of the sequence, from ViSP's own last pose."""
        return self._ask(b"N", image.tobytes())

    def edges_px(self, pose: Pose) -> Array:
        """(N, 4) both ends u, v, u, v of the edges that ViSP would see."""
        self.send(b"V", _numbers(pose))
        (count,) = self.take("I", 1)
        return self.take("d", 4 * int(count)).reshape(-1, 4)

    def _ask(self, *parts: bytes) -> Tracked:
        self.send(*parts)
        (status,) = self.take("i", 1)
        numbers = self.take("d", 14)
        points, letters = self.take("I", 2).astype(int)
        thrown = self.take("B", int(letters)).tobytes().decode(errors="replace").strip()
        pose = Pose(numbers[:9].reshape(3, 3), numbers[9:12].copy()) if status == 0 else None
        return Tracked(pose, thrown, float(numbers[12]), float(numbers[13]), int(points))


def _compiler() -> str | None:
    return shutil.which("c++") or shutil.which("g++") or shutil.which("clang++")


def _include() -> list[str]:
    """ViSP's headers include OpenCV's; warnings of either are not ours."""
    config = shutil.which("pkg-config")
    if config is None:
        return []
    done = subprocess.run(
        [config, "--cflags-only-I", "opencv4"], capture_output=True, text=True, check=False
    )
    return [word for flag in done.stdout.split() for word in ("-isystem", flag[2:])]


def _numbers(pose: Pose) -> bytes:
    return np.concatenate([pose.rotation.ravel(), pose.translation_m]).astype(np.float64).tobytes()
