"""How well a model recognises views it was not trained on: its own statement of error."""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation

from rendezview.appearance.match import Matcher
from rendezview.appearance.model import HeldOut, ViewModel
from rendezview.appearance.placement import place
from rendezview.appearance.signature import Signature
from rendezview.geodesic import angle_between
from rendezview.pose import Array
from rendezview.training.views import ViewSet

_LOST_RAD = np.deg2rad(30.0)  # farther off is a wrong answer, which no covariance describes
_USUAL = 0.995  # share of the held-out views that have less residual than the model states
_PRIOR_ERROR_RAD = np.deg2rad(10.0)


def calibrated(model: ViewModel, views: ViewSet, seed: int) -> ViewModel:
    """The model with the root-mean-square errors of recognition on held-out views.

    Each view is matched from a prior that is off by 10° about a random axis.
    """
    rng = np.random.default_rng([seed, _STREAM])
    matcher = Matcher(model)
    errors, residuals = [], []
    for k in range(len(views)):
        prior_error = rng.normal(size=3)
        prior_error *= _PRIOR_ERROR_RAD / np.linalg.norm(prior_error)
        truth = views.centred_from_target[k]
        signature = Signature(views.readings[k], float(views.area_sr[k]), np.eye(3))
        match = matcher.match(signature, Rotation.from_rotvec(prior_error).as_matrix() @ truth)
        if match is None or angle_between(match.direction, views.direction[k]) > _LOST_RAD:
            continue
        pose, _ = place(model, match, signature)
        residuals.append(match.residual)
        errors.append(_errors(model, pose.apply(model.centre_m), pose.rotation, views, k))
    if not errors:
        return model
    direction, roll, range_fraction, bearing = np.sqrt(np.mean(np.square(errors), axis=0))
    held_out = HeldOut(
        float(direction / np.sqrt(2.0)),
        float(roll),
        float(range_fraction),
        float(bearing),
        float(np.quantile(residuals, _USUAL)),
    )
    return dataclasses.replace(model, held_out=held_out)


_STREAM = 4  # of random numbers


def _errors(
    model: ViewModel, centre_camera: Array, rotation: Array, views: ViewSet, k: int
) -> tuple[float, float, float, float]:
    x, y = views.offset_m[k] / views.range_m[k]
    line = np.array([x, y, 1.0]) / np.sqrt(x * x + y * y + 1.0)
    turn = Rotation.from_matrix(rotation @ views.centred_from_target[k].T).as_rotvec()
    roll = float(turn @ line)
    direction = float(np.linalg.norm(turn - roll * line))
    range_m = float(np.linalg.norm(centre_camera))
    across = float(np.linalg.norm(centre_camera / range_m - line)) * range_m
    return (
        direction,
        roll,
        range_m / views.range_m[k] - 1.0,
        across / model.sphere_radius_m / np.sqrt(2.0),
    )
