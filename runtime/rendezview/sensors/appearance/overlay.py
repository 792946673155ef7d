"""A frame with its result drawn over it: edges, axes, uncertainty and status."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose
from rendezview.geometry.so3 import hat
from rendezview.io.sequences.frame import GreyImage
from rendezview.sensors.appearance.edges.contour_at import contour_pixels
from rendezview.sensors.appearance.model.contours import OUTLINE
from rendezview.sensors.appearance.model.view_model import ViewModel
from rendezview.sensors.appearance.observation import AppearanceObservation

Picture = npt.NDArray[np.uint8]
Colour = tuple[int, int, int]  # blue, green, red

# Colours that the colour-blind tell apart, lighter on the dark picture.
_INK: Colour = (240, 233, 227)  # Source: as the figures of `show`
_MUTED: Colour = (177, 161, 147)  # Source: as the figures of `show`
_PANEL: Colour = (39, 29, 22)  # Source: as the figures of `show`
_OUTLINE: Colour = (0, 159, 230)  # orange. Source: Okabe and Ito, 2008
_INNER: Colour = (233, 180, 86)  # sky blue. Source: Okabe and Ito, 2008
_SIGMA: Colour = (66, 228, 240)  # yellow. Source: Okabe and Ito, 2008
_PROBLEM: Colour = (67, 112, 255)  # vermilion. Source: Okabe and Ito, 2008
_GREEN: Colour = (149, 194, 44)  # bluish green. Source: Okabe and Ito, 2008
_AXES: tuple[Colour, ...] = (_PROBLEM, _GREEN, _INNER)  # x, y, z, always with their letters

_LEAST_PX, _MOST_PX = 640, 1280  # widths of the drawn frame. Source: legible, and small files
_BAR = 0.115  # height of the status bar, of the width. Source: three lines of text
_TEXT = 0.0265  # size of the text, of the width. Source: readable at half size
_LEAST_ELLIPSE = 0.02  # of the width: half axis of the ellipse as drawn. Source: visible
_LONE_PX = 4.0  # length of the edge of a single contour point. Source: visible
_BITS = 4  # of a pixel's fraction in drawing calls. Source: OpenCV's `shift`


@dataclass(frozen=True, slots=True)
class _Canvas:
    """A picture that is drawn on, and how its pixels follow from the camera's."""

    picture: Picture
    scale: float
    width: int

    def line(self, points_px: npt.ArrayLike, colour: Colour, thick: float, halo: bool) -> None:
        """A polyline (N, 2) in the camera's pixels; ``thick`` in thousandths of the width."""
        places = (np.asarray(points_px) + 0.5) * self.scale - 0.5
        if not (np.isfinite(places).all() and np.abs(places).max() < 3e4):
            return
        fixed = [np.rint(places * (1 << _BITS)).astype(np.int32).reshape(-1, 1, 2)]
        wide = max(1, round(thick * 1e-3 * self.width))
        if halo:
            cv2.polylines(self.picture, fixed, False, (0, 0, 0), wide + 2, cv2.LINE_AA, _BITS)
        cv2.polylines(self.picture, fixed, False, colour, wide, cv2.LINE_AA, _BITS)

    def write(
        self,
        text: str,
        x: float,
        y: float,
        colour: Colour,
        *,
        size: float = 1.0,
        bold: bool = False,
    ) -> None:
        """Text with its baseline's left end at (x, y), pixels of the drawing."""
        height = max(12, round(size * _TEXT * self.width))
        font, place = cv2.FontFace("sans"), (round(x), round(y))
        weight = 700 if bold else 400
        shadow = place[0] + 1, place[1] + 1
        cv2.putText(self.picture, text, shadow, (0, 0, 0), font, height, weight)
        cv2.putText(self.picture, text, place, colour, font, height, weight)


