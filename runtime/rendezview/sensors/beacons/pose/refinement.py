"""Least squares of a pose on any three or more spots, through the camera's full model."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.estimation.least_squares import (
    DAMPING_DECAY,
    DAMPING_GROWTH,
    FIRST_DAMPING,
    MOST_STEPS,
    damped_step,
)
from rendezview.estimation.linear_algebra import copy_into, copy_matrix_into, invert
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose
from rendezview.geometry.so3 import between, orthonormalise, perturb_into
from rendezview.sensors.beacons.constellation import ReflectorPattern
from rendezview.sensors.beacons.detect.discs import (
    BLUR_PX,
    LAW,
    camera_doubts,
    camera_numbers,
    project_all,
    turned,
)
from rendezview.sensors.beacons.detect.spot_columns import COLUMNS, COVER, SATURATED, SIGMA, X, Y
from rendezview.sensors.beacons.pose.shares import (
    CAUSES,
    COVERED,
    RIM_LAW,
    share_out,
    spot_slopes,
    whole_sigma,
)

Ints = npt.NDArray[np.int64]

# Of damping, before the last pose is taken as the minimum.
_TRIALS = 8  # Source: by construction, a bound only
_STEP = 1e-12  # rad and share of the range: the end. Source: by construction, rounding
# rad + share of the range: after so small a step the cost may rise by rounding.
# Source: by construction, root of rounding
_ROUNDING = 1e-9
_GAIN = 1e-13  # of the cost: the end. Source: by construction, rounding
# × the least σ of a spot, from which a spot's second order counts. Source: by construction, with
# less it is below the others' noise
_BENT = 10.0
# of √2 σ of a spot: nearer, its second order is not tried. Source: by construction, a bound only
_NEAREST = 1.0 / 64.0
# χ² of a step, likewise: of a pose that the spots hardly determine. Source: by construction, 1e-5 σ
_SETTLED = 1e-10


@dataclass(frozen=True, slots=True, eq=False)
class Refined:
    """A pose adjusted to its spots."""

    camera_from_target: Pose
    # (5, 6, 6) camera frame, (rotation vector, translation), left perturbation; one of each cause
    shares: Array
    residuals_px: Array  # (K, 2) observed minus predicted
    covariance: Array = field(init=False)  # (6, 6) of all causes

    def __post_init__(self) -> None:
        object.__setattr__(self, "covariance", self.shares.sum(axis=0))

    @property
    def scatter(self) -> Array:
        """(6, 6) of what may differ between readings: all but camera and places."""
        return np.asarray(self.shares[0] + self.shares[1] + self.shares[COVERED])

    @property
    def slow(self) -> Array:
        """(6, 6) of it that hardly changes from reading to reading: of what lies over spots."""
        return np.asarray(self.shares[COVERED])


class SpotFit:
    """Least squares of one constellation's pose on spots of one camera.

    ``floor_px``: error of a centroid beside the noise.
    """

    def __init__(
        self, camera: Camera, pattern: ReflectorPattern, blur_px: float = BLUR_PX,
        floor_px: float = 0.0,
    ) -> None:  # fmt: skip
        centre = pattern.centre_m
        self._lens, self._floor_px = camera_numbers(camera, blur_px), floor_px
        self._given = (
            camera_doubts(camera), pattern.positions_m - centre, pattern.normals, pattern.discs,
            centre,
        )  # fmt: skip

    def solve(self, start: Pose, table: Array, seen: Ints) -> Refined | None:
        """The pose near ``start`` that fits the rows ``seen`` of a spot table; None: there is none.

        ``table`` (N, COLUMNS): a row each reflector.
        """
        rotation, translation = np.array(start.rotation), np.empty(3)
        shares, residuals = np.empty((len(CAUSES), 6, 6)), np.empty((len(seen), 2))
        iterations = solve_spots(
            self._lens, *self._given, table, seen, self._floor_px,
            rotation, np.array(start.translation_m), translation, shares, residuals,
        )  # fmt: skip
        if iterations < 0:
            return None
        return Refined(Pose.unchecked(rotation, translation), shares, residuals)

    def fit(
        self, spots_px: Array, which: Ints, start: Pose, sigma_px: npt.ArrayLike, *,
        saturated: bool = False,
    ) -> Refined | None:  # fmt: skip
        """The same of spots (K, 2) of the reflectors ``which`` (K,).

        ``sigma_px``: one or (K,). ``saturated``: all spots are: their places are those of rims.
        """
        table = np.zeros((len(self._given[1]), COLUMNS))
        table[which[:, None], [X, Y]] = spots_px
        table[which, SIGMA], table[which, SATURATED] = sigma_px, 2.0 * saturated
        return self.solve(start, table, which)


def loose_px(pattern: ReflectorPattern, refined: Refined, which: Ints, focal_px: float) -> Array:
    """(K,) σ of spots by the places of their reflectors, px."""
    depth = refined.camera_from_target.apply(pattern.positions_m[which])[:, 2]
    return np.asarray(focal_px * pattern.sigmas_m[which] / depth)


@njit(cache=True, nogil=True, error_model="numpy")
def adjust(
    lens: Array, doubts: Array, arms: Array, normals: Array, discs: Array, spots: Array,
    noise: Array, cover: Array, rotation: Array, shift: Array, shares: Array, residuals: Array,
) -> int:  # fmt: skip
    """Levenberg–Marquardt on the spots; changes ``rotation`` and ``shift`` (of the arms' origin).

    ``noise`` is the σ (K,) of the spots, px, beside that of their reflectors' places. Returns the
    number of iterations, −1 where the pose is not determined or leaves the front of the camera.
    """
    diameters, sigma = discs[:, 0].copy(), whole_sigma(lens, discs, arms, noise, rotation, shift)
    normal, lower = np.empty((6, 6)), np.empty((6, 6))
    used = _converge(
        lens, arms, normals, diameters, spots, sigma, rotation, shift, residuals, normal, lower
    )
    if used < 0 or not invert(normal, lower, shares[0]):
        return -1
    share_out(lens, doubts, arms, normals, discs, noise, cover, sigma, rotation, shift, shares)
    for i in range(len(noise)):
        cause = shares[COVERED if cover[i] > 0.0 else 0]
        if noise[i] > _BENT * noise.min() and not _bend(
            lens, arms, normals, diameters, spots, sigma, i, rotation, shift, cause
        ):
            return -1
    orthonormalise(rotation)
    return used


@njit(cache=True, nogil=True, error_model="numpy")
def _bend(
    lens: Array, arms: Array, normals: Array, diameters: Array, spots: Array, sigma: Array,
    i: int, rotation: Array, shift: Array, covariance: Array,
) -> bool:  # fmt: skip
    """Add what is of second order in the error of spot ``i``, which is far larger than others.

    Half the sum of the steps that the pose makes where the spot is off by √2 σ one way and the
    other; the mean of its square over four directions. Where there is no pose so far away, it is
    the same of less, scaled; False where there is none near by.
    """
    way, steps = np.empty(2), np.empty(6)
    for k in range(4):
        share = 1.0
        while True:
            far = share * math.sqrt(2.0) * sigma[i]
            way[0], way[1] = far * math.cos(0.25 * k * math.pi), far * math.sin(0.25 * k * math.pi)
            if _bent(lens, arms, normals, diameters, spots, sigma, i, rotation, shift, way, steps):
                break
            share *= 0.5
            if share < _NEAREST:
                return False
        for a in range(6):
            for b in range(6):
                covariance[a, b] += 0.25 * steps[a] * steps[b] / share**4
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _bent(
    lens: Array, arms: Array, normals: Array, diameters: Array, spots: Array, sigma: Array,
    i: int, rotation: Array, shift: Array, way: Array, steps: Array,
) -> bool:  # fmt: skip
    """Fill half the sum (6,) of a pose's steps where spot ``i`` is off by ``way`` (2,) and −way."""
    turned_r, moved_t, moved = np.empty((3, 3)), np.empty(3), spots.copy()
    residuals, normal, lower = np.empty_like(spots), np.empty((6, 6)), np.empty((6, 6))
    steps[:] = 0.0
    for sign in (-1.0, 1.0):
        moved[i, 0], moved[i, 1] = spots[i, 0] + sign * way[0], spots[i, 1] + sign * way[1]
        copy_matrix_into(rotation, turned_r)
        copy_into(shift, moved_t)
        used = _converge(
            lens, arms, normals, diameters, moved, sigma, turned_r, moved_t, residuals, normal,
            lower,
        )  # fmt: skip
        if used < 0 or used >= MOST_STEPS:
            return False
        turn = between(turned_r, rotation)
        for a in range(3):
            steps[a] += 0.5 * turn[a]
            steps[3 + a] += 0.5 * (moved_t[a] - shift[a])
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _converge(
    lens: Array, arms: Array, normals: Array, diameters: Array, spots: Array, sigma: Array,
    rotation: Array, shift: Array, residuals: Array, normal: Array, lower: Array,
) -> int:  # fmt: skip
    """Levenberg–Marquardt; changes the pose and fills ``residuals`` and normal equations there."""
    right, step, trial_r, trial_t = np.empty(6), np.empty(6), np.empty((3, 3)), np.empty(3)
    trials, damping, done, used = np.empty_like(residuals), 0.0, False, 0
    cost = _cost(lens, arms, normals, diameters, spots, sigma, rotation, shift, residuals)
    if not math.isfinite(cost):
        return -1
    for _ in range(MOST_STEPS):
        used += 1
        _equations(lens, arms, normals, diameters, sigma, rotation, shift, residuals, normal, right)
        if done:
            break
        accepted = False
        far = math.sqrt(shift[0] ** 2 + shift[1] ** 2 + shift[2] ** 2)
        for _ in range(_TRIALS):
            if not damped_step(normal, right, damping, lower, step):
                return -1
            perturb_into(step[:3], rotation, trial_r)
            for a in range(3):
                trial_t[a] = shift[a] + step[3 + a]
            turn = math.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
            move = math.sqrt(step[3] ** 2 + step[4] ** 2 + step[5] ** 2) / far
            if trial_t[2] > 0.0 and turn < 1.0 and move < 1.0:
                new = _cost(lens, arms, normals, diameters, spots, sigma, trial_r, trial_t, trials)
                # At the limit of rounding the cost may rise a little: converged, not a bad step.
                if new <= cost or turn + move < _ROUNDING:
                    copy_matrix_into(trial_r, rotation)
                    copy_matrix_into(trials, residuals)
                    copy_into(trial_t, shift)
                    small = turn < _STEP and move < _STEP
                    done = small or abs(cost - new) <= max(_GAIN * cost, _SETTLED)
                    cost, accepted = new, True
                    damping *= DAMPING_DECAY
                    break
            damping = max(DAMPING_GROWTH * damping, FIRST_DAMPING)
        done = done or not accepted
    return used if done else MOST_STEPS


@njit(cache=True, nogil=True, error_model="numpy")
def _equations(
    lens: Array, arms: Array, normals: Array, diameters: Array, sigma: Array, rotation: Array,
    shift: Array, residuals: Array, normal: Array, right: Array,
) -> None:  # fmt: skip
    """Fill the normal equations (6, 6) and (6,) of the spots."""
    jacobian = np.empty((2, 6))
    normal[:], right[:] = 0.0, 0.0
    for i in range(arms.shape[0]):
        spot_slopes(lens, arms, normals, diameters, rotation, shift, i, jacobian)
        weight = 1.0 / (sigma[i] * sigma[i])
        for a in range(6):
            right[a] += weight * (
                jacobian[0, a] * residuals[i, 0] + jacobian[1, a] * residuals[i, 1]
            )
            for b in range(a + 1):
                normal[a, b] += weight * (
                    jacobian[0, a] * jacobian[0, b] + jacobian[1, a] * jacobian[1, b]
                )
    for a in range(6):
        for b in range(a):
            normal[b, a] = normal[a, b]


@njit(cache=True, nogil=True, error_model="numpy")
def solve_spots(
    lens: Array, doubts: Array, arms: Array, normals: Array, discs: Array, centre: Array,
    table: Array, seen: Ints, floor_px: float, rotation: Array, translation_before: Array,
    translation: Array, shares: Array, residuals: Array,
) -> int:  # fmt: skip
    """`adjust` on the rows ``seen`` of a spot table; pose and covariances at the target's origin.

    ``rotation`` is that of the start and becomes the result's. Returns the iterations, or −1
    where the visible reflectors are on a line or the pose is not determined.
    """
    count = seen.shape[0]
    some_arms, some_normals = np.empty((count, 3)), np.empty((count, 3))
    some_discs, spots = np.empty((count, 2)), np.empty((count, 2))
    sigma, cover = np.empty(count), np.empty(count)
    lens, clipped = lens.copy(), True
    for i in range(count):
        k = seen[i]
        clipped = clipped and table[k, SATURATED] > 1.0
        some_discs[i, 0], some_discs[i, 1] = discs[k, 0], discs[k, 1]
        for a in range(3):
            some_arms[i, a], some_normals[i, a] = arms[k, a], normals[k, a]
        spots[i, 0], spots[i, 1] = table[k, 0], table[k, 1]
        sigma[i], cover[i] = math.sqrt(table[k, SIGMA] ** 2 + floor_px**2), table[k, COVER]
    if not _spans(some_arms):
        return -1
    if clipped:  # their middles are those of their rims
        lens[LAW] = RIM_LAW
    x, y, z = turned(rotation, centre.reshape(1, 3), 0)
    shift = np.empty(3)
    shift[0], shift[1] = translation_before[0] + x, translation_before[1] + y
    shift[2] = translation_before[2] + z
    used = adjust(
        lens, doubts, some_arms, some_normals, some_discs, spots, sigma, cover,
        rotation, shift, shares, residuals,
    )  # fmt: skip
    if used < 0 or used >= MOST_STEPS:
        return -1
    x, y, z = turned(rotation, centre.reshape(1, 3), 0)
    translation[0], translation[1], translation[2] = shift[0] - x, shift[1] - y, shift[2] - z
    for covariance in shares:
        for j in range(
            6
        ):  # rows, then columns: a left rotation w moves the origin by −w × (R centre)
            a, b, c = covariance[0, j], covariance[1, j], covariance[2, j]
            covariance[3, j] += y * c - z * b
            covariance[4, j] += z * a - x * c
            covariance[5, j] += x * b - y * a
        for j in range(6):
            a, b, c = covariance[j, 0], covariance[j, 1], covariance[j, 2]
            covariance[j, 3] += y * c - z * b
            covariance[j, 4] += z * a - x * c
            covariance[j, 5] += x * b - y * a
    return used


@njit(cache=True, nogil=True, error_model="numpy")
def _spans(arms: Array) -> bool:
    """Whether reflectors are not all on one line."""
    longest, widest = 0.0, 0.0
    for i in range(1, arms.shape[0]):
        ax, ay, az = arms[i, 0] - arms[0, 0], arms[i, 1] - arms[0, 1], arms[i, 2] - arms[0, 2]
        longest = max(longest, ax * ax + ay * ay + az * az)
        for j in range(1, i):
            bx, by, bz = arms[j, 0] - arms[0, 0], arms[j, 1] - arms[0, 1], arms[j, 2] - arms[0, 2]
            cx, cy, cz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
            widest = max(widest, cx * cx + cy * cy + cz * cz)
    return widest > 1e-6 * longest * longest


@njit(cache=True, nogil=True, error_model="numpy")
def _cost(
    lens: Array, arms: Array, normals: Array, diameters: Array, spots: Array, sigma: Array,
    rotation: Array, shift: Array, residuals: Array,
) -> float:  # fmt: skip
    total = 0.0
    project_all(lens, arms, normals, diameters, rotation, shift, residuals)
    for i in range(arms.shape[0]):
        for k in range(2):
            residuals[i, k] = spots[i, k] - residuals[i, k]
        total += (residuals[i, 0] ** 2 + residuals[i, 1] ** 2) / (sigma[i] * sigma[i])
    return total if math.isfinite(total) else np.inf
