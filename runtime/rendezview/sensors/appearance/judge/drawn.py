"""Drawn evidence: how well the picture that a pose predicts explains the frame.

The craft is drawn at the pose, with cast shadows, under the Sun that fits the frame best, beside
uniform light from all around. What is left is a robust cost of each independent cell, so that two
poses are compared where their pictures differ (``rivals``). Every pose has its own Sun: a
half-turned craft under the other pose's Sun would look worse than it can.
"""

from __future__ import annotations

import math
from copy import copy
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.geometry.camera import Camera
from rendezview.geometry.geodesic import Geodesic
from rendezview.geometry.pose import Array, Pose, minimal_rotation
from rendezview.geometry.so3 import rotate_back_into
from rendezview.geometry.zbuffer import draw_from_afar, draw_perspective, empty_buffers
from rendezview.io.grey_frame import WHITE_GREY, Picture
from rendezview.sensors.appearance.edges.lighting import TOLERANCE, light_strengths
from rendezview.sensors.appearance.judge.gloss import GLOSS_ORDER, add_gloss
from rendezview.sensors.appearance.judge.shading import LEAST_POINTS
from rendezview.sensors.appearance.model.shape import Shape
from rendezview.sensors.appearance.model.surface import ALBEDO_UNIT
from rendezview.sensors.appearance.model.view_model import ViewModel
from rendezview.sensors.appearance.sky import Sky

Float32s = npt.NDArray[np.float32]
Indices = npt.NDArray[np.intp]

# Of the target as it is drawn, at most. Source: of 192 Mitsuba frames of eight craft 60 px leave
# 158 right, 9 wrong; 120 px 160, 7
_RADIUS_PX = 120.0
# Half a side of the drawn part. Source: by construction, all of it and a border
_WINDOW_RADII, _WINDOW_MORE_PX = 1.25, 6.0
# Side of the shadow map, and half of it. Source: by construction, its pixel is one of the picture
_SHADOW_PX, _SHADOW_RADII = 160, 1.05
# Of its pixels: nearer surfaces do not shade each other; its 3 × 3 pixels lie on a slope. Source:
# by construction, the diagonal of 3 × 3; docs/notes/rivals.md
_SHADOW_DEPTH_PX, _SHADOW_REACH_PX, _SHADOW_MOST_PX = 0.5, 1.6, 16.0
# σ: small errors of the pose count little. Source: docs/notes/rivals.md, 1.5 is no better
_OBSERVED_BLUR_PX, _DRAWN_BLUR_PX = 0.8, 1.0
_BRIGHT_QUANTILE = 0.9  # of the levels where the craft is. Source: by construction, not the glints
# Of the target's radius: errors of neighbouring pixels are alike. Source: fixed with DRAWN_WEIGHT
_CELLS_ACROSS = 20.0
# Of the two strengths of light: twelve come within 1 % of 200. Source: by construction, of time
_ROUNDS, _LIGHT_SAMPLES = 12, 2000
# The compared pixels reach so far beyond the craft. Source: by construction, three σ of blur
_AROUND_PX = 3
# σ: the sky beside the craft, behind it. Source: by construction, a fifth of its radius
_SKY_BLUR_PX = 12.0
# σ before a picture is shrunk, of the times. Source: by construction, squares of as many have 0.29
_SHRUNK_BLUR = 0.4
# Of the hexagons in which a Sun is looked for: from less than half the spacing of the first
# directions down to where shadows move by a pixel. Source: docs/notes/rivals.md
_SUN_STEPS_RAD = np.deg2rad([12.0, 6.0, 3.0, 1.5])
_MOST_SUN_MOVES = 3  # of each size. Source: docs/notes/rivals.md
# Directions of a hemisphere that are tried first. Source: by construction, 30° apart
_SUNS = 24
# Of the target's radius; triangles are clipped there. Source: by construction
_NEAR_RADII = 1e-3


def _evenly(count: int) -> Array:
    """(N, 3) directions over the hemisphere about +z, on a spiral."""
    height, turn = 1.0 - (np.arange(count) + 0.5) / count, np.pi * (3.0 - math.sqrt(5.0))
    across, angle = np.sqrt(1.0 - height**2), turn * np.arange(count)
    return np.stack([across * np.cos(angle), across * np.sin(angle), height], axis=1)


