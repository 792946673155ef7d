"""What a strain of the craft against its model does to a pose, and how large the edges say it is.

A strain S (symmetric) moves the edge of a point q from the view centre by s = j S q along its
normal, for the slope j. The pose absorbs most of that: (ΣwJJᵀ)⁻¹ ΣwJs. The rest is left in the
residuals, and tells how large the strains are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from rendezview.estimation.least_squares import tukey_weight
from rendezview.geometry.pose import Array
from rendezview.sensors.appearance.edges.alignment import to_origin
from rendezview.sensors.appearance.edges.grey import point_of_slope
from rendezview.sensors.appearance.edges.predicted import FOUND, RESIDUAL, STATE, WEIGHT

_HALF_ROOT = np.sqrt(0.5)  # of a shear, which stands twice in its matrix. Source: by construction
# One σ of a strain: each is as likely before the frame is looked at, since nobody knows how exact
# a mesh is. Source: by construction, a third of what the views are off by, to a tenth of the size
_SIGMAS = np.geomspace(1e-4, 0.1, 12)
# Of the variance: a craft differs from its model in other ways than by one strain, too, of which
# the edges show less. Source: pose-misfit (0.1), hubble and client, seed 7, and close-in (0.1),
# client, seed 5 (Mitsuba): no mean normalised error squared above eight
_OTHER_WAYS = 1.6
# Of the strain that shows most: one that shows less is absorbed by the pose, as a uniform one is by
# the range. Source: by construction, rounding
_UNSEEN = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class StrainMoves:
    """What the edges of a frame tell of pose and strain, apart.

    The six components of a strain are xx, yy, zz, √2 xy, √2 xz, √2 yz in target axes: with these
    factors one that is alike in all directions has a diagonal covariance.
    """

    response: Array  # (6, 6) of the pose at the view centre to a unit of each strain
    information: Array  # (6, 6) on the strains that the pose does not absorb, 1/px²
    right: Array  # (6,) the same sums with the residuals: information @ strain of best fit

    @classmethod
    def of(
        cls, edges: Array, cut: float, loose: Array, rotation: Array, centre: Array
    ) -> StrainMoves:
        """Of the edges last measured.

        Args:
            edges: (N, COLUMNS); the weight of residuals beyond ``cut`` is zero.
            loose: (6,) information that there is anyway, so that all stays finite.
            rotation: (3, 3), and ``centre``: (3,) of the view centre, camera frame.
        """
        pose, both, strain = np.diag(loose), np.zeros((6, 6)), np.zeros((6, 6))
        rights = np.zeros((2, 6))
        _add_moves(edges, cut, rotation, centre, pose, both, strain, rights)
        response: Array = np.asarray(np.linalg.solve(pose, both), dtype=np.float64)
        return cls(response, strain - both.T @ response, rights[1] - response.T @ rights[0])

    def covariance(self, arm: Array, strain: Array) -> Array:
        """(6, 6) of the target's origin where the craft is the model strained.

        Args:
            arm: (3,) from the target's origin to the view centre, camera axes.
            strain: (6, 6) covariance of the strain's components.
        """
        response = to_origin(arm) @ self.response
        return np.asarray(response @ strain @ response.T)

    def likely_variance(self, sigma_px: float) -> float:
        """The expected square of a component of the strain, as the residuals show it.

        Strains of best fit are independent along the eigenvectors of their information a, and
        ŝ ~ N(0, σ² + 1/a) for strains of one σ in all directions. The mean of σ² is taken over
        ``_SIGMAS`` by their likelihood. Where the edges show no strain, that is about what they
        could not show.

        Args:
            sigma_px: one σ of an edge.
        """
        shown, axes = np.linalg.eigh(self.information / sigma_px**2)
        right = axes.T @ self.right / sigma_px**2
        seen = shown > _UNSEEN * shown[-1]
        shown, right = shown[seen], right[seen]
        square = right**2 / shown  # ŝ over its own σ, squared
        spread = 1.0 + shown * _SIGMAS[:, None] ** 2
        log = -0.5 * np.sum(np.log(spread) + square / spread, axis=1)
        likelihood = np.exp(log - log.max())
        return _OTHER_WAYS * float(likelihood @ _SIGMAS**2 / likelihood.sum())


@njit(cache=True, nogil=True, error_model="numpy")
def _add_moves(
    edges: Array, cut: float, rotation: Array, centre: Array, pose: Array, both: Array,
    strain: Array, rights: Array,
) -> None:  # fmt: skip
    """Add ΣwJJᵀ, ΣwJs and Σwss to matrices (6, 6), and ΣwJr and Σwsr to ``rights`` (2, 6)."""
    moves, q, g = np.empty(6), np.empty(3), np.empty(3)
    for n in range(edges.shape[0]):
        if edges[n, STATE] != FOUND:
            continue
        r = edges[n, RESIDUAL]
        w = edges[n, WEIGHT] * tukey_weight(r, cut)
        if w == 0.0:
            continue
        point_of_slope(edges[n], rotation, centre, q, g)
        moves[0], moves[1], moves[2] = g[0] * q[0], g[1] * q[1], g[2] * q[2]
        moves[3] = (g[0] * q[1] + g[1] * q[0]) * _HALF_ROOT
        moves[4] = (g[0] * q[2] + g[2] * q[0]) * _HALF_ROOT
        moves[5] = (g[1] * q[2] + g[2] * q[1]) * _HALF_ROOT
        for a in range(6):
            wj, wm = w * edges[n, a], w * moves[a]
            rights[0, a] += wj * r
            rights[1, a] += wm * r
            for b in range(6):
                pose[a, b] += wj * edges[n, b]
                both[a, b] += wj * moves[b]
                strain[a, b] += wm * moves[b]