def draw_observation(
    image: GreyImage | None,
    observation: AppearanceObservation,
    camera: Camera,
    model: ViewModel,
    *,
    title: str = "",
) -> Picture:
    """The frame with the model's edges, axes, uncertainty and status.

    Args:
        image: (height, width) grey levels of the camera; None: could not be read.
        observation: of this frame. Without a pose, the reason is shown.
        camera: that took it.
        model: of the target; without contour points, or a pose, the silhouette found is drawn.
        title: text for the top left corner, such as the frame's number and time.

    Returns:
        (H, W, 3) blue, green, red; 640 to 1280 px wide, even sizes, with a status bar below.
    """
    width = min(max(camera.width, _LEAST_PX), _MOST_PX) // 2 * 2
    scale = width / camera.width
    height = round(scale * camera.height) // 2 * 2
    bar = round(_BAR * width) // 2 * 2
    picture: Picture = np.zeros((height + bar, width, 3), dtype=np.uint8)
    picture[height:] = _PANEL
    if image is not None:
        sized = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        picture[:height] = cv2.cvtColor(sized, cv2.COLOR_GRAY2BGR)
    canvas = _Canvas(picture, scale, width)
    clip = _Canvas(picture[:height], scale, width)  # a view: nothing is drawn into the bar
    factor = None
    found = observation.silhouette
    if found is not None and (observation.pose is None or model.contours is None):
        for outline in found.outlines_px:
            clip.line(np.vstack([outline, outline[:1]]), _OUTLINE, 2.4, halo=False)
    if observation.pose is not None:
        _edges(clip, observation, observation.pose, camera, model)
        factor = _ellipse(clip, observation, camera, model)
        _axes(clip, observation.pose, camera, model)
    if title:
        clip.write(title, 0.012 * width, 0.036 * width, _INK)
    _status(canvas, height, observation, model, factor)
    return picture


def _edges(
    canvas: _Canvas,
    observation: AppearanceObservation,
    pose: Pose,
    camera: Camera,
    model: ViewModel,
) -> None:
    angles = None if observation.joints is None else observation.joints.angles_rad
    contour = contour_pixels(model, camera, pose, angles)
    if contour is None or not len(contour.points_px):
        return
    points = contour.points_px
    half = 0.5 * _spacing_px(points) + 0.5
    for inner in (True, False):  # the outline last, on top
        chosen = (contour.kinds != OUTLINE) == inner
        for point, along in zip(points[chosen], contour.directions[chosen], strict=True):
            ends = np.stack([point - half * along, point + half * along])
            canvas.line(ends, _INNER if inner else _OUTLINE, 2.4, halo=False)


