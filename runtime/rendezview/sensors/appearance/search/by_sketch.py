"""Which views of a model look like a sketch: all of them, at all rolls, by one matrix product."""

from __future__ import annotations

from copy import copy

import cv2
import numpy as np
import numpy.typing as npt

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array
from rendezview.geometry.so3 import exp
from rendezview.sensors.appearance.edges.network import Sketch
from rendezview.sensors.appearance.model.sketches import (
    COVER,
    CREASE,
    EDGE,
    GRID,
    REACH,
    Float32s,
    ViewSketches,
    centroid,
    cover_of,
    on_grid,
    smoothed,
)
from rendezview.sensors.appearance.model.view_model import ViewModel

_NOTHING = 1e-6  # keeps quotients finite. Source: by construction

Bools = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]

_ROLLS = 40  # 9° apart; alignment converges from half of that. Source: spacing of the nodes' views
# Weights of the correlations of each map. Source: experiment photo-accuracy
_WEIGHTS = {COVER: 1.0, EDGE: 1.0, CREASE: 0.6}
# Where the target leaves the frame: its whole size, of what is seen, and the shift of its centre
# beyond the border, of the growth. Source: experiment photo-accuracy
_CUT_SIZES = (1.0, 1.2, 1.45, 1.75, 2.1)
_CUT_SHIFTS = (0.3, 0.7, 1.1)  # Source: experiment photo-accuracy
# 0: views are judged by what the frame shows alone; 1: by all of them, as if nothing lay beyond.
_BEYOND = 0.5  # Source: experiments photo-accuracy and sketch-confidence
_COARSER = 2  # cells of the grid a cell where targets are cut. Source: by construction, its cost
# Source: spacing of the nodes' views
_SAME_RAD = np.deg2rad(7.0)  # rad; nearer views lead to the same pose
_SORTED = 16384  # likeliest views and rolls that are looked through. Source: by construction
_BLOCK = 512  # of them are compared with each other at once. Source: its cost


