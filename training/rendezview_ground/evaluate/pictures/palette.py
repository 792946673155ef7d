"""Colours, axes and legends of all pictures: one dark palette that is safe for the colour-blind.

Pictures are matplotlib figures made without pyplot, so they change no global state.
"""

from __future__ import annotations

import io
from typing import Literal

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d import Axes3D

BACKGROUND = "#0f141b"
PANEL = "#161d27"
INK = "#e3e9f0"
MUTED = "#93a1b1"
GRID = "#2a3441"
# Okabe and Ito's colours, slightly lighter on the dark background.
ESTIMATE = "#56b4e9"
TRUTH = "#f0e442"
ACTIVE = "#e69f00"
PROBLEM = "#ff7043"
GREEN = "#2cc295"
PURPLE = "#d98cb3"
AXIS_COLOURS = (PROBLEM, GREEN, ESTIMATE)  # x, y, z; always shown with their letters

# Lightness rises evenly, so the map is readable without colour.
ACCURACY = LinearSegmentedColormap.from_list(
    "accuracy", ["#2b1f4d", "#29507f", "#2f86a0", "#6cc0ad", "#e6f5d8"]
)
UNKNOWN = "#3a4350"
DPI = 110


def new_figure(width_in: float, height_in: float, title: str = "") -> Figure:
    """An empty dark figure with automatic layout."""
    figure = Figure(
        figsize=(width_in, height_in), dpi=DPI, facecolor=BACKGROUND, layout="constrained"
    )
    FigureCanvasAgg(figure)
    if title:
        figure.suptitle(title, color=INK, fontsize=12, x=0.01, ha="left")
    return figure


def dress(axes: Axes, *, x: str = "", y: str = "") -> None:
    """Style axes, with labels."""
    axes.set_facecolor(PANEL)
    for side, spine in axes.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color(GRID)
    axes.tick_params(which="both", colors=MUTED, labelsize=9, length=3)
    axes.grid(True, color=GRID, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.set_xlabel(x, color=MUTED, fontsize=10)
    axes.set_ylabel(y, color=MUTED, fontsize=10)


def dress_legend(legend: Legend) -> None:
    """Style a legend."""
    legend.get_frame().set(facecolor=PANEL, edgecolor=GRID, alpha=0.85)
    for text in legend.get_texts():
        text.set_color(INK)


def legend_below(figure: Figure, axes: Axes, *, columns: int = 3, size: float = 9.5) -> None:
    """A styled legend of the axes' labels below them, if there are any labels."""
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        dress_legend(
            figure.legend(handles, labels, loc="outside lower center", ncols=columns, fontsize=size)
        )


def draw_axes(axes: Axes3D, centre_m: npt.NDArray[np.float64], length_m: float) -> None:
    """The three axes of a frame, from its centre, with their letters."""
    for k, letter in enumerate("XYZ"):
        tip = centre_m + length_m * np.eye(3)[k]
        axes.plot(*np.stack([centre_m, tip]).T, color=AXIS_COLOURS[k], linewidth=2.6)
        beyond = centre_m + 1.25 * length_m * np.eye(3)[k]
        axes.text(*beyond, letter, color=AXIS_COLOURS[k], fontsize=9, fontweight="bold")


def space_axes(figure: Figure) -> Axes3D:
    """Styled axes in space, metres."""
    axes = figure.add_subplot(projection="3d")
    assert isinstance(axes, Axes3D)
    axes.set_facecolor(BACKGROUND)
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.set_pane_color((0.0, 0.0, 0.0, 0.0))
        axis._axinfo["grid"].update(color=GRID, linewidth=0.6)
        axis.line.set_color(GRID)
        axis.set_major_locator(MaxNLocator(5))
    axes.tick_params(colors=MUTED, labelsize=8, pad=1)
    axes.set_xlabel("X, m", color=MUTED, fontsize=10)
    axes.set_ylabel("Y, m", color=MUTED, fontsize=10)
    axes.set_zlabel("Z, m", color=MUTED, fontsize=10)
    axes.set_box_aspect(None, zoom=0.88)  # room for the labels
    return axes


def logarithmic(axes: Axes, which: Literal["x", "y"], digits: str = "25") -> None:
    """A logarithmic axis with plain numbers at its decades, and between them at these digits."""
    axis = axes.xaxis if which == "x" else axes.yaxis
    axes.set(**{f"{which}scale": "log"})
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(lambda x, _: f"{x:g}" if f"{x:e}"[0] in digits else "")
    axis.set_tick_params(which="minor", labelsize=8)


def png(figure: Figure) -> bytes:
    """The figure as a PNG file; the same figure gives the same bytes."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", facecolor=figure.get_facecolor(), metadata=_NO_METADATA)
    return buffer.getvalue()


_NO_METADATA: dict[str, str | None] = {"Software": None}
