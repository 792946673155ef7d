"""The inner loops of matching: signatures against signatures, directions against directions."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.geometry.pose import Array
from rendezview.sensors.appearance.outline.signature import Readings

Indices = npt.NDArray[np.intp]


@njit(cache=True, nogil=True, fastmath=True, forceinline=True)
def roll_and_distance(
    view: Readings, node: Readings, guess_rad: float, reach_rad: float
) -> tuple[float, float]:
    """Roll of a view against a node by least squared distance of readings, and the distance.

    Whole bins within the reach of the guess, then the vertex of the parabola through the
    least three.
    """
    bins = view.shape[0]
    step = 2.0 * np.pi / bins
    middle = int(np.rint(-guess_rad / step))
    half = int(np.ceil(reach_rad / step))
    count = 2 * half + 1
    distance = np.empty(count)
    for k in range(count):
        start = (middle + k - half) % bins
        total = np.float32(0.0)
        for b in range(bins - start):
            d = view[b + start] - node[b]
            total += d * d
        for b in range(bins - start, bins):
            d = view[b + start - bins] - node[b]
            total += d * d
        distance[k] = total
    best = int(np.argmin(distance))
    shift = float(middle + best - half)
    if 0 < best < count - 1:
        bend = distance[best - 1] - 2.0 * distance[best] + distance[best + 1]
        if bend > 0.0:
            shift += 0.5 * (distance[best - 1] - distance[best + 1]) / bend
    return -shift * step, distance[best]


@njit(cache=True, nogil=True, fastmath=True)
def best_shifts(
    view: Readings,
    readings: Readings,
    candidates: Indices,
    expected_rad: Array,
    reach_rad: float,
    rolls_rad: Array,
    distances: Array,
) -> None:
    """For each of some views (K,) the roll near the expected one at which it is most alike.

    Whole bins only; ``rolls_rad`` and ``distances`` (K,) receive roll and squared distance.
    """
    bins = view.shape[0]
    step = 2.0 * np.pi / bins
    half = min(int(np.ceil(reach_rad / step)), bins // 2)
    twice = np.concatenate((view, view))
    for k in range(candidates.shape[0]):
        node = readings[candidates[k]]
        middle = int(np.rint(-expected_rad[k] / step))
        distances[k] = np.inf
        for shift in range(middle - half, middle + half + 1):
            part = twice[shift % bins : shift % bins + bins]
            total = np.float32(0.0)
            for b in range(bins):
                d = part[b] - node[b]
                total += d * d
            if total < distances[k]:
                distances[k] = total
                rolls_rad[k] = -shift * step


@njit(cache=True, nogil=True)
def most_alike(
    view: Readings, readings: Readings, candidates: Indices, guesses_rad: Array, reach_rad: float
) -> tuple[int, float, float]:
    """Of some views (K,) the one nearest to a signature: its place among them, roll, distance."""
    best, best_roll, least = 0, 0.0, np.inf
    for k in range(candidates.shape[0]):
        roll, distance = roll_and_distance(view, readings[candidates[k]], guesses_rad[k], reach_rad)
        if distance < least:
            best, best_roll, least = k, roll, distance
    return best, best_roll, least


@njit(cache=True, nogil=True)
def spread_out(order: Indices, directions: Array, cosine: float, most: int) -> Indices:
    """The first of some directions (K, 3), in order, no two nearer than acos(cosine)."""
    chosen = np.empty(most, dtype=np.intp)
    count = 0
    for k in order:
        near = False
        for j in range(count):
            a, b = directions[k], directions[chosen[j]]
            if a[0] * b[0] + a[1] * b[1] + a[2] * b[2] > cosine:
                near = True
                break
        if not near:
            chosen[count] = k
            count += 1
            if count == most:
                break
    return chosen[:count]


@njit(cache=True, nogil=True)
def mean_shift(directions: Array, trust: Array, width: float, weights: Array, mean: Array) -> None:
    """Mode of weighted directions (K, 3) under the kernel ``exp((cos − 1)/width)``.

    From the best supported direction, five steps. ``weights`` (K,) receives trust times
    kernel at the mode, ``mean`` (3,) the mode.
    """
    count = directions.shape[0]
    start, most = 0, -1.0
    for i in range(count):
        support = 0.0
        for j in range(count):
            a, b = directions[i], directions[j]
            cosine = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
            support += trust[j] * np.exp((cosine - 1.0) / width)
        if support > most:
            start, most = i, support
    mean[:] = directions[start]
    for _ in range(5):
        total = np.zeros(3)
        for j in range(count):
            b = directions[j]
            cosine = mean[0] * b[0] + mean[1] * b[1] + mean[2] * b[2]
            weights[j] = trust[j] * np.exp((cosine - 1.0) / width)
            total += weights[j] * b
        mean[:] = total / np.sqrt(np.sum(total * total))