def _spacing_px(points: Array) -> float:
    """Median distance of points (N, 2) to their nearest neighbour, from some of them."""
    if len(points) < 2:
        return _LONE_PX
    some = points[:: 1 + len(points) // 64]
    return float(np.median([np.partition(np.hypot(*(points - p).T), 1)[1] for p in some]))


def _axes(canvas: _Canvas, pose: Pose, camera: Camera, model: ViewModel) -> None:
    tips = pose.apply(model.centre_m + 0.75 * model.target_radius_m * np.eye(3))
    centre = camera.project(pose.apply(model.centre_m))
    for k in np.argsort(-tips[:, 2]):  # farther axes first
        tip = camera.project(tips[k])
        canvas.line([centre, tip], _AXES[k], 4.0, halo=True)
        if np.isfinite(tip).all():
            away = (tip - centre) / max(float(np.hypot(*(tip - centre))), 1.0) * 0.02 * camera.width
            x, y = (tip + away) * canvas.scale
            canvas.write(
                "XYZ"[k], x - 0.008 * canvas.width, y + 0.01 * canvas.width, _AXES[k], bold=True
            )


def _centre_covariance(observation: AppearanceObservation, model: ViewModel) -> Array | None:
    """(3, 3) m², camera frame, of the view centre."""
    if observation.pose is None or observation.covariance is None:
        return None
    # centre = R c + t, so d(centre) = w × (R c) + v
    arm = observation.pose.rotation @ model.centre_m
    slope = np.hstack([-hat(arm), np.eye(3)])
    return np.asarray(slope @ observation.covariance @ slope.T)


def _ellipse(
    canvas: _Canvas, observation: AppearanceObservation, camera: Camera, model: ViewModel
) -> int | None:
    """Draw one σ of the view centre in the picture, enlarged; the factor, a power of ten."""
    covariance = _centre_covariance(observation, model)
    if covariance is None or observation.pose is None:
        return None
    centre_m = observation.pose.apply(model.centre_m)
    middle = camera.project(centre_m)
    step = 1e-4 * float(np.linalg.norm(centre_m))
    slope = np.stack([(camera.project(centre_m + step * e) - middle) / step for e in np.eye(3)], 1)
    if not np.isfinite(slope).all():
        return None
    values, vectors = np.linalg.eigh(slope @ covariance @ slope.T)
    sigmas = np.sqrt(np.maximum(values, 0.0))
    if not sigmas[1] > 0.0:
        return None
    wanted = _LEAST_ELLIPSE * camera.width / float(sigmas[1])
    factor = int(10 ** max(0, math.ceil(math.log10(wanted))))
    turn = np.linspace(0.0, 2.0 * np.pi, 73)
    ring = np.stack([sigmas[0] * np.cos(turn), sigmas[1] * np.sin(turn)], 1) @ vectors.T
    canvas.line(middle + factor * ring, _SIGMA, 3.0, halo=True)
    return factor


def _status(
    canvas: _Canvas, top: int, observation: AppearanceObservation, model: ViewModel,
    factor: int | None,
) -> None:  # fmt: skip
    width = canvas.width
    left, rows = 0.025 * width, [top + k * width for k in (0.036, 0.069, 0.102)]
    bad = observation.pose is None
    mark = _PROBLEM if bad else _AXES[1]
    cv2.rectangle(
        canvas.picture, (0, top), (round(0.01 * width), canvas.picture.shape[0]), mark, -1
    )
    if observation.pose is None:
        canvas.write(f"no pose: {observation.status.value}", left, rows[0], _PROBLEM, bold=True)
        for row, text in zip(rows[1:], _wrapped(observation.reason or "", 78), strict=False):
            canvas.write(text, left, row, _INK)
        return
    centre_m = observation.pose.apply(model.centre_m)
    first, second = f"{observation.status.value}   range {np.linalg.norm(centre_m):.2f} m", ""
    covariance = _centre_covariance(observation, model)
    if covariance is not None and observation.covariance is not None:
        sight = centre_m / np.linalg.norm(centre_m)
        along = math.sqrt(max(0.0, float(sight @ covariance @ sight)))
        across = math.sqrt(max(0.0, 0.5 * (float(np.trace(covariance)) - along**2)))
        turn = math.sqrt(float(np.trace(observation.covariance[:3, :3])) / 3.0)
        first += f" ± {length(along)}"
        second = f"1 σ: across {length(across)}, attitude {math.degrees(turn):.2f}° per axis"
    if observation.confidence is not None:
        second += f"{'   ' if second else ''}confidence {100.0 * observation.confidence:.0f} %"
    canvas.write(first, left, rows[0], _INK, bold=True)
    canvas.write(second, left, rows[1], _INK)
    legend: list[tuple[str, Colour]] = []
    if model.contours is not None:
        legend += [("outline", _OUTLINE), ("inner edges", _INNER)]
    if factor is not None:
        legend.append(
            (f"1 σ of the centre × {factor}" if factor > 1 else "1 σ of the centre", _SIGMA)
        )
    x = left
    for words, colour in legend:
        y = rows[2] - 0.008 * width
        cv2.line(canvas.picture, (round(x), round(y)), (round(x + 0.03 * width), round(y)), colour,
                 max(2, round(0.004 * width)), cv2.LINE_AA)  # fmt: skip
        canvas.write(words, x + 0.038 * width, rows[2], _MUTED, size=0.85)
        x += (0.075 + 0.0125 * len(words)) * width


def length(metres: float) -> str:
    """A length with two digits and its unit: 12 mm, 3.4 cm, 1.2 m."""
    for unit, factor in (("mm", 1e3), ("cm", 1e2)):
        if metres * factor < 10.0:
            return f"{metres * factor:.2g} {unit}"
    return f"{metres:.2f} m"


def _wrapped(text: str, columns: int) -> list[str]:
    lines = [""]
    for word in text.split():
        if len(lines[-1]) + len(word) + 1 > columns and lines[-1]:
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}".strip()
    return lines
