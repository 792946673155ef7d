"""Whether the lights agree on one rigid body, and which of them to leave out where they do not.

A light that is seen by reflection, or under another light's number, makes the sum of squares
too large for its degrees of freedom. The fewest lights are then left out whose absence makes
the rest agree: one in one camera, one in all cameras, two, a whole camera. With so few
lights all the possibilities can be tried, so the answer does not depend on chance.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.stats import chi2

from rendezview.pose import Array
from rendezview.stereo.collinearity import rotation_vector, solve
from rendezview.stereo.rig import Rig, Sights

_FALSE_ALARM = 1e-5  # of a reading without fault
LIMITS = np.concatenate([[np.inf], chi2.isf(_FALSE_ALARM, np.arange(1, 2001))])
TOLERANCE = 0.1  # of a standard deviation; steps shrink quadratically, so what follows is nothing
ITERATIONS = 15
_LIKE = 9.0  # sums of squares closer than this do not tell two explanations apart
_APART = 30.0  # squared distance of two poses, in standard deviations, that matters
_FEWEST_SPARE = 2  # equations left over: with none, anything agrees
_MOST_TRIED = 1500
UNKNOWNS = 6
_NOTHING, _IDENTITY, _ORIGIN = np.zeros((6, 6)), np.eye(3), np.zeros(3)


@dataclass(slots=True, eq=False)
class Fit:
    """A pose with what the equations say of it; arrays are the fit's own."""

    rotation: Array  # (3, 3) rig from target
    translation: Array  # (3,)
    information: Array  # (6, 6) rig frame
    cost: float  # sum of squares, in variances
    spare: int  # equations more than unknowns
    steps: int
    left_out: tuple[tuple[int, int], ...] = ()  # (camera, light)

    @property
    def agrees(self) -> bool:
        """Whether the sum of squares is as small as noise alone makes it."""
        return self.spare >= 0 and self.cost <= LIMITS[min(self.spare, len(LIMITS) - 1)]


def iterate(
    rig: Rig,
    leds: Array,
    sights: Sights,
    rotation: Array,
    translation: Array,
    weight: Array | None = None,
    iterations: int = ITERATIONS,
) -> Fit | None:
    """Least squares from a start; ``None`` where the lights do not determine a pose near it."""
    weight = sights.weight if weight is None else weight
    fit = Fit(
        np.array(rotation), np.array(translation), np.empty((6, 6)), 0.0,
        int(np.count_nonzero(weight)) - UNKNOWNS, 0,
    )  # fmt: skip
    if fit.spare < 0:
        return None
    fit.cost, fit.steps, done = solve(
        fit.rotation, fit.translation, leds, rig.rotations, rig.translations, sights.xy, weight,
        _NOTHING, _IDENTITY, _ORIGIN, iterations, TOLERANCE, fit.information,
    )  # fmt: skip
    if not (done or iterations == 1) or not fit.cost < np.inf:
        return None
    return fit


@dataclass(frozen=True, slots=True)
class Disagreement:
    """No subset of the lights agrees, or two do and contradict each other."""

    reason: str
    ambiguous: bool = False


def agree(
    rig: Rig, leds: Array, sights: Sights, rotation: Array, translation: Array
) -> Fit | Disagreement:
    """The fit of the largest set of lights that agrees, from a start close by."""
    whole = iterate(rig, leds, sights, rotation, translation)
    if whole is not None and whole.agrees:
        return whole
    if whole is not None:
        rotation, translation = whole.rotation, whole.translation
    tried = 0
    for ways in _ways_to_leave_out(sights.seen):
        passing: list[Fit] = []
        for left_out in ways:
            tried += 1
            if tried > _MOST_TRIED:
                break
            weight = sights.weight.copy()
            for camera, light in left_out:
                weight[camera, light] = 0.0
            if np.count_nonzero(weight) - UNKNOWNS < _FEWEST_SPARE:
                continue
            fit = iterate(rig, leds, sights, rotation, translation, weight)
            if fit is not None and fit.agrees:
                fit.left_out = left_out
                passing.append(fit)
        if passing:
            passing.sort(key=lambda fit: fit.cost - LIMITS[fit.spare])
            best = passing[0]
            for other in passing[1:]:
                if other.cost - best.cost < _LIKE and distance(best, other) > _APART:
                    return Disagreement(
                        "the lights contradict each other, and which of them is false "
                        f"cannot be told ({_told(best)} or {_told(other)})",
                        ambiguous=True,
                    )
            return best
    if whole is None:
        return Disagreement("the lights do not determine a pose")
    return Disagreement(
        f"the lights do not fit the target: sum of squares {whole.cost:.0f} for "
        f"{whole.spare} degrees of freedom, with any two lights left out too"
    )


def distance(one: Fit, other: Fit) -> float:
    """Squared distance of two poses in standard deviations of the first."""
    away = np.empty(6)
    rotation_vector(other.rotation @ one.rotation.T, away)
    away[3:] = other.translation - one.translation
    return float(away @ one.information @ away)


def _told(fit: Fit) -> str:
    return ", ".join(f"light {light + 1} in camera {camera + 1}" for camera, light in fit.left_out)


def _ways_to_leave_out(
    seen: npt.NDArray[np.bool_],
) -> Iterator[list[tuple[tuple[int, int], ...]]]:
    """Sets of (camera, light) to leave out, the likelier faults first."""
    spots = [(int(k), int(j)) for k, j in zip(*np.nonzero(seen), strict=True)]
    lights = sorted({j for _, j in spots})
    yield [(spot,) for spot in spots]
    by_light = {j: tuple(spot for spot in spots if spot[1] == j) for j in lights}
    yield [spots_of for spots_of in by_light.values() if len(spots_of) > 1]
    yield [
        (a, b) for a, b in itertools.combinations(spots, 2) if a[0] == b[0]
    ]  # two exchanged in one camera
    yield [
        (*by_light[a], *by_light[b]) for a, b in itertools.combinations(lights, 2)
    ]  # … in all
    yield [(a, b) for a, b in itertools.combinations(spots, 2) if a[0] != b[0]]
    yield [tuple(spot for spot in spots if spot[0] == k) for k in range(len(seen))]
