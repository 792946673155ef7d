"""A reading drawn over its picture."""

from __future__ import annotations

import math

import cv2
import numpy as np
import numpy.typing as npt

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.sensors.beacons.constellation import ReflectorPattern
from rendezview.sensors.beacons.detect.difference import Grey, LitDark
from rendezview.sensors.beacons.observation import ReflectorObservation

_SCALE = 2  # px of the drawing a pixel. Source: by construction
_SPOT, _REFLECTOR, _WORDS = (120, 120, 120), (0, 165, 255), (230, 230, 230)  # blue green red
_AXES = (
    (80, 80, 255),
    (80, 220, 80),
    (255, 160, 80),
)  # x red, y green, z blue. Source: by construction


def draw_reading(
    frames: LitDark, reading: ReflectorObservation, camera: Camera, patterns: list[ReflectorPattern]
) -> npt.NDArray[np.uint8]:
    """(2 H, 2 W, 3) blue-green-red: the difference, every spot, and what was made of them.

    Grey circles are spots, orange ones reflectors with their names; the lines are the face frame
    of the group at the pose: x red, y green, z (towards the camera) blue.
    """
    grey: Grey = frames.lit if frames.dark is None else cv2.subtract(frames.lit, frames.dark)  # type: ignore[assignment]
    wide = cv2.resize(grey, None, fx=_SCALE, fy=_SCALE, interpolation=cv2.INTER_NEAREST)
    canvas = np.asarray(cv2.cvtColor(wide, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    for row, name in zip(reading.spots.table, reading.reflectors, strict=True):
        place = _pixel(row[:2])
        radius = max(int(_SCALE * (2.5 * row[5] + 3)), 5)
        cv2.circle(canvas, place, radius, _SPOT if name is None else _REFLECTOR, 1, cv2.LINE_AA)
        if name is not None:
            _write(canvas, name, (place[0] + radius + 2, place[1] - radius), _REFLECTOR)
    pattern = next((p for p in patterns if p.name == reading.group), None)
    if reading.pose is not None and pattern is not None:
        _axes(canvas, camera, reading.pose, pattern)
    lines = [str(reading.status)]
    if reading.six is not None:
        six = reading.six
        degrees = [
            math.degrees(a)
            for a in (
                six.azimuth_rad, six.elevation_rad, six.roll_rad, six.pitch_rad, six.yaw_rad
            )
        ]  # fmt: skip
        lines = [
            f"range {six.range_m:.3f} m   az {degrees[0]:.2f}  el {degrees[1]:.2f}",
            f"roll {degrees[2]:.2f}  pitch {degrees[3]:.2f}  yaw {degrees[4]:.2f}"
            + ("   (or half a turn from it)" if reading.roll_ambiguous else ""),
        ]
    elif reading.reason is not None:
        lines.append(reading.reason[:90])
    for number, line in enumerate(lines):
        _write(canvas, line, (8, 18 + 18 * number), _WORDS)
    return canvas


def _pixel(point_px: npt.ArrayLike) -> tuple[int, int]:
    """Place on the enlarged picture, whose pixel (0, 0) is the centre of the first too."""
    x, y = (np.asarray(point_px, dtype=np.float64) + 0.5) * _SCALE - 0.5
    return round(float(x)), round(float(y))


def _axes(
    canvas: npt.NDArray[np.uint8], camera: Camera, pose: Pose, pattern: ReflectorPattern
) -> None:
    tips = np.vstack([np.zeros(3), 0.5 * pattern.base_m * np.eye(3)])
    places = camera.project((pose @ pattern.target_from_face).apply(tips))
    if not (np.isfinite(places).all() and np.abs(places).max() < 1e4):
        return
    for k, colour in enumerate(_AXES):
        cv2.line(canvas, _pixel(places[0]), _pixel(places[1 + k]), colour, 1, cv2.LINE_AA)


def _write(
    canvas: npt.NDArray[np.uint8], text: str, place: tuple[int, int], colour: tuple[int, int, int]
) -> None:
    cv2.putText(canvas, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.42, colour, 1, cv2.LINE_AA)
