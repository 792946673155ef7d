"""Perturbed views: the target as a real camera sees it, at random poses."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.errors import RendezviewError
from rendezview.geometry.geodesic import Geodesic
from rendezview.geometry.pose import Array, Pose
from rendezview.sensors.appearance.outline.silhouette import (
    Missing,
    SilhouetteOptions,
    find_silhouette,
    outlines_of_mask,
)
from rendezview_ground.learn.options import TrainingOptions, ViewGeometry
from rendezview_ground.learn.views.views import (
    View,
    ViewSet,
    look_from,
    looking,
    rays,
    view,
    view_set,
)
from rendezview_ground.render.projection import Mask, SilhouetteRenderer, Window

_SHARED_DRAWING = 2  # perturbed views of one drawing, where there are many of each node
# Perturbed views a node; fewer need a drawing each. Source: test_recognizer: with 5 a node the
# trees' direction error was 5.3° with shared drawings and 3.9° without
_MANY_VIEWS = 20
# Focal length of a drawing at a sphere radius, in those of flight. Source: 1.3 samples per pixel at
# the least range, 4 at the greatest of three radii
_DRAWN_SIZE = 4.0 / 3.0
_HALVES = 4  # a drawing is halved twice. Source: 2² of the sizes of three ranges
_LEAST_SIDE_PX = 16  # px; of a view. Source: by construction
_LEAST_PX = 64  # px; a drawing is not halved below. Source: by construction
_MARGIN_PX = 24  # px of sky around a drawing; 6 px at least around a view
_SKY_GREY = 12.0  # grey levels
_TILE = 1024  # px; side of the tile of noise
_NOISE_UNITS = 256.0  # of the tile per σ. Source: by construction
# All blobs belong to the one target. The low threshold is that of flight; the high one simulates
# wires and panels that are too dim to be visible.
_THRESHOLDS = (
    SilhouetteOptions(merge_gap=10.0),
    SilhouetteOptions(merge_gap=10.0, averaged_px=1, least_contrast_grey=8.0),
)


def perturbed_views(
    renderer: SilhouetteRenderer,
    geometry: ViewGeometry,
    options: TrainingOptions,
    stream: int,
    indices: range,
) -> ViewSet:
    """Random views as a real camera sees them: range, bearing, blur, noise, threshold.

    Each drawing of the target serves several views, each with its own size in pixels, blur and
    noise.
    A drawing and its views have their own random numbers (seed, stream, number), so the views do
    not depend on the shards.
    """
    views = []
    each = _views_of_drawing(options)
    first, last = indices.start // each, (indices.stop - 1) // each
    for number in range(first, last + 1):
        rng = np.random.default_rng([options.seed, stream, number])
        drawn = _Drawing.random(renderer, geometry, options, rng)
        for part in range(each):
            picture = _Picture.random(drawn, options, rng)
            if number * each + part in indices:
                views.append(_perturbed_view(drawn, picture, geometry, options))
    return view_set(views)


def _views_of_drawing(options: TrainingOptions) -> int:
    nodes = len(Geodesic.of_order(options.order).nodes)
    return _SHARED_DRAWING if options.perturbed_views >= _MANY_VIEWS * nodes else 1


@dataclass(frozen=True, slots=True, eq=False)
class _Drawing:
    """A silhouette from a random direction, range and bearing, large in its picture."""

    direction: Array  # (3,) unit, view centre → camera
    range_m: float
    near: bool  # drawn at the least range
    rotation: Array  # (3, 3) camera_from_target
    window: Window
    halves: list[Mask]  # the picture, and the same at half the size, a quarter …

    @classmethod
    def random(
        cls,
        renderer: SilhouetteRenderer,
        geometry: ViewGeometry,
        options: TrainingOptions,
        rng: np.random.Generator,
    ) -> _Drawing:
        direction = rng.normal(size=3)
        direction /= np.linalg.norm(direction)
        rotation = look_from(direction, rng.uniform(0.0, 2.0 * np.pi))
        is_near = rng.random() < _near_fraction(options)
        near, far = options.range_radii
        radii = near if is_near else rng.uniform(near, far)
        range_m = geometry.sphere_radius_m * radii
        # off-centre bearing that keeps the target in the picture
        half = np.arctan(geometry.flight_half_px / geometry.flight_focal_px)
        room = max(0.0, half - np.arcsin(geometry.target_radius_m / range_m))
        turn = _bearing_rotation(room * rng.uniform(-0.7, 0.7, size=2))
        pose = looking(turn @ rotation, range_m, geometry, turn)
        window = _window_around(pose, geometry, _DRAWN_SIZE * radii * geometry.flight_focal_px)
        halves = [renderer.draw(pose, window)]
        while len(halves[-1]) >= 4 * _LEAST_PX:
            halves.append(_resized(halves[-1], len(halves[-1]) // 2, cv2.INTER_AREA))
        return cls(direction, range_m, is_near, pose.rotation, window, halves)

    def seen(self, focal_px: float) -> tuple[Mask, Window]:
        """The picture at about another focal length, which is that of the window."""
        side = max(_LEAST_SIDE_PX, round(self.window.width * focal_px / self.window.focal_px))
        level = min(int(np.log2(max(1.0, self.window.width / side))), len(self.halves) - 1)
        zoom = side / self.window.width
        cx, cy = (self.window.cx + 0.5) * zoom - 0.5, (self.window.cy + 0.5) * zoom - 0.5
        window = Window(side, side, self.window.focal_px * zoom, cx, cy)
        return _resized(self.halves[level], side, cv2.INTER_LINEAR), window


def _resized(picture: Mask, side: int, interpolation: int) -> Mask:
    return np.asarray(
        cv2.resize(picture, (side, side), interpolation=interpolation), dtype=np.uint8
    )


@dataclass(frozen=True, slots=True)
class _Picture:
    """How a camera sees a drawing."""

    clean: bool  # without blur and noise
    radii: float  # sphere radii; the range that the size in pixels is that of
    noise_grey: float
    blur_px: float
    level_grey: float  # of the target
    corner: tuple[int, int]  # of the tile of noise
    threshold: SilhouetteOptions

    @classmethod
    def random(
        cls, drawn: _Drawing, options: TrainingOptions, rng: np.random.Generator
    ) -> _Picture:
        clean = drawn.near and rng.random() < options.clean_fraction / _near_fraction(options)
        row, column, threshold = rng.integers(0, [_TILE, _TILE, len(_THRESHOLDS)])
        return cls(
            clean=bool(clean),
            radii=rng.uniform(*options.range_radii),
            noise_grey=options.noise_sigma_grey * rng.uniform(0.5, 1.5),
            blur_px=rng.uniform(0.4, 1.2),
            level_grey=rng.uniform(80.0, 200.0),
            corner=(int(row), int(column)),
            threshold=_THRESHOLDS[threshold],
        )


def _perturbed_view(
    drawn: _Drawing, picture: _Picture, geometry: ViewGeometry, options: TrainingOptions
) -> View:
    # its size in pixels is that of any range, its perspective that of the drawing
    focal_px = geometry.flight_focal_px * drawn.range_m / (picture.radii * geometry.sphere_radius_m)
    cover, window = drawn.seen(focal_px)
    outlines: list[Array] = []
    if not picture.clean:
        blurred = np.asarray(cv2.GaussianBlur(cover, (0, 0), picture.blur_px), dtype=np.uint8)
        gain = picture.level_grey / 255.0
        frame = exposed(
            blurred, gain, _SKY_GREY, picture.noise_grey, _noise_tile(), *picture.corner
        )
        outlines = _flight_outlines(frame, window, picture.threshold)
    if not outlines:  # noise at the border of this small window, or a dark target
        mask = np.where(cover > 127, 255, 0).astype(np.uint8)
        outlines = [rays(points, window) for points in outlines_of_mask(mask)]
    return view(drawn.direction, drawn.range_m, drawn.rotation, outlines, options)


def _near_fraction(options: TrainingOptions) -> float:
    """Share of the drawings at the least range; their views are clean or not, by chance."""
    return min(1.0, _views_of_drawing(options) * options.clean_fraction)


def _flight_outlines(frame: Mask, window: Window, threshold: SilhouetteOptions) -> list[Array]:
    """Outlines as the flight code finds them; empty if it finds no silhouette."""
    found = find_silhouette(frame, threshold)
    return [] if isinstance(found, Missing) else [rays(o, window) for o in found.outlines_px]


def _bearing_rotation(bearing_rad: Array) -> Array:
    """(3, 3) small rotation of the camera about its x and y axes."""
    return np.asarray(cv2.Rodrigues(np.array([bearing_rad[0], bearing_rad[1], 0.0]))[0])


def _window_around(pose: Pose, geometry: ViewGeometry, focal: float) -> Window:
    """A square of whole pixels of the picture plane, around the bounding sphere."""
    centre = pose.apply(geometry.centre_m)
    distance = float(np.linalg.norm(centre))
    half_angle = np.arcsin(min(1.0, geometry.target_radius_m / distance))
    off_axis = np.arctan2(np.hypot(centre[0], centre[1]), centre[2])
    if off_axis + half_angle > np.deg2rad(85.0):
        raise RendezviewError("the camera's field of view is too wide for a plane picture")
    # the widest meridian bounds the picture of the cone
    middle = centre[:2] / centre[2] * focal
    reach = focal * (np.tan(off_axis + half_angle) - np.tan(off_axis))
    half = int(np.ceil(reach)) + _MARGIN_PX
    # twice even, so that halves of it have the same field
    half = -(-half // _HALVES) * _HALVES
    low = np.round(middle) - half
    return Window(2 * half, 2 * half, focal, float(-low[0]), float(-low[1]))


_noise: npt.NDArray[np.int16] | None = None


def _noise_tile() -> npt.NDArray[np.int16]:
    """A tile of unit Gaussian noise, drawn once; a view reads it from a random corner."""
    global _noise
    if _noise is None:
        rng = np.random.default_rng(20_260_101)
        noise = rng.standard_normal((_TILE, _TILE), dtype=np.float32)
        _noise = np.rint(noise * _NOISE_UNITS).astype(np.int16)
    return _noise


@njit(cache=True, nogil=True, error_model="numpy")
def exposed(
    cover: Mask,
    gain: float,
    sky: float,
    noise: float,
    tile: npt.NDArray[np.int16],
    row: int,
    column: int,
) -> Mask:
    """8-bit frame of a coverage picture, with gain, sky level and noise from a tile.

    ``tile`` holds unit noise in 1 / 256. Whole numbers, 1 / 65,536 grey levels, are quick.
    """
    height, width = cover.shape
    side = tile.shape[0]
    frame = np.empty((height, width), dtype=np.uint8)
    steps = np.int32(np.rint(gain * 65536.0))
    base = np.int32(np.rint((sky + 0.5) * 65536.0))
    grain = np.int32(np.rint(noise * 65536.0 / _NOISE_UNITS))
    low, high = np.int32(0), np.int32(255)
    for y in range(height):
        line = tile[(y + row) % side]
        x = 0
        while x < width:  # pieces of the row within one tile
            start = (x + column) % side
            length = min(width - x, side - start)
            source, result = cover[y, x : x + length], frame[y, x : x + length]
            grains = line[start : start + length]
            for k in range(length):
                value = (np.int32(source[k]) * steps + base + np.int32(grains[k]) * grain) >> 16
                result[k] = np.uint8(min(max(value, low), high))
            x += length
    return frame
