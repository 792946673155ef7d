"""A process that draws one mesh with pyrender: ``python -m`` and the name of this module.

OpenGL keeps one current context per thread and its libraries keep more state per process, so every
drawing thread of `PyrenderRenderer` has a process of this kind to itself. Requests come on the
standard input and answers leave on the standard output, both pickled. Nothing of rendezview but
this file is needed here.
"""

from __future__ import annotations

import ctypes
import os
import pickle
import signal
import sys
from dataclasses import dataclass
from typing import Any, BinaryIO

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


@dataclass(frozen=True, slots=True)
class Request:
    """One view to draw."""

    target_from_camera: npt.NDArray[np.float64]  # (4, 4), OpenGL's camera: y up, z backwards
    width: int
    height: int
    focal_px: float
    cx: float  # px from the centre of the top-left pixel
    cy: float
    near_m: float
    far_m: float
    faces: bool  # whether the face of each pixel is wanted, too


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
        self, request: Request
    ) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int32] | None]:
        """(height, width) depth in metres, 0 in the sky, and the number of the face, −1."""
        pyrender = self._pyrender
        camera = pyrender.IntrinsicsCamera(
            request.focal_px,
            request.focal_px,
            request.cx + 0.5,  # OpenGL counts from the pixel's corner
            request.cy + 0.5,
            znear=request.near_m,
            zfar=request.far_m,
        )
        node = self._scene.add(camera, pose=request.target_from_camera)
        try:
            self._renderer.viewport_width = request.width
            self._renderer.viewport_height = request.height
            flags = pyrender.RenderFlags.SKIP_CULL_FACES
            if not request.faces:
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


def _serve(requests: BinaryIO, answers: BinaryIO) -> None:
    """Answer until the requests end: first the mesh, then views."""

    def answer(kind: str, value: Any) -> None:
        pickle.dump((kind, value), answers, protocol=pickle.HIGHEST_PROTOCOL)
        answers.flush()

    try:
        drawer = _Drawer(*pickle.load(requests))
        from OpenGL.GL import GL_RENDERER, GL_VERSION, glGetString

        names = [glGetString(name).decode() for name in (GL_RENDERER, GL_VERSION)]
    except Exception as error:
        answer("error", f"{type(error).__name__}: {error}")
        return
    answer("ready", ", OpenGL ".join(names))
    while True:
        try:
            request = pickle.load(requests)
        except EOFError:
            return
        try:
            drawn = drawer.draw(request)
        except Exception as error:
            answer("error", f"{type(error).__name__}: {error}")
        else:
            answer("drawn", drawn)


def main() -> None:
    """Serve one parent, whose end of the pipe ends this process, not its Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # what libraries print is no answer
    _serve(sys.stdin.buffer, answers)


if __name__ == "__main__":
    main()
