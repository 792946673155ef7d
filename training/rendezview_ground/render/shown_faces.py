"""The faces that a target shows around a direction, so that views draw those only.

Most triangles of a CAD model lie inside it or on its far side. Drawing all of them takes most of
the time of a view.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rendezview.geometry.pose import Array, Pose
from rendezview.geometry.zbuffer import Float32s, Int32s, draw_chosen, empty_buffers
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.render.projection import Mask, Window, project_vertices
from rendezview_ground.render.rasterizer import fill_silhouette

# Nodes nearest to a direction, whose faces are drawn. Source: of 130,000 pixels of `hubble`, 800 px
# wide, 7 leave 7 to 15 with another face than all faces have, 19 leave one or two
SOME_AROUND, MANY_AROUND = 7, 19


@dataclass(frozen=True, slots=True, eq=False)
class ShownFaces:
    """Which of F faces are visible from each of S directions, from near or from afar."""

    nodes: Array  # (S, 3) unit
    bits: npt.NDArray[np.uint8]  # (S, F / 8), lowest first
    faces: int

    def near(self, direction: Array, around: int) -> npt.NDArray[np.intp]:
        """The faces that are visible from one of the nodes around a direction (3,), ascending."""
        nearest = np.argpartition(-(self.nodes @ direction), around)[:around]
        together = np.bitwise_or.reduce(self.bits[nearest], axis=0)
        return np.flatnonzero(np.unpackbits(together, bitorder="little"))


def bits_of(owner: Int32s, faces: int) -> npt.NDArray[np.uint8]:
    """(F / 8,) which faces own a pixel of a z-buffer."""
    shown = np.zeros(faces + 1, dtype=np.bool_)
    shown[owner] = True  # the sky, −1, is the last
    return np.packbits(shown[:-1], bitorder="little")


class ShownRenderer:
    """Draws the shown faces of one mesh: silhouettes and surfaces.

    ``around``: nodes around a direction whose faces are drawn.
    """

    def __init__(
        self, mesh: Mesh, shown: ShownFaces, centre_m: Array, around: int = SOME_AROUND
    ) -> None:
        self._vertices = np.ascontiguousarray(mesh.vertices_m)
        self._faces = np.ascontiguousarray(mesh.faces, dtype=np.int32)
        self._shown = shown
        self._centre_m = centre_m
        self._around = around

    def draw(self, camera_from_target: Pose, window: Window) -> Mask:
        """(height, width) mask, 255 on the target.

        Raises:
            RendezviewError: a part of the target lies behind the camera's plane.
        """
        points_px = project_vertices(self._vertices, camera_from_target, window)
        mask = np.zeros((window.height, window.width), dtype=np.uint8)
        fill_silhouette(points_px, self._faces[self._near(camera_from_target)], mask)
        return mask

    def draw_surfaces(self, camera_from_target: Pose, window: Window) -> tuple[Float32s, Int32s]:
        """(height, width) nearness in 1/m, 0 in the sky; and the face that is seen, −1 in the sky.

        Raises:
            RendezviewError: a part of the target lies behind the camera's plane.
        """
        on_plane = project_vertices(self._vertices, camera_from_target, window, 3)
        nearness, owner = empty_buffers(window.height, window.width)
        draw_chosen(on_plane, self._faces, self._near(camera_from_target), nearness, owner)
        return nearness, owner

    def _near(self, camera_from_target: Pose) -> npt.NDArray[np.intp]:
        pose = camera_from_target
        direction = -(pose.rotation.T @ pose.translation_m) - self._centre_m
        return self._shown.near(direction, self._around)
