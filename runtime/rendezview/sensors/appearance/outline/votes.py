"""From a signature to on nodes and a direction of view, given roughly where to look."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy import fft

from rendezview.geometry.pose import Array, Pose, minimal_rotation, rotation_angle
from rendezview.sensors.appearance.model import ViewModel
from rendezview.sensors.appearance.outline.signature import Readings, Signature, twist
from rendezview.sensors.appearance.outline.similarity import (
    best_shifts,
    mean_shift,
    most_alike,
    roll_and_distance,
    spread_out,
)

_COARSE = 4  # readings averaged for the first search
_ROLL_REACH_RAD = np.deg2rad(6.0)  # around the roll that a neighbouring view gives
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

    active_nodes: npt.NDArray[np.intp]  # (K,) ascending
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
        self._coarse_nodes = self._coarse(self._readings[:nodes])
        self._spectra = np.conj(fft.rfft(self._coarse_nodes, axis=1))
        forest, on, off = model.forest, model.leaf_on, model.leaf_off
        # Shrunk, because a pure leaf of one sample is not certain.
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

    def at(self, signature: Signature, pose: Pose) -> Match | None:
        """On nodes at a known pose, camera_from_target; None where there are none."""
        attitude = signature.centred_from_camera @ pose.rotation
        found = self._ask(signature.readings, attitude)
        if found is None:
            return None
        _, residual = self._aligned(signature.readings, found)
        return replace(found, residual=residual)

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
        """Nodes and rolls in order of likeness of their signatures."""
        coarse = self._coarse(readings)
        step = 2.0 * np.pi / len(coarse)
        if prior is None:
            most = self.options.hypotheses_anywhere
            nodes, rolls, distances = self._anywhere(coarse)
        else:
            most = self.options.hypotheses
            nodes = self._sphere.within(-prior[2], prior_error_rad + self._edge)
            expected = twist(prior, self._node_rotations[nodes])
            rolls, distances = np.empty(len(nodes)), np.empty(len(nodes))
            reach = prior_error_rad + step
            best_shifts(coarse, self._coarse_nodes, nodes, expected, reach, rolls, distances)
        order = np.argsort(distances, kind="stable")
        apart = np.cos(1.2 * self._edge)
        result = []
        for k in spread_out(order, self._sphere.nodes[nodes], apart, most):
            node = int(nodes[k])
            roll, _ = roll_and_distance(readings, self._readings[node], rolls[k], step)
            result.append((node, roll))
        return result

    def _anywhere(self, coarse: Readings) -> tuple[npt.NDArray[np.intp], Array, Array]:
        """All nodes, each at its most alike roll, by circular correlation of signatures."""
        # correlation[s] = Σ_b view[b + s] node[b]
        correlation = fft.irfft(fft.rfft(coarse) * self._spectra, n=len(coarse), axis=1)
        distances = np.sum(self._coarse_nodes**2, axis=1)[:, None] - 2.0 * correlation
        shift = np.argmin(distances, axis=1)
        nodes = np.arange(len(shift))
        # readings of the node at bin b stand in the view at bin b − roll
        return nodes, -2.0 * np.pi / len(coarse) * shift, distances[nodes, shift]

    def _ask(self, readings: Readings, attitude: Array) -> Match | None:
        """On nodes around an attitude, and the direction on which they agree."""
        reach = (self.options.margin_edges + 2.0) * self._edge
        nodes = self._sphere.within(-attitude[2], reach)
        on, trust = self.nodes_on(readings, attitude, nodes)
        if len(on) == 0:
            return None
        direction, weights = self.consensus(on, trust)
        return Match(on, weights, direction, attitude)

    def consensus(self, active_nodes: npt.NDArray[np.intp], trust: Array) -> tuple[Array, Array]:
        """Direction of view on which on nodes agree, and how much each weighed, (3,) and (K,).

        A mean shift from the best supported node: far-off nodes weigh little, so one
        wrong tree among five does not pull the direction.
        """
        weights = np.empty(len(active_nodes))
        width = (self.options.kernel_edges * self._edge) ** 2
        mean = np.empty(3)
        mean_shift(self._sphere.nodes[active_nodes], trust, width, weights, mean)
        return mean, weights

    def _aligned(self, readings: Readings, found: Match) -> tuple[Array, float]:
        """The attitude with the direction found and the roll of the most alike view near it.

        Also how far that view is off: root mean square of the differences of readings.
        """
        near = self._lattice.within(found.direction, 0.75 * self._edge)
        rotations = self.model.views.centred_from_target[near]
        guess = twist(found.centred_from_target, rotations)
        best, roll, least = most_alike(readings, self._readings, near, guess, _ROLL_REACH_RAD)
        # turn the target so that it is seen from the direction found, without rolling
        turn = minimal_rotation(found.direction, self._lattice.nodes[near[best]])
        attitude = np.asarray(_about_boresight(roll) @ rotations[best] @ turn)
        return attitude, float(np.sqrt(least / len(readings)))


def _apart(a: Match, b: Match) -> float:
    return rotation_angle(a.centred_from_target @ b.centred_from_target.T)


def _about_boresight(angle_rad: float) -> Array:
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
