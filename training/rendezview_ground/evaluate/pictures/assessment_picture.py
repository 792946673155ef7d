"""How accurate a model is on its craft, on the sphere of views."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from rendezview.geometry.geodesic import Geodesic
from rendezview_ground.evaluate.assessment import Answers, Conditions
from rendezview_ground.evaluate.pictures.palette import (
    ESTIMATE,
    INK,
    TRUTH,
    dress,
    legend_below,
    new_figure,
)
from rendezview_ground.evaluate.pictures.sphere_pictures import PaintedSphere, colour_bar

_ORDER = 3  # of the sphere that is painted
_INSIDE = 8  # frames in the mean that colour a node: those in a cap around it


def assessment_picture(seen: Conditions, answer: Answers) -> Figure:
    """Two hemispheres of the share of right poses, two of the attitude's error; errors beside σ."""
    sphere, count = Geodesic.of_order(_ORDER), len(seen.range_m)
    cap = 1.0 - 2.0 * min(_INSIDE / count, 1.0)  # cosine of its angle: area over the sphere's
    right, error = np.full(len(sphere.nodes), np.nan), np.full(len(sphere.nodes), np.nan)
    for node, direction in enumerate(sphere.nodes):
        inside = seen.direction @ direction >= cap
        if inside.any():
            right[node] = 100.0 * np.mean(answer.right[inside])
        if (answer.right & inside).any():
            error[node] = np.rad2deg(np.median(answer.rotation_rad[answer.right & inside]))
    figure = new_figure(8.4, 9.4)
    rows = figure.add_gridspec(3, 2, height_ratios=(1.3, 1.3, 1.0))
    for row, (values, label) in enumerate(
        ((right, "right and given, %"), (error, "error of the attitude, median °"))
    ):
        pair = [figure.add_subplot(rows[row, column]) for column in range(2)]
        for sign, axes in zip((1.0, -1.0), pair, strict=True):
            colours = PaintedSphere(sphere, np.array([sign, 0.0, 0.0])).draw(axes, values)
            axes.set_title(f"from {'+' if sign > 0 else '−'}X", color=INK, fontsize=11)
        colour_bar(figure, pair, colours, label)
    axes = figure.add_subplot(rows[2, :])
    dress(axes, x="range, m", y="attitude, °")
    given = answer.given
    for values, colour, label in (
        (answer.rotation_rad, ESTIMATE, "error"),
        (answer.sigma_rad, TRUTH, "σ that the pose claims"),
    ):
        axes.plot(
            seen.range_m[given], np.rad2deg(np.maximum(values[given], 1e-6)), ".", color=colour,
            markersize=4, alpha=0.8, label=label,
        )  # fmt: skip
    axes.set_yscale("log")
    legend_below(figure, axes)
    return figure