_HEMISPHERE = _evenly(_SUNS)


@dataclass(frozen=True, slots=True, eq=False)
class Explained:
    """What a pose leaves unexplained of a frame."""

    cells: Array  # (K,) what it leaves of each independent cell of the window, 0 … 1
    picture: Float32s  # (H, W) the levels that it predicts
    sun_camera: Array  # (3,) unit, towards the Sun that fits best

    @property
    def cost(self) -> float:
        """Independent cells that it does not explain."""
        return float(self.cells.sum())


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """The part of a frame about the craft, as a camera without distortion would see it smaller."""

    levels: Float32s  # (H, W) above black
    fx: float
    fy: float
    cx: float
    cy: float
    tolerance_grey: float
    white_grey: float  # above black, from which a level is a lower bound
    cell_px: float  # pixels of an independent cell
    sky: Float32s  # (H, W) levels as they are expected beside the craft
    seen: Indices  # (M,) pixels that are compared
    cells: Indices  # (H W,) the cell of every pixel
    blurred: tuple[slice, slice]  # rows and columns that blur may bring to them

    def beside(self, drawn: list[Drawn]) -> Window:
        """The same for poses that are compared: where one of them has the craft.

        The sky is interpolated from around all of them.
        """
        anywhere = np.zeros(self.levels.shape, np.uint8)
        for one in drawn:
            anywhere.ravel()[one.where] = 1
        near = cv2.dilate(anywhere, np.ones((2 * _AROUND_PX + 1,) * 2, np.uint8))
        free = (1 - near).astype(np.float32)
        size = (0, 0), _SKY_BLUR_PX
        weight = cv2.GaussianBlur(free, *size)
        blurred = cv2.GaussianBlur(free * self.levels, *size) / np.maximum(weight, 1e-6)
        sky = np.where(weight > 1e-3, blurred, 0.0).astype(np.float32)
        seen = np.flatnonzero(near.ravel())
        left, top, width, height = cv2.boundingRect(near)
        part = _reached(top, height), _reached(left, width)
        return replace(self, sky=sky, seen=seen, blurred=part)


