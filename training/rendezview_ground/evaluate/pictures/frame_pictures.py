"""A frame with the result of its recognition drawn over it, as a figure."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from rendezview.geometry.camera import Camera
from rendezview.sensors.appearance import AppearanceObservation, ViewModel
from rendezview.sensors.appearance.overlay import draw_observation
from rendezview_ground.evaluate.pictures.palette import BACKGROUND, DPI, PROBLEM

_EDGE = 0.01  # of the width: the mark of a problem. Source: as that of `draw_observation`


def frame_overlay(
    image: npt.NDArray[np.uint8] | None,
    observation: AppearanceObservation,
    camera: Camera,
    model: ViewModel,
    *,
    title: str = "",
    note: str = "",
    bad: bool = False,
) -> Figure:
    """Draw the frame with edges, axes of the CAD frame, uncertainty and status.

    Args:
        image: (height, width) grey levels of the camera; None: could not be read.
        observation: of this frame. Without a pose, the picture shows its reason.
        camera: that took it.
        model: for the edges, the view centre and the length of the axes.
        title: text for the top left corner, such as the frame's number.
        note: text behind the title, such as the error.
        bad: mark the frame as a problem, although there is a pose.

    Returns:
        A figure of the frame, 640 to 1280 px wide, with the status bar below.
    """
    words = "   ".join(text for text in (title, note) if text)
    drawn = draw_observation(image, observation, camera, model, title=words)
    height, width = drawn.shape[:2]
    figure = Figure(figsize=(width / DPI, height / DPI), dpi=DPI, facecolor=BACKGROUND)
    FigureCanvasAgg(figure)
    figure.figimage(drawn[..., ::-1])
    if bad or observation.pose is None:
        figure.add_artist(Rectangle((0.0, 0.0), _EDGE, 1.0, color=PROBLEM))
    return figure
