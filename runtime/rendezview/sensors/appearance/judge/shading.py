"""Shading: the brightness of the target's surface under the best light, beside the image.

The model stores, for every surface point, which nodes of a sphere see it. The same table gives
visibility from the camera and shadow from the Sun. The light is fitted to the points that a pose
shows, and their expected brightness is correlated with the grey levels in small windows, each about
its own means, since foil is not diffuse; and over the whole target, where one side may be black.
This separates half turns and other poses whose edges are alike.
"""

from __future__ import annotations

from copy import copy
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.estimation.linear_algebra import copy_into, quantile
from rendezview.geometry.camera import Camera
from rendezview.geometry.lens import distorted, lens_vector
from rendezview.geometry.pose import Array, Pose
from rendezview.geometry.so3 import rotate_back_into, rotate_into
from rendezview.io.grey_frame import Picture
from rendezview.sensors.appearance.edges.lighting import (
    BEHIND,
    BRIGHT_PERCENTILE,
    ROUNDS,
    light_strengths,
)
from rendezview.sensors.appearance.model.contours import DIRECTION_UNIT, POINT_UNIT
from rendezview.sensors.appearance.model.surface import ALBEDO_UNIT, Surface
from rendezview.sensors.appearance.model.view_model import ViewModel
from rendezview.sensors.appearance.model.view_tables import Lens, read_only
from rendezview.sensors.appearance.sky import Sky

_WINDOWS = 18  # across the target. Source: by hand, seeds of docs/notes/refinement.md
_LEAST_WINDOW_PX = 5.0  # px, a side. Source: by hand, seeds of docs/notes/refinement.md
_LEAST_IN_WINDOW = 5  # points. Source: by hand, seeds of docs/notes/refinement.md
LEAST_POINTS = 60  # visible, or pixels. Source: by hand, seeds of docs/notes/refinement.md
# points at most, to which the light is fitted. Source: by construction, a bound of time
_FITTED = 240
# Of the level of the bright points: less contrast in both counts as agreement. Source: by hand,
# seeds of docs/notes/refinement.md
_EVEN = 0.06
# Of the level of the bright points; a larger difference is an outlier (glints). Source: by hand,
# seeds of docs/notes/refinement.md
_TOLERANCE = 0.4
# Nodes of each level of the sphere, and how near to the best one before, as a cosine: the nodes
# of a level lie 32°, 16° and 8° apart. Source: by construction, 0.8 of the level before
_SUN_LEVELS = ((42, -2.0), (162, np.cos(np.deg2rad(25.0))), (642, np.cos(np.deg2rad(13.0))))
# Cosine between a given Sun and the nodes that represent it. Source: spacing of the nodes, 8°
_NEAR_SUN = 0.99
_NOTHING = 1e-6  # grey levels squared; keeps quotients finite. Source: by construction
_EDGE_ON = 0.08  # cosine; surfaces closer to edge-on are left out. Source: by construction, 5°
# rad; of the 642 directions.
_NODE_SPACING_RAD = 0.15  # Source: by construction, mean edge of a sphere of order 3, 8.6°


class SurfaceTables(NamedTuple):
    """The surface of one model as the compiled loops read it."""

    point: Array  # (3, P) metres: coordinates apart, so that loops become vectors
    normal: Array  # (P, 3)
    albedo: Array  # (P,)
    seen: npt.NDArray[np.uint8]
    nodes: Array  # (S, 3)
    radius_m: float

    @classmethod
    def of(cls, surface: Surface, radius_m: float) -> SurfaceTables:
        """Unpacked."""
        return cls(
            np.ascontiguousarray(surface.point.T.astype(np.float64) * (POINT_UNIT * radius_m)),
            surface.normal.astype(np.float64) * DIRECTION_UNIT,
            surface.albedo.astype(np.float64) * ALBEDO_UNIT,
            read_only(surface.seen),
            read_only(surface.sphere.nodes),
            radius_m,
        )