class SketchRetrieval:
    """Starting poses for a sketch, by correlation with every view at every roll."""

    def __init__(self, model: ViewModel, sketches: ViewSketches, camera: Camera) -> None:
        self._sketches = sketches
        self._camera = camera
        self._radius_m = model.target_radius_m
        self._vectors = _vectors(sketches.decoded())
        self._partial: PartialViews | None = None  # made for the first target that is cut

    def with_camera(self, camera: Camera) -> SketchRetrieval:
        """The same for sketches of another camera's frames."""
        other = copy(self)
        other._camera = camera
        return other

    def starts(
        self, sketch: Sketch, most: int, near: Array | None = None, within_rad: float = np.pi
    ) -> tuple[Array, Array]:
        """Rotations (K, 3, 3) camera_from_target and view centres (K, 3) m, the likeliest first.

        ``near``: (3, 3) an attitude; only others ``within_rad`` of it are given, finer spaced.
        """
        turns = 2.0 * np.pi * np.arange(_ROLLS) / _ROLLS
        spins = np.array([exp(np.array([0.0, 0.0, turn])) for turn in turns])
        apart_rad = _SAME_RAD
        allowed: Bools | None = None
        if near is not None:
            apart_rad = 0.5 * _SAME_RAD
            seen = towards(self._ray(sketch, centroid(cover_of(sketch.maps))[0])).T @ near
            traces = np.einsum("rij,vjk,ik->rv", spins, self._sketches.rotation, seen)
            allowed = traces > 1.0 + 2.0 * np.cos(within_rad)
        placements = self._placements(sketch)
        alike = self._alike(sketch, placements, turns, allowed)
        chosen = _distinct(alike, spins, self._sketches.rotation, most, apart_rad)
        which, roll, view = np.unravel_index(np.array(chosen, np.int64), alike.shape)
        middles = np.array([centre for centre, _ in placements])[which]
        sizes = np.array([size for _, size in placements])[which]
        bearings, ranges_m = self._placed(sketch, middles, sizes, view, spins[roll])
        ahead = np.array([towards(bearing) for bearing in bearings]).reshape(-1, 3, 3)
        rotations = ahead @ spins[roll] @ self._sketches.rotation[view].astype(np.float64)
        return rotations, bearings * ranges_m[:, None]

    def likeness(self, sketch: Sketch) -> float:
        """Correlation of a sketch that shows a whole target alone with the likeliest view."""
        turns = 2.0 * np.pi * np.arange(_ROLLS) / _ROLLS
        return float(self._alike(sketch, [centroid(cover_of(sketch.maps))], turns, None).max())

    def _placements(self, sketch: Sketch) -> list[tuple[Array, float]]:
        """Centre and size (root of the area) of the cover, px; guesses of both where it is cut."""
        centre, size = centroid(cover_of(sketch.maps))
        if not sketch.is_cut:
            return [(centre, size)]
        return [
            (centre + shift * (f - 1.0) * size * sketch.rest, f * size)
            for f in _CUT_SIZES
            for shift in (_CUT_SHIFTS if f > 1.0 else _CUT_SHIFTS[:1])
        ]

    def _alike(
        self,
        sketch: Sketch,
        placements: list[tuple[Array, float]],
        turns: Array,
        allowed: Bools | None,
    ) -> Array:
        """(placements, rolls, views) correlation of views at rolls with the sketch; −∞ if not
        allowed."""
        rolls = np.arange(len(turns)) if allowed is None else np.flatnonzero(allowed.any(1))
        alike = np.full((len(placements), len(turns), len(self._vectors)), -np.inf)
        if not len(rolls):
            return alike
        if sketch.is_cut:
            if self._partial is None:
                self._partial = PartialViews(self._sketches.decoded())
            grids = _partly(sketch.maps, placements, turns[rolls])
            found = self._partial.alike(grids[:, :-1], grids[:, -1])
        else:
            [(centre, size)] = placements
            grids = on_grid(smoothed(sketch.maps, size), centre, size, turns[rolls])
            found = _vectors(grids) @ self._vectors.T
        alike[:, rolls] = found.reshape(len(placements), len(rolls), -1)
        if allowed is not None:
            alike[:, ~allowed] = -np.inf
        return alike

    def placed(self, sketch: Sketch, rotations: Array) -> Array:
        """View centres (K, 3) m that put the cover of the nearest views over the sketch's."""
        centre, size = centroid(cover_of(sketch.maps))
        ahead = towards(self._ray(sketch, centre))
        views = np.empty(len(rotations), np.int64)
        spins = np.empty((len(rotations), 3, 3))
        for k, rotation in enumerate(rotations):
            views[k], turn = nearest_view(self._sketches, ahead.T @ rotation)
            spins[k] = exp(np.array([0.0, 0.0, turn]))
        many = len(rotations)
        bearings, ranges_m = self._placed(
            sketch, np.tile(centre, (many, 1)), np.full(many, size), views, spins
        )
        return bearings * ranges_m[:, None]

    def _placed(
        self, sketch: Sketch, centres_px: Array, sizes_px: Array, views: Ints, spins: Array
    ) -> tuple[Array, Array]:
        """Unit directions (K, 3) to the view centres and their distances (K,), for covers at
        ``centres_px`` (K, 2) of ``sizes_px`` (K,), shown by ``views`` at rolls ``spins``."""
        # Sketch px a target radius.
        scales = sizes_px / self._sketches.size_radii[views].astype(np.float64)
        off = np.einsum("kij,kj->ki", spins[:, :2, :2], self._sketches.centre_radii[views])
        focal = float(np.sqrt(self._camera.fx * self._camera.fy))
        ranges_m = focal * sketch.scale * self._radius_m / scales
        return self._rays(sketch, centres_px - scales[:, None] * off), ranges_m

    def _ray(self, sketch: Sketch, place_px: Array) -> Array:
        """Unit direction (3,) to a place of the sketch."""
        return np.asarray(self._rays(sketch, place_px[None])[0])

    def _rays(self, sketch: Sketch, places_px: Array) -> Array:
        """Unit directions (K, 3) to places (K, 2) of the sketch."""
        in_frame = (places_px - np.array([sketch.left_px, sketch.top_px])) / sketch.scale
        rays = np.asarray(self._camera.rays(in_frame)).reshape(-1, 3)
        return np.asarray(rays / np.linalg.norm(rays, axis=1)[:, None])


class PartialViews:
    """All views, for correlation with sketches of which a part lies beyond the frame."""

    def __init__(self, maps: Float32s) -> None:
        """``maps``: (V, MAPS, GRID, GRID)."""
        coarse = _coarser(maps)
        planes = np.stack([coarse[:, k].reshape(len(coarse), -1).T for k in _WEIGHTS])
        self._planes = np.ascontiguousarray(planes)  # (maps, cells, views)
        self._squares = self._planes**2
        self._spreads = planes.shape[1] * planes.var(1) + _NOTHING

    def alike(self, maps: Float32s, within: Float32s) -> Float32s:
        """(R, V) weighted correlations over what lies within the frame.

        Args:
            maps: (R, MAPS, h, w) of the sketch at each roll, coarse.
            within: (R, h, w) share of the cells in the frame.
        """
        mask = np.clip(within, 0.0, 1.0).reshape(len(within), -1)
        count = mask.sum(1, keepdims=True) + _NOTHING
        alike = np.zeros((len(maps), self._planes.shape[2]), np.float32)
        parts = zip(_WEIGHTS.items(), self._planes, self._squares, self._spreads, strict=True)
        for (k, weight), planes, squares, whole in parts:
            seen = maps[:, k].reshape(len(maps), -1)
            seen = mask * (seen - (mask * seen).sum(1, keepdims=True) / count)
            sums = mask @ planes
            spread = np.maximum(mask @ squares - sums * sums / count, 0.0)
            norm = np.sqrt((seen**2).sum(1, keepdims=True) * spread)
            # What lies beyond the frame may be there: half way between asking for it and not.
            shown = np.sqrt(np.minimum(spread / whole, 1.0)) ** _BEYOND
            alike += np.float32(weight) * shown * (seen @ planes) / (norm + _NOTHING)
        return alike


