"""Which views of a model look like a sketch: all of them, at all rolls, by one matrix product."""

from __future__ import annotations

from copy import copy
from functools import cache, cached_property, partial

import numpy as np
import numpy.typing as npt

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, minimal_rotation
from rendezview.geometry.so3 import exp
from rendezview.sensors.appearance.edges.network import Box, Sketch
from rendezview.sensors.appearance.model.signature import BORESIGHT
from rendezview.sensors.appearance.model.sketches import (
    Float32s,
    ViewSketches,
    centroid,
    cover_of,
    on_grid,
    smoothed,
)
from rendezview.sensors.appearance.model.view_model import ViewModel
from rendezview.sensors.appearance.outline.retrieval import SAME_VIEW_RAD
from rendezview.sensors.appearance.search.partial_views import (
    AMONG_OTHERS,
    COARSE,
    NOTHING,
    ROUGH,
    WEIGHTS,
    PartialViews,
    coarse_grids,
    coarser,
    extents,
)

Bools = npt.NDArray[np.bool_]

_ROLLS = 40  # 9° apart; alignment converges from half of that. Source: spacing of the nodes' views
# Where the target leaves the frame: its whole size, of what is seen, and the shift of its centre
# beyond the border, of the growth. Source: experiment photo-accuracy
_CUT_SIZES = (1.0, 1.2, 1.45, 1.75, 2.1)
_CUT_SHIFTS = (0.3, 0.7, 1.1)  # Source: experiment photo-accuracy
# A box that is known roughly: sizes of covers, of the root of its area; places of their centres, of
# its sides, off its middle; and how much of a view's box and the given one is common. Source:
# docs/notes/photographs.md
_BOX_SIZES = (0.5, 0.6, 0.72, 0.86, 1.04, 1.25)
_BOX_SHIFTS = (-0.3, -0.15, 0.0, 0.15, 0.3)  # Source: the same
_LEAST_OVERLAP = 0.35  # Source: the same
_COMPARED = 600  # of 6000 placements and rolls, in finer cells. Source: the same; 480 find the same

towards = partial(minimal_rotation, BORESIGHT)  # the least turn of the boresight to (3,)


class _Tables:
    """What only some targets need of the views, made for the first of them."""

    def __init__(self, sketches: ViewSketches) -> None:
        self._sketches = sketches

    @cached_property
    def cut(self) -> PartialViews:
        """Beside targets that the frame cuts."""
        return PartialViews(self._sketches.decoded(), WEIGHTS, alone=False)

    @cached_property
    def alone(self) -> PartialViews:
        """Beside targets whose box is known."""
        return PartialViews(self._sketches.decoded(), AMONG_OTHERS, alone=True)

    @cached_property
    def rough(self) -> PartialViews:
        """The same in coarser cells."""
        return PartialViews(coarser(self._sketches.decoded()), AMONG_OTHERS, alone=True)

    @cached_property
    def extents(self) -> Array:
        """(rolls, V, 4) of ``extents``."""
        return extents(self._sketches.decoded(), _ROLLS)


