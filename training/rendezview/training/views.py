"""Training views: clean views of the lattice, and perturbed views as a real camera sees them."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Array, Pose
from rendezview.sensors.appearance.model import FAR_RADII
from rendezview.sensors.appearance.outline.signature import Readings, Signature
from rendezview.sensors.appearance.outline.silhouette import (
    Missing,
    SilhouetteOptions,
    find_silhouette,
    outlines_of_mask,
)
from rendezview.training.options import TrainingOptions, ViewGeometry
from rendezview.training.projection import Mask, SilhouetteRenderer, Window

_SUPERSAMPLING = 2  # samples per pixel side of perturbed views
_MARGIN_PX = 6  # px of sky around a perturbed view
_SKY_GREY = 12.0  # grey levels
_TILE = 1024  # px; side of the tile of noise
# All blobs belong to the one target. The low threshold is that of flight; the high one simulates
# wires and panels that are too dim to be visible.
_THRESHOLDS = (
    SilhouetteOptions(merge_gap=10.0),
    SilhouetteOptions(merge_gap=10.0, averaged_px=1, least_contrast_grey=8.0),
)


@dataclass(frozen=True, slots=True, eq=False)
class ViewSet:
    """Signatures of K views and their view directions."""

    direction: Array  # (K, 3) unit, view centre → camera, target frame
    range_m: Array  # (K,) view centre to camera
    centred_from_target: Array  # (K, 3, 3)
    readings: Readings  # (K, N) smoothed
    area_sr: Array  # (K,)
    offset_m: Array  # (K, 2) view centre off the centroid's line of sight

    def __len__(self) -> int:
        return len(self.range_m)

    @classmethod
    def joined(cls, parts: list[ViewSet]) -> ViewSet:
        """Join several sets."""
        return cls(
            *(
                np.concatenate([getattr(p, name) for p in parts])
                for name in cls.__dataclass_fields__
            )
        )


def look_from(direction: Array, roll_rad: float = 0.0) -> Array:
    """(3, 3) attitude of a camera that looks at the view centre from a unit direction (3,).

    At roll 0 the target's +z is up in the picture (+x within 26° of the poles). This is a
    convention: every comparison uses the roll between two views.
    """
    up = np.array([0.0, 0.0, 1.0]) if abs(direction[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
    rotation = np.empty((3, 3))
    _look(np.asarray(direction, dtype=np.float64), up, roll_rad, rotation)
    return rotation


@njit(cache=True, nogil=True)
def _look(direction: Array, up: Array, roll_rad: float, rotation: Array) -> None:
    z = -direction
    x = np.cross(-up, z)
    x /= np.sqrt(np.sum(x * x))
    y = np.cross(z, x)
    c, s = np.cos(roll_rad), np.sin(roll_rad)
    rotation[0] = c * x - s * y
    rotation[1] = s * x + c * y
    rotation[2] = z


def clean_views(
    renderer: SilhouetteRenderer,
    geometry: ViewGeometry,
    options: TrainingOptions,
    directions: Array,
    range_radii: float = 1.0,
) -> ViewSet:
    """Noiseless views from given directions (K, 3), in which the target fills the picture."""
    size = geometry.resolution_px
    range_m = geometry.sphere_radius_m * range_radii
    tangent = np.tan(np.arcsin(geometry.target_radius_m / range_m))
    middle = 0.5 * (size - 1)
    window = Window(size, size, (0.5 * size - 4.0) / tangent, middle, middle)
    views = []
    for direction in directions:
        rotation = look_from(direction)
        mask = renderer.draw(_looking(rotation, range_m, geometry), window)
        outlines = [_rays(points, window) for points in outlines_of_mask(mask)]
        views.append(_view(direction, range_m, rotation, outlines, options))
    return _view_set(views)


def lattice_slopes(near: ViewSet, far: ViewSet, geometry: ViewGeometry) -> Array:
    """(V,) relative change of ``area_sr × range²`` with sphere radius / range, per view."""
    near_m2, far_m2 = near.area_sr * near.range_m**2, far.area_sr * far.range_m**2
    change = 1.0 - geometry.sphere_radius_m / far.range_m
    return np.asarray((near_m2 - far_m2) / (near_m2 * change))


def far_views(
    renderer: SilhouetteRenderer,
    geometry: ViewGeometry,
    options: TrainingOptions,
    directions: Array,
) -> ViewSet:
    """Clean views from four sphere radii, where perspective is weak."""
    return clean_views(renderer, geometry, options, directions, FAR_RADII)


def perturbed_views(
    renderer: SilhouetteRenderer,
    geometry: ViewGeometry,
    options: TrainingOptions,
    stream: int,
    indices: range,
) -> ViewSet:
    """Random views as a real camera sees them: range, bearing, blur, noise, threshold.

    Each view has its own random numbers (seed, stream, index), so the views do not depend on the
    shards.
    """
    return _view_set(
        [
            _perturbed_view(
                renderer, geometry, options, np.random.default_rng([options.seed, stream, index])
            )
            for index in indices
        ]
    )


_View = tuple[Array, float, Array, Readings, float, Array]


def _perturbed_view(
    renderer: SilhouetteRenderer,
    geometry: ViewGeometry,
    options: TrainingOptions,
    rng: np.random.Generator,
) -> _View:
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    rotation = look_from(direction, rng.uniform(0.0, 2.0 * np.pi))
    clean = rng.random() < options.clean_fraction
    near, far = options.range_radii
    radii = near if clean else rng.uniform(near, far)
    noise = options.noise_sigma_grey * rng.uniform(0.5, 1.5)
    blur_px = rng.uniform(0.4, 1.2)
    level = rng.uniform(80.0, 200.0)
    corner = rng.integers(0, _TILE, size=2)
    threshold = _THRESHOLDS[int(rng.integers(len(_THRESHOLDS)))]
    range_m = geometry.sphere_radius_m * radii
    # off-centre bearing that keeps the target in the picture
    half = np.arctan(geometry.flight_half_px / geometry.flight_focal_px)
    room = max(0.0, half - np.arcsin(geometry.target_radius_m / range_m))
    bearing = room * rng.uniform(-0.7, 0.7, size=2)
    turn = _bearing_rotation(bearing)
    turned = turn @ rotation
    pose = _looking(turned, range_m, geometry, turn)
    window = _window_around(pose, geometry)
    if clean:
        mask = renderer.draw(pose, window)
        outlines = [_rays(points, window) for points in outlines_of_mask(mask)]
        return _view(direction, range_m, turned, outlines, options)
    drawn = renderer.draw(pose, window.supersampled(_SUPERSAMPLING))
    cover = cv2.resize(drawn, (window.width, window.height), interpolation=cv2.INTER_AREA)
    blurred = np.asarray(cv2.GaussianBlur(cover, (0, 0), blur_px), dtype=np.uint8)
    frame = exposed(blurred, level / 255.0, _SKY_GREY, noise, _noise_tile(), corner[0], corner[1])
    outlines = _flight_outlines(frame, window, threshold)
    if not outlines:  # noise at the border of this small window, or a dark target
        mask = np.where(cover > 127, 255, 0).astype(np.uint8)
        outlines = [_rays(points, window) for points in outlines_of_mask(mask)]
    return _view(direction, range_m, turned, outlines, options)


def _flight_outlines(frame: Mask, window: Window, threshold: SilhouetteOptions) -> list[Array]:
    """Outlines as the flight code finds them; empty if it finds no silhouette."""
    found = find_silhouette(frame, threshold)
    return [] if isinstance(found, Missing) else [_rays(o, window) for o in found.outlines_px]


def _looking(
    rotation: Array, range_m: float, geometry: ViewGeometry, bearing: Array | None = None
) -> Pose:
    """camera_from_target of a camera that sees the view centre at a range and a bearing."""
    sight = np.array([0.0, 0.0, range_m])
    if bearing is not None:
        sight = bearing @ sight
    return Pose(rotation, sight - rotation @ geometry.centre_m)


def _bearing_rotation(bearing_rad: Array) -> Array:
    """(3, 3) small rotation of the camera about its x and y axes."""
    return np.asarray(cv2.Rodrigues(np.array([bearing_rad[0], bearing_rad[1], 0.0]))[0])


def _window_around(pose: Pose, geometry: ViewGeometry) -> Window:
    """The part of the picture plane that the bounding sphere covers, in whole pixels."""
    focal = geometry.flight_focal_px
    centre = pose.apply(geometry.centre_m)
    distance = float(np.linalg.norm(centre))
    half_angle = np.arcsin(min(1.0, geometry.target_radius_m / distance))
    off_axis = np.arctan2(np.hypot(centre[0], centre[1]), centre[2])
    if off_axis + half_angle > np.deg2rad(85.0):
        raise RendezviewError("the camera's field of view is too wide for a plane picture")
    # the widest meridian bounds the picture of the cone
    middle = centre[:2] / centre[2] * focal
    reach = focal * (np.tan(off_axis + half_angle) - np.tan(off_axis))
    low = np.floor(middle - reach) - _MARGIN_PX
    high = np.ceil(middle + reach) + _MARGIN_PX
    width, height = (high - low + 1).astype(int)
    return Window(int(width), int(height), focal, float(-low[0]), float(-low[1]))


def _rays(points_px: Array, window: Window) -> Array:
    """Undistorted rays (M, 3) of pixels of a window."""
    rays = np.ones((len(points_px), 3))
    rays[:, 0] = (points_px[:, 0] - window.cx) / window.focal_px
    rays[:, 1] = (points_px[:, 1] - window.cy) / window.focal_px
    return rays


def _view(
    direction: Array,
    range_m: float,
    camera_rotation: Array,
    outlines: list[Array],
    options: TrainingOptions,
) -> _View:
    signature = Signature.of_outlines(outlines, options.bins, options.smooth_bins)
    if signature is None:
        raise RendezviewError(
            "the target is invisible from one side: it is flat or too thin for the "
            f"resolution of the views; its direction is {np.round(direction, 3).tolist()}"
        )
    centred = signature.centred_from_camera @ camera_rotation
    centre = -range_m * (centred @ direction)
    offset_m = centre[:2] / centre[2] * range_m
    return direction, range_m, centred, signature.readings, signature.area_sr, offset_m


def _view_set(views: list[_View]) -> ViewSet:
    return ViewSet(*(np.array(column) for column in zip(*views, strict=True)))


_noise: npt.NDArray[np.float32] | None = None


def _noise_tile() -> npt.NDArray[np.float32]:
    """A tile of unit Gaussian noise, drawn once; a view reads it from a random corner."""
    global _noise
    if _noise is None:
        rng = np.random.default_rng(20_260_101)
        _noise = rng.standard_normal((_TILE, _TILE), dtype=np.float32)
    return _noise


@njit(cache=True, nogil=True)
def exposed(
    cover: npt.NDArray[np.uint8],
    gain: float,
    sky: float,
    noise: float,
    tile: npt.NDArray[np.float32],
    row: int,
    column: int,
) -> npt.NDArray[np.uint8]:
    """8-bit frame of a coverage picture, with gain, sky level and noise from a tile."""
    height, width = cover.shape
    side = tile.shape[0]
    frame = np.empty((height, width), dtype=np.uint8)
    gain32, sky32, noise32 = np.float32(gain), np.float32(sky + 0.5), np.float32(noise)
    low, high = np.float32(0.0), np.float32(255.0)
    for y in range(height):
        line, source, result = tile[(y + row) % side], cover[y], frame[y]
        x = 0
        while x < width:  # pieces of the row within one tile
            start = (x + column) % side
            length = min(width - x, side - start)
            for k in range(length):
                value = source[x + k] * gain32 + sky32 + noise32 * line[start + k]
                result[x + k] = np.uint8(min(max(value, low), high))
            x += length
    return frame
