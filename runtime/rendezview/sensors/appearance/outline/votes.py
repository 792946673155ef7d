"""From a signature to active nodes, and to the direction of view that they vote for."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.estimation.hypotheses import choose
from rendezview.geometry.pose import Array, Pose, rotation_angle
from rendezview.sensors.appearance.model.signature import Readings, Signature, twist
from rendezview.sensors.appearance.model.view_model import ViewModel
from rendezview.sensors.appearance.outline.silhouette import Missing
from rendezview.sensors.appearance.outline.similarity import Indices, ViewSimilarity
from rendezview.sensors.observation import Status

# Share of the residual that 99.5 % of good views stay below; a smaller one needs no other
# attitude. Source: experiment recognition-accuracy, seed 1
_SETTLED = 0.5
# Of the same residual; a larger one means another outline, of another body or of the lit parts
# only. Source: by construction
_MOST_RESIDUAL = 1.0
# A node is active above these log odds of its forest, and as likely as not at the even ones.
# Source: experiment recognition-accuracy, hubble, seed 11
LEAST_ODDS, EVEN_ODDS, STEEPNESS = -2.0, -1.5, 1.1
_SHIFTS = 5  # steps of the mean shift. Source: by construction, a bound only


@dataclass(frozen=True, kw_only=True)
class MatchOptions:
    """How far to search."""

    # Rad. Source: Cleghorn & Sternberg 1991, "about 20 degrees"
    prior_error_rad: float = np.deg2rad(20.0)
    # Edges; nodes so far outside the prior's circle may be active too.
    # Source: experiment recognition-accuracy, seed 1
    margin_edges: float = 1.2
    # Attitudes whose nodes are evaluated near a prior. Source: recognition-accuracy, seed 1
    attitudes: int = 4
    # The same without a prior. Source: experiment recognition-accuracy, seed 1
    attitudes_anywhere: int = 12
    # Rad; an attitude farther off is another answer. Source: recognition-accuracy, seed 1
    rival_angle_rad: float = np.deg2rad(25.0)
    # Times the best residual; a rival below it is as good. Source: recognition-accuracy, seed 1
    rival_residual: float = 1.5
    # Edges; active nodes farther than this from the others weigh little.
    # Source: experiment recognition-accuracy, seed 1
    kernel_edges: float = 1.65


@dataclass(frozen=True, slots=True, eq=False)
class Match:
    """The trees' votes on one signature, at the attitude with the best agreement."""

    active_nodes: Indices  # (K,) ascending
    weights: Array  # (K,) trust in each, 0 … 1
    direction: Array  # (3,) unit, view centre → camera, target frame
    centred_from_target: Array  # (3, 3) attitude of the camera turned to the centroid
    residual: float = float("nan")  # r.m.s. of the readings less those of the most similar view
    rival: Match | None = None  # another attitude that fits nearly as well