class SketchRetrieval:
    """Starting poses for a sketch, by correlation with every view at every roll."""

    def __init__(self, model: ViewModel, sketches: ViewSketches, camera: Camera) -> None:
        self._sketches = sketches
        self._camera = camera
        self._radius_m = model.target_radius_m
        self._vectors = _vectors(sketches.decoded())
        self._tables = _Tables(sketches)

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
        _, spins = _rolls()
        apart_rad = SAME_VIEW_RAD
        allowed: Bools | None = None
        if near is not None:
            apart_rad = 0.5 * SAME_VIEW_RAD
            middle, _ = centroid(cover_of(sketch.maps))
            seen = towards(self._rays(sketch, middle[None])[0]).T @ near
            traces = np.einsum("rij,vjk,ik->rv", spins, self._sketches.rotation, seen)
            allowed = traces > 1.0 + 2.0 * np.cos(within_rad)
        placements = self._placements(sketch)
        alike = self._alike(sketch, placements, allowed)
        return self._likeliest(sketch, placements, alike, most, apart_rad)

    def starts_in(self, sketch: Sketch, box: Box, most: int) -> tuple[Array, Array]:
        """As ``starts``, of views that fill a box of the frame, right to a third.

        What else stands in the box does not count.
        """
        turns, _ = _rolls()
        place = sketch.scale * np.array(box) + np.tile([sketch.left_px, sketch.top_px], 2)
        middle, sides = 0.5 * (place[:2] + place[2:]), place[2:] - place[:2]
        sizes = np.array(_BOX_SIZES) * float(np.sqrt(sides.prod()))
        off = np.array(_BOX_SHIFTS)
        placements = [
            (middle + sides * (x, y), float(size)) for size in sizes for y in off for x in off
        ]
        fits = _fit(self._tables.extents, sizes, off, sides).reshape(-1, len(self._vectors))
        # Those of low correlation in coarser cells, at every other roll, are not compared in finer.
        every_other = [turns[::2]] * len(placements)
        rough = self._tables.rough.alike(*_within(sketch, placements, every_other, ROUGH))
        best = np.where(fits[::2], rough, -np.inf).max(1).reshape(len(placements), -1)
        likely = np.stack([best, 0.5 * (best + np.roll(best, -1, axis=1))], axis=-1).ravel()
        rows = np.sort(np.argpartition(-likely, _COMPARED)[:_COMPARED])
        of_each = np.searchsorted(rows, len(turns) * np.arange(1, len(placements)))
        some = np.split(turns[rows % len(turns)], of_each)
        alike: Array = np.full(fits.shape, -np.inf, np.float32)
        alike[rows] = self._tables.alone.alike(*_within(sketch, placements, some, COARSE))
        alike[~fits] = -np.inf
        each = alike.reshape(len(placements), len(turns), -1)
        return self._likeliest(sketch, placements, each, most, SAME_VIEW_RAD)

    def _likeliest(
        self, sketch: Sketch, placements: list[tuple[Array, float]], alike: Array, most: int,
        apart_rad: float,
    ) -> tuple[Array, Array]:  # fmt: skip
        """The starts that are most alike, by (placements, rolls, views)."""
        _, spins = _rolls()
        chosen = _distinct(alike, spins, self._sketches.rotation, most, apart_rad)
        which, roll, view = np.unravel_index(np.array(chosen, np.int64), alike.shape)
        middles = np.array([centre for centre, _ in placements])[which]
        sizes = np.array([size for _, size in placements])[which]
        scales = sizes / self._sketches.size_radii[view].astype(np.float64)  # px a target radius
        off = np.einsum("kij,kj->ki", spins[roll][:, :2, :2], self._sketches.centre_radii[view])
        focal = float(np.sqrt(self._camera.fx * self._camera.fy))
        ranges_m = focal * sketch.scale * self._radius_m / scales
        bearings = self._rays(sketch, middles - scales[:, None] * off)
        ahead = np.array([towards(bearing) for bearing in bearings]).reshape(-1, 3, 3)
        rotations = ahead @ spins[roll] @ self._sketches.rotation[view].astype(np.float64)
        return rotations, bearings * ranges_m[:, None]

    def likeness(self, sketch: Sketch) -> float:
        """Correlation of a sketch that shows a whole target alone with the likeliest view."""
        return float(self._alike(sketch, [centroid(cover_of(sketch.maps))], None).max())

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
        allowed: Bools | None,
    ) -> Array:
        """(placements, rolls, views) correlation of views at rolls with the sketch; −∞ if not
        allowed."""
        turns, _ = _rolls()
        rolls = np.arange(len(turns)) if allowed is None else np.flatnonzero(allowed.any(1))
        alike = np.full((len(placements), len(turns), len(self._vectors)), -np.inf)
        if not len(rolls):
            return alike
        if sketch.is_cut:
            each = [turns[rolls]] * len(placements)
            found = self._tables.cut.alike(*_within(sketch, placements, each, COARSE))
        else:
            [(centre, size)] = placements
            grids = on_grid(smoothed(sketch.maps, size), centre, size, turns[rolls])
            found = _vectors(grids) @ self._vectors.T
        alike[:, rolls] = found.reshape(len(placements), len(rolls), -1)
        if allowed is not None:
            alike[:, ~allowed] = -np.inf
        return alike

    def _rays(self, sketch: Sketch, places_px: Array) -> Array:
        """Unit directions (K, 3) to places (K, 2) of the sketch."""
        in_frame = (places_px - np.array([sketch.left_px, sketch.top_px])) / sketch.scale
        rays = np.asarray(self._camera.rays(in_frame)).reshape(-1, 3)
        return np.asarray(rays / np.linalg.norm(rays, axis=1)[:, None])


