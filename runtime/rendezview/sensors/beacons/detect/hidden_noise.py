"""Noise that the steps between neighbouring pixels do not show: compression, moved texture.

A centroid averages over its spot, so what counts is the noise of an average. White noise of a pixel
tells it only if there is nothing slower. A background that moves between lit and dark leaves a
smooth pattern in the difference; JPEG (and MJPEG) takes the fast noise away and leaves multiples of
its quantisation steps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from rendezview.geometry.pose import Array
from rendezview.sensors.beacons.detect.difference import Grey, LitDark, background_of, noise_grey
from rendezview.sensors.beacons.detect.spot_columns import (
    AMPLITUDE,
    BOTTOM,
    COLUMNS,
    LEFT,
    ROUGH,
    SIGMA,
    SIZE,
)

_CELLS_PX = (4, 8, 16, 32)  # Source: by construction, the extents of spots of σ 1 to 8 px
_CELLS_A_SIZE = 4.0  # px of a cell for each of a spot's σ. Source: experiment reflector-nees
_CHANCE = 1.15  # of the variance of slopes. Source: by construction, 3 σ of 1500 cells
# / √N: that of N steps between cells by chance. Source: 4 σ of their median, were they independent
_STEPS_CHANCE = 9.5
_DIFFERENCE_CELLS = 3  # of a difference: spots reach into most wider cells. Source: by construction
_MOST_CELLS = 2000  # that are looked at. Source: by construction, a chance of 1.2
_BAND = 8  # rows of cells. Source: by construction, few steps are lost between bands
_FEWEST_STEPS = 50  # between cells. Source: by construction, their median is within 20 %
_EVERY = 4  # rows. Source: by construction, a bound of time
# × a spot's size, and px: the Gaussian with the slope of the plane through the ring about the spot.
# A ring of radius ρ has that of ρ / 2; this one lies 3 px beyond 2.25 half widths of the spot,
# which is 1.6 sizes wide. Source: by construction, `ring_plane`
_RING, _RING_PX = 1.8, 2.0
_LEAST_LEFT = 0.02  # of a variance whose texture is taken out. Source: by construction, white noise
_MOST, _MOST_SIGMA = 0.8, 1.2816  # share of the slopes, σ. Source: normal distribution
_BLOCK = 8  # px. Source: ITU-T T.81
_MOST_BLOCKS = 1000  # that are looked at first. Source: by construction, 0.1 ms
_SLOWEST = ((0, 1), (1, 0), (1, 1))  # coefficients down, across. Source: by construction
_ROUNDING = 1e-3  # grey of a coefficient that is 0. Source: by construction, single precision
# share of blocks without detail, and of coefficients that are a step. Source: experiment
# reflector-nees --kind JPEG
_EVEN, _LEAST = 0.5, 0.1
_FEWEST = 12  # multiples of a step. Source: by construction, chance is below 1e-6
_LEAST_STEP = 1.5  # grey of a coefficient. Source: by construction, five times its rounding
# Source: by construction, qualities 30 to 88; smaller steps hide less than a grey level
_STEPS = tuple(range(24, 2, -1))
_MULTIPLES = 12.0  # of a step, at most. Source: by construction, few are so small in a wall
_OFF_GRID = 0.12  # of a step; 0.25 by chance. Source: by construction, rounding of a step of 3
# Variance of a pixel's noise over the square of a step: 1/12 of the quantisation itself, the noise
# that it hides, and the larger steps of faster coefficients. Source: experiment reflector-nees
_STEP_VARIANCE = 0.12


@dataclass(frozen=True, slots=True, eq=False)
class HiddenNoise:
    """Variances beside the white noise of a pixel, grey²."""

    of_cells: Array  # (4,) as white noise of a pixel that gives cells of 4 to 32 px their scatter
    of_compression: float
    single: bool = False  # of a single picture: it is all texture that is in the picture

    @classmethod
    def none(cls) -> HiddenNoise:
        """Nothing is known."""
        return cls(np.zeros(len(_CELLS_PX)), 0.0)

    @classmethod
    def of(cls, frames: LitDark, table: Array | None = None) -> HiddenNoise:
        """Measured in whole pictures.

        ``table``: of the spots in a difference, whose light is no noise.
        """
        compression = _STEP_VARIANCE * quantisation_step(frames.lit) ** 2
        if frames.dark is None:
            difference = cv2.subtract(frames.lit, background_of(frames.lit), dtype=cv2.CV_32F)
            return cls(_slopes(difference, noise_grey(frames)), compression, True)
        compression += _STEP_VARIANCE * quantisation_step(frames.dark) ** 2
        table = np.zeros((0, COLUMNS)) if table is None else table
        return cls(_slow(frames, noise_grey(frames), table), compression)

    def widen(self, table: Array) -> None:
        """Add it to the errors of the spots of a table.

        White noise of one grey level moves a windowed centroid by √(2/π) / amplitude, px.
        """
        if not (self.of_compression or self.of_cells.any()):
            return
        cell = np.log2(np.clip(_CELLS_A_SIZE * table[:, SIZE], _CELLS_PX[0], _CELLS_PX[-1]))
        # It grows with a power of the size.
        slow = np.exp(np.interp(cell, np.log2(_CELLS_PX), np.log(np.maximum(self.of_cells, 1e-3))))
        hidden = slow + self.of_compression
        if self.single:  # the ring around each spot shows the same texture, but not at its scale
            hidden -= table[:, ROUGH]
        moved = math.sqrt(2.0 / math.pi) / np.maximum(table[:, AMPLITUDE], 1.0)
        least = _LEAST_LEFT * table[:, SIGMA] ** 2
        table[:, SIGMA] = np.sqrt(np.maximum(table[:, SIGMA] ** 2 + hidden * moved**2, least))


def _lights(shape: tuple[int, ...], table: Array, cell: int) -> Grey:
    """(H // cell, W // cell) 1 in cells with a spot's light: its box and half as far again."""
    mask = np.zeros((shape[0] // cell, shape[1] // cell), np.uint8)
    for left, top, right, bottom in table[:, LEFT : BOTTOM + 1].astype(int):
        grow = 3 + (max(right - left, bottom - top) + 1) // 2  # as far as its ring
        rows = slice(max(top - grow, 0) // cell, (bottom + grow) // cell + 1)
        mask[rows, max(left - grow, 0) // cell : (right + grow) // cell + 1] = 1
    return mask


def _slow(frames: LitDark, noise: float, table: Array) -> Array:
    """(4,) variance of cells of the difference beyond that of white noise, as noise of a pixel."""
    assert frames.dark is not None
    found = np.zeros(len(_CELLS_PX))
    for k, cell in enumerate(_CELLS_PX[:_DIFFERENCE_CELLS]):
        if min(frames.lit.shape) < _BAND * cell:
            break
        lit, dark = _bands(frames.lit, cell), _bands(frames.dark, cell)
        difference = cv2.subtract(lit, dark, dtype=cv2.CV_32F)
        size = (lit.shape[1] // cell, lit.shape[0] // cell)
        cells = np.asarray(cv2.resize(difference, size, interpolation=cv2.INTER_AREA))
        cells = cells.reshape(-1, _BAND, size[0])
        free = _bands(_lights(frames.lit.shape, table, cell), 1).reshape(cells.shape) == 0
        steps = [np.diff(cells, axis=2)[free[..., 1:] & free[..., :-1]],
                 np.diff(cells, axis=1)[free[:, 1:] & free[:, :-1]]]  # fmt: skip
        sizes = np.abs(np.concatenate(steps))
        if len(sizes) < _FEWEST_STEPS:
            break
        # Spots and edges are few: the median of |steps| is 0.6745 √2 σ of a normal distribution.
        middle = len(sizes) // 2
        sigma = float(np.partition(sizes, middle)[middle]) / (0.6745 * math.sqrt(2.0))
        variance = (cell * sigma) ** 2
        chance = 1.0 + _STEPS_CHANCE / math.sqrt(len(sizes))
        found[k:] = variance - noise**2 if variance > chance * noise**2 else 0.0
    return found


def _bands(picture: Grey, cell: int) -> Grey:
    """Some of a picture's bands of rows of cells, one under the other; whole cells only."""
    height, width = picture.shape[0] // (_BAND * cell), picture.shape[1] // cell
    bands = picture[: _BAND * cell * height, : cell * width].reshape(height, -1)
    return bands[:: 1 + _BAND * height * width // _MOST_CELLS].reshape(-1, cell * width)


def _slopes(difference: cv2.typing.MatLike, noise: float) -> Array:
    """(4,) noise of a pixel beyond the white, as a centroid's window sees it behind a spot.

    A first moment under a Gaussian window is the slope of the smoothed picture, less that of the
    plane around the spot, here of a wider Gaussian. White noise of σ has slopes of σ / (√(8π) s²)
    after a Gaussian of s px.
    """
    found = np.zeros(len(_CELLS_PX))
    for k, cell in enumerate(_CELLS_PX):
        size = cell / _CELLS_A_SIZE
        ring = _RING + _RING_PX / size
        left = 1.0 + ring**-4 - 2.0 * (2.0 / (1.0 + ring**2)) ** 2  # of the variance of white noise
        soft = cv2.GaussianBlur(difference, (0, 0), size)
        soft = (soft - cv2.GaussianBlur(difference, (0, 0), ring * size))[::_EVERY]
        slopes = np.abs(np.diff(soft, axis=1)).ravel()
        rank = int(_MOST * (len(slopes) - 1))  # spots and edges are few
        sigma = float(np.partition(slopes, rank)[rank]) / _MOST_SIGMA
        variance = (sigma * math.sqrt(8.0 * math.pi) * size * size) ** 2 / left
        found[k] = variance - noise**2 if variance > _CHANCE * noise**2 else 0.0
    return found


def quantisation_step(picture: Grey) -> float:
    """Grey levels of the slowest coefficients' steps in a JPEG; 0 where it is none.

    Blocks of 8 × 8 px from the first pixel on. Of a JPEG their coefficients are multiples of a
    whole number, up to rounding.
    """
    rows, columns = picture.shape[0] // _BLOCK, picture.shape[1] // _BLOCK
    if rows < 1 or columns < 1:
        return 0.0
    blocks = picture[: rows * _BLOCK, : columns * _BLOCK].reshape(rows, _BLOCK, columns, _BLOCK)
    angle = math.pi * (np.arange(_BLOCK) + 0.5) / _BLOCK
    basis = np.stack([np.full(_BLOCK, math.sqrt(0.125)), 0.5 * np.cos(angle)], axis=1)
    # In a dark picture only the spots' own blocks have any.
    sizes = np.empty((0, 0))
    for every in (1 + rows * columns // _MOST_BLOCKS, 1):
        across = blocks[::every].astype(np.float32) @ basis  # (rows, 8, columns, 2)
        whole = np.tensordot(basis, across, ((0,), (1,)))  # (v, rows, columns, u)
        sizes = np.array([np.abs(whole[v, ..., u].ravel()) for v, u in _SLOWEST])
        steps = [_common_step(own) for own in sizes]
        known = [step for step in steps if step is not None]
        found = [step for step in known if step > 0]
        if len(found) > 1:
            return float(np.mean(found))
        if len(known) > 1:
            break
    # Too few, or ringing is cut off at 0; but blocks are even, noise and all, as none is that is
    # not coded: the least coefficients are a step, or more.
    some = sizes[sizes > _LEAST_STEP]
    even = (sizes < _ROUNDING).all(axis=0).mean() > _EVEN
    return float(np.quantile(some, _LEAST)) if even and len(some) else 0.0


def _common_step(sizes: Array) -> int | None:
    """The largest whole number of which all are multiples; 0: there is none, None: too few."""
    sizes = sizes[sizes > _LEAST_STEP]
    if len(sizes) < _FEWEST:
        return None
    largest = sizes.min() / (1.0 - 3.0 * _OFF_GRID)  # of which the least may be a multiple
    for step in (step for step in _STEPS if step <= largest):
        some = sizes[sizes < _MULTIPLES * step] / step
        if len(some) < _FEWEST:
            continue
        if np.abs(some - np.rint(some)).mean() < _OFF_GRID:
            return step
    return 0