class Matcher:
    """Finds the active nodes of one model; holds tables that are computed once."""

    def __init__(self, model: ViewModel, options: MatchOptions | None = None) -> None:
        self.model = model
        self.options = options or MatchOptions()
        self._views = ViewSimilarity(model)
        self._sphere = model.geodesic
        self._edge = self._sphere.mean_edge_rad
        self._reach_rad = (self.options.margin_edges + 2.0) * self._edge
        self._usual_residual = model.held_out.residual
        forest, on, off = model.forest, model.leaf_on, model.leaf_off
        # Shrunk, because a pure leaf of one sample is not certain.
        trust = (on + 0.5) / (on + off + 2.0)
        self._trust = np.where(forest.category == 1, trust, 0.0)
        self.forest_scores = model.forest_scores()

    def match(
        self,
        signature: Signature,
        prior_centred_from_target: Array | None = None,
        prior_error_rad: float | None = None,
    ) -> Match | None:
        """The attitude whose views are most similar and whose trees agree.

        Args:
            signature: of the frame.
            prior_centred_from_target: (3, 3) expected attitude of the centred camera;
                ``None``: all attitudes are searched.
            prior_error_rad: how far off the prior may be; ``None``: the value of the options.

        Returns:
            ``None`` where no node is active. Without a prior, ``rival`` holds another attitude
            that fits nearly as well, if there is one.
        """
        options, prior = self.options, prior_centred_from_target
        error_rad = options.prior_error_rad if prior_error_rad is None else prior_error_rad
        most = options.attitudes_anywhere if prior is None else options.attitudes
        readings = signature.readings
        found: list[Match] = []
        for attitude in self._views.candidates(readings, prior, error_rad, most):
            first = self._vote(readings, attitude)
            if first is None:
                continue
            # Once more with the roll that fits the views around the direction found.
            attitude, _ = self._views.aligned(readings, first.direction, attitude)
            second = self._vote(readings, attitude) or first
            attitude, residual = self._views.aligned(
                readings, second.direction, second.centred_from_target
            )
            found.append(replace(second, centred_from_target=attitude, residual=residual))
            if prior is not None and residual < _SETTLED * self._usual_residual:
                return found[-1]
        choice = choose(
            [-one.residual for one in found],
            lambda k, known: _apart(found[k], found[known]) <= options.rival_angle_rad,
        )
        if choice is None:
            return None
        best = found[choice.best]
        if prior is not None or not choice.rivals:
            return best
        rival = found[choice.rivals[0]]
        as_good = rival.residual <= options.rival_residual * best.residual
        return replace(best, rival=rival) if as_good else best

    def at(self, signature: Signature, pose: Pose) -> Match | None:
        """Active nodes at a known pose, camera_from_target; ``None`` where there are none."""
        attitude = signature.centred_from_camera @ pose.rotation
        found = self._vote(signature.readings, attitude)
        if found is None:
            return None
        _, residual = self._views.aligned(signature.readings, found.direction, attitude)
        return replace(found, residual=residual)

    def _vote(self, readings: Readings, attitude: Array) -> Match | None:
        """Active nodes around an attitude, and the direction on which they agree."""
        near = self._sphere.within(-attitude[2], self._reach_rad)
        trust = self.decided(near, readings, twist(attitude, self._views.node_rotations[near]))
        nodes, trust = near[trust > 0.0], trust[trust > 0.0]
        if len(nodes) == 0:
            return None
        direction, weights = self.consensus(nodes, trust)
        return Match(nodes, weights, direction, attitude)

    def decided(self, nodes: Indices, readings: Readings, rolls_rad: Array) -> Array:
        """The trust (K,) that nodes are active, 0 where they are not.

        The forest of the nodes decides; in a model without them the tree of each node.
        """
        if self.forest_scores is None:
            return self.trust_of(self.model.forest.leaves(readings, nodes, rolls_rad))
        odds = self.forest_scores.node_odds(readings, nodes, rolls_rad)
        trust = 1.0 / (1.0 + np.exp(-STEEPNESS * (odds - EVEN_ODDS)))
        return np.where(odds > LEAST_ODDS, trust, 0.0)

    def trust_of(self, leaves: npt.NDArray[np.int32]) -> Array:
        """The confidence of a leaf (K,) that its node is active, 0 … 1; 0 where it is inactive."""
        return np.asarray(self._trust[leaves])

    def consensus(self, active_nodes: Indices, trust: Array) -> tuple[Array, Array]:
        """Direction (3,) on which active nodes agree, and the weight (K,) of each.

        A mean shift from the direction with most votes. Nodes far off weigh little, so one
        wrong tree among five does not pull the direction.
        """
        weights = np.empty(len(active_nodes))
        width = (self.options.kernel_edges * self._edge) ** 2
        mean = np.empty(3)
        mean_shift(self._sphere.nodes[active_nodes], trust, width, weights, mean)
        return mean, weights

    def refusal(self, match: Match) -> Missing | None:
        """Why a match gives no pose; ``None`` if it gives one."""
        limit = _MOST_RESIDUAL * self._usual_residual
        if match.residual > limit:
            return Missing(
                Status.UNRECOGNIZED,
                f"the outline is unlike every view of the target (differs by "
                f"{match.residual:.0f} thousandths of its size, at most {limit:.0f} is usual)",
            )
        if match.rival is not None:
            return Missing(
                Status.AMBIGUOUS,
                f"two attitudes {np.rad2deg(_apart(match, match.rival)):.0f}° apart fit this "
                "outline: give a prior, or look at more frames",
            )
        return None


def _apart(a: Match, b: Match) -> float:
    return rotation_angle(a.centred_from_target @ b.centred_from_target.T)


@njit(cache=True, nogil=True, error_model="numpy")
def mean_shift(directions: Array, trust: Array, width: float, weights: Array, mean: Array) -> None:
    """Mode of weighted directions (K, 3) under the kernel ``exp((cos − 1)/width)``.

    Five steps from the direction with most votes. ``weights`` (K,) receives trust times kernel
    at the mode, ``mean`` (3,) the mode.
    """
    count = directions.shape[0]
    start, most = 0, -1.0
    for i in range(count):
        votes = 0.0
        for j in range(count):
            a, b = directions[i], directions[j]
            cosine = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
            votes += trust[j] * np.exp((cosine - 1.0) / width)
        if votes > most:
            start, most = i, votes
    # Plain numbers: numba compiles ``mean[:] = …`` for three seconds, for its error message.
    x, y, z = directions[start, 0], directions[start, 1], directions[start, 2]
    for _ in range(_SHIFTS):
        p, q, r = 0.0, 0.0, 0.0
        for j in range(count):
            b = directions[j]
            weights[j] = trust[j] * np.exp((x * b[0] + y * b[1] + z * b[2] - 1.0) / width)
            p, q, r = p + weights[j] * b[0], q + weights[j] * b[1], r + weights[j] * b[2]
        length = np.sqrt(p * p + q * q + r * r)
        x, y, z = p / length, q / length, r / length
    mean[0], mean[1], mean[2] = x, y, z