class DrawnEvidence:
    """Draws one model at poses, in the frames of one camera."""

    def __init__(self, shape: Shape, model: ViewModel, camera: Camera) -> None:
        """The mesh is unpacked once."""
        self._vertices = np.ascontiguousarray(shape.vertices_m, dtype=np.float64)
        self._faces = np.ascontiguousarray(shape.faces)
        corners = self._vertices[shape.faces]
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        length = np.linalg.norm(cross, axis=1, keepdims=True)
        self._normals = np.ascontiguousarray(cross / np.maximum(length, 1e-30))
        self._albedo = shape.albedo.astype(np.float64) * ALBEDO_UNIT
        self._facets = Geodesic.of_order(GLOSS_ORDER).nearest(self._normals)
        self.centre_m, self._radius_m = model.centre_m, model.target_radius_m
        self._camera = camera

    def with_camera(self, camera: Camera) -> DrawnEvidence:
        """The same in the frames of another camera."""
        other = copy(self)
        other._camera = camera
        return other

    def window(self, image: Picture, sky: Sky, pose: Pose) -> Window:
        """The part of a frame (H, W) about a pose, for it and its rivals."""
        camera, centre = self._camera, pose.apply(self.centre_m)
        radius_px = camera.fx * self._radius_m / float(np.linalg.norm(centre))
        times = max(1.0, radius_px / _RADIUS_PX)
        half = math.ceil((_WINDOW_RADII * radius_px + _WINDOW_MORE_PX) / times)
        fx, fy = camera.fx / times, camera.fy / times
        cx, cy = half - fx * centre[0] / centre[2], half - fy * centre[1] / centre[2]
        black = sky.level_grey if sky.dark else 0.0
        levels = self._undistorted(image, 2 * half + 1, (fx, fy, cx, cy), times, black)
        levels = cv2.GaussianBlur(levels, (0, 0), _OBSERVED_BLUR_PX) - np.float32(black)
        drawn, _ = self._geometry(pose, levels.shape, fx, fy, cx, cy)
        seen = levels[drawn > 0.0]
        bright = float(np.quantile(seen, _BRIGHT_QUANTILE)) if len(seen) else 0.0
        tolerance = TOLERANCE * max(bright, 0.0) + sky.noise_grey
        white, cell_px = WHITE_GREY - black, (radius_px / times / _CELLS_ACROSS) ** 2
        nothing, all_of_it = np.zeros_like(levels), np.arange(levels.size)
        cells = _cells_of(len(levels), cell_px)
        whole = slice(None), slice(None)
        return Window(
            levels, fx, fy, cx, cy, tolerance, white, cell_px, nothing, all_of_it, cells, whole
        )

    def _undistorted(
        self, image: Picture, side: int, intrinsics: tuple[float, ...], times: float, black: float
    ) -> Float32s:
        """(side, side) of a frame, as a pinhole camera with other intrinsics would take it."""
        fx, fy, cx, cy = intrinsics
        camera, k = self._camera, np.arange(side)
        x, y = (k - cx) / fx, (k - cy) / fy
        if camera.is_distorted:
            directions = np.ones((side, side, 3))
            directions[..., 0], directions[..., 1] = x, y[:, None]
            u, v = np.moveaxis(camera.project(directions), -1, 0)
        else:
            u, v = camera.fx * x + camera.cx, (camera.fy * y + camera.cy)[:, None]
        margin = math.ceil(2.0 * times)
        left, top = (max(math.floor(places.min()) - margin, 0) for places in (u, v))
        right, bottom = (math.ceil(places.max()) + margin for places in (u, v))
        part = image[top : max(bottom, top + 1), left : max(right, left + 1)].astype(np.float32)
        if part.size == 0:
            return np.full((side, side), black, np.float32)
        if times > 1.0:
            part = np.asarray(cv2.GaussianBlur(part, (0, 0), _SHRUNK_BLUR * times))
        at = np.empty((side, side, 2), np.float32)
        at[..., 0], at[..., 1] = u - left, v - top
        return np.asarray(
            cv2.remap(part, at[..., 0], at[..., 1], cv2.INTER_LINEAR,
                      borderMode=cv2.BORDER_CONSTANT, borderValue=black)
        )  # fmt: skip

    def drawn(self, window: Window, pose: Pose) -> Drawn | None:
        """The craft at a pose (camera_from_target); None where too little lies in the window."""
        nearness, owner = self._geometry(
            pose, window.levels.shape, window.fx, window.fy, window.cx, window.cy
        )
        where = np.flatnonzero(owner.ravel() >= 0)
        if len(where) < LEAST_POINTS:
            return None
        points, normals = np.empty((len(where), 3)), np.empty((len(where), 3))
        intrinsics = np.array([window.fx, window.fy, window.cx, window.cy])
        rotation, centre = pose.rotation.copy(), pose.apply(self.centre_m)
        _surface_at(where, nearness, owner, intrinsics, rotation, centre, self._normals,
                    points, normals)  # fmt: skip
        faces = owner.ravel()[where]
        albedo, facets = self._albedo[faces], self._facets[faces]
        places = 2.0 * np.stack(np.divmod(where, len(owner))[::-1], axis=1) / len(owner) - 1.0
        return Drawn(self, window, pose, where, places, points, normals, albedo, facets)

    def _geometry(
        self, pose: Pose, shape: tuple[int, ...], fx: float, fy: float, cx: float, cy: float
    ) -> tuple[Float32s, npt.NDArray[np.int32]]:
        """(H, W) nearness (1/z) and faces of the craft at a pose."""
        nearness, owner = empty_buffers(*shape)
        vertices = self._vertices @ pose.rotation.T + pose.apply(self.centre_m)
        near_m = _NEAR_RADII * self._radius_m
        draw_perspective(vertices, self._faces, fx, fy, cx, cy, near_m, nearness, owner)
        return nearness, owner

    def shadow_map(self, sun: Array) -> tuple[Float32s, Array]:
        """Heights towards a Sun (3,), target axes; its axes (3, 3), pixels a metre."""
        tilt = minimal_rotation(sun, np.array([0.0, 0.0, 1.0]))
        scale = _SHADOW_PX / (2.0 * _SHADOW_RADII * self._radius_m)
        height, _ = draw_from_afar(self._vertices, self._faces, tilt, scale, _SHADOW_PX)
        return height, scale * tilt


