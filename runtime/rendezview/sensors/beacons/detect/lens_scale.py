"""How a lens's distortion scales small things, by their place in the picture."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array
from rendezview.sensors.beacons.detect.spot_columns import SIZE
from rendezview.sensors.beacons.detect.spots import SpotTable

_CELLS = 48  # across the longer side. Source: by construction, 0.3 % off at most
_STEP_PX = 0.5  # Source: by construction, slopes over a pixel


class LensScale:
    """The extent of a small disc beside that through a pinhole of the same focal length.

    Its root mean square over all directions, as a spot's size is, in a grid over the picture.
    """

    def __init__(self, camera: Camera, blur_px: float) -> None:
        self._blur_px = blur_px
        self._ends = np.array([camera.width - 1.0, camera.height - 1.0])
        self._grid = _grid_of(camera) if camera.is_distorted else None
        counts = np.array(np.shape(self._grid)[::-1] if self._grid is not None else (2, 2))
        self._last, self._cells = counts - 2, self._ends / (counts - 1)

    def at(self, places_px: Array) -> Array:
        """(N,) scale at places (N, 2), bilinear; NaN where a place is."""
        if self._grid is None:
            return np.ones(len(places_px))
        at = np.clip(places_px, 0.0, self._ends) / self._cells
        known = np.isfinite(at).all(axis=1)
        cell = np.minimum(np.where(known[:, None], at, 0.0).astype(int), self._last)
        x, y = (at - cell).T
        i, j = cell.T
        grid = self._grid
        return np.asarray(
            (1 - y) * ((1 - x) * grid[j, i] + x * grid[j, i + 1])
            + y * ((1 - x) * grid[j + 1, i] + x * grid[j + 1, i + 1])
        )

    def straightened(self, spots: SpotTable) -> SpotTable:
        """The spots with the sizes that they would have without distortion."""
        if self._grid is None or not len(spots):
            return spots
        table, blur2 = spots.table.copy(), self._blur_px**2
        disc = np.maximum(table[:, SIZE] ** 2 - blur2, 0.0)
        rest = table[:, SIZE] ** 2 - disc
        table[:, SIZE] = np.sqrt(rest + disc / self.at(table[:, :2]) ** 2)
        return SpotTable(table, spots.overfull)

    def distort(self, expected: Array) -> None:
        """Change the sizes (third column) of expected spots (N, 3) to those in the picture."""
        if self._grid is None:
            return
        disc = np.maximum(expected[:, 2] ** 2 - self._blur_px**2, 0.0)
        rest = expected[:, 2] ** 2 - disc
        expected[:, 2] = np.sqrt(rest + disc * self.at(expected[:, :2]) ** 2)


@lru_cache(maxsize=8)
def _grid_of(camera: Camera) -> Array:
    """(rows, columns) scale at nodes from corner to corner of the picture."""
    cell = max(camera.width, camera.height) / _CELLS
    sides = [
        np.linspace(0.0, side - 1.0, max(round(side / cell), 1) + 1)
        for side in (camera.width, camera.height)
    ]
    u, v = np.meshgrid(*sides)
    nodes = np.column_stack([u.ravel(), v.ravel()])
    ideal_by_px = np.empty((len(nodes), 2, 2))
    for axis in range(2):
        step = _STEP_PX * np.eye(2)[axis]
        ends = camera.rays(nodes + step), camera.rays(nodes - step)
        ideal_by_px[:, :, axis] = camera.fx * (ends[0] - ends[1])[:, :2] / (2.0 * _STEP_PX)
    a, b, c, d = ideal_by_px.reshape(-1, 4).T
    with np.errstate(invalid="ignore", divide="ignore"):
        scale = np.sqrt(0.5 * (a * a + b * b + c * c + d * d)) / np.abs(a * d - b * c)
    return np.where(np.isfinite(scale), scale, 1.0).reshape(u.shape)