def _within(
    sketch: Sketch, placements: list[tuple[Array, float]], turns: list[Array], cells: int
) -> tuple[Float32s, Float32s]:
    """(R, MAPS, n, n) of ``coarse_grids`` and (R, n, n) what lies within: all but of cut ones."""
    grids = coarse_grids(sketch.maps, placements, turns, cells)
    if not sketch.is_cut:  # nothing of the target lies beyond
        grids[:, -1] = 1.0
    return grids[:, :-1], grids[:, -1]


def _fit(extents: Array, sizes: Array, off: Array, sides: Array) -> Bools:
    """(sizes, off y, off x, rolls, V) whether the box of a view has enough in common with a box.

    Args:
        extents: (rolls, V, 4) of covers of size 1; ``sizes``: (S,) that they have.
        off: (P,) of the sides (2,) of the box, from its middle to the centre of a cover.
    """
    boxes = (sizes[:, None, None, None] * extents).astype(np.float32)
    common = np.float32(1.0)
    for axis in (0, 1):
        first, last = boxes[:, None, ..., axis], boxes[:, None, ..., axis + 2]
        moved, half = (off * sides[axis]).astype(np.float32)[:, None, None], 0.5 * sides[axis]
        along = np.minimum(last + moved, half) - np.maximum(first + moved, -half)
        along = np.maximum(along, np.float32(0.0))
        common = common * (along[:, None] if axis == 0 else along[:, :, None])
    areas = (boxes[..., 2] - boxes[..., 0]) * (boxes[..., 3] - boxes[..., 1])
    least = _LEAST_OVERLAP / (1.0 + _LEAST_OVERLAP) * (areas + sides.prod())
    return np.asarray(common >= least[:, None, None].astype(np.float32))


@cache
def _rolls() -> tuple[Array, Array]:
    """(R,) turns of the picture, rad, and the rotations (R, 3, 3) of the camera."""
    turns = 2.0 * np.pi * np.arange(_ROLLS) / _ROLLS
    return turns, np.array([exp(np.array([0.0, 0.0, turn])) for turn in turns])


def _distinct(
    alike: Array, spins: Array, views: Float32s, most: int, apart_rad: float
) -> list[int]:
    """Flat places of the likeliest of ``alike`` (P, R, V) whose attitudes are some angle apart.

    Args:
        spins: (R, 3, 3), and ``views``: (V, 3, 3), whose product is the attitude.
    """
    best = alike.max(0).ravel()  # of all placements at an attitude
    order = np.argsort(-best, kind="stable")[: np.count_nonzero(best > -np.inf)]
    roll, view = np.unravel_index(order, alike.shape[1:])
    turned = (spins[roll] @ views[view]).reshape(-1, 9)
    least = 1.0 + 2.0 * np.cos(apart_rad)  # trace of the rotation between two
    free, kept = np.ones(len(order), bool), list[int]()
    while len(kept) < most and free.any():
        k = int(np.argmax(free))
        kept.append(k)
        free &= turned @ turned[k] <= least
    placement = alike.argmax(0).ravel()[order[kept]]
    return [int(i) for i in placement * best.size + order[kept]]


def _vectors(maps: Float32s) -> Float32s:
    """Maps (N, MAPS, GRID, GRID) as vectors (N, …) whose products are weighted correlations."""
    parts = []
    for k, weight in WEIGHTS.items():
        planes = maps[:, k].reshape(len(maps), -1)
        planes = planes - planes.mean(1, keepdims=True)
        norms = np.linalg.norm(planes, axis=1, keepdims=True) + NOTHING
        parts.append(np.sqrt(weight) * planes / norms)
    return np.concatenate(parts, 1).astype(np.float32)
