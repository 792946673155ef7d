"""A reading drawn over its picture."""

from __future__ import annotations

import math
import textwrap

import cv2
import numpy as np
import numpy.typing as npt

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array
from rendezview.sensors.ring.observation import RingObservation

Picture = npt.NDArray[np.uint8]

_LETTER_PX = 8  # px; the widest of the font as it is written. Source: by looking at it

_BEST, _OTHER = (0, 165, 255), (170, 140, 90)  # blue green red
_UNSURE = (167, 121, 204)  # purple, of an ellipse that is no reading. Source: Okabe and Ito, 2008
_CHOSEN, _REFUSED, _WORDS = (80, 220, 80), (120, 120, 120), (230, 230, 230)


def draw_reading(image: npt.ArrayLike, reading: RingObservation, camera: Camera) -> Picture:
    """(H, W, 3) blue-green-red: all ellipses, the ring's in orange, and the axes of its poses.

    Where no pose is given, the likeliest ellipse is purple: it may be another circle.

    The chosen pose's axis is green, the other's grey; both are as long as the ring's radius.
    """
    canvas = np.asarray(cv2.cvtColor(np.asarray(image, np.uint8), cv2.COLOR_GRAY2BGR), np.uint8)
    best = _UNSURE if reading.circle is None else _BEST
    for k, edge in reversed(list(enumerate(reading.edges))):
        round_it = camera.pinhole.rays(edge.ellipse.points(240))
        _lines(canvas, round_it, camera, best if k == reading.edge else _OTHER, closed=True)
    for k, circle in enumerate(reading.circles):
        chosen = reading.choice is not None and reading.choice.index == k
        ends = np.vstack([circle.centre_m, circle.centre_m + circle.radius_m * circle.axis])
        _lines(canvas, ends, camera, _CHOSEN if chosen else _REFUSED, closed=False)
    lines = [f"{reading.status}: {len(reading.edges)} ellipses"]
    if reading.circle is not None:
        far = float(np.linalg.norm(reading.circle.centre_m))
        lines = [f"range {far:.3f} m   tilt {math.degrees(reading.circle.tilt_rad):.2f}°"]
    elif reading.reason:
        lines += textwrap.wrap(reading.reason, max(canvas.shape[1] // _LETTER_PX, 1))
    for number, line in enumerate(lines):
        cv2.putText(
            canvas, line, (8, 18 + 18 * number), cv2.FONT_HERSHEY_SIMPLEX, 0.42, _WORDS, 1,
            cv2.LINE_AA,
        )  # fmt: skip
    return canvas


def _lines(
    canvas: Picture, points_m: Array, camera: Camera, colour: tuple[int, int, int], closed: bool
) -> None:
    """A line through points (N, 3) of the camera frame, where all of them are near the picture."""
    places, shift = camera.project(points_m), 4
    if np.isfinite(places).all() and np.abs(places).max() < 3e4:
        fixed = np.rint(places * (1 << shift)).astype(np.int32)
        cv2.polylines(canvas, [fixed], closed, colour, 1, cv2.LINE_AA, shift)
