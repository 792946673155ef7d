"""Colours and axes of all pictures: one dark palette that the colour-blind can tell apart.

Pictures are matplotlib figures made without pyplot, so nothing global is touched.
"""

from __future__ import annotations

import io

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.legend import Legend

BACKGROUND = "#0f141b"
PANEL = "#161d27"
INK = "#e3e9f0"
MUTED = "#93a1b1"
GRID = "#2a3441"
# Okabe and Ito's colours, a little lighter where the dark ground asks for it.
ESTIMATE = "#56b4e9"
TRUTH = "#f0e442"
ON_NODE = "#e69f00"
PROBLEM = "#ff7043"
GREEN = "#2cc295"
PURPLE = "#d98cb3"
AXIS_COLOURS = (PROBLEM, GREEN, ESTIMATE)  # x, y, z; always with their letters

# Lightness rises evenly, so it reads without colour too.
ACCURACY = LinearSegmentedColormap.from_list(
    "accuracy", ["#2b1f4d", "#29507f", "#2f86a0", "#6cc0ad", "#e6f5d8"]
)
UNKNOWN = "#3a4350"
DPI = 110


def new_figure(width_in: float, height_in: float) -> Figure:
    """An empty dark figure that lays itself out."""
    figure = Figure(
        figsize=(width_in, height_in), dpi=DPI, facecolor=BACKGROUND, layout="constrained"
    )
    FigureCanvasAgg(figure)
    return figure


def dress(axes: Axes, *, x: str = "", y: str = "", title: str = "") -> None:
    """Give axes the house's look, labels and a title at the left."""
    axes.set_facecolor(PANEL)
    for side, spine in axes.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color(GRID)
    axes.tick_params(which="both", colors=MUTED, labelsize=9, length=3)
    axes.grid(True, color=GRID, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.set_xlabel(x, color=MUTED, fontsize=10)
    axes.set_ylabel(y, color=MUTED, fontsize=10)
    if title:
        axes.set_title(title, color=INK, fontsize=11, loc="left", pad=8)


def dress_legend(legend: Legend) -> None:
    """The house's look for a legend."""
    legend.get_frame().set(facecolor=PANEL, edgecolor=GRID, alpha=0.85)
    for text in legend.get_texts():
        text.set_color(INK)


def png(figure: Figure) -> bytes:
    """The figure as a PNG file; the same figure gives the same bytes."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", facecolor=figure.get_facecolor(), metadata=_NO_METADATA)
    return buffer.getvalue()


def pixels(figure: Figure) -> npt.NDArray[np.uint8]:
    """The figure as RGB (height, width, 3)."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()  # type: ignore[no-untyped-call]
    return np.array(canvas.buffer_rgba(), dtype=np.uint8)[..., :3]  # type: ignore[no-untyped-call]


_NO_METADATA: dict[str, str | None] = {"Software": None}
