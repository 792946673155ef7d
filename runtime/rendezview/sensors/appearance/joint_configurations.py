"""Recognition of a target with joints: which of the model's configurations a frame shows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from rendezview.estimation.motion import rates_between
from rendezview.geometry.joint import Joint, apart
from rendezview.geometry.pose import Array
from rendezview.geometry.symmetry import angle_between
from rendezview.sensors.appearance.hypothesis import Hypothesis
from rendezview.sensors.appearance.model.view_model import ViewModel
from rendezview.sensors.appearance.observation import AppearanceObservation

# Rad; a pose or an angle further away is another answer. Source: as in the experiments
_OTHER_RAD = np.deg2rad(5.0)
_AS_GOOD = 0.03  # merit; poses that differ by less fit as well. Source: pose-joints (0.1)
# Rad, of an angle, where its edges are looked for again. Source: pose-joints (0.1)
_ASIDE_RAD = np.deg2rad([-9.0, -6.0, -3.0, 3.0, 6.0, 9.0])


def best_of(
    observations: Sequence[AppearanceObservation],
    models: Sequence[ViewModel],
    confident: Callable[[AppearanceObservation], AppearanceObservation],
) -> AppearanceObservation:
    """The best of the configurations' looks at one frame.

    The margin of its pose becomes that over the best other answer of any configuration.

    Args:
        observations: one of each configuration, given or not.
        models: the configurations.
        confident: gives or refuses the pose of an observation by its margin.
    """
    found = [k for k, observation in enumerate(observations) if observation.found is not None]
    if not found:
        return observations[0]
    found.sort(key=lambda k: -_merit(observations[k]))
    best, joints = observations[found[0]], models[0].joints
    assert best.found is not None
    margin = best.found.margin
    for k in found[1:]:
        if _another(best, observations[k], models[0], joints):
            margin = min(margin, _merit(best) - _merit(observations[k]))
            break
    best_pose = _spread(best.found.best, [observations[k] for k in found[1:]], _merit(best), joints)
    return confident(replace(best, found=replace(best.found, margin=margin, best=best_pose)))


def _spread(
    best: Hypothesis, others: Sequence[AppearanceObservation], merit: float, joints: Sequence[Joint]
) -> Hypothesis:
    """The best pose, its covariance widened to the nearby ones that fit as well.

    A plate seen edge-on fits at two angles.
    """
    covariance = best.joint_covariance
    if covariance is None or best.angles_rad is None:
        return best
    for observation in others:
        assert observation.found is not None
        other = observation.found.best
        if other.angles_rad is None or merit - observation.found.merit > _AS_GOOD:
            continue
        if best.pose.angle_to(other.pose) > _OTHER_RAD:
            continue
        moved = rates_between(best.pose, other.pose, 1.0)
        away = np.concatenate([moved, apart(joints, other.angles_rad, best.angles_rad)])
        if away @ np.linalg.solve(covariance, away) > len(away):
            covariance = covariance + np.outer(away, away)
    return replace(best, joint_covariance=covariance, covariance=covariance[:6, :6])


def around(joints: Sequence[Joint], angles_rad: Array) -> list[Array]:
    """Angles (J,) to start from again: each joint aside by some steps."""
    found = []
    for k, joint in enumerate(joints):
        for aside in _ASIDE_RAD:
            angles = angles_rad.copy()
            angles[k] = joint.within(float(angles[k] + aside))
            found.append(angles)
    return found


def _merit(observation: AppearanceObservation) -> float:
    assert observation.found is not None
    return observation.found.merit


def _another(
    a: AppearanceObservation, b: AppearanceObservation, model: ViewModel, joints: Sequence[Joint]
) -> bool:
    """Whether two observations are different answers."""
    assert a.found is not None
    assert b.found is not None
    one, other = a.found.best, b.found.best
    if angle_between(one.pose, other.pose, model.symmetries) > _OTHER_RAD:
        return True
    if one.angles_rad is None or other.angles_rad is None:
        return False
    return bool(np.abs(apart(joints, one.angles_rad, other.angles_rad)).max() > _OTHER_RAD)
