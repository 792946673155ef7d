"""Search for the stored views, and their rolls, that are most similar to a signature.

The distance of two signatures is the sum of squared differences of their readings.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy import fft

from rendezview.geometry.geodesic import cosine_within
from rendezview.geometry.pose import Array, minimal_rotation
from rendezview.geometry.so3 import about_z
from rendezview.sensors.appearance.model.shadowed_silhouettes import SHADOWED_BINS
from rendezview.sensors.appearance.model.signature import (
    Readings,
    rebinning,
    roll_against,
    twist,
)
from rendezview.sensors.appearance.model.view_model import ViewModel

Indices = npt.NDArray[np.intp]

# Most similar entries at a shift; of these the poses are chosen. Source: by construction, a bound
# of time
_KEPT = 2000
# Of a signature, compared first in a large catalogue. Source: by construction, details of 18°
_HARMONICS = 20
# Entries; of a larger catalogue those with the most similar harmonics. Source: by construction, a
# bound of time
_CORRELATED = 2000
_SAME_ROLL_BINS = 3  # of 90, so 12°. Source: by construction
# Rad around the roll that a neighbouring view gives. Source: recognition-accuracy, seed 1
_ROLL_REACH_RAD = np.deg2rad(6.0)
# Edges; candidates are at least this far apart. Source: recognition-accuracy, seed 1
_APART_EDGES = 1.2
# Edges around a direction; the lattice has half the edge. Source: by construction
_ALIGNED_EDGES = 0.75


class Catalogue:
    """Signatures with their spectra: the similarity of one to all, at every roll at once."""

    def __init__(self, readings: Readings) -> None:
        self.bins = readings.shape[1]
        self._spectra = np.conj(fft.rfft(readings, axis=1))
        self._squares = np.sum(readings**2, axis=1)
        # The amplitudes of the harmonics do not change with roll.
        self._sizes = np.ascontiguousarray(np.abs(self._spectra[:, :_HARMONICS]))

    def most_similar(self, readings: Readings) -> tuple[Indices, Indices]:
        """Entries and shifts in bins, least distance first, at most ``_KEPT``.

        By circular correlation, of the entries whose harmonics are of the right size.
        """
        spectrum = fft.rfft(readings)
        entries = np.arange(len(self._sizes))
        if len(entries) > _CORRELATED:
            sizes = np.abs(spectrum[:_HARMONICS]).astype(np.float32)
            entries = least(_squared_distances(self._sizes, sizes), _CORRELATED)
        distance = self._distances(spectrum, entries).ravel()
        first = least(distance, _KEPT)
        first = first[np.argsort(distance[first], kind="stable")]
        rows, shifts = np.divmod(first, self.bins)
        return entries[rows], shifts

    def nearest(
        self, readings: Readings, entries: Indices, around: Array, reach: float
    ) -> tuple[Indices, Array]:
        """Of some entries (E,) the shift of the least distance, in bins, and that distance.

        Only shifts up to ``reach`` bins from ``around`` (E,) count.
        """
        distances = self._distances(fft.rfft(readings), entries)
        off = np.arange(self.bins) - np.rint(around)[:, None]
        off -= self.bins * np.rint(off / self.bins)
        distances = np.where(np.abs(off) > np.ceil(reach), np.inf, distances)
        shifts = np.argmin(distances, axis=1)
        return shifts, distances[np.arange(len(shifts)), shifts]

    def _distances(self, spectrum: npt.NDArray[np.complex64], entries: Indices) -> npt.NDArray[Any]:
        """Of some entries (E,) at every shift (E, bins), but for the square of the readings."""
        # correlation[s] = Σ_b view[b + s] entry[b]
        correlation = fft.irfft(spectrum * self._spectra[entries], n=self.bins, axis=1)
        return np.asarray(self._squares[entries][:, None] - 2.0 * correlation)


def least(values: npt.NDArray[np.float32], count: int) -> Indices:
    """Places, ascending, of the ``count`` least of many values (K,); all where there are fewer."""
    count = min(count, len(values))
    return np.sort(np.argpartition(values, count - 1)[:count])


class ViewSimilarity:
    """The views of one model, ready to be compared with a signature at every roll."""

    def __init__(self, model: ViewModel) -> None:
        sphere = model.geodesic
        nodes = len(sphere.nodes)
        self.node_rotations = np.ascontiguousarray(model.views.centred_from_target[:nodes])
        # Arrays of a file cannot be written to, which would be another type to the compiler.
        self._rotations = model.views.centred_from_target.copy()
        self._directions = model.lattice.nodes.copy()
        self._sphere, self._edge = sphere, sphere.mean_edge_rad
        self._aligned_cosine = cosine_within(_ALIGNED_EDGES * self._edge)
        self._readings = model.views.readings.astype(np.float32)
        self._rebinning = rebinning(model.bins, SHADOWED_BINS)
        self._catalogue = Catalogue(self._coarse(self._readings[:nodes]))

    def candidates(
        self, readings: Readings, prior: Array | None, prior_error_rad: float, most: int
    ) -> list[Array]:
        """Attitudes (3, 3) of the centred camera, most similar first, at different nodes.

        Args:
            readings: (N,) of the frame.
            prior: (3, 3) expected attitude of the centred camera; ``None``: all are searched.
            prior_error_rad: how far off the prior may be.
            most: attitudes at most.
        """
        coarse = self._coarse(readings)
        step = 2.0 * np.pi / len(coarse)
        # The node's reading at bin b is the view's at bin b − roll.
        nodes, expected = np.arange(len(self.node_rotations)), np.zeros(1)
        reach = float(len(coarse))
        if prior is not None:
            nodes = self._sphere.within(-prior[2], prior_error_rad + self._edge)
            expected = -twist(prior, self.node_rotations[nodes]) / step
            reach = prior_error_rad / step + 1.0
        shifts, distances = self._catalogue.nearest(coarse, nodes, expected, reach)
        rolls = -step * shifts
        order = np.argsort(distances, kind="stable")
        apart = np.cos(_APART_EDGES * self._edge)
        result = []
        anywhere = np.zeros(len(order), np.intp)  # one roll a node
        for place in spread_out(order, anywhere, self._sphere.nodes[nodes], apart, 1, most):
            k = order[place]
            node = int(nodes[k])
            roll, _ = roll_and_distance(readings, self._readings[node], rolls[k], step)
            result.append(about_z(roll) @ self.node_rotations[node])
        return result

    def aligned(self, readings: Readings, direction: Array, attitude: Array) -> tuple[Array, float]:
        """Attitude (3, 3) with a given direction and the roll of the most similar view near it.

        Args:
            readings: (N,) of the frame.
            direction: (3,) unit, view centre → camera, target frame.
            attitude: (3, 3) of the centred camera, roughly.

        Returns:
            The attitude, and the root mean square difference to that view's readings.
        """
        best, roll, least = most_similar(
            readings, self._readings, self._directions, self._rotations, direction,
            self._aligned_cosine, attitude, _ROLL_REACH_RAD,
        )  # fmt: skip
        # Turn the target, without rolling, until it is seen from the direction.
        turn = minimal_rotation(direction, self._directions[best])
        turned = np.asarray(about_z(roll) @ self._rotations[best] @ turn)
        return turned, float(np.sqrt(least / len(readings)))

    def _coarse(self, readings: Readings) -> Readings:
        return np.asarray(readings @ self._rebinning, dtype=np.float32)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def roll_and_distance(
    view: Readings, node: Readings, guess_rad: float, reach_rad: float
) -> tuple[float, float]:
    """Roll of a view against a node by least distance, and that distance.

    Whole bins within the reach of the guess, then the vertex of the parabola through the
    least three.
    """
    bins = view.shape[0]
    step = 2.0 * np.pi / bins
    middle = int(np.rint(-guess_rad / step))
    half = int(np.ceil(reach_rad / step))
    count = 2 * half + 1
    distance, best = np.empty(count), 0
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
        if distance[k] < distance[best]:
            best = k
    shift = float(middle + best - half)
    if 0 < best < count - 1:
        bend = distance[best - 1] - 2.0 * distance[best] + distance[best + 1]
        if bend > 0.0:
            shift += 0.5 * (distance[best - 1] - distance[best + 1]) / bend
    return -shift * step, distance[best]


@njit(cache=True, nogil=True, error_model="numpy")
def most_similar(
    view: Readings, readings: Readings, directions: Array, rotations: Array, direction: Array,
    cosine: float, attitude: Array, reach_rad: float,
) -> tuple[int, float, float]:  # fmt: skip
    """The view around a direction that is most similar to a signature: which, roll, distance.

    Args:
        view: (N,) readings of the signature.
        readings: (V, N) of all views, with their unit ``directions`` (V, 3) and ``rotations``
            (V, 3, 3), centred_from_target.
        direction: (3,) unit; cosine: of the angle of the views from it, at most.
        attitude: (3, 3) centred_from_target of the signature, for the roll, which is right to
            ``reach_rad``.
    """
    best, best_roll, least = 0, 0.0, np.inf
    x, y, z = direction[0], direction[1], direction[2]
    for k in range(directions.shape[0]):
        if x * directions[k, 0] + y * directions[k, 1] + z * directions[k, 2] < cosine:
            continue
        guess_rad = roll_against(attitude, rotations[k])
        roll, distance = roll_and_distance(view, readings[k], guess_rad, reach_rad)
        if distance < least:
            best, best_roll, least = k, roll, distance
    return best, best_roll, least


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _squared_distances(
    rows: npt.NDArray[np.float32], one: npt.NDArray[np.float32]
) -> npt.NDArray[np.float32]:
    """Of each of some vectors (K, N) to one (N,)."""
    squares = np.empty(rows.shape[0], dtype=np.float32)
    for k in range(rows.shape[0]):
        total = np.float32(0.0)
        for j in range(one.shape[0]):
            apart = rows[k, j] - one[j]
            total += apart * apart
        squares[k] = total
    return squares


@njit(cache=True, nogil=True, error_model="numpy")
def spread_out(
    views: Indices, shifts: Indices, directions: Array, cosine: float, bins: int, most: int
) -> Indices:
    """Places of the first of some views and shifts (K,), in order, that are not near one before.

    Near are directions (V, 3) within acos(cosine) at shifts, of so many bins, that are alike.
    """
    chosen = np.empty(most, dtype=np.intp)
    count = 0
    for k in range(views.shape[0]):
        near = False
        a = directions[views[k]]
        for j in range(count):
            b = directions[views[chosen[j]]]
            if a[0] * b[0] + a[1] * b[1] + a[2] * b[2] > cosine:
                apart = abs(shifts[k] - shifts[chosen[j]])
                if min(apart, bins - apart) <= _SAME_ROLL_BINS:
                    near = True
                    break
        if not near:
            chosen[count] = k
            count += 1
            if count == most:
                break
    return chosen[:count]
