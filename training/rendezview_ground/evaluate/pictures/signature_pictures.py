"""The signature of a view, and the tests of a tree on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure
from matplotlib.projections.polar import PolarAxes
from matplotlib.ticker import MaxNLocator

from rendezview.sensors.appearance.model.trees import Forest
from rendezview_ground.evaluate.pictures.palette import (
    ACTIVE,
    ESTIMATE,
    GREEN,
    GRID,
    MUTED,
    PANEL,
    PURPLE,
    dress_legend,
    new_figure,
)

_MARK_RAD = np.deg2rad(3.0)  # rad; half the length of a threshold's bar


@dataclass(frozen=True, slots=True)
class TreeTest:
    """One test of a tree on the path to a leaf."""

    component: int  # bin
    threshold: float  # thousandths of sqrt(area)
    at_most: bool  # the result: reading <= threshold


def tree_tests(forest: Forest, tree: int, readings: npt.ArrayLike) -> list[TreeTest]:
    """The tests of one tree on a signature (N,), rolled to the tree's node."""
    values = np.asarray(readings)
    tests: list[TreeTest] = []
    entry = int(forest.roots[tree])
    while forest.component[entry] >= 0:
        component, threshold = int(forest.component[entry]), float(forest.threshold[entry])
        at_most = bool(values[component] <= threshold)
        tests.append(TreeTest(component, threshold, at_most))
        entry = int(forest.left[entry] if at_most else forest.right[entry])
    return tests


def signature_picture(
    readings: npt.ArrayLike,
    node_readings: npt.ArrayLike | None = None,
    tests: Sequence[TreeTest] = (),
    *,
    node: int | None = None,
) -> Figure:
    """A signature as the silhouette's outer shape, with the node's own and the thresholds.

    Args:
        readings: (N,) of the view, rolled to the node (`outline.signature`).
        node_readings: (N,) of the node's clean view.
        tests: of the node's tree; see `tree_tests`.
        node: its number, for the legend.
    """
    view = np.asarray(readings, dtype=np.float64)
    angle = 2.0 * np.pi * np.arange(len(view) + 1) / len(view)
    figure = new_figure(6.2, 5.9)
    axes = figure.add_subplot(projection="polar")
    assert isinstance(axes, PolarAxes)
    axes.set_facecolor(PANEL)
    axes.spines["polar"].set_color(GRID)
    axes.grid(color=GRID, linewidth=0.6)
    axes.tick_params(colors=MUTED, labelsize=9)
    if node_readings is not None:
        clean = np.asarray(node_readings, dtype=np.float64)
        label = "best active node" if node is None else f"best active node, #{node}"
        axes.plot(angle, np.append(clean, clean[0]), color=ACTIVE, linewidth=1.4, label=label)
    closed = np.append(view, view[0])
    axes.fill(angle, closed, color=ESTIMATE, alpha=0.12)
    axes.plot(angle, closed, color=ESTIMATE, linewidth=2.0, label="this view")
    seen: set[bool] = set()
    for test in tests:
        middle = 2.0 * np.pi * test.component / len(view)
        arc = np.linspace(middle - _MARK_RAD, middle + _MARK_RAD, 5)
        colour = PURPLE if test.at_most else GREEN
        words = "tree: reading at most" if test.at_most else "tree: reading above"
        axes.plot(
            arc, np.full(5, test.threshold), color=colour, linewidth=3.0, solid_capstyle="butt",
            label=None if test.at_most in seen else words,
        )  # fmt: skip
        axes.plot(
            (middle, middle), (test.threshold, view[test.component]), color=colour, linewidth=0.9
        )
        seen.add(test.at_most)
    axes.set_ylim(0.0, None)
    axes.set_rlabel_position(float(np.rad2deg(angle[int(np.argmin(view))])))
    axes.yaxis.set_major_locator(MaxNLocator(nbins=4, steps=[1, 2, 2.5, 5, 10]))
    axes.set_title(
        "radius: thousandths of √area; angle: from right, counter-clockwise",
        color=MUTED, fontsize=9.5, pad=14,
    )  # fmt: skip
    dress_legend(figure.legend(loc="outside lower center", ncols=2, fontsize=9.5))
    return figure
