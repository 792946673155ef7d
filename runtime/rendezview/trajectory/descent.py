"""Ways down the robust cost of a segment: the downhill simplex, Gauss–Newton, or both.

The simplex is the paper's way (Cleghorn & Sternberg 1991). It starts from the closed-form fit to a
few frames with the least median misfit, so that outliers do not choose the valley. Gauss–Newton
starts from the closed-form fit to all points. It is faster, and ends in another valley where
outliers, hops or few points make several.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

import numpy as np
from scipy.special import chdtri

from rendezview.estimation.least_squares import Equations, Options, minimise
from rendezview.geometry import so3
from rendezview.geometry.pose import Array
from rendezview.trajectory.misfits import RESIDUALS, cost, normal_equations, residuals
from rendezview.trajectory.no_fit import NoFit
from rendezview.trajectory.scaling import typical_sizes
from rendezview.trajectory.shapes import DRIFT, HOPS, LINE, SPIRAL
from rendezview.trajectory.start import first_guess, hops_of

# c² of the robust cost over the variance of a point: 3.5 σ counts half. Source: by construction
CUT = 12.0
NEAR = 0.01  # the simplex ends so near, in units of χ²: a tenth of a σ. Source: by construction
# Of the diagonal, the first damping; what holds a parameter of which nothing is known, over its
# squared typical size. Source: by construction, far below what any point tells
_FIRST_DAMPING, _HELD = 1e-6, 1e-12
# χ² that hops must save: five parameters, and chance. Source: experiment trajectory-accuracy
_HOPS_WORTH = 30.0
_SUBSETS = 40  # of three frames: with 40 % outliers nine are clean. Source: by construction
# Of the typical sizes, sides of the first simplex. Source: trajectory-methods (0.1), seed 1
SIDES = 0.02
# Where one of these holds, several valleys are likely. Share of the points that are more than 3.5 σ
# off. Source: trajectory-methods (0.1), seed 1
_OUTLIERS = 0.05
# Times what poses claim: between two groups of them nothing is off by many of its own σ. Source:
# plain clouds, 40 % of outliers off alike, seed 32
_SCATTER = 3.0


class Method(StrEnum):
    """How the least cost is sought."""

    BEST = "best"  # Gauss–Newton; both where residuals or hops show that there are several valleys
    SIMPLEX = "simplex"  # the paper's
    GAUSS_NEWTON = "gauss-newton"


@dataclass(frozen=True, slots=True, eq=False)
class Descent:
    """Where a way down has come to, and the data with σ that fit their scatter."""

    code: int
    parameters: Array
    scales: Array  # (P,) typical sizes of the parameters
    data: tuple[Any, ...]  # see ``misfits``: times, base, constants, carrier, points, …
    weights: Array
    scatters: tuple[float, float] = (1.0, 1.0)  # claims over scatter: nodes, poses
    evaluations: int = 0  # of the simplex

    def down(self, cut: float = CUT, steps: int = 8) -> tuple[Array, float]:
        """Parameters and cost after at most so many steps of Gauss–Newton."""
        cost, held = self.cost_at(cut), np.diag(_HELD / self.scales**2)

        def equations(p: Array) -> Equations:
            matrix, right = normal_equations(
                self.code, p, self.scales, self.data, self.weights, cut
            )
            return cost(p), matrix + held, right

        options = Options(iterations=steps, trials=6, first_damping=_FIRST_DAMPING)
        found = minimise(equations, np.add, self.parameters, cost=cost, options=options)
        return (self.parameters, np.inf) if found is None else (found.at, found.cost)

    def by_simplex(self) -> Descent:
        """The end of Nelder and Mead's simplex, with Gao and Han's (2012) coefficients."""
        from scipy.optimize import minimize  # slow to import

        corners = np.vstack([self.parameters, self.parameters + SIDES * np.diag(self.scales)])
        options = {
            "initial_simplex": corners, "adaptive": True, "maxfev": 200 * len(self.scales),
            "fatol": NEAR, "xatol": np.inf,
        }  # fmt: skip
        found = minimize(self.cost_at(), self.parameters, method="Nelder-Mead", options=options)
        return replace(self, parameters=found.x, evaluations=int(found.nfev))

    def squares(self) -> Array:
        """(N,) squared misfits in variances."""
        out = np.empty((len(self.weights), RESIDUALS))
        residuals(self.code, self.parameters, self.data, np.empty((len(out), 3)), out)
        return np.asarray(np.einsum("ij,ij->i", out, out))

    def cost(self, data: tuple[Any, ...] | None = None) -> float:
        """The robust cost, with other standard deviations if they are given."""
        # The base belongs to the parameters, the standard deviations to the data.
        whitening = self.data[5] if data is None else data[5]
        own = replace(self, data=(*self.data[:5], whitening, self.data[6]))
        return own.cost_at()(self.parameters)

    def cost_at(self, cut: float = CUT) -> Callable[[Array], float]:
        """The robust cost of any parameters."""
        place, out = np.empty((len(self.weights), 3)), np.empty((len(self.weights), RESIDUALS))
        return lambda p: float(cost(self.code, p, self.data, self.weights, cut, place, out))

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
                scatter = np.sqrt(np.median(squares[chosen]) / chdtri(3, 0.5))
                claims[kind] = 1.0 / max(float(scatter), 1e-6)
                whitening[chosen] *= claims[kind]
        whitening[by_node, 2, 2] = claimed[by_node, 2, 2]  # the range of a node, no deviation
        return replace(
            self, data=(*self.data[:5], whitening, by_node), scatters=(claims[0], claims[1])
        )


def descend(start: Descent, places_m: Array, length_m: float, method: Method) -> Descent:
    """The least cost of a segment that a method finds.

    Args:
        start: the closed-form fit to all points, with the covariances given.
        places_m: (N, 3) of the points, less the carrier's.
        length_m: typical distance.
    """
    seek, claimed = start.code == LINE, start.data[5]
    newton = None
    if method is not Method.SIMPLEX:
        newton = _by_newton(start)
        if seek:
            newton = _with_hops(newton, claimed, places_m, length_m, by_simplex=False)
        single = method is Method.BEST and not _several_valleys(newton)
        if method is Method.GAUSS_NEWTON or single:
            return newton
    simplex = _by_simplex(start, places_m)
    if seek:
        simplex = _with_hops(simplex, claimed, places_m, length_m, by_simplex=True)
    if newton is None:
        return simplex
    polished = replace(simplex, parameters=simplex.down()[0])
    return _better(newton, _better(simplex, polished))


def _several_valleys(fit: Descent) -> bool:
    """Whether residuals or hops make several valleys likely."""
    if fit.code == HOPS or fit.scatters[1] * _SCATTER < 1.0:
        return True
    return bool(np.mean(fit.squares() > CUT) > _OUTLIERS)


def _better(first: Descent, second: Descent) -> Descent:
    """The one of less cost, by the standard deviations of both."""
    ours = first.cost() + first.cost(second.data)
    return first if ours <= second.cost() + second.cost(first.data) else second


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
    """From the geometric start of least median misfit."""
    starts = [replace(fit, parameters=p) for p in _starts(fit, places_m)]
    return _simplex(min(starts, key=lambda start: float(np.median(start.squares()))))


def _simplex(fit: Descent) -> Descent:
    """The end of a simplex about a start."""
    claimed = fit.data[5]
    return fit.scaled(claimed).by_simplex().scaled(claimed)


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
        hopping = _simplex(unscaled)
        hopping = replace(hopping, evaluations=hopping.evaluations + fit.evaluations)
        least = hopping.cost(fit.data)
    else:
        parameters, least = hopping.down(steps=20)
        hopping = replace(hopping, parameters=parameters)
    return fit if straight - least < _HOPS_WORTH else hopping
