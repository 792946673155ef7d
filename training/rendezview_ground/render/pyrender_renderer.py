"""A renderer through pyrender, as a cross-check. It needs the system's OpenGL (EGL or OSMesa)."""

from __future__ import annotations

import contextlib
import os
import pickle
import subprocess
import sys
import tempfile
import threading
import weakref
from typing import Any

import numpy as np

from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Pose
from rendezview.geometry.zbuffer import NOBODY, Float32s, Int32s
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.render.projection import Mask, Window, project_vertices
from rendezview_ground.render.pyrender_process import Request

_PLATFORMS = ("egl", "osmesa")  # in this order, unless PYOPENGL_PLATFORM names one
_START_S = 60.0  # s; a process that has not answered by then hangs. Source: 1 s on an idle machine
_END_S = 5.0  # s until a process that should end is killed. Source: it ends within 0.1 s
_MARGIN = 0.01  # of the depth, between the target and the clipping planes. Source: any small share
_NEAREST_M = 1e-3  # m; nearest clipping plane. Source: the z-buffer's own, in `drawn_view`


class PyrenderRenderer:
    """Off-screen OpenGL through pyrender; slower than the default, for cross-checks only.

    Every thread that draws at the same time gets a process with its own OpenGL context. They start
    when they are first needed, and end with this object. Pickled, it is the mesh alone.
    """

    def __init__(self, mesh: Mesh) -> None:
        self._mesh = mesh
        self._lock = threading.Lock()
        self._idle: list[_Process] = []
        self._all: list[_Process] = []
        self._platforms: tuple[str, ...] = _PLATFORMS
        if chosen := os.environ.get("PYOPENGL_PLATFORM"):
            self._platforms = (chosen,)
        weakref.finalize(self, _end, self._all)

    def __reduce__(self) -> tuple[Any, ...]:
        return (PyrenderRenderer, (self._mesh,))

    def opengl(self) -> str:
        """Renderer and version of OpenGL here, such as ``llvmpipe …, OpenGL 4.5 … Mesa 22.3.6``.

        Raises:
            RendezviewError: pyrender or OpenGL does not work here; the message says why.
        """
        process = self._taken()
        self._give_back(process)
        return process.opengl

    def draw(self, camera_from_target: Pose, window: Window) -> Mask:
        """(height, width) mask, 255 on the target.

        Raises:
            RendezviewError: a part of the target lies behind the camera's plane, or pyrender does
                not work here.
        """
        project_vertices(self._mesh.vertices_m, camera_from_target, window)  # checks the depths
        depth, _ = self._drawn(camera_from_target, window, faces=False)
        return np.where(depth > 0, 255, 0).astype(np.uint8)

    def draw_surfaces(self, camera_from_target: Pose, window: Window) -> tuple[Float32s, Int32s]:
        """See ``SurfaceRenderer``."""
        depth, owner = self._drawn(camera_from_target, window, faces=True)
        shown = (owner >= 0) & (depth > 0.0)
        nearness = np.zeros(depth.shape, dtype=np.float32)
        nearness[shown] = 1.0 / depth[shown]
        return nearness, np.where(shown, owner, NOBODY).astype(np.int32)

    def _drawn(self, camera_from_target: Pose, window: Window, *, faces: bool) -> Any:
        depths = camera_from_target.apply(self._mesh.vertices_m)[:, 2]
        inverse = camera_from_target.inverse()
        target_from_camera = np.eye(4)
        target_from_camera[:3, :3] = inverse.rotation @ np.diag([1.0, -1.0, -1.0])
        target_from_camera[:3, 3] = inverse.translation_m
        near = max((1.0 - _MARGIN) * float(depths.min()), _NEAREST_M)
        request = Request(
            target_from_camera,
            window.width,
            window.height,
            window.focal_px,
            window.cx,
            window.cy,
            near,
            max((1.0 + _MARGIN) * float(depths.max()), 2.0 * near),
            faces,
        )
        process = self._taken()
        drawn = process.ask(request)  # a process that fails is not given back
        self._give_back(process)
        return drawn

    def _taken(self) -> _Process:
        """An idle process, or a new one."""
        with self._lock:
            if self._idle:
                return self._idle.pop()
            # One start at a time: the first one finds the platform for all.
            failures = []
            for platform in self._platforms:
                process = _Process(platform)
                self._all.append(process)
                try:
                    process.start(self._mesh)
                except RendezviewError as error:
                    failures.append(f"{platform}: {error}")
                    continue
                self._platforms = (platform,)
                return process
        raise RendezviewError(
            f"pyrender does not work here ({'; '.join(dict.fromkeys(failures))}): install "
            "rendezview[training] and OpenGL without a screen (libegl1 and libgl1-mesa-dri, or "
            "libosmesa6), or use --renderer numba"
        )

    def _give_back(self, process: _Process) -> None:
        with self._lock:
            self._idle.append(process)


class _Process:
    """A drawing process and the two ends of its pipes."""

    def __init__(self, platform: str) -> None:
        self.opengl = ""
        self._messages = tempfile.TemporaryFile()  # noqa: SIM115  # closed in `end`
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "rendezview_ground.render.pyrender_process"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._messages,
            env=os.environ | {"PYOPENGL_PLATFORM": platform},
        )

    def start(self, mesh: Mesh) -> None:
        """Send the mesh and wait until the process can draw.

        Raises:
            RendezviewError: it cannot.
        """
        timer = threading.Timer(_START_S, self._process.kill)
        timer.start()
        try:
            self.opengl = self.ask((mesh.vertices_m, mesh.faces))
        finally:
            timer.cancel()

    def ask(self, request: Any) -> Any:
        """Send a request and return the answer.

        Raises:
            RendezviewError: the process died or reports an error; it has ended then.
        """
        requests, answers = self._process.stdin, self._process.stdout
        assert requests is not None
        assert answers is not None
        try:
            pickle.dump(request, requests, protocol=pickle.HIGHEST_PROTOCOL)
            requests.flush()
            kind, value = pickle.load(answers)
        except (OSError, EOFError, pickle.UnpicklingError):
            kind, value = "error", self._last_words()
        if kind == "error":
            self.end()
            raise RendezviewError(str(value).strip().splitlines()[0])
        return value

    def end(self) -> None:
        """End the process. Safe to call twice."""
        with contextlib.suppress(OSError):
            if self._process.stdin is not None:
                self._process.stdin.close()
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        if self._process.stdout is not None:
            self._process.stdout.close()
        self._messages.close()

    def _last_words(self) -> str:
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(_END_S)
        self._messages.seek(0)
        lines = self._messages.read().decode(errors="replace").strip().splitlines()
        return f"the drawing process ended with {self._process.poll()}" + (
            f", {lines[-1]}" if lines else ""
        )


def _end(processes: list[_Process]) -> None:
    for process in processes:
        process.end()
