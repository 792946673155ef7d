"""Tests whether the lights agree on one rigid body, and finds those to leave out otherwise.

A light that is seen by reflection, or under another light's number, makes the sum of squares
too large for its degrees of freedom. Every fault is then tried: two lights exchanged, in one
camera or in all; one spot, one light, two of either, or a whole camera left out. With so few
lights all the possibilities can be tried, so the answer does not depend on chance.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.special import chdtri

from rendezview.geometry import so3
from rendezview.geometry.pose import Array
from rendezview.sensors.beacons.pose.collinearity import count_lights, solve
from rendezview.sensors.beacons.rig import Rig, Sights

_FALSE_ALARM = 1e-5  # of a reading without fault. Source: by construction, a rate of false alarms
# Source: χ² distribution
LIMITS = np.concatenate([[np.inf], chdtri(np.arange(1, 2001), _FALSE_ALARM)])
# Of a standard deviation: the step after one so short is a twentieth of it. Source: by construction
TOLERANCE = 0.3
ITERATIONS = 15  # Source: by construction, a bound only
# sums of squares closer than this do not distinguish two explanations. Source: normal distribution,
# 3 σ
_LIKE = 9.0
# Squared distance of two poses, in standard deviations, that matters. Source: χ² distribution, six
# degrees, 4·10⁻⁵
_APART = 30.0
_FEWEST_SPARE = 2  # equations left over: with none, anything agrees. Source: by construction
# 2 ln of the places, in variances, that a false spot could have at S/N 200. Source: by construction
_ANYWHERE = 19.0
_MOST_TRIED = 1500  # Source: by construction, a bound of time
UNKNOWNS = 6  # Source: by construction
FEWEST_LIGHTS = 3  # two leave a turn about the line between them. Source: by construction
_NOTHING, _IDENTITY, _ORIGIN = np.zeros((6, 6)), np.eye(3), np.zeros(3)


@dataclass(slots=True, eq=False)
class LightsFit:
    """A pose with its statistics from the equations; arrays are the fit's own."""

    rotation: Array  # (3, 3) rig from target
    translation: Array  # (3,)
    information: Array  # (6, 6) rig frame
    cost: float  # sum of squares, in variances
    spare: int  # equations more than unknowns
    steps: int
    sights: Sights  # what it was solved from, faults mended
    left_out: tuple[tuple[int, int], ...] = ()  # (camera, light)
    exchanged: tuple[tuple[int, int], ...] = ()  # (light, light)

    @property
    def agrees(self) -> bool:
        """Whether noise explains the sum of squares."""
        return self.spare >= 0 and self.cost <= LIMITS[min(self.spare, len(LIMITS) - 1)]


def iterate(
    rig: Rig,
    leds: Array,
    sights: Sights,
    rotation: Array,
    translation: Array,
    iterations: int = ITERATIONS,
) -> LightsFit | None:
    """Least squares from a start; ``None`` where the lights do not determine a pose near it."""
    lights, equations = count_lights(sights.weight)
    if lights < FEWEST_LIGHTS or equations < UNKNOWNS:
        return None
    fit = LightsFit(
        np.array(rotation, order="C"), np.array(translation), np.empty((6, 6)), 0.0,
        equations - UNKNOWNS, 0, sights,
    )  # fmt: skip
    fit.cost, fit.steps, done = solve(
        fit.rotation, fit.translation, leds, rig.rotations, rig.translations, sights.xy,
        sights.weight, _NOTHING, _IDENTITY, _ORIGIN, iterations, TOLERANCE, fit.information,
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
) -> LightsFit | Disagreement:
    """The fit of all lights, or of the rest after the likeliest fault is mended.

    A fault is likelier the fewer equations it takes away: each light left out in a camera
    could have been anywhere, which costs as much as `_ANYWHERE` of the sum of squares.
    """
    whole = iterate(rig, leds, sights, rotation, translation)
    if whole is not None and whole.agrees:
        return whole
    if whole is not None:
        rotation, translation = whole.rotation, whole.translation
    passing: list[tuple[float, LightsFit]] = []
    for mended, left_out, exchanged in itertools.islice(_mended(sights), _MOST_TRIED):
        if np.count_nonzero(mended.weight) - UNKNOWNS < _FEWEST_SPARE:
            continue
        fit = iterate(rig, leds, mended, rotation, translation)
        if fit is not None and fit.agrees:
            fit.left_out, fit.exchanged = left_out, exchanged
            passing.append((fit.cost + _ANYWHERE * len(left_out), fit))
    if not passing:
        if whole is None:
            return Disagreement("the lights do not determine a pose")
        return Disagreement(
            f"the lights do not fit the target: sum of squares {whole.cost:.0f} for "
            f"{whole.spare} degrees of freedom, with any two lights left out too"
        )
    passing.sort(key=lambda pair: pair[0])
    score, best = passing[0]
    for other_score, other in passing[1:]:
        if other_score - score < _LIKE and distance(best, other) > _APART:
            return Disagreement(
                "the lights contradict each other, and the false one cannot be identified "
                f"({_faults(best)}, or {_faults(other)})",
                ambiguous=True,
            )
    return best


