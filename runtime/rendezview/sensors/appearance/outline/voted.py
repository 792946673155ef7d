"""The attitude of a silhouette by its forest: also where shadow hides a part of the target."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from rendezview.geometry.pose import Array, Pose
from rendezview.sensors.appearance.model.forest import ForestScores
from rendezview.sensors.appearance.model.signature import Signature
from rendezview.sensors.appearance.model.view_model import HeldOut, ViewModel
from rendezview.sensors.appearance.outline.placement import covariance_of_place
from rendezview.sensors.appearance.outline.retrieval import Retrieval

_STARTS = 60  # most similar silhouettes, whole and sunlit. Source: that of the search on edges
_STARTS_NEAR = 1000  # before those far from a prior are left out. Source: by construction
_BESIDE_RAD = np.deg2rad(5.0)  # rad; of a view beyond the prior's error. Source: views' spacing
_VOTES_WORTH = 0.3  # of the log of the rank by similarity. Source: tree-ablation (0.1), seed 4101
_LEAST_VOTES = -0.5  # log odds about the pose. Source: experiment tree-ablation (0.1), seed 4101
# The same near a prior, which leaves fewer other views to tell from.
_LEAST_VOTES_NEAR = 0.5  # Source: experiment recognition-accuracy, seed 77
_LEAST_LEAD = 1.5  # log odds above another view's. Source: tree-ablation (0.1), seed 4101
_OTHER_RAD = np.deg2rad(20.0)  # rad; farther off is another view. Source: by construction
# Rad; turns among which the votes are averaged: three steps either way, twice.
_STEP_RAD, _STEPS, _ROUNDS = np.deg2rad(3.0), 3, 2  # Source: tree-ablation (0.1), seed 4101
# One σ of such a pose; the bearing's is that of whole silhouettes twice.
# Source: tree-ablation (0.1), seed 4101
_DIRECTION_RAD, _ROLL_RAD = np.deg2rad(3.0), np.deg2rad(2.5)
_RANGE_FRACTION = 0.06  # Source: experiment tree-ablation (0.1), seed 4101


class VotedPose:
    """Finds the pose of a silhouette among all views of a model by its forest."""

    def __init__(self, model: ViewModel, forest_scores: ForestScores) -> None:
        self._model, self._forest_scores = model, forest_scores
        self._retrieval = Retrieval(model)
        steps = _STEP_RAD * np.arange(-_STEPS, _STEPS + 1)
        x, y = (grid.ravel() for grid in np.meshgrid(steps, steps))
        self._turns = np.stack([x, y, np.zeros(len(x))], axis=1)
        self._matrices = Rotation.from_rotvec(self._turns).as_matrix()

    def find(
        self, signature: Signature, prior: Pose | None = None, prior_error_rad: float = np.pi
    ) -> tuple[Pose, Array] | None:
        """The pose and its covariance; None where votes doubt it, or say as much for another view.

        Args:
            signature: of the frame.
            prior: camera_from_target; ``None``: all attitudes are searched.
            prior_error_rad: how far off the prior may be.
        """
        starts = _STARTS if prior is None else _STARTS_NEAR
        rotations, centres = self._retrieval.of(signature, starts)
        if prior is not None:
            turned = np.einsum("kij,ij->k", rotations, prior.rotation)
            near = turned > 1.0 + 2.0 * np.cos(min(prior_error_rad + _BESIDE_RAD, np.pi))
            if not near.any():
                return None
            rotations, centres = rotations[near][:_STARTS], centres[near][:_STARTS]
        scores = self._forest_scores.scores(signature, rotations)
        best = int(np.argmax(likely(scores)))
        rotation = self._averaged(signature, rotations[best])
        votes = float(self._forest_scores.scores(signature, rotation[None])[0])
        cosines = 0.5 * (np.einsum("kij,ij->k", rotations, rotations[best]) - 1.0)
        others = scores[cosines < np.cos(_OTHER_RAD)]
        least = _LEAST_VOTES if prior is None else _LEAST_VOTES_NEAR
        if votes < least or votes - float(others.max(initial=-np.inf)) < _LEAST_LEAD:
            return None
        centre, model = centres[best], self._model
        pose = Pose(rotation, centre - rotation @ model.centre_m)
        held_out = model.held_out
        errors: HeldOut = replace(
            held_out,
            direction_rad=float(_DIRECTION_RAD),
            roll_rad=float(_ROLL_RAD),
            range_fraction=_RANGE_FRACTION,
            bearing_rad=2.0 * held_out.bearing_rad,
        )
        return pose, covariance_of_place(model, errors, pose)

    def _averaged(self, signature: Signature, rotation: Array) -> Array:
        """The mean of attitudes tilted about one, weighted by the odds that each is right."""
        centred = signature.centred_from_camera
        attitude = centred @ rotation
        for _ in range(_ROUNDS):
            scores = self._forest_scores.scores(signature, centred.T @ (self._matrices @ attitude))
            weights = np.exp(scores - scores.max())
            mean = weights @ self._turns / weights.sum()
            attitude = Rotation.from_rotvec(mean).as_matrix() @ attitude
        return np.asarray(centred.T @ attitude)


def likely(scores: Array) -> Array:
    """(K,) how likely views are by their rank in `Retrieval.of` and the log odds of the forest.

    Whole and sunlit silhouettes come there in turns.
    """
    return np.asarray(_VOTES_WORTH * scores - np.log1p(np.arange(len(scores)) // 2))
