"""Places between the nodes, from the signatures stored around a match.

An active node gives only its own direction, up to an edge off. The stored signatures give more.
Around each view a quadratic in the direction is fitted to its neighbours' readings at the frame's
range; perspective changes a signature as much as degrees do, so far views are stored beside near
ones. A robust Gauss–Newton over direction and roll then finds where the frame's signature lies on
the quadratic. Every view near the answer gives one place; they differ by what a quadratic leaves
out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numba import njit

from rendezview.estimation.linear_algebra import solve
from rendezview.geometry.pose import Array
from rendezview.sensors.appearance.model.signature import UNIT, Readings, Signature, rolled, twist
from rendezview.sensors.appearance.model.view_model import FAR_RADII, ViewModel
from rendezview.sensors.appearance.outline.placement import range_from_area
from rendezview.sensors.appearance.outline.votes import Match

# Edges of the node sphere around a view; the quadratic is fitted to the views within.
# Source: experiment trajectory-accuracy, seeds 1000–1002
_REACH_EDGES = 1.0
# Edges around the answer; each view within gives a place.
# Source: experiment trajectory-accuracy, seeds 1000–1002
_NEAR_EDGES = 0.6
_STEPS = 8  # of Gauss–Newton. Source: by construction, a bound only
_KEPT = 256  # quadratics, of the views used last. Source: by construction, a bound of memory
# px that an outline lies too far out, by blur and the low threshold: the mean over frames with
# truth. Source: experiment trajectory-accuracy, seeds 1000–1002
_FAT_PX = 0.3
# thousandths; scatter of readings by rounding and noise. Source: trajectory-accuracy, seeds
# 1000–1002
_NOISE = 3.0
_CUT = 2.5  # σ; residuals beyond weigh little. Source: trajectory-accuracy, seeds 1000–1002


@dataclass(frozen=True, slots=True, eq=False)
class _Local:
    """The quadratic around one view."""

    axes: Array  # (3, 3) rows: x and y of the tangent plane, the view's direction
    near: Array  # (6, N) coefficients of the readings at the sphere radius, of 1 x y x² xy y² …
    far: Array  # (6, N) … and at far range less that
    misfit: Array  # (N,) r.m.s. of the neighbours' readings off the quadratic
    area: Array  # (6, 2) of ``area_m2`` and ``area_slope``


class Interpolator:
    """Places between the nodes of one model. Threads may share an instance."""

    def __init__(self, model: ViewModel) -> None:
        if model.views.far_change is None:
            raise ValueError("the model has no far readings")
        self._model = model
        self._lattice = model.lattice
        self._edge = model.geodesic.mean_edge_rad
        self._near = model.views.readings.astype(np.float32)
        self._far = np.asarray(model.views.far_readings, dtype=np.float32)
        self._local = lru_cache(maxsize=_KEPT)(self._fitted)

    def points(self, match: Match, signature: Signature, pixel_rad: float) -> tuple[Array, Array]:
        """Where views around a match put the camera: (K, 3) m, target frame, and weights (K,).

        Args:
            match: of the frame.
            signature: of the frame.
            pixel_rad: angle of a pixel, to correct the area of an outline that lies too far out.
        """
        signature = _slimmer(signature, _FAT_PX * pixel_rad)
        direction, attitude = match.direction, match.centred_from_target
        view = int(self._lattice.nearest(direction))
        range_m = self._range(np.eye(6)[0] @ self._local(view).area, signature)
        direction, range_m, _ = self._placed(view, direction, attitude, range_m, signature)
        views = self._lattice.within(direction, _NEAR_EDGES * self._edge)
        points, weights = np.empty((len(views), 3)), np.empty(len(views))
        for k, view in enumerate(views):
            found, far, residual = self._placed(int(view), direction, attitude, range_m, signature)
            points[k] = self._model.centre_m + far * found
            off = np.sum((found - self._lattice.nodes[view]) ** 2) / (0.5 * self._edge) ** 2
            weights[k] = np.exp(-0.5 * off) / (1.0 + residual**2)
        return points, weights / weights.max()

    def _placed(
        self, view: int, start: Array, attitude: Array, range_m: float, signature: Signature
    ) -> tuple[Array, float, float]:
        """Direction, range and r.m.s. residual that one view's quadratic gives from a start."""
        local = self._local(view)
        # Readings go with sphere radius over range, from 1 (near) to 1/FAR_RADII.
        share = (1.0 - self._model.sphere_radius_m / range_m) / (1.0 - 1.0 / FAR_RADII)
        found = np.empty(3)
        found[:2] = local.axes[:2] @ start / max(float(local.axes[2] @ start), 0.5)
        found[2] = twist(attitude, self._model.views.centred_from_target[view])
        surface = np.ascontiguousarray((local.near + share * local.far).T)
        residual = descend(signature.readings, surface, local.misfit, found)
        x, y = found[:2]
        away = local.axes[2] + x * local.axes[0] + y * local.axes[1]
        area = np.array([1.0, x, y, x * x, x * y, y * y]) @ local.area
        return away / np.linalg.norm(away), self._range(area, signature), residual

    def _range(self, area: Array, signature: Signature) -> float:
        return float(range_from_area(self._model, area[:1], area[1:], signature.area_sr)[0])

    def _fitted(self, view: int) -> _Local:
        """The quadratic around a view, by least squares over its neighbours."""
        views = self._model.views
        direction = self._lattice.nodes[view]
        around = self._lattice.within(direction, _REACH_EDGES * self._edge)
        camera = views.centred_from_target
        x_axis = camera[view][0] - (camera[view][0] @ direction) * direction
        x_axis /= np.linalg.norm(x_axis)
        axes = np.stack([x_axis, np.cross(direction, x_axis), direction])
        x, y, ahead = axes @ self._lattice.nodes[around].T
        x, y = x / ahead, y / ahead
        rolls = twist(camera[around], camera[view])
        near, far = (
            np.array([rolled(kept[k], roll) for k, roll in zip(around, rolls, strict=True)])
            for kept in (self._near, self._far)
        )
        terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
        solve = np.linalg.pinv(terms)
        fitted = solve @ near
        areas = np.stack([views.area_m2[around], views.area_slope[around]], axis=1)
        return _Local(
            axes,
            fitted,
            solve @ far - fitted,
            np.sqrt(np.mean((terms @ fitted - near) ** 2, axis=0)),
            solve @ areas,
        )


