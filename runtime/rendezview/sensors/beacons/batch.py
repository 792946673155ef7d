"""A whole log of photodiode readings at once, for the time after the experiment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.estimation.linear_algebra import invert
from rendezview.geometry.pose import Array
from rendezview.sensors.beacons.detect.detectors import read_currents
from rendezview.sensors.beacons.match.agreement import (
    FEWEST_LIGHTS,
    ITERATIONS,
    LIMITS,
    TOLERANCE,
    UNKNOWNS,
    Disagreement,
    agree,
)
from rendezview.sensors.beacons.pose.collinearity import count_lights, solve
from rendezview.sensors.beacons.rig import Sights, ideal_spot
from rendezview.sensors.beacons.stereo_tracker import StereoTracker

_PIECE = 1024  # Source: by construction, a bound of memory


@dataclass(frozen=True, slots=True, eq=False)
class Poses:
    """Poses of N readings, rig frame; NaN in all fields where ``ok`` is False."""

    rotation: Array  # (N, 3, 3) rig from target
    translation_m: Array  # (N, 3)
    covariance: Array  # (N, 6, 6)
    ok: npt.NDArray[np.bool_]  # (N,)


def reprocess(tracker: StereoTracker, currents: npt.ArrayLike) -> Poses:
    """Every reading's own pose, each started from the one before.

    What does not agree at the first attempt (the first reading, false lights, jumps) is done
    again one by one as the tracker does it. The tracker's own state does not change.

    Args:
        tracker: of a rig of photodiodes.
        currents: (N, C, L, 4) x1 x2 y1 y2 of each light in each camera; NaN where not read.

    Raises:
        ValueError: a wrong shape, or a camera that is no photodiode.
    """
    given = np.ascontiguousarray(currents, dtype=np.float64)
    rig, leds = tracker.rig, tracker.leds
    wanted = (len(rig), len(leds), 4)
    if given.ndim != 4 or given.shape[1:] != wanted:
        raise ValueError(f"currents must be (readings, {wanted}), not {given.shape}")
    diodes = [camera.photodiode for camera in rig.cameras]
    if any(diode is None for diode in diodes):
        raise ValueError("a log of currents needs a rig of photodiodes")
    count = len(given)
    out = Poses(
        np.empty((count, 3, 3)), np.empty((count, 3)), np.empty((count, 6, 6)),
        np.zeros(count, np.bool_),
    )  # fmt: skip
    # In pieces that stay in the processor's cache.
    size = (min(count, _PIECE), *wanted[:2], 2)
    xy, weight = np.empty(size), np.empty(size)
    for first in range(0, count, _PIECE):
        piece = given[first : first + _PIECE]
        for k, (camera, diode) in enumerate(zip(rig.cameras, diodes, strict=True)):
            assert diode is not None
            noise, total, curve, half_width = diode.kernel_arguments
            given_camera, lens, corrects = camera.kernel_arguments
            _sights(
                piece, k, noise, total, curve, half_width, given_camera, lens, corrects, xy, weight
            )
        done, end = first, first + len(piece)
        while done < end:  # up to the next one that needs more than iterations
            if done > 0 and out.ok[done - 1]:
                done = _run(
                    first, done, end, leds, rig.rotations, rig.translations, xy, weight, LIMITS,
                    out.rotation, out.translation_m, out.covariance, out.ok,
                )  # fmt: skip
            if done < end:
                _one(tracker, Sights(xy[done - first], weight[done - first]), done, out)
                done += 1
    for field in (out.rotation, out.translation_m, out.covariance):
        field[~out.ok] = np.nan
    return out


def _one(tracker: StereoTracker, sights: Sights, index: int, out: Poses) -> None:
    fit = None
    if index > 0 and out.ok[index - 1]:
        start = out.rotation[index - 1], out.translation_m[index - 1]
        fit = agree(tracker.rig, tracker.leds, sights, *start)
    if fit is None or isinstance(fit, Disagreement):
        fit = tracker.locate(sights)
    if isinstance(fit, Disagreement):
        return
    out.rotation[index], out.translation_m[index] = fit.rotation, fit.translation
    out.covariance[index] = np.linalg.inv(fit.information)
    out.ok[index] = True


@njit(cache=True, nogil=True, error_model="numpy")
def _sights(
    currents: Array,
    camera: int,
    noise: float,
    total: bool,
    response: Array,
    half_width: float,
    intrinsics: Array,
    lens: Array,
    corrects: bool,
    xy: Array,
    weight: Array,
) -> None:
    lights = currents.shape[2]
    places, sigma = np.empty((lights, 2)), np.empty((lights, 2))
    visible = np.empty(lights, np.bool_)
    for n in range(currents.shape[0]):
        read_currents(
            currents[n, camera], noise, total, response, half_width, places, sigma, visible
        )
        for j in range(lights):
            xy[n, camera, j], weight[n, camera, j] = 0.0, 0.0
            if not visible[j]:
                continue
            x, y, sx, sy = ideal_spot(
                places[j, 0], places[j, 1], sigma[j, 0], sigma[j, 1], intrinsics, lens, corrects
            )
            if np.isfinite(x) and np.isfinite(y):
                xy[n, camera, j, 0], xy[n, camera, j, 1] = x, y
                weight[n, camera, j, 0], weight[n, camera, j, 1] = 1.0 / sx, 1.0 / sy


@njit(cache=True, nogil=True, error_model="numpy")
def _run(
    origin: int,
    first: int,
    end: int,
    leds: Array,
    cr: Array,
    ct: Array,
    xy: Array,
    weight: Array,
    limits: Array,
    rotations: Array,
    translations: Array,
    covariances: Array,
    ok: npt.NDArray[np.bool_],
) -> int:
    """Iterate readings first … end, whose sights begin at origin; returns the first that fails."""
    nothing, identity, zero = np.zeros((6, 6)), np.eye(3), np.zeros(3)
    information, lower = np.empty((6, 6)), np.zeros((6, 6))
    rotation, translation = rotations[first - 1].copy(), translations[first - 1].copy()
    for n in range(first, end):
        i = n - origin
        lights, equations = count_lights(weight[i])
        spare = equations - UNKNOWNS
        if spare < 0 or lights < FEWEST_LIGHTS:
            return n
        cost, _, done = solve(
            rotation, translation, leds, cr, ct, xy[i], weight[i], nothing, identity, zero,
            ITERATIONS, TOLERANCE, information,
        )  # fmt: skip
        if not done or not cost <= limits[min(spare, limits.shape[0] - 1)]:
            return n
        if not invert(information, lower, covariances[n]):
            return n
        rotations[n], translations[n], ok[n] = rotation, translation, True
    return end
