"""Errors of recognition on held-out views, which a model states as its own."""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation

from rendezview.geometry.geodesic import angle_between
from rendezview.geometry.pose import Array
from rendezview.sensors.appearance.model.signature import Signature
from rendezview.sensors.appearance.model.view_model import HeldOut, ViewModel
from rendezview.sensors.appearance.outline.placement import place
from rendezview.sensors.appearance.outline.votes import Matcher
from rendezview_ground.learn.views.views import ViewSet

_LOST_RAD = np.deg2rad(30.0)  # rad; a larger error is a wrong answer, not covered by a covariance
_USUAL = 0.995  # quantile of the residual that the model states
_PRIOR_ERROR_RAD = np.deg2rad(10.0)  # rad; error of the priors


def prior_errors(count: int, seed: int) -> Array:
    """(K, 3) rotation vectors, the errors of the priors of K held-out views: 10° each."""
    errors = np.random.default_rng([seed, _STREAM]).normal(size=(count, 3))
    errors *= _PRIOR_ERROR_RAD / np.linalg.norm(errors, axis=1, keepdims=True)
    return errors


def recognition_errors(model: ViewModel, views: ViewSet, priors: Array, rows: slice) -> Array:
    """(M, 5) errors and residual of the recognised views among ``rows``.

    Each view is matched from a prior whose error is its row of ``priors`` (K, 3). Columns:
    direction, rad; roll, rad; range, share; bearing, share of the sphere radius; residual.
    """
    matcher = Matcher(model)
    errors: list[tuple[float, ...]] = []
    for k in range(len(views))[rows]:
        truth = views.centred_from_target[k]
        signature = Signature(views.readings[k], float(views.area_sr[k]), np.eye(3))
        match = matcher.match(signature, Rotation.from_rotvec(priors[k]).as_matrix() @ truth)
        if match is None or angle_between(match.direction, views.direction[k]) > _LOST_RAD:
            continue
        pose, _ = place(model, match, signature)
        place_errors = _errors(model, pose.apply(model.centre_m), pose.rotation, views, k)
        errors.append((*place_errors, match.residual))
    return np.array(errors).reshape(-1, 5)


def calibrated(model: ViewModel, errors: Array) -> ViewModel:
    """The model with the root-mean-square of ``recognition_errors`` (M, 5) as its stated errors."""
    if not len(errors):
        return model
    direction, roll, range_fraction, bearing = np.sqrt(np.mean(np.square(errors[:, :4]), axis=0))
    held_out = HeldOut(
        float(direction / np.sqrt(2.0)),
        float(roll),
        float(range_fraction),
        float(bearing),
        float(np.quantile(errors[:, 4], _USUAL)),
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