FRONT = np.array([0.0, 0.0, -1.0])  # a Sun behind the camera. Source: by construction


class Shade(NamedTuple):
    """How the surface points of a pose agree with a frame."""

    agreement: float  # −1 … 1, in small windows
    sun_camera: Array  # (3,) unit, towards the Sun that fits best, camera frame; 0: too few points

    @property
    def sun(self) -> Array:
        """(3,) the same; behind the camera where the points do not tell."""
        return self.sun_camera if self.sun_camera.any() else FRONT


class Shading:
    """Agreement of bright and dark with poses of one model, in the frames of one camera."""

    def __init__(self, model: ViewModel, camera: Camera) -> None:
        """The surface is unpacked once."""
        self._surface = None
        if model.surface is not None:
            self._surface = SurfaceTables.of(model.surface, model.target_radius_m)
        self._centre_m = model.centre_m
        self._lens = (lens_vector(camera), camera.is_distorted)

    def with_camera(self, camera: Camera) -> Shading:
        """The same in the frames of another camera."""
        other = copy(self)
        other._lens = (lens_vector(camera), camera.is_distorted)
        return other

    def of(self, image: Picture, sky: Sky, pose: Pose) -> Shade | None:
        """Agreement in small windows and its Sun; None where the model has no surface."""
        if self._surface is None:
            return None
        centre, sun = pose.apply(self._centre_m), np.zeros(3)
        within, _ = shading(
            image, self._lens, sky.vector, self._surface, pose.rotation.copy(), centre, sun
        )
        return Shade(float(within), sun)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def shading(
    image: Picture, lens: Lens, frame: Array, surface: SurfaceTables, rotation: Array,
    centre: Array, sun: Array,
) -> tuple[float, float]:  # fmt: skip
    """Correlations of the grey levels with the expected brightness of a pose, −1 … 1.

    Under the light that fits best: in windows of an eighteenth of the target, each about its own
    means, and over the whole target. 0 where few points are visible.

    Args:
        image: (H, W) uint8.
        lens: ``lens_vector`` of the camera, and whether it distorts.
        frame: (6,) as in ``Sky.vector``.
        rotation: (3, 3), and ``centre``: (3,) of the view centre, camera frame.
        sun: (3,) gets the direction to the Sun, camera frame; it begins as 0.
    """
    most = surface.point.shape[1]
    which = np.empty(most, dtype=np.int64)
    u, v = np.empty(most), np.empty(most)
    facing = np.empty((most, 3))  # normals on the side of the camera, camera frame
    levels = np.empty(most)
    black = frame[1] if frame[2] > 0.0 else 0.0
    found = visible_points(
        image, lens, surface, rotation, centre, black, which, u, v, facing, levels
    )
    if found < LEAST_POINTS:
        return 0.0, 0.0
    every, behind = 1 + found // _FITTED, -BEHIND * np.sqrt(_dot(centre, centre))
    kept = (found + every - 1) // every
    some, albedo, sunlit = np.empty(kept), np.empty(kept), np.empty(kept)
    for k in range(kept):
        some[k], albedo[k] = levels[k * every], surface.albedo[which[k * every]]
    tolerance = _TOLERANCE * quantile(some, 0.01 * BRIGHT_PERCENTILE) + frame[0]
    strengths, chosen, tried, middle = np.empty(2), np.zeros(2), np.empty(3), np.empty(3)
    node, rounds = int(np.int64(-1)), int(np.int64(ROUNDS))  # literals: numba would compile copies
    known, best = frame[3] != 0.0 or frame[4] != 0.0 or frame[5] != 0.0, np.inf
    for nodes, near in _SUN_LEVELS:
        copy_into(sun, middle)
        for s in range(min(nodes, surface.nodes.shape[0])):
            rotate_into(rotation, surface.nodes[s], tried)
            if known:
                if tried[0] * frame[3] + tried[1] * frame[4] + tried[2] * frame[5] < _NEAR_SUN:
                    continue
            elif _dot(tried, centre) > behind or (near > -1.0 and _dot(tried, middle) < near):
                continue
            for k in range(kept):
                sunlit[k] = _brightness(surface, s, which[k * every], facing[k * every], tried)
            cost = light_strengths(
                some, sunlit, albedo, tolerance, np.inf, strengths, rounds, False
            )
            if cost < best:
                best, node = cost, s
                copy_into(tried, sun)
                copy_into(strengths, chosen)
    if node < 0:
        return 0.0, 0.0
    side = max(2.0 * surface.radius_m * lens[0][0] / centre[2] / _WINDOWS, _LEAST_WINDOW_PX)
    # Before a bright sky, evenness may be the sky's own.
    even = (_EVEN * quantile(some, 0.01 * BRIGHT_PERCENTILE)) ** 2 if frame[2] > 0.0 else 0.0
    return _correlations(surface, which, u, v, facing, levels, found, node, sun, chosen, side, even)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, inline="always")
