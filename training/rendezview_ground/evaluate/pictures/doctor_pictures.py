"""A mesh from four sides, with its open edges, mixed winding and suspicious bodies."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from rendezview.geometry.pose import Array
from rendezview_ground.evaluate.doctor import Diagnosis
from rendezview_ground.evaluate.pictures.palette import (
    ACTIVE,
    BACKGROUND,
    ESTIMATE,
    INK,
    PROBLEM,
    dress_legend,
    new_figure,
)
from rendezview_ground.learn.options import TrainingOptions, ViewGeometry, view_geometry
from rendezview_ground.learn.views.drawn_view import DrawnView, draw_view
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.mesh.triangles import crosses

_SIDE_PX, _BORDER_PX = 560, 24.0  # of a view. Source: readable at half size
_DIRECTIONS = np.array([[1.0, 0.6, 0.5], [-1.0, 0.7, 0.4], [-0.6, -1.0, 0.5], [0.7, -0.4, -1.0]])
_FROM = ("+x +y +z", "−x +y +z", "−x −y +z", "+x −y −z")
_HIDDEN = 0.01  # of the depth: an edge this far behind the surface is hidden. Source: chosen
_TINT = np.array([1.0, 0.44, 0.26])  # of bodies that should not be there; also hatched


def doctor_picture(diagnosis: Diagnosis, title: str) -> Figure:
    """Four views of the mesh; orange: open edges, blue: mixed winding, red: suspicious bodies."""
    mesh = diagnosis.mesh
    geometry = view_geometry(mesh, TrainingOptions(), None)
    figure = new_figure(9.6, 10.2, title)
    for axes, direction, words in zip(
        figure.subplots(2, 2).ravel(), _DIRECTIONS, _FROM, strict=True
    ):
        _draw(axes, diagnosis, geometry, direction / np.linalg.norm(direction))
        axes.set_title(f"from {words}", color=INK, fontsize=10, loc="left")
    handles = [
        Patch(color=ACTIVE, label=f"open edges: {len(diagnosis.open_edges)}"),
        Patch(color=ESTIMATE, label=f"mixed winding: {len(diagnosis.mixed_edges)} edges"),
        Patch(
            facecolor=PROBLEM,
            hatch="///",
            label=f"suspicious body: {diagnosis.far_faces.sum()} faces",
        ),
    ]
    dress_legend(figure.legend(handles=handles, loc="outside lower center", ncols=3, fontsize=9.5))
    return figure


def _draw(axes: Axes, diagnosis: Diagnosis, geometry: ViewGeometry, direction: Array) -> None:
    mesh = diagnosis.mesh
    view = draw_view(mesh, geometry, direction, geometry.sphere_radius_m, _SIDE_PX, _BORDER_PX)
    axes.imshow(_shaded(view, mesh, diagnosis.far_faces), interpolation="antialiased")
    for edges, colour in ((diagnosis.mixed_edges, ESTIMATE), (diagnosis.open_edges, ACTIVE)):
        lines = _visible(view, edges)
        axes.add_collection(LineCollection(list(lines), colors=colour, linewidths=1.1))
    length_m = _round(0.5 * geometry.target_radius_m)
    length_px = length_m * view.focal / geometry.sphere_radius_m
    left, low = 0.04 * _SIDE_PX, 0.955 * _SIDE_PX
    axes.plot([left, left + length_px], [low, low], color=INK, linewidth=2.0)
    axes.text(left, low - 8, f"{length_m:g} m", color=INK, fontsize=9)
    axes.set(xlim=(-0.5, _SIDE_PX - 0.5), ylim=(_SIDE_PX - 0.5, -0.5))
    axes.set_axis_off()


def _shaded(view: DrawnView, mesh: Mesh, far: npt.NDArray[np.bool_]) -> Array:
    """(size, size, 3): faces lit from the camera, with their own brightness."""
    normal = crosses(view.vertices[view.faces])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    towards = np.abs(normal @ np.array([0.3, -0.35, -0.89]))
    albedo = np.sqrt(np.clip(mesh.face_albedo, 0.0, 1.0))
    colour = (0.18 + 0.62 * towards * (0.35 + 0.65 * albedo))[:, None] * np.ones(3)
    colour[far] = (0.4 + 0.6 * towards[far, None]) * _TINT
    background = np.array([int(BACKGROUND[k : k + 2], 16) / 255.0 for k in (1, 3, 5)])
    rows, columns = np.indices(view.owner.shape)
    picture = np.where((view.owner >= 0)[..., None], colour[view.owner], background)
    hatched = far[view.owner] & (view.owner >= 0) & ((rows + columns) % 14 < 3)
    picture[hatched] = background
    return np.asarray(np.clip(picture, 0.0, 1.0))


def _visible(view: DrawnView, edges: npt.NDArray[np.int64]) -> Array:
    """(K, 2, 2) px of the edges whose middle is not behind a surface."""
    ends = view.vertices[edges]
    places = view.focal * ends[..., :2] / ends[..., 2:] + view.middle
    middle = np.rint(places.mean(axis=1)).astype(int).reshape(-1, 2)
    inside = ((middle >= 1) & (middle < _SIDE_PX - 1)).all(axis=1)
    column, row = np.where(inside[:, None], middle, 1).T
    # The nearest surface around the pixel: an open edge is at the border of its own face.
    around = [view.nearness[row + dy, column + dx] for dy in (-1, 0, 1) for dx in (-1, 0, 1)]
    surface = np.min(np.where(np.array(around) > 0.0, around, np.inf), axis=0)
    nearness = 1.0 / ends[..., 2].mean(axis=1) if len(ends) else np.zeros(0)
    shown = inside & (~np.isfinite(surface) | (nearness > surface * (1.0 - _HIDDEN)))
    return np.asarray(places[shown])


def _round(length_m: float) -> float:
    """1, 2 or 5 times a power of ten, not longer than ``length_m``."""
    power = 10.0 ** np.floor(np.log10(length_m))
    return float(max(k for k in (1.0, 2.0, 5.0) if k * power <= length_m) * power)
