"""Spots that run together: the Gaussians of a group are fitted at once.

The reflectors of a far target are a few pixels apart, and each lies in the others' windows, whose
centroids it would move (crowded fields: Stetson, PASP 99, 1987).
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from rendezview.estimation.least_squares import Equations, Minimum, minimise
from rendezview.geometry.pose import Array

Grey = npt.NDArray[np.uint8]
Ints = npt.NDArray[np.int64]
Bools = npt.NDArray[np.bool_]
Box = tuple[int, int, int, int]  # first and last column, rows; px, the last not included

_REACH = 3.0  # σ of a spot: beyond is a hundredth of its light. Source: by construction
_MOST = 8  # spots of a group. Source: by construction, a bound of time
_PIXEL = 1.0 / 12.0  # px², variance of a pixel. Source: by construction
_LEAST_SPREAD = 0.3  # px, of a start. Source: by construction
_FARTHEST = 1.5  # ln of a size over its start's. Source: by construction, a bound only
_SPARROW = 2.0  # σ between two Gaussians, nearer have one peak. Source: Sparrow's limit
_EXPLAINED = 4.0  # σ of χ² up to which noise explains it. Source: normal distribution


def parted(
    pictures: tuple[Grey, Grey], spots: Array, extents: Array, long: Bools, noise: float,
    level: float,
) -> Iterator[tuple[Ints, Array, Array]]:  # fmt: skip
    """Groups of spots that lie in each other's windows, and what a fit of all makes of each.

    Args:
        pictures: (H, W) lit and dark.
        spots: (N, 4) x, y, size (px, a pixel's own included) and peak (grey) of each, about.
        extents: (N,) px, half of each above the threshold.
        long: (N,) whether one without a neighbour may be several.
        noise: of a pixel of the difference, grey.
        level: the threshold, grey.

    Yields:
        indices (K,) of those that a fit explains; (M, 4) of `fit_blended`, M ≥ K, and (M,) errors.
    """
    reach = np.maximum(_REACH * np.maximum(spots[:, 2], 1.0), extents + 1.0)
    near = np.hypot(*(spots[:, None, :2] - spots[:, :2]).T) < reach[:, None] + reach
    left = set(range(len(spots)) if long.any() or near.sum() > len(spots) else ())
    while left:
        group: set[int] = set()
        new = {left.pop()}
        while new:
            group |= new
            new = {int(k) for k in np.flatnonzero(near[list(new)].any(axis=0))} - group
        left -= group
        if len(group) <= _MOST and (len(group) > 1 or long[min(group)]):
            some = np.array(sorted(group))
            found = fit_blended(*pictures, spots[some], reach[some], noise, level)
            if found is not None:
                yield some, *found


def fit_blended(
    lit: Grey, dark: Grey, spots: Array, reach: Array, noise: float, level: float
) -> tuple[Array, Array] | None:
    """Least squares of all spots of a group in the difference of two pictures.

    Where they leave light above the threshold, one more is there.

    Args:
        lit, dark: (H, W) pictures.
        spots: (N, 4) x, y, size (px, a pixel's own included) and peak (grey) of each, about.
        reach: (N,) how far the light of each is used, px.
        noise: of a pixel of the difference, grey.
        level: the threshold, grey.

    Returns:
        (M, 4) of the same, M ≥ N, and (M,) error of the place, one σ an axis, px. None where noise
        does not explain what Gaussians of two peaks leave, or they do not stay.
    """
    reach = reach[:, None]
    low = np.floor((spots[:, :2] - reach).min(axis=0)).astype(int)
    high = np.ceil((spots[:, :2] + reach).max(axis=0)).astype(int) + 1
    (x0, y0), (x1, y1) = np.maximum(low, 0), np.minimum(high, lit.shape[::-1])
    box = (x0, x1, y0, y1)
    across = np.arange(x0, x1)[None, :] - spots[:, :1]
    down = np.arange(y0, y1)[None, :] - spots[:, 1:2]
    far = across[:, None, :] ** 2 + down[:, :, None] ** 2 > (reach * reach)[:, :, None]
    sigma = np.where(far.all(axis=0), np.inf, noise)  # beyond, other groups shine
    grey = lit[y0:y1, x0:x1].astype(np.float64) - dark[y0:y1, x0:x1]
    spread = np.sqrt(np.maximum(spots[:, 2] ** 2 - _PIXEL, _LEAST_SPREAD**2))
    flux = 2.0 * math.pi * spots[:, 3] * spots[:, 2] ** 2
    at = np.column_stack([spots[:, :2], np.log(flux), np.log(spread)])
    while True:
        found = _fit(grey, box, at, sigma)
        if found is None:
            return None
        at, dof = found.at, int(np.isfinite(sigma).sum()) - found.at.size
        if dof < 1:
            return None
        if found.cost < dof + _EXPLAINED * math.sqrt(2.0 * dof):
            break
        rest = np.where(np.isfinite(sigma), grey - _light(at, box)[0], 0.0)
        v, u = np.unravel_index(int(rest.argmax()), rest.shape)
        if len(at) == _MOST or rest[v, u] < level:
            return None
        size = np.exp(2.0 * at[:, 3].min()) + _PIXEL
        more = x0 + u, y0 + v, math.log(2.0 * math.pi * rest[v, u] * size), at[:, 3].min()
        at = np.vstack([at, more])
    sizes = np.sqrt(np.exp(2.0 * at[:, 3]) + _PIXEL)
    away = np.hypot(*(at[:, None, :2] - at[:, :2]).T) + np.diag(np.full(len(at), np.inf))
    normal = _equations(at, grey, box, sigma)[1]
    if (away < _SPARROW * sizes).any() or np.linalg.matrix_rank(normal) < len(normal):
        return None
    variances = np.diag(np.linalg.inv(normal)).reshape(-1, 4)
    peaks = np.exp(at[:, 2]) / (2.0 * math.pi * sizes**2)
    errors = np.sqrt(0.5 * (variances[:, 0] + variances[:, 1]))
    return np.column_stack([at[:, :2], sizes, peaks]), errors


def _fit(grey: Array, box: Box, start: Array, sigma: Array) -> Minimum[Array] | None:
    def equations(at: Array) -> Equations:
        if np.abs(at[:, 3] - start[:, 3]).max() > _FARTHEST:  # it left its spot
            return math.inf, np.zeros((at.size, at.size)), np.zeros(at.size)
        return _equations(at, grey, box, sigma)

    found = minimise(equations, lambda at, step: at + step.reshape(-1, 4), start)
    return found if found is not None and found.converged else None


def _equations(at: Array, grey: Array, box: Box, sigma: Array) -> Equations:
    light, slopes = _light(at, box)
    rest = ((grey - light) / sigma).reshape(-1)
    jacobian = (slopes / sigma).reshape(len(slopes), -1)
    return float(rest @ rest), jacobian @ jacobian.T, jacobian @ rest


def _light(at: Array, box: Box) -> tuple[Array, Array]:
    """(H, W) grey of Gaussians (N, 4: x, y, ln flux, ln σ), and (4 N, H, W) its slopes."""
    light = np.zeros((box[3] - box[2], box[1] - box[0]))
    slopes = np.empty((4 * len(at), *light.shape))
    for k, (x, y, log_flux, log_spread) in enumerate(at):
        flux, spread = math.exp(log_flux), math.exp(log_spread)
        across, across_x, across_s = _profile(x, spread, box[0], box[1])
        down, down_y, down_s = _profile(y, spread, box[2], box[3])
        one = flux * np.outer(down, across)
        light += one
        slopes[4 * k] = flux * np.outer(down, across_x)
        slopes[4 * k + 1] = flux * np.outer(down_y, across)
        slopes[4 * k + 2] = one
        slopes[4 * k + 3] = flux * (np.outer(down, across_s) + np.outer(down_s, across))
    return light, slopes


def _profile(middle: float, spread: float, first: int, last: int) -> tuple[Array, Array, Array]:
    """A Gaussian's share on pixels of a line, its slopes by the middle and by ln σ."""
    edges = (np.arange(first, last + 1) - 0.5 - middle) / spread
    whole = np.array([0.5 * math.erf(edge / math.sqrt(2.0)) for edge in edges])
    density = np.exp(-0.5 * edges**2) / math.sqrt(2.0 * math.pi)
    return np.diff(whole), -np.diff(density) / spread, -np.diff(edges * density)
