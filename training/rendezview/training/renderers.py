"""Silhouette renderers by name. All three set the pixels whose centre a triangle covers."""

from __future__ import annotations

from enum import StrEnum

from rendezview.training.mesh import Mesh
from rendezview.training.projection import SilhouetteRenderer
from rendezview.training.rasterizer import NumbaRenderer, NumpyRenderer


class Renderer(StrEnum):
    """The renderer of the training views."""

    NUMBA = "numba"
    NUMPY = "numpy"
    PYRENDER = "pyrender"


def make_renderer(kind: Renderer, mesh: Mesh) -> SilhouetteRenderer:
    """Make a renderer of the mesh.

    Raises:
        RendezviewError: pyrender is requested but cannot be imported here.
    """
    if kind is Renderer.NUMPY:
        return NumpyRenderer(mesh)
    if kind is Renderer.PYRENDER:
        from rendezview.training.pyrender_renderer import PyrenderRenderer  # needs OpenGL

        return PyrenderRenderer(mesh)
    return NumbaRenderer(mesh)
