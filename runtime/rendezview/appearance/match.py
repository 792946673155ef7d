"""From a signature to on nodes and a direction of view, given roughly where to look."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy import fft

from rendezview.appearance.model import ViewModel
from rendezview.appearance.signature import Readings, Signature, twist
from rendezview.pose import Array, minimal_rotation, rotation_angle

_COARSE = 4  # readings averaged for the first search
_SETTLED = 0.5  # of the residual that good views keep below: no other attitude is tried


@dataclass(frozen=True, kw_only=True)
class MatchOptions:
    """How far to look."""

    prior_error_rad: float = np.deg2rad(20.0)  # Cleghorn & Sternberg's "about 20 degrees"
    margin_edges: float = 1.2  # nodes that far outside the prior's circle may be on too
    hypotheses: int = 4  # attitudes whose nodes are asked, near a prior …
    hypotheses_anywhere: int = 12  # … and without one
    rival_angle_rad: float = np.deg2rad(25.0)  # another answer, no longer the same one
    rival_residual: float = 1.5  # times the best one's: as good as that is not worse
    kernel_edges: float = 1.65  # on nodes farther than this from the others weigh little


@dataclass(frozen=True, slots=True, eq=False)
class Match:
    """What the trees said of one signature, at the attitude they agree on best."""

    on_nodes: npt.NDArray[np.intp]  # (K,) ascending
    weights: Array  # (K,) trust in each, 0 … 1
    direction: Array  # (3,) unit, view centre → camera, target frame
    centred_from_target: Array  # (3, 3) attitude of the camera turned to the centroid
    residual: float = float("nan")  # r.m.s. of the readings less those of the most alike view
    rival: Match | None = None  # another attitude that fits nearly as well


class Matcher:
    """Searches the views of one model; holds what is computed once."""

    def __init__(self, model: ViewModel, options: MatchOptions | None = None) -> None:
        self.model = model
        self.options = options or MatchOptions()
        self._sphere, self._lattice = model.geodesic, model.lattice
        self._edge = self._sphere.mean_edge_rad
        nodes = len(self._sphere.nodes)
        self._node_rotations = np.ascontiguousarray(model.views.centred_from_target[:nodes])
        self._readings = model.views.readings.astype(np.float32)
        self._group = _COARSE if model.bins % _COARSE == 0 else 1
        coarse = self._coarse(self._readings[:nodes])
        self._spectra = np.conj(fft.rfft(coarse, axis=1))
        self._energy = np.sum(coarse**2, axis=1)
        forest, on, off = model.forest, model.leaf_on, model.leaf_off
        # Laplace's rule of succession: a pure leaf of one sample is not certain.
        trust = (on + 0.5) / (on + off + 2.0)
        self._trust = np.where(forest.category == 1, trust, 0.0)

    def _coarse(self, readings: Readings) -> Readings:
        groups = readings.reshape(*readings.shape[:-1], -1, self._group)
        return np.asarray(groups.mean(axis=-1), dtype=np.float32)

    def match(
        self,
        signature: Signature,
        prior_centred_from_target: Array | None = None,
        prior_error_rad: float | None = None,
    ) -> Match | None:
        """The attitude whose views are most alike and whose trees agree.

        Args:
            signature: of the frame.
            prior_centred_from_target: (3, 3) expected attitude of the centred camera;
                ``None`` to look everywhere.
            prior_error_rad: how far off the prior may be; ``None``: as the options say.

        Returns:
            ``None`` where no node is on. Without a prior, ``rival`` holds another attitude
            that fits nearly as well, if there is one.
        """
        error_rad = self.options.prior_error_rad if prior_error_rad is None else prior_error_rad
        usual = _SETTLED * self.model.held_out.residual
        found: list[Match] = []
        readings = signature.readings
        for node, roll in self._candidates(readings, prior_centred_from_target, error_rad):
            first = self._ask(readings, _about_boresight(roll) @ self._node_rotations[node])
            if first is None:
                continue
            # Once more with the roll that fits the views around the direction found.
            attitude, _ = self._aligned(readings, first)
            second = self._ask(readings, attitude) or first
            attitude, residual = self._aligned(readings, second)
            found.append(
                replace(second, centred_from_target=attitude, residual=residual, rival=None)
            )
            if prior_centred_from_target is not None and residual < usual:
                return found[-1]
        if not found:
            return None
        best = min(found, key=lambda m: m.residual)
        if prior_centred_from_target is not None:
            return best
        others = [m for m in found if _apart(m, best) > self.options.rival_angle_rad]
        rival = min(others, key=lambda m: m.residual, default=None)
        if rival is None or rival.residual > self.options.rival_residual * best.residual:
            return best
        return replace(best, rival=rival)

    def nodes_on(
        self, readings: Readings, centred_from_target: Array, nodes: npt.NDArray[np.intp]
    ) -> tuple[npt.NDArray[np.intp], Array]:
        """Of some nodes (K,) those that are on, with their trust, at a known attitude."""
        rolls = twist(centred_from_target, self._node_rotations[nodes])
        trust = self.trust_of(self.model.forest.leaves(readings, nodes, rolls))
        on = trust > 0.0
        return nodes[on], trust[on]

    def trust_of(self, leaves: npt.NDArray[np.int32]) -> Array:
        """How surely a leaf (K,) means on, 0 … 1; 0 at a leaf that means off."""
        return np.asarray(self._trust[leaves])

    def _candidates(
        self, readings: Readings, prior: Array | None, prior_error_rad: float
    ) -> list[tuple[int, float]]:
        """Nodes and rolls in order of likeness, by circular correlation of signatures."""
        coarse = self._coarse(readings)
        spectrum = fft.rfft(coarse)
        if prior is None:
            nodes = np.arange(len(self._spectra))
        else:
            reach = prior_error_rad + self._edge
            nodes = self._sphere.within(-prior[2], reach)
        # correlation[s] = Σ_b view[b + s] node[b]
        correlation = fft.irfft(spectrum * self._spectra[nodes], n=len(coarse), axis=1)
        distance = self._energy[nodes, None] - 2.0 * correlation
        step = 2.0 * np.pi / len(coarse)
        # readings of the node at bin b stand in the view at bin b − roll
        rolls = -step * np.arange(len(coarse))
        if prior is not None:
            expected = twist(prior, self._node_rotations[nodes])
            off = (rolls[None] - expected[:, None] + np.pi) % (2.0 * np.pi) - np.pi
            distance[np.abs(off) > prior_error_rad + step] = np.inf
        shift = np.argmin(distance, axis=1)
        least = distance[np.arange(len(nodes)), shift]
        order = np.argsort(least, kind="stable")
        result: list[tuple[int, float]] = []
        most = self.options.hypotheses_anywhere if prior is None else self.options.hypotheses
        for k in order:
            node = int(nodes[k])
            near = any(
                self._sphere.nodes[node] @ self._sphere.nodes[other] > np.cos(1.2 * self._edge)
                for other, _ in result
            )
            if near:
                continue
            roll = _best_roll(readings, self._readings[node], float(rolls[shift[k]]), step)
            result.append((node, roll))
            if len(result) == most:
                break
        return result

    def _ask(self, readings: Readings, attitude: Array) -> Match | None:
        """On nodes around an attitude, and the direction on which they agree."""
        reach = (self.options.margin_edges + 2.0) * self._edge
        nodes = self._sphere.within(-attitude[2], reach)
        on, trust = self.nodes_on(readings, attitude, nodes)
        if len(on) == 0:
            return None
        direction, weights = self.consensus(on, trust)
        return Match(on, weights, direction, attitude)

    def consensus(self, on_nodes: npt.NDArray[np.intp], trust: Array) -> tuple[Array, Array]:
        """Direction of view on which on nodes agree, and how much each weighed, (3,) and (K,).

        A mean shift from the best supported node: far-off nodes weigh little, so one
        wrong tree among five does not pull the direction.
        """
        directions = self._sphere.nodes[on_nodes]
        width = (self.options.kernel_edges * self._edge) ** 2
        support = np.exp((directions @ directions.T - 1.0) / width) @ trust
        mean = directions[int(np.argmax(support))]
        weights = trust
        for _ in range(5):
            weights = trust * np.exp((directions @ mean - 1.0) / width)
            mean = weights @ directions
            mean = mean / np.sqrt(mean @ mean)
        return mean, weights

    def _aligned(self, readings: Readings, found: Match) -> tuple[Array, float]:
        """The attitude with the direction found and the roll of the most alike view near it.

        Also how far that view is off: root mean square of the differences of readings.
        """
        near = self._lattice.within(found.direction, 0.75 * self._edge)
        rotations = self.model.views.centred_from_target[near]
        guess = twist(found.centred_from_target, rotations)
        step = np.deg2rad(6.0)
        best, least, roll = 0, np.inf, 0.0
        for k in range(len(near)):
            r, d = _roll_and_distance(readings, self._readings[near[k]], guess[k], step)
            if d < least:
                best, least, roll = k, d, r
        # turn the target so that it is seen from the direction found, without rolling
        turn = minimal_rotation(found.direction, self._lattice.nodes[near[best]])
        attitude = np.asarray(_about_boresight(roll) @ rotations[best] @ turn)
        return attitude, float(np.sqrt(least / len(readings)))


def _apart(a: Match, b: Match) -> float:
    return rotation_angle(a.centred_from_target @ b.centred_from_target.T)


def _about_boresight(angle_rad: float) -> Array:
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _best_roll(view: Readings, node: Readings, guess_rad: float, reach_rad: float) -> float:
    return float(_roll_and_distance(view, node, guess_rad, reach_rad)[0])


@njit(cache=True, nogil=True, fastmath=True)
def _roll_and_distance(
    view: Readings, node: Readings, guess_rad: float, reach_rad: float
) -> tuple[float, float]:
    """Roll of a view against a node by least squared distance of readings, and the distance.

    Whole bins within the reach, then the vertex of the parabola through the least three.
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
