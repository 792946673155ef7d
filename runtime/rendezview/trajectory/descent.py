"""Ways down the robust cost of a segment: the downhill simplex, Gauss–Newton, or both.

The simplex is the paper's way (Cleghorn & Sternberg 1991): from geometric starts, restarted where
it has ended. Its starts are closed-form fits to a few frames each, of which those with the least
median misfit lead, so that outliers do not choose the valley. Gauss–Newton starts from the
closed-form fit to all points. It is faster, and ends in another valley where outliers, hops or few
points make several.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

import numpy as np

from rendezview.geometry import so3
from rendezview.geometry.pose import Array
from rendezview.trajectory.no_fit import NoFit
from rendezview.trajectory.scaling import typical_sizes
from rendezview.trajectory.shapes import DRIFT, HOPS, LINE, SPIRAL
from rendezview.trajectory.simplex import (
    RESIDUALS,
    cost,
    downhill_simplex,
    gauss_newton,
    residuals,
)
from rendezview.trajectory.start import first_guess, hops_of

# c² of the robust cost over the variance of a point: 3.5 σ counts half. Source: by construction
CUT = 12.0
_MEDIAN_OF_THREE = 2.366  # of χ² with three degrees of freedom. Source: by construction
_NEAR = 0.01  # the simplex ends so near, in units of χ²: a tenth of a σ. Source: by construction
# χ² that hops must save: five parameters, and chance. Source: experiment trajectory-accuracy
_HOPS_WORTH = 30.0
_SUBSETS = 40  # of three frames: with 40 % outliers nine are clean. Source: by construction
_LED = 3  # starts that the simplex goes down from. Source: trajectory-methods (0.1), seed 1
_SIDES = 0.02  # of the typical sizes, longest sides of a first simplex. Source: the same
_LEAST_SIDES = 1e-4  # of the same: the shortest. Source: by construction
_RESTARTS = 4  # Source: experiment trajectory-methods (0.1), seed 1
# Where one of these holds, several valleys are likely.
_FEW_FRAMES = 20  # of a line: hops may be missed. Source: trajectory-methods (0.1), seed 1
# Share of the points that are more than 3.5 σ off. Source: trajectory-methods (0.1), seed 1
_OUTLIERS = 0.05
# Times what poses claim: between two groups of them nothing is off by many of its own σ. Source:
# plain clouds, 40 % of outliers off alike, seed 32
_SCATTER = 3.0


class Method(StrEnum):
    """How the least cost is sought."""

    BEST = "best"  # Gauss–Newton; both where residuals or hops show that there are several valleys
    SIMPLEX = "simplex"  # the paper's
    GAUSS_NEWTON = "gauss-newton"
    BOTH = "both"  # the simplex, then Gauss–Newton from its end; or Gauss–Newton's own if better


@dataclass(frozen=True, slots=True, eq=False)
class Descent:
    """Where a way down has come to, and the data with σ that fit their scatter."""

    code: int
    parameters: Array
    scales: Array  # (P,) typical sizes of the parameters
    data: tuple[Any, ...]  # see ``simplex``: times, base, constants, carrier, points, …
    weights: Array
    scatters: tuple[float, float] = (1.0, 1.0)  # claims over scatter: nodes, poses
    evaluations: int = 0  # of the simplex

    def down(self, cut: float = CUT, steps: int = 8) -> tuple[Array, float]:
        """Parameters and cost after at most so many steps of Gauss–Newton."""
        parameters, least = gauss_newton(
            self.code, self.parameters, self.scales, self.data, self.weights, cut, steps
        )
        return parameters, float(least)

    def squares(self) -> Array:
        """(N,) squared misfits in variances."""
        out = np.empty((len(self.weights), RESIDUALS))
        residuals(self.code, self.parameters, self.data, np.empty((len(out), 3)), out)
        return np.asarray(np.einsum("ij,ij->i", out, out))

    def cost(self, data: tuple[Any, ...] | None = None) -> float:
        """The robust cost, with other standard deviations if they are given."""
        place, out = np.empty((len(self.weights), 3)), np.empty((len(self.weights), RESIDUALS))
        # The base belongs to the parameters, the standard deviations to the data.
        whitening = self.data[5] if data is None else data[5]
        own = (*self.data[:5], whitening, self.data[6])
        return float(cost(self.code, self.parameters, own, self.weights, CUT, place, out))

    def scaled(self, claimed: Array) -> Descent:
        """The same with σ that fit the scatter of nodes and of poses.

        Args:
            claimed: (N, 3, 3) whitening by the covariances given.
        """
        squares = replace(self, data=(*self.data[:5], claimed, self.data[6])).squares()
        by_node = self.data[6]
        whitening, claims = claimed.copy(), [1.0, 1.0]
        for kind, chosen in enumerate((by_node, ~by_node)):
            if chosen.any():
                scatter = np.sqrt(np.median(squares[chosen]) / _MEDIAN_OF_THREE)
                claims[kind] = 1.0 / max(float(scatter), 1e-6)
                whitening[chosen] *= claims[kind]
        whitening[by_node, 2, 2] = claimed[by_node, 2, 2]  # the range of a node, no deviation
        return replace(
            self, data=(*self.data[:5], whitening, by_node), scatters=(claims[0], claims[1])
        )


def descend(
    start: Descent, places_m: Array, length_m: float, method: Method, *, hops: bool, near: bool
) -> Descent:
    """The least cost of a segment that a method finds.

    Args:
        start: the closed-form fit to all points, or the last fit, with the covariances given.
        places_m: (N, 3) of the points, less the carrier's.
        length_m: typical distance.
        hops: look for hops of a straight line.
        near: the start is the last fit, so its valley is known; no other starts are tried.
    """
    seek, claimed = hops and start.code == LINE, start.data[5]
    newton = None
    if method is not Method.SIMPLEX:
        newton = _by_newton(start)
        if seek:
            newton = _with_hops(newton, claimed, places_m, length_m, by_simplex=False)
        single = method is Method.BEST and not _several_valleys(newton)
        if method is Method.GAUSS_NEWTON or single:
            return newton
    simplex = _restarted(start) if near else _by_simplex(start, places_m)
    if seek:
        simplex = _with_hops(simplex, claimed, places_m, length_m, by_simplex=True)
    if newton is None:
        return simplex
    polished = replace(simplex, parameters=simplex.down()[0])
    return _better(newton, _better(simplex, polished))


def _several_valleys(fit: Descent) -> bool:
    """Whether residuals, hops or a line of few frames make several valleys likely."""
    if fit.code == HOPS or fit.scatters[1] * _SCATTER < 1.0:
        return True
    few = fit.code == LINE and np.count_nonzero(np.diff(fit.data[0])) + 1 < _FEW_FRAMES
    return bool(few or np.mean(fit.squares() > CUT) > _OUTLIERS)


def _better(first: Descent, second: Descent) -> Descent:
    """The one of less cost, by the standard deviations of both."""
    ours = first.cost() + first.cost(second.data) + _handicap(first)
    return first if ours <= second.cost() + second.cost(first.data) + _handicap(second) else second


def _handicap(fit: Descent) -> float:
    return 2.0 * _HOPS_WORTH if fit.code == HOPS else 0.0


def _by_newton(fit: Descent) -> Descent:
    """From least squares to the robust cost.

    Nodes and poses are scaled by their own scatter each, not by their given covariances.
    """
    claimed, cut = fit.data[5], np.inf
    for _ in range(4):
        fit = replace(fit, parameters=fit.down(cut)[0]).scaled(claimed)
        cut = CUT
    return fit


def _by_simplex(fit: Descent, places_m: Array) -> Descent:
    """From the geometric starts of least median misfit; the end of least cost."""
    starts = _starts(fit, places_m)
    medians = [float(np.median(replace(fit, parameters=p).squares())) for p in starts]
    order = np.argsort(medians, kind="stable")[:_LED]
    best: Descent | None = None
    asked = 0
    for k in order:
        end = _restarted(replace(fit, parameters=starts[k]))
        asked += end.evaluations
        best = end if best is None else _better(best, end)
    assert best is not None
    return replace(best, evaluations=asked)


def _restarted(fit: Descent) -> Descent:
    """Simplexes one after the other, each from the end of the last, until none gains."""
    claimed = fit.data[5]
    fit = fit.scaled(claimed)
    sides = most = _SIDES * fit.scales
    asked = 0
    for _ in range(_RESTARTS + 1):
        before = fit.cost()
        parameters, least, count = downhill_simplex(
            fit.code, fit.parameters, sides, fit.data, fit.weights, CUT,
            200 * len(sides), _NEAR,
        )  # fmt: skip
        asked += int(count)
        moved = np.abs(parameters - fit.parameters)
        fit = replace(fit, parameters=parameters).scaled(claimed)
        if before - least < 10.0 * _NEAR:
            break
        sides = np.clip(moved, _LEAST_SIDES * fit.scales, most)
    return replace(fit, evaluations=asked)


def _starts(fit: Descent, places_m: Array) -> list[Array]:
    """Parameters about one base: of all points, and of a few frames at a time."""
    times, base, constants = fit.data[:3]
    frames = np.unique(times)
    rng = np.random.default_rng(0)
    size = 4 if fit.code == DRIFT else 3
    found = [fit.parameters]
    for _ in range(_SUBSETS):
        # One frame of each part of the segment, so that the few span it.
        parts = np.array_split(frames, size)
        chosen = np.isin(times, [rng.choice(part) for part in parts])
        guess = first_guess(
            fit.code, times[chosen], places_m[chosen], fit.weights[chosen], constants[0]
        )
        if isinstance(guess, NoFit):
            continue
        own, parameters = guess
        if fit.code <= SPIRAL:
            parameters[:3] = so3.log(base.T @ own)
        found.append(parameters)
    return found


def _with_hops(
    fit: Descent, claimed: Array, places_m: Array, length_m: float, *, by_simplex: bool
) -> Descent:
    """A straight line with hops, if the points show them."""
    straight = fit.cost() if by_simplex else fit.down()[1]
    line = fit.parameters
    times, base, constants, *rest = fit.data
    far_m = float(np.linalg.norm(line[:3]))
    closing = -float(line[:3] @ line[3:]) / max(far_m, 1e-9) ** 2
    start = hops_of(times, places_m, fit.weights, closing, robust=by_simplex)
    if start is None:
        return fit
    half_s = 0.5 * float(times[-1] - times[0])
    hopping = replace(
        fit,
        code=HOPS,
        parameters=start,
        scales=typical_sizes(HOPS, length_m, half_s),
        data=(times, base, np.array([constants[0], closing]), *rest),
    )
    if by_simplex:
        unscaled = replace(hopping, data=(*hopping.data[:5], claimed, hopping.data[6]))
        hopping = _restarted(unscaled)
        hopping = replace(hopping, evaluations=hopping.evaluations + fit.evaluations)
        least = hopping.cost(fit.data)
    else:
        parameters, least = hopping.down(steps=20)
        hopping = replace(hopping, parameters=parameters)
    if straight - least < _HOPS_WORTH or not _sound_hops(hopping.parameters, half_s):
        return fit
    return hopping


def _sound_hops(parameters: Array, half_s: float) -> bool:
    """A period that the segment can show."""
    return bool(0.1 * half_s < parameters[9] < 4.0 * half_s)