def _dot(a: Array, b: Array) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]  # type: ignore[no-any-return]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def _brightness(surface: SurfaceTables, node: int, point: int, normal: Array, sun: Array) -> float:
    """Albedo times the cosine to the Sun of a point, 0 in shadow."""
    cosine = _dot(normal, sun)
    if cosine <= 0.0 or not (surface.seen[node, point >> 3] >> (point & 7)) & 1:
        return 0.0
    return surface.albedo[point] * cosine  # type: ignore[no-any-return]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def _mean_level(image: Picture, u: float, v: float) -> float:
    """Grey level at a pixel, a mean of 3 × 3."""
    column, row = int(u + 0.5), int(v + 0.5)
    total = 0
    for i in range(-1, 2):
        for j in range(-1, 2):
            total += image[row + i, column + j]
    return total / 9.0


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def visible_points(
    image: Picture, lens: Lens, surface: SurfaceTables, rotation: Array, centre: Array,
    black: float, which: npt.NDArray[np.int64], u: Array, v: Array, facing: Array, levels: Array,
) -> int:  # fmt: skip
    """The surface points that a pose shows in the image; how many.

    Args:
        which, u, v, facing, levels: get the index of each, its pixel, its normal on the side of the
            camera (3,), camera frame, and its grey level above black, a mean of 3 × 3.
    """
    height, width = image.shape
    camera = lens[0]
    away = np.empty(3)  # from the camera to the view centre, target axes
    rotate_back_into(rotation, centre, away)
    distance = np.sqrt(_dot(away, away))
    # The node nearest to the line of sight of a point is one of those near the camera.
    reach = np.arcsin(min(1.0, surface.radius_m / distance)) + _NODE_SPACING_RAD
    cosine = np.cos(min(reach, 3.1)) * distance
    nodes, normal, seen = surface.nodes, surface.normal, surface.seen
    px, py, pz = surface.point[0], surface.point[1], surface.point[2]
    nearest = np.full(len(px), -1, dtype=np.int64)
    most = np.full(len(px), -np.inf)
    for s in range(nodes.shape[0]):
        s0, s1, s2 = nodes[s, 0], nodes[s, 1], nodes[s, 2]
        towards_eye = -(s0 * away[0] + s1 * away[1] + s2 * away[2])
        if towards_eye <= cosine:
            continue
        for k in range(len(px)):  # no branches: the compiler makes vectors of it
            along = towards_eye - s0 * px[k] - s1 * py[k] - s2 * pz[k]
            closer = along > most[k]
            most[k] = along if closer else most[k]
            nearest[k] = s if closer else nearest[k]
    found = 0
    for k in range(len(px)):
        if nearest[k] < 0 or not (seen[nearest[k], k >> 3] >> (k & 7)) & 1:
            continue
        x = centre[0] + rotation[0, 0] * px[k] + rotation[0, 1] * py[k] + rotation[0, 2] * pz[k]
        y = centre[1] + rotation[1, 0] * px[k] + rotation[1, 1] * py[k] + rotation[1, 2] * pz[k]
        z = centre[2] + rotation[2, 0] * px[k] + rotation[2, 1] * py[k] + rotation[2, 2] * pz[k]
        if z <= 0.0:
            continue
        m0, m1, m2 = normal[k, 0], normal[k, 1], normal[k, 2]
        n0 = rotation[0, 0] * m0 + rotation[0, 1] * m1 + rotation[0, 2] * m2
        n1 = rotation[1, 0] * m0 + rotation[1, 1] * m1 + rotation[1, 2] * m2
        n2 = rotation[2, 0] * m0 + rotation[2, 1] * m1 + rotation[2, 2] * m2
        towards = -(n0 * x + n1 * y + n2 * z)
        if towards * towards < _EDGE_ON * _EDGE_ON * (x * x + y * y + z * z):
            continue
        way = 1.0 if towards > 0.0 else -1.0
        a, b = x / z, y / z
        if lens[1]:
            a, b = distorted(a, b, camera)
        pu, pv = camera[0] * a + camera[2], camera[1] * b + camera[3]
        if not (pu > 1.0 and pv > 1.0 and pu < width - 2.0 and pv < height - 2.0):
            continue
        which[found], u[found], v[found] = k, pu, pv
        levels[found] = _mean_level(image, pu, pv) - black
        facing[found, 0], facing[found, 1], facing[found, 2] = way * n0, way * n1, way * n2
        found += 1
    return found


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def _correlations(
    surface: SurfaceTables, which: npt.NDArray[np.int64], u: Array, v: Array, facing: Array,
    levels: Array, found: int, node: int, sun: Array, strengths: Array, side: float, even: float,
) -> tuple[float, float]:  # fmt: skip
    """Of the levels with the expected ones: within windows of ``side`` pixels, and over all.

    ``even``: a variance, grey levels squared, that both have in common: where neither shows any
    contrast, they agree.
    """
    left, right, top, bottom = u[0], u[0], v[0], v[0]
    for k in range(found):
        left, right = min(left, u[k]), max(right, u[k])
        top, bottom = min(top, v[k]), max(bottom, v[k])
    columns = int((right - left) / side) + 1
    rows = int((bottom - top) / side) + 1
    sums = np.zeros((rows * columns, 6))
    for k in range(found):
        window = int((v[k] - top) / side) * columns + int((u[k] - left) / side)
        point = which[k]
        bright = strengths[0] * _brightness(surface, node, point, facing[k], sun)
        bright += strengths[1] * surface.albedo[point]
        s = sums[window]
        s[0] += 1.0
        s[1] += levels[k]
        s[2] += bright
        s[3] += levels[k] * levels[k]
        s[4] += bright * bright
        s[5] += levels[k] * bright
    whole, within, count = np.zeros(6), np.zeros(3), 0.0
    for window in range(len(sums)):
        s = sums[window]  # iterated, numba would compile another copy of what is called
        for k in range(6):
            whole[k] += s[k]
        if s[0] >= _LEAST_IN_WINDOW:
            count += s[0]
            _add_moments(s, within)
    over = np.zeros(3)
    _add_moments(whole, over)
    return _correlation_of(within, count * even), _correlation_of(over, found * even)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def _add_moments(sums: Array, moments: Array) -> None:
    """Add sums of squares and of products about the means, from ``sums`` (6,) of 1 a b a² b² ab."""
    moments[0] += sums[3] - sums[1] * sums[1] / sums[0]
    moments[1] += sums[4] - sums[2] * sums[2] / sums[0]
    moments[2] += sums[5] - sums[1] * sums[2] / sums[0]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def _correlation_of(moments: Array, same: float) -> float:
    """From ``_add_moments``; ``same`` is a sum of squares that both have in common."""
    both = (moments[0] + same + _NOTHING) * (moments[1] + same + _NOTHING)
    return (moments[2] + same) / np.sqrt(both)  # type: ignore[no-any-return]