@dataclass(frozen=True, slots=True, eq=False)
class Drawn:
    """One pose in one window, under any Sun: N pixels of the craft."""

    evidence: DrawnEvidence
    window: Window
    pose: Pose
    where: Indices  # (N,) pixels of the window
    places: Array  # (N, 2) columns and rows from its middle, in halves of a side
    points: Array  # (N, 3) m from the view centre, target axes
    normals: Array  # (N, 3) towards the camera
    albedo: Array  # (N,)
    facets: Indices  # (N,) their directions, of the sphere of gloss

    def under(self, sun_camera: Array) -> Explained:
        """What stays unexplained under a Sun (3,)."""
        window, sunlit = self.window, self.sunlit(sun_camera)
        seen = window.levels.ravel()[self.where].astype(np.float64)
        tolerance, (sun, around) = window.tolerance_grey, self._light(seen, sunlit)
        levels = np.minimum(sun * sunlit + around * self.albedo, window.white_grey)
        add_gloss(self.places, self.facets, sunlit, seen, tolerance, window.cell_px, levels)
        drawn = window.sky.copy()
        drawn.ravel()[self.where] = levels
        part = drawn[window.blurred]
        part[:] = cv2.GaussianBlur(part, (0, 0), _DRAWN_BLUR_PX)
        cells = np.zeros(window.cells[-1] + 1)
        _unexplained(window.levels, drawn, window.seen, window.cells, tolerance, cells)
        return Explained(cells / window.cell_px, drawn, sun_camera)

    def _light(self, seen: Array, sunlit: Array) -> Array:
        """(2,) strengths of the Sun and around, of both optima that which explains (N,) levels."""
        window, every = self.window, len(seen) // _LIGHT_SAMPLES + 1
        some, lit, albedo = (np.ascontiguousarray(x[::every]) for x in (seen, sunlit, self.albedo))
        tolerance, white, found = window.tolerance_grey, window.white_grey, np.empty((2, 2))
        costs = [
            light_strengths(some, lit, albedo, tolerance, white, found[k], _ROUNDS, k == 1)
            for k in range(2)
        ]
        return np.asarray(found[int(np.argmin(costs))])

    def under_best_sun(self, seen: Explained, *, near: bool = False) -> Explained:
        """Under the Sun that explains the frame best, in front of the target or as ``seen``.

        ``near``: about that one only.
        """
        if not near:
            towards = minimal_rotation(
                np.array([0.0, 0.0, 1.0]), -self.pose.apply(self.evidence.centre_m)
            )
            seen = min([seen, *map(self.under, _HEMISPHERE @ towards.T)], key=cost_of)
        for step_rad in _SUN_STEPS_RAD:
            for _ in range(_MOST_SUN_MOVES):
                around = [self.under(sun) for sun in _beside(seen.sun_camera, step_rad)]
                best = min([seen, *around], key=cost_of)
                if best is seen:
                    break
                seen = best
        return seen

    def sunlit(self, sun_camera: Array) -> Array:
        """(N,) albedo times the cosine to a Sun (3,), 0 in shadow."""
        sun = self.pose.rotation.T @ sun_camera
        depth, axes = self.evidence.shadow_map(sun)
        sunlit = np.empty(len(self.where))
        _sunlit(self.points, self.normals, self.albedo, sun, axes, depth, sunlit)
        return sunlit


def cost_of(explained: Explained) -> float:
    return explained.cost


def _beside(sun: Array, angle_rad: float) -> Array:
    """(6, 3) directions at an angle from one, as a hexagon."""
    across = minimal_rotation(np.array([0.0, 0.0, 1.0]), sun)[:, :2]
    turns = np.pi / 3.0 * np.arange(6)
    ring = np.stack([np.cos(turns), np.sin(turns)])
    return np.asarray(math.cos(angle_rad) * sun + math.sin(angle_rad) * (across @ ring).T)


