"""A renderer through pyrender, as a cross-check. It needs the system's OpenGL (EGL or OSMesa)."""

from __future__ import annotations

import os
import threading
import weakref
from collections.abc import Callable
from typing import Any

import numpy as np
from joblib.externals.loky import ProcessPoolExecutor
from joblib.externals.loky.process_executor import BrokenProcessPool

from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Pose
from rendezview.geometry.zbuffer import NOBODY, Float32s, Int32s
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.render.projection import Mask, Window, project_vertices
from rendezview_ground.render.pyrender_process import draw, start

_PLATFORMS = ("egl", "osmesa")  # in this order, unless PYOPENGL_PLATFORM names one
_START_S = 60.0  # s; a process that has not answered by then hangs. Source: 1 s on an idle machine
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
        self._opengl = ""
        self._idle: list[ProcessPoolExecutor] = []  # of one process each
        self._all: list[ProcessPoolExecutor] = []
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
        self._idle.append(self._taken())
        return self._opengl

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
        far = max((1.0 + _MARGIN) * float(depths.max()), 2.0 * near)
        process = self._taken()
        drawn = _answer(
            process, None, draw, target_from_camera, (window.width, window.height),
            window.focal_px, (window.cx, window.cy), (near, far), faces,
        )  # fmt: skip
        self._idle.append(process)  # a process that fails is not given back
        return drawn

    def _taken(self) -> ProcessPoolExecutor:
        """An idle process, or a new one."""
        with self._lock:
            if self._idle:
                return self._idle.pop()
            # One start at a time: the first one finds the platform for all.
            failures = []
            for platform in self._platforms:
                process = ProcessPoolExecutor(1, env={"PYOPENGL_PLATFORM": platform})
                self._all.append(process)
                mesh = self._mesh.vertices_m, self._mesh.faces
                try:
                    self._opengl = _answer(process, _START_S, start, *mesh)
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


def _answer(
    process: ProcessPoolExecutor, most_s: float | None, task: Callable[..., Any], *arguments: Any
) -> Any:
    """What a task returns in the process, within some seconds.

    Raises:
        RendezviewError: the process died or reports an error; it has ended then.
    """
    try:
        return process.submit(task, *arguments).result(most_s)
    except Exception as error:
        _end([process])
        words = str(error).strip().splitlines() or [""]
        if isinstance(error, BrokenProcessPool):
            why = next((line for line in words if "exit code" in line), words[0])
            raise RendezviewError(f"the drawing process ended: {why}") from None
        raise RendezviewError(f"{type(error).__name__}: {words[0]}") from None


def _end(processes: list[ProcessPoolExecutor]) -> None:
    for process in processes:
        process.shutdown(kill_workers=True)
