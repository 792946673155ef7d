"""Recognition of a target with joints: which of the model's configurations a frame shows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from rendezview.estimation.hypotheses import choose
from rendezview.geometry.joint import Joint, apart
from rendezview.geometry.pose import Array
from rendezview.geometry.symmetry import angle_between
from rendezview.sensors.appearance.hypothesis import Hypothesis
from rendezview.sensors.appearance.judge.found import Found
from rendezview.sensors.appearance.judge.rivals import RIVAL_RAD
from rendezview.sensors.appearance.model.view_model import ViewModel
from rendezview.sensors.appearance.observation import AppearanceObservation

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
    seen = [(one, one.found) for one in observations if one.found is not None]
    seen.sort(key=lambda pair: -pair[1].merit)
    model, merits = models[0], [found.merit for _, found in seen]
    choice = choose(merits, lambda k, known: not _another(seen[k][1], seen[known][1], model))
    if choice is None:
        return observations[0]
    best, found = seen[choice.best]
    pose = _spread(found, [other for _, other in seen[1:]], model.joints)
    margin = min(found.margin, choice.margin)
    return confident(replace(best, found=replace(found, margin=margin, best=pose)))


def _spread(found: Found, others: Sequence[Found], joints: Sequence[Joint]) -> Hypothesis:
    """The best pose, its covariance widened to the nearby ones that fit as well.

    A plate seen edge-on fits at two angles.
    """
    best, covariance = found.best, found.best.joint_covariance
    if covariance is None or best.angles_rad is None:
        return best
    for one in others:
        other = one.best
        if other.angles_rad is None or found.merit - one.merit > _AS_GOOD:
            continue
        if best.pose.angle_to(other.pose) > RIVAL_RAD:
            continue
        angles_rad = apart(joints, other.angles_rad, best.angles_rad)
        away = np.concatenate([other.pose.delta_from(best.pose), angles_rad])
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


def _another(a: Found, b: Found, model: ViewModel) -> bool:
    """Whether two configurations give different answers."""
    one, other = a.best, b.best
    if angle_between(one.pose, other.pose, model.symmetries) > RIVAL_RAD:
        return True
    if one.angles_rad is None or other.angles_rad is None:
        return False
    angles = apart(model.joints, one.angles_rad, other.angles_rad)
    return bool(np.abs(angles).max() > RIVAL_RAD)