def _reached(start: int, length: int) -> slice:
    """Pixels from which blur reaches some in a row."""
    margin = math.ceil(5.0 * _DRAWN_BLUR_PX)
    return slice(max(start - margin, 0), start + length + margin)


def _cells_of(side: int, cell_px: float) -> Indices:
    """(side²,) the cell of each pixel of a square picture, counted by rows."""
    across = max(1, round(math.sqrt(cell_px)))
    cell = np.arange(side) // across
    return np.asarray(np.add.outer((cell[-1] + 1) * cell, cell).ravel())


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _unexplained(
    levels: Float32s, drawn: Float32s, seen: Indices, cells_of: Indices, tolerance: float,
    cells: Array,
) -> None:  # fmt: skip
    """Add r² / (1 + r²) of some pixels (Geman and McClure 1987) to their cells (K,)."""
    levels, drawn = levels.ravel(), drawn.ravel()
    for k in range(len(seen)):
        r = (levels[seen[k]] - drawn[seen[k]]) / tolerance
        cells[cells_of[seen[k]]] += r * r / (1.0 + r * r)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _surface_at(
    where: npt.NDArray[np.intp], nearness: Float32s, owner: npt.NDArray[np.int32],
    intrinsics: Array, rotation: Array, centre: Array, face_normals: Array, points: Array,
    normals: Array,
) -> None:  # fmt: skip
    """Fill points and normals (N, 3), target axes, of pixels ``where``; see ``Drawn``."""
    width = owner.shape[1]
    eye, q = np.empty(3), np.empty(3)
    for i in range(3):
        q[i] = -centre[i]
    rotate_back_into(rotation, q, eye)
    for k in range(len(where)):
        row, column = where[k] // width, where[k] % width
        z = 1.0 / nearness[row, column]
        q[0] = (column - intrinsics[2]) * z / intrinsics[0] - centre[0]
        q[1] = (row - intrinsics[3]) * z / intrinsics[1] - centre[1]
        q[2] = z - centre[2]
        rotate_back_into(rotation, q, points[k])
        normal = face_normals[owner[row, column]]
        towards = 0.0
        for i in range(3):
            towards += normal[i] * (eye[i] - points[k, i])
        for i in range(3):
            normals[k, i] = normal[i] if towards >= 0.0 else -normal[i]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _sunlit(
    points: Array, normals: Array, albedo: Array, sun: Array, axes: Array, depth: Float32s,
    out: Array,
) -> None:  # fmt: skip
    """Fill ``out`` (N,): albedo times the cosine to the Sun, 0 in shadow; see ``shadow_map``."""
    size = depth.shape[0]
    for k in range(len(out)):
        out[k] = 0.0
        cosine = normals[k, 0] * sun[0] + normals[k, 1] * sun[1] + normals[k, 2] * sun[2]
        if cosine <= 0.0:
            continue
        x, y, z = points[k, 0], points[k, 1], points[k, 2]
        u = axes[0, 0] * x + axes[0, 1] * y + axes[0, 2] * z + 0.5 * size
        v = axes[1, 0] * x + axes[1, 1] * y + axes[1, 2] * z + 0.5 * size
        w = axes[2, 0] * x + axes[2, 1] * y + axes[2, 2] * z + 1.5 * size
        slope = np.sqrt(max(1.0 - cosine * cosine, 0.0)) / cosine
        w += min(_SHADOW_DEPTH_PX + _SHADOW_REACH_PX * slope, _SHADOW_MOST_PX)
        # All of the target lies four pixels within the map.
        i0, j0 = min(max(int(v + 0.5), 1), size - 2), min(max(int(u + 0.5), 1), size - 2)
        bright = 0
        for i in range(i0 - 1, i0 + 2):
            for j in range(j0 - 1, j0 + 2):
                bright += depth[i, j] < w
        out[k] = albedo[k] * cosine * bright / 9.0
