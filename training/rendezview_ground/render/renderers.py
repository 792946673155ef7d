"""Silhouette renderers by name. All three set the pixels whose centre a triangle covers."""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum

from rendezview.errors import RendezviewError
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.render.projection import SilhouetteRenderer
from rendezview_ground.render.pyrender_renderer import PyrenderRenderer
from rendezview_ground.render.rasterizer import NumbaRenderer, NumpyRenderer


class Renderer(StrEnum):
    """The renderer of the training views."""

    NUMBA = "numba"
    NUMPY = "numpy"
    PYRENDER = "pyrender"


_CLASSES: dict[Renderer, Callable[[Mesh], SilhouetteRenderer]] = {
    Renderer.NUMBA: NumbaRenderer,
    Renderer.NUMPY: NumpyRenderer,
    Renderer.PYRENDER: PyrenderRenderer,  # its processes need OpenGL, this one does not
}


def make_renderer(kind: Renderer, mesh: Mesh) -> SilhouetteRenderer:
    """Make a renderer of the mesh."""
    return _CLASSES[kind](mesh)


def working_renderer(kind: Renderer, mesh: Mesh, tell: Callable[[str], None]) -> Renderer:
    """``kind``, or the default where ``kind`` does not work; ``tell`` gets one line about it."""
    if kind is Renderer.PYRENDER:
        renderer = PyrenderRenderer(mesh)
        try:
            tell(f"pyrender draws with {renderer.opengl()}")
        except RendezviewError as error:
            tell(f"{error}. The views are drawn with --renderer numba instead")
            return Renderer.NUMBA
    return kind
