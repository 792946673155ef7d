"""Connected spots of the difference picture, and where their middles are.

Three centroids: binary (every pixel alike), weighted by what is above the threshold (Book et
al.'s), and Gaussian-windowed: the point about which a Gaussian window of the spot's own size
finds no first moment. For a spot that is itself Gaussian that is the best there is: its error
σ_noise √(2/π) / peak is the Cramér–Rao bound.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numba import njit

from rendezview.estimation.saturated_spot import Plane, fit_rim
from rendezview.estimation.spot_centroid import centre_spot, elongation, overlap_error, ring_plane
from rendezview.geometry.pose import Array
from rendezview.sensors.beacons.detect.blended import parted
from rendezview.sensors.beacons.detect.difference import (
    Centroid,
    Grey,
    LitDark,
    ThresholdOptions,
    background_of,
    cut_valleys,
    faint_mask,
    noise_grey,
    spot_mask,
    threshold_of,
)
from rendezview.sensors.beacons.detect.labels import label
from rendezview.sensors.beacons.detect.spot_columns import (
    ABOVE,
    AMPLITUDE,
    AREA,
    BINARY_X,
    BOTTOM,
    COLUMNS,
    LEFT,
    LONG_X,
    LONG_XY,
    PEAK,
    RIGHT,
    ROUGH,
    SATURATED,
    SHAPE,
    SIGMA,
    SIZE,
    TOP,
    WEIGHTED_X,
    WEIGHTED_Y,
    X,
    Y,
)

_FEWEST = 3  # spots that can be a target. Source: by construction
_RISES = 10  # of the threshold, each by a half: up to 38 times. Source: by construction
_SEVERAL = 0.75  # small over large axis: one that is longer may be several. Source: by construction
# px by which a saturated spot's light passes the threshold beyond its disc. Source: by
# construction, one σ of the blur; a start only
_SKIRT_PX = 0.7
# share of a saturated spot's size: an error where its rim is not that of a disc. Source: by
# construction, charge over a quarter of a flat disc's diameter at one end
_RAN_OVER = 0.4
# Among more, chance fits dots of another size, or fainter ones. Source: experiments
# reflector-tolerance (0.1) and reflector-nees
MOST_CERTAIN = 20
# more than that is no picture of a target. Source: by construction, a bound of time
MOST_SPOTS = 400
_LOW, _HIGH = np.array([LEFT, TOP]), np.array([RIGHT, BOTTOM])  # Source: by construction
_GAUSSIAN = np.array([X, Y, SIZE, AMPLITUDE])  # Source: by construction
_RECORDED = {
    "x_px": X, "y_px": Y, "area_px": AREA, "peak_grey": PEAK, "size_px": SIZE,
    "saturated_px": SATURATED, "sigma_px": SIGMA,
}  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class SpotTable:
    """Spots of one picture; ``table`` (N, COLUMNS) as the compiled loops use it."""

    table: Array
    overfull: bool = False  # more than MOST_SPOTS were found, and dropped

    def __len__(self) -> int:
        return len(self.table)

    @property
    def centroids_px(self) -> Array:
        """(N, 2) by the method asked for."""
        return self.table[:, :2]

    @property
    def area_px(self) -> Array:
        """(N,) pixels above the threshold."""
        return np.asarray(self.table[:, AREA])

    @property
    def peak_grey(self) -> Array:
        """(N,) largest difference."""
        return np.asarray(self.table[:, PEAK])

    @property
    def size_px(self) -> Array:
        """(N,) σ of the Gaussian that has the spot's extent."""
        return np.asarray(self.table[:, SIZE])

    @property
    def saturated_px(self) -> Array:
        """(N,) number of saturated pixels."""
        return np.asarray(self.table[:, SATURATED])

    @property
    def sigma_px(self) -> Array:
        """(N,) error of the centroid that the picture's noise makes, one σ an axis."""
        return np.asarray(self.table[:, SIGMA])

    def records(self) -> list[dict[str, float]]:
        """One mapping a spot, as a log has them."""
        kinds = {AREA: int, SATURATED: int}
        columns = _RECORDED.items()
        return [{k: kinds.get(n, float)(row[n]) for k, n in columns} for row in self.table]