def nearest_view(views: ViewSketches, ahead: Array) -> tuple[int, float]:
    """The view nearest to an attitude (3, 3) of a camera that looks at the target, and its roll."""
    view = int(np.argmax(views.rotation[:, 2] @ ahead[2]))
    between = ahead @ views.rotation[view].astype(np.float64).T
    turn = np.arctan2(between[1, 0] - between[0, 1], between[0, 0] + between[1, 1])
    return view, float(turn)


def towards(bearing: Array) -> Array:
    """(3, 3) the least rotation that turns the boresight to a unit direction (3,)."""
    axis = np.array([-bearing[1], bearing[0], 0.0])
    sine = float(np.linalg.norm(axis))
    if sine < 1e-12:
        return np.eye(3)
    return np.asarray(exp(axis / sine * np.arctan2(sine, bearing[2])))


def _distinct(
    alike: Array, spins: Array, views: Float32s, most: int, apart_rad: float
) -> list[int]:
    """Flat places of the likeliest of ``alike`` (P, R, V) whose attitudes are some angle apart.

    Args:
        spins: (R, 3, 3), and ``views``: (V, 3, 3), whose product is the attitude.
    """
    flat = alike.ravel()
    likely = np.argpartition(-flat, min(_SORTED, len(flat) - 1))[:_SORTED]
    order = likely[np.argsort(-flat[likely], kind="stable")]
    least = 1.0 + 2.0 * np.cos(apart_rad)  # trace of the rotation between two
    kept: list[int] = []
    known = np.empty((most, 9))
    for start in range(0, len(order), _BLOCK):
        block = order[start : start + _BLOCK]
        _, roll, view = np.unravel_index(block, alike.shape)
        turned = (spins[roll] @ views[view]).reshape(-1, 9)
        free = flat[block] > -np.inf
        if kept:
            free &= (turned @ known[: len(kept)].T).max(1) <= least
        apart = turned @ turned.T <= least
        while len(kept) < most and free.any():
            k = int(np.argmax(free))
            known[len(kept)] = turned[k]
            kept.append(int(block[k]))
            free &= apart[k]
            free[k] = False
        if len(kept) == most or not np.isfinite(flat[block[-1]]):
            break
    return kept


def _coarser(maps: Float32s) -> Float32s:
    """(…, GRID / n, GRID / n) means of n × n cells."""
    n = _COARSER
    *many, height, width = maps.shape
    cells = maps.reshape(*many, height // n, n, width // n, n)
    return np.asarray(cells.mean((-3, -1)), dtype=np.float32)


def _partly(maps: Float32s, placements: list[tuple[Array, float]], turns: Array) -> Float32s:
    """(P R, MAPS + 1, n, n) a sketch on the coarser grid at each place and turn, nothing beyond
    the frame; the last map is the share of each cell that lies within."""
    cells = GRID // _COARSER
    planes = np.concatenate([maps, np.ones((1, *maps.shape[1:]), np.float32)])
    means: dict[int, Float32s] = {}
    grids = []
    for centre, size in placements:
        side = 2 * round(REACH * size / cells) + 1  # odd: the mean lies where it is read
        if side not in means:  # over a cell; those half beyond the border are read, too
            border = (side, side, side, side)
            wider = [cv2.copyMakeBorder(p, *border, cv2.BORDER_CONSTANT) for p in planes]
            means[side] = np.stack([np.asarray(cv2.blur(p, (side, side))) for p in wider])
        grids.append(on_grid(means[side], centre + side, size, turns, cells))
    return np.concatenate(grids)


def _vectors(maps: Float32s) -> Float32s:
    """Maps (N, MAPS, GRID, GRID) as vectors (N, …) whose products are weighted correlations."""
    parts = []
    for k, weight in _WEIGHTS.items():
        planes = maps[:, k].reshape(len(maps), -1)
        planes = planes - planes.mean(1, keepdims=True)
        norms = np.linalg.norm(planes, axis=1, keepdims=True) + _NOTHING
        parts.append(np.sqrt(weight) * planes / norms)
    return np.concatenate(parts, 1).astype(np.float32)