def _slimmer(signature: Signature, width_rad: float) -> Signature:
    """The signature with the area of an outline that lies ``width_rad`` farther in."""
    radius = signature.readings * np.sqrt(signature.area_sr) / UNIT
    slope = (np.roll(radius, -1) - np.roll(radius, 1)) * len(radius) / (4.0 * np.pi)
    around = float(np.mean(np.hypot(radius, slope))) * 2.0 * np.pi
    area_sr = max(signature.area_sr - width_rad * around, 0.5 * signature.area_sr)
    return replace(signature, area_sr=area_sr)


@njit(cache=True, nogil=True, error_model="numpy")
def descend(readings: Readings, surface: Array, misfit: Array, found: Array) -> float:
    """Move (x, y, roll) to where a signature lies on a quadratic; robust Gauss–Newton.

    Args:
        readings: (N,) of the frame.
        surface: (N, 6) coefficients of each reading, of 1 x y x² xy y².
        misfit: (N,) r.m.s. that the quadratic leaves in each reading.
        found: (3,) direction x, y in the tangent plane and roll, rad; changed in place.

    Returns:
        The r.m.s. residual, thousandths.
    """
    bins = readings.shape[0]
    off, size, slopes = np.empty(bins), np.empty(bins), np.empty((bins, 3))
    matrix, lower = np.empty((3, 3)), np.empty((3, 3))
    right, move = np.empty(3), np.empty(3)
    total = 0.0
    for k in range(_STEPS + 1):
        total = _residuals_into(readings, surface, found, off, slopes)
        if k == _STEPS:
            break
        for b in range(bins):
            size[b] = abs(off[b])
        scatter = 1.4826 * np.median(size) + _NOISE
        matrix[:] = 0.0
        right[:] = 0.0
        for b in range(bins):
            variance = scatter**2 + misfit[b] ** 2
            weight = 1.0 / variance / (1.0 + off[b] ** 2 / variance / _CUT**2) ** 2
            for i in range(3):
                right[i] -= weight * slopes[b, i] * off[b]
                for j in range(3):
                    matrix[i, j] += weight * slopes[b, i] * slopes[b, j]
        for i in range(3):
            matrix[i, i] *= 1.0 + 1e-6
            matrix[i, i] += 1e-9
        if not solve(matrix, right, lower, move):
            break
        found += move
        if np.sqrt(move[0] ** 2 + move[1] ** 2) < 1e-4 and abs(move[2]) < 1e-3:
            break
    return float(np.sqrt(total / bins))


@njit(cache=True, nogil=True, error_model="numpy")
def _residuals_into(
    readings: Readings, surface: Array, found: Array, off: Array, slopes: Array
) -> float:
    """Fill residuals (N,) and their derivatives (N, 3) by x, y, roll; returns Σ residual²."""
    bins = readings.shape[0]
    step_rad = 2.0 * np.pi / bins
    x, y = found[0], found[1]
    shift = -found[2] / step_rad
    whole = int(np.floor(shift))
    part = shift - whole
    total = 0.0
    for b in range(bins):
        s = surface[b]
        at = (b + whole) % bins
        here, ahead = readings[at], readings[at + 1 if at + 1 < bins else 0]
        model = s[0] + x * s[1] + y * s[2] + x * x * s[3] + x * y * s[4] + y * y * s[5]
        off[b] = here + part * (ahead - here) - model
        slopes[b, 0] = -(s[1] + 2.0 * x * s[3] + y * s[4])
        slopes[b, 1] = -(s[2] + x * s[4] + 2.0 * y * s[5])
        slopes[b, 2] = -(ahead - here) / step_rad
        total += off[b] ** 2
    return total
