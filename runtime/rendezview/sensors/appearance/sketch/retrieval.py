"""Which views of a model look like a sketch: all of them, at all rolls, by one matrix product."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array
from rendezview.geometry.so3 import exp
from rendezview.sensors.appearance.model import ViewModel
from rendezview.sensors.appearance.sketch.network import COVER, CREASE, EDGE, Float32s, Sketch
from rendezview.sensors.appearance.sketch.views import (
    ViewSketches,
    centroid,
    cover_of,
    on_grid,
    smoothed,
)

_NOTHING = 1e-6  # keeps quotients finite. Source: by construction

Bools = npt.NDArray[np.bool_]

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


class SketchRetrieval:
    """Starting poses for a sketch, by correlation with every view at every roll."""

    def __init__(self, model: ViewModel, sketches: ViewSketches, camera: Camera) -> None:
        self._sketches = sketches
        self._camera = camera
        self._radius_m = model.target_radius_m
        self._vectors = np.stack([_vector(maps) for maps in sketches.decoded()])
        self._partial: PartialViews | None = None  # made for the first target that is cut

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
        alike = np.stack(
            [self._alike(sketch, place, turns, allowed) for place in placements]
        )  # (placements, rolls, views)
        rotations: list[Array] = []
        centres: list[Array] = []
        turned = np.empty((most, 3, 3))
        least = 1.0 + 2.0 * np.cos(apart_rad)
        for k in np.argsort(-alike, axis=None):
            which, roll, view = np.unravel_index(k, alike.shape)
            if alike[which, roll, view] == -np.inf:
                break
            spin, (centre, size) = spins[roll], placements[which]
            rotation = spin @ self._sketches.rotation[view].astype(np.float64)
            known = turned[: len(rotations)]
            if len(known) and np.einsum("kij,ij->k", known, rotation).max() > least:
                continue
            turned[len(rotations)] = rotation
            bearing, range_m = self._placed(sketch, centre, size, int(view), spin)
            rotations.append(towards(bearing) @ rotation)
            centres.append(bearing * range_m)
            if len(rotations) == most:
                break
        return np.array(rotations).reshape(-1, 3, 3), np.array(centres).reshape(-1, 3)

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
        self, sketch: Sketch, place: tuple[Array, float], turns: Array, allowed: Bools | None
    ) -> Array:
        """(rolls, views) correlation of views at rolls with the sketch; −∞ if not allowed."""
        centre, size = place
        rolls = np.arange(len(turns)) if allowed is None else np.flatnonzero(allowed.any(1))
        alike = np.full((len(turns), len(self._vectors)), -np.inf)
        if not len(rolls):
            return alike
        maps = smoothed(sketch.maps, size)
        if sketch.is_cut:
            if self._partial is None:
                self._partial = PartialViews(self._sketches.decoded())
            within = np.ones((1, *maps.shape[1:]), np.float32)
            parts = np.concatenate([maps, within])
            asked = np.stack([_coarser(on_grid(parts, centre, size, turns[r])) for r in rolls])
            alike[rolls] = self._partial.alike(asked[:, :-1], asked[:, -1])
        else:
            asked = np.stack([_vector(on_grid(maps, centre, size, turns[r])) for r in rolls])
            alike[rolls] = asked @ self._vectors.T
        if allowed is not None:
            alike[~allowed] = -np.inf
        return alike

    def placed(self, sketch: Sketch, rotations: Array) -> Array:
        """View centres (K, 3) m that put the cover of the nearest views over the sketch's."""
        centre, size = centroid(cover_of(sketch.maps))
        ahead = towards(self._ray(sketch, centre))
        centres = []
        for rotation in rotations:
            seen = ahead.T @ rotation
            view, turn = nearest_view(self._sketches, seen)
            bearing, range_m = self._placed(
                sketch, centre, size, view, exp(np.array([0.0, 0.0, turn]))
            )
            centres.append(bearing * range_m)
        return np.array(centres).reshape(-1, 3)

    def _placed(
        self, sketch: Sketch, centre_px: Array, size_px: float, view: int, spin: Array
    ) -> tuple[Array, float]:
        """Unit direction (3,) to the view centre and its distance, for a view and its roll."""
        scale = size_px / float(self._sketches.size_radii[view])  # sketch px a target radius
        off = spin[:2, :2] @ self._sketches.centre_radii[view].astype(np.float64)
        focal = float(np.sqrt(self._camera.fx * self._camera.fy))
        range_m = focal * sketch.scale * self._radius_m / scale
        return self._ray(sketch, centre_px - scale * off), range_m

    def _ray(self, sketch: Sketch, place_px: Array) -> Array:
        """Unit direction (3,) to a place of the sketch."""
        in_frame = (place_px - np.array([sketch.left_px, sketch.top_px])) / sketch.scale
        ray = np.asarray(self._camera.rays(in_frame[None]))[0]
        return np.asarray(ray / np.linalg.norm(ray))


class PartialViews:
    """All views, for correlation with sketches of which a part lies beyond the frame."""

    def __init__(self, maps: Float32s) -> None:
        """``maps``: (V, MAPS, GRID, GRID)."""
        coarse = _coarser(maps)
        self._planes = {k: coarse[:, k].reshape(len(coarse), -1).T.copy() for k in _WEIGHTS}
        self._squares = {k: plane**2 for k, plane in self._planes.items()}
        self._spreads = {k: len(p) * p.var(0) + _NOTHING for k, p in self._planes.items()}

    def alike(self, maps: Float32s, within: Float32s) -> Float32s:
        """(R, V) weighted correlations over what lies within the frame.

        Args:
            maps: (R, MAPS, h, w) of the sketch at each roll, coarse.
            within: (R, h, w) share of the cells in the frame.
        """
        mask = np.clip(within, 0.0, 1.0).reshape(len(within), -1)
        count = mask.sum(1, keepdims=True) + _NOTHING
        alike = np.zeros((len(maps), next(iter(self._planes.values())).shape[1]), np.float32)
        for k, weight in _WEIGHTS.items():
            seen = maps[:, k].reshape(len(maps), -1)
            seen = mask * (seen - (mask * seen).sum(1, keepdims=True) / count)
            sums, squares = mask @ self._planes[k], mask @ self._squares[k]
            spread = np.maximum(squares - sums**2 / count, 0.0)
            norm = np.sqrt((seen**2).sum(1, keepdims=True) * spread)
            # What lies beyond the frame may be there: half way between asking for it and not.
            shown = np.sqrt(np.clip(spread / self._spreads[k], 0.0, 1.0)) ** _BEYOND
            alike += np.float32(weight) * shown * (seen @ self._planes[k]) / (norm + _NOTHING)
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


def _coarser(maps: Float32s) -> Float32s:
    """(…, GRID / n, GRID / n) means of n × n cells."""
    n = _COARSER
    *many, height, width = maps.shape
    cells = maps.reshape(*many, height // n, n, width // n, n)
    return np.asarray(cells.mean((-3, -1)), dtype=np.float32)


def _vector(maps: Float32s) -> Float32s:
    """The maps (MAPS, GRID, GRID) as one vector whose products are weighted correlations."""
    parts = []
    for plane, weight in _WEIGHTS.items():
        centred = maps[plane] - maps[plane].mean()
        parts.append(np.sqrt(weight) * centred.ravel() / (np.linalg.norm(centred) + 1e-6))
    return np.concatenate(parts).astype(np.float32)
