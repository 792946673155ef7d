"""A renderer through pyrender, as a cross-check. It needs the system's OpenGL (EGL or OSMesa)."""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Pose
from rendezview.training.mesh import Mesh
from rendezview.training.projection import Mask, Window, project_vertices

# px from the pixel's centre. pyrender draws four samples a pixel and reads the depth of the first,
# which lies at (3/8, 1/8) px from the lower left corner. Source: OpenGL's standard 4-sample pattern
_SAMPLE_PX = (0.375 - 0.5, 0.5 - 0.125)


class PyrenderRenderer:
    """Off-screen OpenGL through pyrender; slower than the default, for cross-checks only."""

    def __init__(self, mesh: Mesh) -> None:
        self._mesh = mesh
        self._pyrender, scene_mesh = _load(mesh)
        self._scene = self._pyrender.Scene(bg_color=[0, 0, 0, 0])
        self._scene.add(scene_mesh)
        self._renderers: dict[tuple[int, int], Any] = {}

    def draw(self, camera_from_target: Pose, window: Window) -> Mask:
        project_vertices(self._mesh.vertices_m, camera_from_target, window)  # checks the depths
        pyrender = self._pyrender
        centre, radius = self._mesh.bounding_sphere
        distance = float(np.linalg.norm(camera_from_target.apply(centre)))
        near = max((distance - radius) * 0.5, 1e-3 * distance)
        camera = pyrender.IntrinsicsCamera(
            window.focal_px,
            window.focal_px,
            window.cx + 0.5 + _SAMPLE_PX[0],  # OpenGL counts from the pixel's corner
            window.cy + 0.5 + _SAMPLE_PX[1],
            znear=near,
            zfar=distance + 2.0 * radius,
        )
        target_from_camera = np.eye(4)
        inverse = camera_from_target.inverse()
        target_from_camera[:3, :3] = inverse.rotation @ np.diag([1.0, -1.0, -1.0])
        target_from_camera[:3, 3] = inverse.translation_m
        node = self._scene.add(camera, pose=target_from_camera)
        size = (window.width, window.height)
        if size not in self._renderers:
            self._renderers[size] = pyrender.OffscreenRenderer(*size)
        flags = pyrender.RenderFlags.DEPTH_ONLY | pyrender.RenderFlags.SKIP_CULL_FACES
        depth = self._renderers[size].render(self._scene, flags=flags)
        self._scene.remove_node(node)
        return np.where(depth > 0, 255, 0).astype(np.uint8)


def _load(mesh: Mesh) -> tuple[Any, Any]:
    os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
    if not hasattr(np, "infty"):
        setattr(np, "infty", np.inf)  # noqa: B010  # pyrender 0.1.45 is older than numpy 2
    try:
        import pyrender
        import trimesh

        shape = trimesh.Trimesh(mesh.vertices_m, mesh.faces, process=False)
        return pyrender, pyrender.Mesh.from_trimesh(shape, smooth=False)
    except Exception as error:
        raise RendezviewError(
            f"pyrender does not work here ({error}); install rendezview[pyrender] and the "
            "system's OpenGL, or use --renderer numba"
        ) from error