def distance(one: LightsFit, other: LightsFit) -> float:
    """Squared distance of two poses in standard deviations of the first."""
    away = difference(other.rotation, other.translation, one.rotation, one.translation)
    return float(away @ one.information @ away)


def difference(
    rotation: Array, translation: Array, other_rotation: Array, other_translation: Array
) -> Array:
    """(6,) perturbation that leads from the other pose to this one."""
    return np.append(so3.between(rotation, other_rotation), translation - other_translation)


def _faults(fit: LightsFit) -> str:
    left = [f"light {light + 1} in camera {camera + 1}" for camera, light in fit.left_out]
    swapped = [f"lights {a + 1} and {b + 1} exchanged" for a, b in fit.exchanged]
    return ", ".join(left + swapped)


def _mended(
    sights: Sights,
) -> Iterator[tuple[Sights, tuple[tuple[int, int], ...], tuple[tuple[int, int], ...]]]:
    """Sights without a fault, for every fault; with the lights left out and those exchanged."""
    cameras = range(len(sights.weight))
    visible = sights.visible
    lights = np.flatnonzero(visible.any(axis=0)).tolist()
    for a, b in itertools.combinations(lights, 2):
        everywhere: list[list[int]] = [list(cameras)]
        for which in everywhere + [[k] for k in cameras if len(visible) > 1]:
            if any(visible[k, a] or visible[k, b] for k in which):
                xy, weight = sights.xy.copy(), sights.weight.copy()
                for k in which:
                    xy[k, [a, b]], weight[k, [a, b]] = xy[k, [b, a]], weight[k, [b, a]]
                yield Sights(xy, weight), (), ((a, b),)
    for left_out in _ways_to_leave_out(visible):
        weight = sights.weight.copy()
        for camera, light in left_out:
            weight[camera, light] = 0.0
        yield Sights(sights.xy, weight), left_out, ()


def _ways_to_leave_out(visible: npt.NDArray[np.bool_]) -> Iterator[tuple[tuple[int, int], ...]]:
    """Sets of (camera, light) to leave out: a spot, a light, two of either, a camera."""
    spots = [(int(k), int(j)) for k, j in zip(*np.nonzero(visible), strict=True)]
    by_light = [
        tuple(spot for spot in spots if spot[1] == j) for j in sorted({j for _, j in spots})
    ]
    yield from ((spot,) for spot in spots)
    yield from (light for light in by_light if len(light) > 1)
    yield from itertools.combinations(spots, 2)
    yield from (a + b for a, b in itertools.combinations(by_light, 2) if len(a + b) > 2)
    if len(visible) > 1:
        yield from (
            tuple(spot for spot in spots if spot[0] == k)
            for k in range(len(visible))
            if visible[k].any()
        )