def find_spots(
    frames: LitDark, options: ThresholdOptions | None = None, centroid: Centroid | None = None,
    *, faint: bool = False,
) -> SpotTable:  # fmt: skip
    """All spots of a picture; those that run together are last.

    ``centroid`` wins over that of the options. ``faint``: look for spots below the threshold of
    single pixels too, as is done where fewer than three are above it.
    """
    chosen, noise = options or ThresholdOptions(), noise_grey(frames)
    table, pieces = np.zeros((MOST_SPOTS, COLUMNS)), np.zeros((0, COLUMNS))
    if frames.dark is None and chosen.lower_grey is None:
        count = _label_faint(frames, noise, chosen, table)
    else:
        level, count = threshold_of(chosen, noise, frames), 0
        if not faint or chosen.lower_grey is not None:
            mask_of = partial(spot_mask, frames, level, chosen)
            count, pieces = _labelled(mask_of, frames, level, level, table)
        if 0 <= count < _FEWEST and chosen.lower_grey is None:
            mask_of = partial(faint_mask, frames, frames.dark_or_nothing, noise, chosen)
            others = np.zeros_like(table)
            more, parts = _labelled(mask_of, frames, level, noise, others)
            if not 0 <= more <= count:  # some are too faint for single pixels
                count, table, pieces = more, others, parts
    overfull, centroid = count < 0, centroid or chosen.centroid
    found = table[: MOST_SPOTS if overfull else count]
    place(frames.lit, frames.dark_or_nothing, found, noise)
    if frames.dark is not None and not overfull and centroid is Centroid.WINDOWED:
        found = _parted(frames, pieces, found, noise, level)
    recentre(found, noise, centroid)
    return SpotTable(found, overfull)


def _labelled(
    mask_of: Callable[[], Grey], frames: LitDark, level: float, floor: float, table: Array
) -> tuple[int, Array]:
    """Label spots; how many there are, and the rows of all after cuts between lights, if any."""
    mask, pieces = mask_of(), np.zeros((0, COLUMNS))
    if frames.dark is not None and cut_valleys(mask, frames, level):
        pieces = np.zeros((MOST_SPOTS, COLUMNS))
        pieces = pieces[: max(label(mask, frames.lit, frames.dark, floor, pieces), 0)]
        mask = mask_of()
    return label(mask, frames.lit, frames.dark_or_nothing, floor, table), pieces


def _parted(frames: LitDark, pieces: Array, table: Array, noise: float, level: float) -> Array:
    """The rows of `table`, with several for spots that run together, if a fit of all explains them.

    ``pieces`` (M, COLUMNS): those after cuts. Where fewer than three are found, a long one may be
    several.
    """
    dark, starts, owners = frames.dark_or_nothing, table, np.arange(len(table))
    if len(pieces):
        place(frames.lit, dark, pieces, noise)
        inside = pieces[:, None, _LOW] >= table[:, _LOW]
        inside &= pieces[:, None, _HIGH] <= table[:, _HIGH]
        owner = inside.all(axis=2).argmax(axis=1)
        several = np.bincount(owner, minlength=len(table))[owner] > 1
        whole = ~np.isin(owners, owner[several])
        starts = np.vstack([table[whole], pieces[several]])
        owners = np.concatenate([owners[whole], owner[several]])
    clear = (starts[:, SATURATED] <= 1.0) & (starts[:, AMPLITUDE] > 0.0)
    starts, owners = starts[clear], owners[clear]
    half = 0.5 * (starts[:, _HIGH] - starts[:, _LOW]).max(axis=1, initial=0.0)
    long = (starts[:, SHAPE] < _SEVERAL) & (len(table) < _FEWEST)
    numbers, kept, parts = starts[:, _GAUSSIAN], np.ones(len(table), np.bool_), []
    for group, found, errors in parted((frames.lit, dark), numbers, half, long, noise, level):
        kept[owners[group]] = False
        rows = starts[np.resize(group, len(found))]
        rows[:, _GAUSSIAN], rows[:, SIGMA] = found, errors
        rows[:, SHAPE], rows[:, LONG_X], rows[:, LONG_XY] = 1.0, 0.0, 0.0
        parts.append(rows)
    return np.vstack([table[kept], *parts]) if parts else table


def _label_faint(frames: LitDark, noise: float, options: ThresholdOptions, table: Array) -> int:
    """Label the spots of a single picture; among too many the threshold rises until they fit."""
    behind = background_of(frames.lit)
    for _ in range(_RISES):
        mask = faint_mask(frames, behind, noise, options)
        count = label(mask, frames.lit, behind, noise, table)
        if count >= 0:
            break
        options = replace(options, faint_factor=1.5 * options.faint_factor)
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def place(lit: Grey, dark: Grey, table: Array, noise: float) -> None:
    """Fill place, size and error of every spot by its window."""
    columns, rows = np.empty(lit.shape[1]), np.empty(lit.shape[0])
    for i in range(table.shape[0]):
        window_centroid(lit, dark, table[i], noise, columns, rows)


