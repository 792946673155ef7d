"""Views beside a sketch of which only a part is the target, or shows a part of it: correlations."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from rendezview.geometry.pose import Array
from rendezview.sensors.appearance.model.sketches import (
    COVER,
    CREASE,
    EDGE,
    GRID,
    REACH,
    Float32s,
    on_grid,
)

# Weights of the correlations of each map. Source: experiment photo-accuracy
WEIGHTS = {COVER: 1.0, EDGE: 1.0, CREASE: 0.6}
# The same of what stands among other things, whose covers run together. Without covers fewer poses
# are right. Source: drawn rooms and photographs (docs/notes/photographs.md)
AMONG_OTHERS = WEIGHTS | {COVER: 0.5}
# 0: views are judged by what the frame shows alone; 1: by all of them, as if nothing lay beyond.
_BEYOND = 0.5  # Source: experiments photo-accuracy and sketch-confidence
_COARSER = 2  # cells of the grid a cell. Source: by construction, its cost
COARSE = GRID // _COARSER  # cells a side
ROUGH = COARSE // _COARSER  # of views that are made ``coarser`` once more
_COVERED = 0.25  # share of a coarse cell that makes it the target's. Source: by construction
_FAINT = 0.05  # probability; a fainter contrast in a sketch is none. Source: by construction
NOTHING = 1e-6  # keeps quotients finite. Source: by construction


class PartialViews:
    """All views, for correlation with the part of a sketch that the frame shows.

    ``alone``: only over each view's own cover and the cells next to it; what stands beside or
    behind the target, and joins its cover, does not count then.
    """

    def __init__(self, maps: Float32s, weights: dict[int, float], *, alone: bool) -> None:
        """``maps``: (V, MAPS, GRID, GRID)."""
        coarse, self._weights = coarser(maps), weights
        # (cells, views), or (cells, 1) where it is the same of all views.
        self._area = np.ones((coarse[0, COVER].size, 1), np.float32)
        if alone:
            covers = (coarse[:, COVER] > _COVERED).astype(np.uint8)
            around = [cv2.dilate(cover, np.ones((3, 3), np.uint8)) for cover in covers]
            self._area = _as_columns(np.array(around, np.float32))
        self._planes = [self._area * _as_columns(coarse[:, k]) for k in weights]
        self._squares = [self._area * planes**2 for planes in self._planes]
        count = self._area.sum(0)
        self._whole = [
            squares.sum(0) - planes.sum(0) ** 2 / count + NOTHING
            for planes, squares in zip(self._planes, self._squares, strict=True)
        ]

    def alike(self, maps: Float32s, within: Float32s) -> Float32s:
        """(R, V) weighted correlations over what lies within the frame.

        Args:
            maps: (R, MAPS, h, w) of the sketch at each roll, coarse.
            within: (R, h, w) share of the cells in the frame.
        """
        mask = np.clip(within, 0.0, 1.0).reshape(len(within), -1)
        if mask.min() == 1.0:
            mask = mask[:1]  # all sums of the views are the same then
        area = self._area
        count = mask @ area + NOTHING
        alike = np.zeros((len(maps), self._whole[0].size), np.float32)
        parts = zip(self._weights.items(), self._planes, self._squares, self._whole, strict=True)
        for (k, weight), planes, squares, whole in parts:
            plain = maps[:, k].reshape(len(maps), -1)
            seen = mask * plain
            seen_sum, sums = seen @ area, mask @ planes
            spread = np.maximum(mask @ squares - sums * sums / count, 0.0)
            power = (
                np.maximum((seen * plain) @ area - seen_sum * seen_sum / count, 0.0)
                + _FAINT**2 * count
            )
            # What lies beyond the frame may be there: half way between asking for it and not.
            shown = np.sqrt(np.minimum(spread / whole, 1.0)) ** _BEYOND
            together = seen @ planes - seen_sum * sums / count
            alike += np.float32(weight) * shown * together / (np.sqrt(power * spread) + NOTHING)
        return alike


def extents(maps: Float32s, turns: int) -> Array:
    """(turns, V, 4) left, top, right, bottom of views' covers, of the root of their areas.

    Args:
        maps: (V, MAPS, GRID, GRID), a picture is turned from right to down as in ``on_grid``.
        turns: a multiple of four; turn k is 2 π k / turns.
    """
    cell = 2.0 * REACH / GRID
    along = cell * (np.arange(GRID) - 0.5 * (GRID - 1))
    angles = 2.0 * np.pi * np.arange(turns) / turns
    towards = np.stack([np.cos(angles), np.sin(angles)])
    reach = np.zeros((turns, len(maps)))  # of each cover in each direction
    for view, cover in enumerate(maps[:, COVER]):
        rows, columns = np.nonzero(cover > 0.5 * cover.max())
        if len(rows):
            places = np.column_stack([along[columns], along[rows]])
            reach[:, view] = (places @ towards).max(0) + 0.5 * cell
    # Turned by an angle, a cover reaches to the right as far as it did in the opposite direction.
    right, below, left, above = (
        reach[(quarter * turns // 4 - np.arange(turns)) % turns] for quarter in range(4)
    )
    return np.stack([-left, -above, right, below], axis=-1)


def coarse_grids(
    maps: Float32s, placements: list[tuple[Array, float]], turns: list[Array], cells: int
) -> Float32s:
    """(R, MAPS + 1, cells, cells) a sketch at each place and its turns, nothing beyond the frame;
    the last map is the share of each cell that lies within."""
    planes = np.concatenate([maps, np.ones((1, *maps.shape[1:]), np.float32)])
    means: dict[int, Float32s] = {}
    grids = []
    for (centre, size), some in zip(placements, turns, strict=True):
        if not len(some):
            continue
        side = 2 * round(REACH * size / cells) + 1  # odd: the mean lies where it is read
        if side not in means:  # over a cell; those half beyond the border are read, too
            border = (side, side, side, side)
            wider = [cv2.copyMakeBorder(p, *border, cv2.BORDER_CONSTANT) for p in planes]
            means[side] = np.stack([np.asarray(cv2.blur(p, (side, side))) for p in wider])
        grids.append(on_grid(means[side], centre + side, size, some, cells))
    return np.concatenate(grids)


def _as_columns(planes: npt.NDArray[np.float32]) -> Float32s:
    """(cells, V) of planes (V, h, w)."""
    return np.ascontiguousarray(planes.reshape(len(planes), -1).T, dtype=np.float32)


def coarser(maps: Float32s) -> Float32s:
    """(…, GRID / n, GRID / n) means of n × n cells."""
    n = _COARSER
    parts = (maps[..., i::n, j::n] for i in range(n) for j in range(n))
    return np.asarray(sum(parts) / np.float32(n * n), dtype=np.float32)
