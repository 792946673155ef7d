"""Draws one mesh with pyrender, in a process of its own.

OpenGL keeps one current context per thread and its libraries keep more state per process, so every
drawing thread of `PyrenderRenderer` has a process to itself. Nothing of rendezview but this file is
needed there.
"""

from __future__ import annotations

import ctypes
import os
import signal
import threading
import time
from typing import Any

import numpy as np
import numpy.typing as npt

# Flags of OSMesaCreateContextAttribs. Source: GL/osmesa.h of Mesa
_OSMESA = {
    "OSMESA_DEPTH_BITS": 0x30,
    "OSMESA_PROFILE": 0x33,
    "OSMESA_CORE_PROFILE": 0x34,
    "OSMESA_CONTEXT_MAJOR_VERSION": 0x36,
    "OSMESA_CONTEXT_MINOR_VERSION": 0x37,
}


class _Drawer:
    """The scene and its off-screen renderer."""

    def __init__(self, vertices_m: Any, faces: Any) -> None:
        self._pyrender = pyrender = _import_pyrender()
        corners = np.asarray(vertices_m, dtype=np.float32)[faces].reshape(-1, 3)
        number = np.repeat(np.arange(1, len(faces) + 1), 3)  # 0: sky
        colour = np.ones((len(corners), 4), dtype=np.float32)
        for k in range(3):
            colour[:, k] = ((number >> (8 * k)) & 255) / 255.0
        material = pyrender.MetallicRoughnessMaterial(
            baseColorFactor=[1.0, 1.0, 1.0, 1.0], alphaMode="OPAQUE", doubleSided=True
        )
        mesh = pyrender.Mesh(
            [pyrender.Primitive(corners, color_0=colour, material=material, mode=4)]
        )
        self._scene = pyrender.Scene(bg_color=[0.0, 0.0, 0.0, 0.0])
        self._scene.add(mesh)
        self._renderer = pyrender.OffscreenRenderer(64, 64)

    def draw(
        self,
        target_from_camera: npt.NDArray[np.float64],
        size: tuple[int, int],
        focal_px: float,
        middle_px: tuple[float, float],
        depths_m: tuple[float, float],
        faces: bool,
    ) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int32] | None]:
        """See `draw`."""
        pyrender = self._pyrender
        camera = pyrender.IntrinsicsCamera(
            focal_px,
            focal_px,
            middle_px[0] + 0.5,  # OpenGL counts from the pixel's corner
            middle_px[1] + 0.5,
            znear=depths_m[0],
            zfar=depths_m[1],
        )
        node = self._scene.add(camera, pose=target_from_camera)
        try:
            self._renderer.viewport_width, self._renderer.viewport_height = size
            flags = pyrender.RenderFlags.SKIP_CULL_FACES
            if not faces:
                depth = self._renderer.render(
                    self._scene, flags=flags | pyrender.RenderFlags.DEPTH_ONLY
                )
                return depth, None
            colour, depth = self._renderer.render(
                self._scene, flags=flags | pyrender.RenderFlags.FLAT
            )
        finally:
            self._scene.remove_node(node)
        bytes_of = colour.astype(np.int32)
        number = bytes_of[..., 0] | bytes_of[..., 1] << 8 | bytes_of[..., 2] << 16
        return depth, number - 1


def _import_pyrender() -> Any:
    """pyrender 0.1.45, made to work with today's packages and to take one sample a pixel."""
    if not hasattr(np, "infty"):
        setattr(np, "infty", np.inf)  # noqa: B010  # it is older than numpy 2
    if os.environ["PYOPENGL_PLATFORM"] == "osmesa":
        _complete_osmesa()
    import pyrender
    import pyrender.renderer

    storage = pyrender.renderer.glRenderbufferStorageMultisample

    def one_sample(target: int, samples: int, *rest: int) -> None:
        storage(target, 0, *rest)  # in the pixel's centre; a mean of face numbers is none

    pyrender.renderer.glRenderbufferStorageMultisample = one_sample
    return pyrender


def _complete_osmesa() -> None:
    """Give PyOpenGL 3.1.0, which pyrender asks for, what it lacks of OSMesa."""
    import OpenGL.osmesa
    import OpenGL.platform
    from pyrender.platforms import osmesa

    if not hasattr(OpenGL.osmesa, "OSMesaCreateContextAttribs"):
        library = OpenGL.platform.PLATFORM.OSMesa
        create = library.OSMesaCreateContextAttribs
        create.argtypes = [ctypes.POINTER(ctypes.c_int), OpenGL.osmesa.OSMesaContext]
        create.restype = OpenGL.osmesa.OSMesaContext
        OpenGL.osmesa.OSMesaCreateContextAttribs = lambda attributes, shared: create(
            np.ascontiguousarray(attributes, np.int32).ctypes.data_as(ctypes.POINTER(ctypes.c_int)),
            shared,
        )
        for name, value in _OSMESA.items():
            setattr(OpenGL.osmesa, name, value)
    # PyOpenGL looks up by context, and OSMesa's are not hashable: this process has a single one.
    for part in (OpenGL.platform, OpenGL.platform.PLATFORM):
        part.GetCurrentContext = lambda: 1
    # OSMesa has framebuffer objects: without them a view of another size needs a new context.
    osmesa.OSMesaPlatform.supports_framebuffers = lambda _: True


_drawers: list[_Drawer] = []  # of this process, one


def start(vertices_m: Any, faces: Any) -> str:
    """Prepare this process for a mesh; the renderer and the version of OpenGL."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent, which ends this
    threading.Thread(target=_end_with, args=(os.getppid(),), daemon=True).start()
    nowhere = os.open(os.devnull, os.O_WRONLY)  # for what libraries print
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    _drawers.append(_Drawer(vertices_m, faces))
    from OpenGL.GL import GL_RENDERER, GL_VERSION, glGetString

    return ", OpenGL ".join(glGetString(name).decode() for name in (GL_RENDERER, GL_VERSION))


def _end_with(parent: int) -> None:
    """End this process within a second after its parent, even if that is killed."""
    while os.getppid() == parent:
        time.sleep(1.0)
    os._exit(1)


def draw(*view: Any) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int32] | None]:
    """(height, width) depth in metres, 0 in the sky, and the number of the face, −1.

    Args:
        view: target_from_camera (4, 4) of OpenGL's camera (y up, z backwards); width and height;
            focal length, px; middle, px from the centre of the top-left pixel; depths of the
            clipping planes, m; and whether faces are wanted, too.
    """
    return _drawers[0].draw(*view)