def recentre(table: Array, noise: float, centroid: Centroid) -> None:
    """Put another centroid and its error in the place of the windowed one; sizes stay."""
    if centroid is Centroid.WINDOWED:
        return
    k = BINARY_X if centroid is Centroid.BINARY else WEIGHTED_X
    table[:, X], table[:, Y] = table[:, k], table[:, k + 1]
    if centroid is Centroid.BINARY:  # each pixel of the rim is in or out: uniform, about √area
        table[:, SIGMA] = 0.29 / table[:, AREA] ** 0.25
    else:  # noise of every pixel times its lever, the thresholded rim included
        lever = table[:, SIZE] * np.sqrt(table[:, AREA])
        table[:, SIGMA] = noise * lever / np.maximum(table[:, ABOVE], 1e-6)


@njit(cache=True, nogil=True, error_model="numpy")
def window_centroid(
    lit: Grey, dark: Grey, row: Array, noise: float, columns: Array, rows: Array
) -> None:
    """Fill place, size, amplitude and error of a spot by a Gaussian window of its own size.

    The place of a saturated spot is that of its rim.
    """
    x, y = row[WEIGHTED_X], row[WEIGHTED_Y]
    box = (int(row[LEFT]), int(row[RIGHT]), int(row[TOP]), int(row[BOTTOM]))
    level, slope_x, slope_y, rough, doubt = ring_plane(lit, dark, box, noise)
    at_x, at_y = 0.5 * (box[0] + box[1]), 0.5 * (box[2] + box[3])
    here = level + slope_x * (x - at_x) + slope_y * (y - at_y)
    # The rows above the threshold are the top of the spot: its true width is larger.
    x, y, size, amplitude, error = centre_spot(
        lit, dark, (here, slope_x, slope_y, doubt), (x, y, 1.2 * row[SIZE]), rough, columns, rows
    )
    # A window that ran away from its spot is no measurement of it.
    away = 0.5 * max(row[RIGHT] - row[LEFT], row[BOTTOM] - row[TOP], 2.0)
    ran = max(abs(x - row[WEIGHTED_X]), abs(y - row[WEIGHTED_Y])) > away
    if ran or not error > 0.0:
        x, y, error = row[WEIGHTED_X], row[WEIGHTED_Y], max(error, away)
    elif amplitude > 0.0:
        spot, slopes = (x, y, size, amplitude), (slope_x, slope_y)
        error = math.hypot(error, overlap_error(lit, dark, spot, slopes, max(rough, noise)))
    row[X], row[Y], row[SIZE], row[SIGMA] = x, y, size, error
    row[ROUGH] = max(rough * rough - noise * noise, 0.0)
    if amplitude > 0.0:
        row[AMPLITUDE] = amplitude
    if row[SATURATED] <= 1.0:
        plane = (level - slope_x * at_x - slope_y * at_y, slope_x, slope_y)
        row[LONG_X], row[LONG_XY] = elongation(lit, dark, (x, y, size), plane)
        return
    row[LONG_X], row[LONG_XY] = np.nan, np.nan
    x, y = row[WEIGHTED_X], row[WEIGHTED_Y]
    here = level + slope_x * (x - at_x) + slope_y * (y - at_y)
    _use_rim(lit, dark, row, (x, y, here, slope_x, slope_y), max(rough, noise), away)


@njit(cache=True, nogil=True, error_model="numpy")
def _use_rim(lit: Grey, dark: Grey, row: Array, plane: Plane, noise: float, away: float) -> None:
    """Take place and error of a saturated spot from its rim, if that is one of a disc."""
    box = (int(row[LEFT]), int(row[RIGHT]), int(row[TOP]), int(row[BOTTOM]))
    radius = max(math.sqrt(row[AREA] / math.pi) - _SKIRT_PX, _SKIRT_PX)
    x, y, error = fit_rim(lit, dark, plane, radius, noise, box)
    if not error > 0.0 or max(abs(x - plane[0]), abs(y - plane[1])) > away:
        row[SIGMA] = math.hypot(row[SIGMA], _RAN_OVER * row[SIZE])
        return
    row[X], row[Y], row[SIGMA], row[ROUGH] = x, y, error, 0.0
