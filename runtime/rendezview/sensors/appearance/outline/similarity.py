"""Search for the stored views, and their rolls, that are most similar to a signature.

The distance of two signatures is the sum of squared differences of their readings.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy import fft

from rendezview.geometry.geodesic import cosine_within
from rendezview.geometry.pose import Array, minimal_rotation
from rendezview.geometry.so3 import about_z
from rendezview.sensors.appearance.model.signature import Readings, roll_against, twist
from rendezview.sensors.appearance.model.view_model import ViewModel

Indices = npt.NDArray[np.intp]

_COARSE = 4  # readings averaged for the first search. Source: recognition-accuracy, seed 1
# Rad around the roll that a neighbouring view gives. Source: recognition-accuracy, seed 1
_ROLL_REACH_RAD = np.deg2rad(6.0)
# Edges; candidates are at least this far apart. Source: recognition-accuracy, seed 1
_APART_EDGES = 1.2
# Edges around a direction; the lattice has half the edge. Source: by construction
_ALIGNED_EDGES = 0.75


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
        self._group = _COARSE if model.bins % _COARSE == 0 else 1
        self._coarse_nodes = self._coarse(self._readings[:nodes])
        self._spectra = np.conj(fft.rfft(self._coarse_nodes, axis=1))

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
        if prior is None:
            nodes, rolls, distances = self._anywhere(coarse)
        else:
            nodes = self._sphere.within(-prior[2], prior_error_rad + self._edge)
            expected = twist(prior, self.node_rotations[nodes])
            rolls, distances = np.empty(len(nodes)), np.empty(len(nodes))
            reach = prior_error_rad + step
            best_shifts(coarse, self._coarse_nodes, nodes, expected, reach, rolls, distances)
        order = np.argsort(distances, kind="stable")
        apart = np.cos(_APART_EDGES * self._edge)
        result = []
        for k in spread_out(order, self._sphere.nodes[nodes], apart, most):
            node = int(nodes[k])
            roll, _ = roll_and_distance(readings, self._readings[node], rolls[k], step)
            result.append(about_z(roll) @ self.node_rotations[node])
        return result

    def _anywhere(self, coarse: Readings) -> tuple[Indices, Array, Array]:
        """All nodes, each at its most similar roll, by circular correlation of signatures."""
        # correlation[s] = Σ_b view[b + s] node[b]
        correlation = fft.irfft(fft.rfft(coarse) * self._spectra, n=len(coarse), axis=1)
        distances = np.sum(self._coarse_nodes**2, axis=1)[:, None] - 2.0 * correlation
        shift = np.argmin(distances, axis=1)
        nodes = np.arange(len(shift))
        # The node's reading at bin b is the view's at bin b − roll.
        return nodes, -2.0 * np.pi / len(coarse) * shift, distances[nodes, shift]

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
        groups = readings.reshape(*readings.shape[:-1], -1, self._group)
        return np.asarray(groups.mean(axis=-1), dtype=np.float32)


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


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def best_shifts(
    view: Readings,
    readings: Readings,
    candidates: Indices,
    expected_rad: Array,
    reach_rad: float,
    rolls_rad: Array,
    distances: Array,
) -> None:
    """For each of some views (K,) the roll near the expected one at the least distance.

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


@njit(cache=True, nogil=True, error_model="numpy")
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
