"""The views of a model as sketches: what the network would draw of an exact craft."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from rendezview.geometry.pose import Array
from rendezview.sensors.appearance.model.container import check_shapes

COVER, EDGE, CREASE = 0, 1, 2  # maps of a sketch, probabilities
MAPS = 3  # Source: by construction
GRID = 40  # cells a side of a view's maps. Source: experiment photo-accuracy
# Half a side of the maps, of the root of the cover's area. Source: experiment photo-accuracy
REACH = 1.3
_DOUBT = 0.3  # probability; a fainter cover is none. Source: experiment photo-accuracy
_SMOOTH_CELLS = 0.5  # σ of the maps before they are read. Source: half a cell, by construction

Float32s = npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class ViewSketches:
    """V views of the target from one distance, each centred on its cover and scaled by its area."""

    rotation: npt.NDArray[np.float32]  # (V, 3, 3) camera_from_target, view centre on the boresight
    maps: npt.NDArray[np.uint8]  # (V, MAPS, GRID, GRID) probabilities × 255
    # (V, 2) the cover's centroid off the view centre, target radii at its distance, right and down
    centre_radii: npt.NDArray[np.float32]
    size_radii: npt.NDArray[np.float32]  # (V,) square root of the cover's area, in the same unit

    def check(self) -> None:
        """The arrays belong together.

        Raises:
            ValueError: they do not; which one is said.
        """
        count = len(self.size_radii)
        check_shapes(
            "sketches", self, rotation=(count, 3, 3), maps=(count, MAPS, GRID, GRID),
            centre_radii=(count, 2), size_radii=(count,),
        )  # fmt: skip
        if not (count and np.all(self.size_radii > 0.0)):
            raise ValueError("sketches.size_radii must hold positive numbers")

    def decoded(self, views: slice | int | Array = slice(None)) -> Float32s:
        """(…, MAPS, GRID, GRID) of some views, 0 … 1."""
        return self.maps[views].astype(np.float32) / np.float32(255.0)

    def deformed(self, matrix: Array) -> ViewSketches:
        """The views of the target with its points moved by a matrix (3, 3) near unity.

        Seen from afar, the moved target from direction M z looks like the target from z but for a
        linear map of the picture: directions of sight move with the points, and so do the maps.
        """
        maps = np.empty_like(self.maps)
        rotation = self.rotation.astype(np.float64)
        centre, size = self.centre_radii.astype(np.float64), self.size_radii.astype(np.float64)
        middle = np.full(2, 0.5 * (GRID - 1))
        for view, old in enumerate(rotation.copy()):
            ahead = matrix @ old[2]
            right = old[0] - ahead * (old[0] @ ahead) / (ahead @ ahead)
            new = np.stack(
                [right / np.linalg.norm(right), np.zeros(3), ahead / np.linalg.norm(ahead)]
            )
            new[1] = np.cross(new[2], new[0])
            plane = new[:2] @ matrix @ old[:2].T
            growth = float(np.sqrt(np.linalg.det(plane)))
            rotation[view], centre[view], size[view] = (
                new,
                plane @ centre[view],
                growth * size[view],
            )
            linear = plane / growth
            warp = np.column_stack([linear, middle - linear @ middle])
            for k in range(MAPS):
                maps[view, k] = cv2.warpAffine(self.maps[view, k], warp, (GRID, GRID))
        return ViewSketches(
            rotation.astype(np.float32),
            maps,
            centre.astype(np.float32),
            size.astype(np.float32),
        )


def encoded(maps: Float32s) -> npt.NDArray[np.uint8]:
    """The inverse of ``ViewSketches.decoded``, for (…, MAPS, h, w)."""
    return np.asarray(np.rint(np.clip(maps, 0.0, 1.0) * 255.0), dtype=np.uint8)


def centroid(cover: Float32s) -> tuple[Array, float]:
    """(2,) centroid of a cover (h, w), right and down, px, and the square root of its area, px."""
    area = max(float(cover.sum()), 1e-6)
    x = float(cover.sum(0) @ np.arange(cover.shape[1])) / area
    y = float(cover.sum(1) @ np.arange(cover.shape[0])) / area
    return np.array([x, y]), float(np.sqrt(area))


def smoothed(maps: Float32s, size_px: float) -> Float32s:
    """The maps (MAPS, h, w), smoothed so that cells of the grid for a size can be read off them."""
    sigma = _SMOOTH_CELLS * 2.0 * REACH * size_px / GRID
    if sigma < 0.3:  # px; a narrower kernel is none
        return maps
    return np.stack([np.asarray(cv2.GaussianBlur(plane, (0, 0), sigma)) for plane in maps])


def on_grid(
    maps: Float32s,
    centre_px: Array,
    size_px: float,
    turns_rad: npt.ArrayLike = 0.0,
    cells: int = GRID,
) -> Float32s:
    """(…, MAPS, cells, cells) around a centre, scaled by a size, turned.

    Args:
        maps: (MAPS, h, w), ``smoothed``.
        centre_px: (2,) of the grid's middle.
        size_px: square root of the cover's area.
        turns_rad: (…) the picture is the grid's content turned by this, from right to down.
        cells: a side of the grid.
    """
    turns = np.asarray(turns_rad, dtype=np.float64)
    cell = 2.0 * REACH * size_px / cells
    along = cell * (np.arange(cells) - 0.5 * (cells - 1))
    c, s = np.cos(turns)[..., None, None], np.sin(turns)[..., None, None]
    x, y = (
        (centre + off).astype(np.float32).reshape(-1, cells)
        for centre, off in zip(
            centre_px, (c * along - s * along[:, None], s * along + c * along[:, None]), strict=True
        )
    )
    planes = cv2.merge([np.ascontiguousarray(plane) for plane in maps])
    grid = np.asarray(cv2.remap(planes, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT))
    grid = grid.reshape(*turns.shape, cells, cells, len(maps))
    return np.ascontiguousarray(np.moveaxis(grid, -1, -3), dtype=np.float32)


def cover_of(maps: Float32s) -> Float32s:
    """The cover (h, w) without faint doubts far from the target."""
    return np.where(maps[COVER] > _DOUBT, maps[COVER], np.float32(0.0))
