"""The geodesic sphere of a model: accuracy of each node, and the active nodes of a frame."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PolyCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.ticker import MaxNLocator
from scipy.spatial import SphericalVoronoi

from rendezview.geometry.geodesic import Geodesic
from rendezview.geometry.pose import Array
from rendezview.sensors.appearance import ViewModel
from rendezview_ground.evaluate.pictures.palette import (
    ACCURACY,
    ACTIVE,
    BACKGROUND,
    ESTIMATE,
    GRID,
    INK,
    MUTED,
    PURPLE,
    TRUTH,
    UNKNOWN,
    dress,
    legend_below,
    new_figure,
)

_HELD_OUT = "correct decisions on held-out views"
_TRAINING = "correct decisions on training views"


def sphere_picture(
    model: ViewModel,
    *,
    active_nodes: npt.ArrayLike = (),
    direction: npt.ArrayLike | None = None,
    truth: npt.ArrayLike | None = None,
) -> Figure:
    """The accuracy map seen from the camera's side, with the target's +Z upwards.

    Args:
        model: whose sphere it is.
        active_nodes: (K,) indices of nodes to outline.
        direction: (3,) estimated, view centre → camera, target frame; seen from there.
        truth: (3,) the true one.
    """
    values, label = _accuracy(model)
    seen_from = direction if direction is not None else truth
    figure = new_figure(6.2, 5.6)
    axes = figure.add_subplot()
    side = np.array([1.0, 0.0, 0.0]) if seen_from is None else seen_from
    painted = PaintedSphere(model.geodesic, side)
    colours = painted.draw(axes, np.asarray(values, dtype=np.float64))
    painted.outline(axes, np.asarray(active_nodes, dtype=np.intp))
    if truth is not None:
        painted.mark(axes, truth, "o", TRUTH, "true direction", hollow=True)
    if direction is not None:
        painted.mark(axes, direction, "+", ESTIMATE, "estimated direction")
    colour_bar(figure, axes, colours, label)
    legend_below(figure, axes)
    return figure


def model_picture(model: ViewModel) -> Figure:
    """Two hemispheres of the accuracy map, and the sizes of the trees."""
    values, label = _accuracy(model)
    figure = new_figure(7.0, 6.2)
    top = figure.add_gridspec(2, 2, height_ratios=(1.55, 1.0))
    for column, sign in enumerate((1.0, -1.0)):
        axes = figure.add_subplot(top[0, column])
        painted = PaintedSphere(model.geodesic, np.array([sign, 0.0, 0.0]))
        colours = painted.draw(axes, values)
        axes.set_title(f"from {'+' if sign > 0 else '−'}X", color=INK, fontsize=11)
    colour_bar(figure, figure.axes, colours, label)
    trees = range(len(model.forest))
    counts = {
        "depth of the tree, levels": [model.forest.depth(tree) for tree in trees],
        "leaves of the tree": [model.forest.leaf_count(tree) for tree in trees],
    }
    for column, (name, numbers) in enumerate(counts.items()):
        axes = figure.add_subplot(top[1, column])
        dress(axes, x=name, y="nodes" if column == 0 else "")
        wide = max(1, -(-(max(numbers) - min(numbers) + 1) // 30))
        edges = np.arange(min(numbers) - 0.5, max(numbers) + 0.5 + wide, wide)
        axes.hist(numbers, bins=list(edges), color=ESTIMATE, edgecolor=BACKGROUND, linewidth=0.8)
        axes.grid(False, axis="x")
        axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))
        median = float(np.median(numbers))
        axes.axvline(median, color=TRUTH, linewidth=1.4)
        axes.text(
            median, 1.02, f"median {median:g}", transform=axes.get_xaxis_transform(),
            color=TRUTH, fontsize=9, ha="center", va="bottom",
        )  # fmt: skip
    return figure


def _accuracy(model: ViewModel) -> tuple[Array, str]:
    """Held-out accuracy of the nodes, or that on training views if none was measured."""
    if np.isfinite(model.held_out_accuracy).any():
        return model.held_out_accuracy, _HELD_OUT
    return model.training_accuracy, _TRAINING


def colour_bar(
    figure: Figure, axes: Axes | list[Axes], colours: ScalarMappable, label: str
) -> None:
    """A styled bar beside the axes, with what the colours mean."""
    bar = figure.colorbar(colours, ax=axes, shrink=0.75, aspect=28, pad=0.02)
    bar.set_label(label, color=MUTED, fontsize=10)
    bar.ax.tick_params(colors=MUTED, labelsize=9)
    bar.outline.set_visible(False)


class PaintedSphere:
    """Orthographic picture of a sphere whose cells are the regions closest to each node."""

    def __init__(self, sphere: Geodesic, seen_from: npt.ArrayLike) -> None:
        ahead = np.asarray(seen_from, dtype=np.float64)
        ahead = ahead / np.linalg.norm(ahead)
        up = np.array([0.0, 0.0, 1.0]) if abs(ahead[2]) < 0.99 else np.array([0.0, 1.0, 0.0])
        right = np.cross(up, ahead)
        right /= np.linalg.norm(right)
        self._view = np.stack([right, np.cross(ahead, right), ahead])  # picture from target
        self._nodes = sphere.nodes @ self._view.T
        self._cells = SphericalVoronoi(self._nodes)
        self._cells.sort_vertices_of_regions()

    def _cell(self, node: int) -> Array:
        """(5 or 6, 2) corners of a node's cell in the picture, in order."""
        return np.asarray(self._cells.vertices[self._cells.regions[node], :2])

    def draw(self, axes: Axes, values: Array) -> ScalarMappable:
        """Draw the coloured cells in front, and the letters of the target's axes."""
        front = np.flatnonzero(self._nodes[:, 2] > 0.0)
        known = values[np.isfinite(values)]
        low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 1.0)
        if high - low < 1e-9:
            low, high = low - 0.005, high + 0.005
        colours = ScalarMappable(Normalize(low, high), ACCURACY.with_extremes(bad=UNKNOWN))
        paint = colours.to_rgba(np.ma.masked_invalid(values[front]))
        rim = Circle((0.0, 0.0), 1.0, facecolor=UNKNOWN, edgecolor=GRID, linewidth=1.0)
        axes.add_patch(rim)
        cells = PolyCollection(
            [self._cell(int(n)) for n in front], facecolors=paint, edgecolors=BACKGROUND,
            linewidths=0.35 if len(front) < 2000 else 0.1,
        )  # fmt: skip
        axes.add_collection(cells)
        cells.set_clip_path(rim)
        for k, letter in enumerate("XYZ"):
            for sign in (1.0, -1.0):
                x, y, depth = sign * self._view[:, k]
                if depth > -0.05:
                    out = 1.0 if depth > 0.35 else 1.09 / max(float(np.hypot(x, y)), 1e-9)
                    axes.text(
                        x * out, y * out, f"{'+' if sign > 0 else '−'}{letter}",
                        color=INK if out != 1.0 else "black", fontsize=10, fontweight="bold",
                        ha="center", va="center",
                        bbox=None if out != 1.0 else {
                            "boxstyle": "round,pad=0.15", "facecolor": INK, "alpha": 0.75,
                            "edgecolor": "none",
                        },
                    )  # fmt: skip
        axes.set(xlim=(-1.17, 1.17), ylim=(-1.14, 1.14), aspect="equal")
        axes.set_axis_off()
        return colours

    def outline(self, axes: Axes, nodes: npt.NDArray[np.intp]) -> None:
        """Outline each active node; nodes on the far side are dots on the rim."""
        cells = [self._cell(int(n)) for n in nodes if self._nodes[n, 2] > 0.0]
        hidden = [self._nodes[n, :2] for n in nodes if self._nodes[n, 2] <= 0.0]
        if cells:
            axes.add_collection(
                PolyCollection(
                    cells,
                    facecolors="none",
                    edgecolors=ACTIVE,
                    linewidths=2.2,
                    label="active nodes",
                )
            )
        if hidden:
            x, y = np.transpose([p / max(float(np.hypot(*p)), 1e-9) for p in hidden])
            axes.plot(x, y, "o", color=PURPLE, markersize=6, label="active, far side")

    def mark(
        self, axes: Axes, direction: npt.ArrayLike, marker: str, colour: str, label: str,
        *, hollow: bool = False,
    ) -> None:  # fmt: skip
        """Mark a direction; directions on the far side are marked on the rim."""
        point = self._view @ (np.asarray(direction) / np.linalg.norm(np.asarray(direction)))
        x, y = point[:2]
        if point[2] < 0.0:
            x, y = point[:2] / max(float(np.hypot(x, y)), 1e-9)
            label += " (far side)"
        axes.plot(
            [x], [y], marker, color=colour, markersize=15, label=label, linestyle="none",
            markerfacecolor="none" if hollow else colour, markeredgewidth=2.4,
        )  # fmt: skip
