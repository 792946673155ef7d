"""Damped robust least squares: Gauss–Newton with Levenberg's and Marquardt's damping.

One driver, `minimise`, for problems that are set up in Python; its pieces (`damped_step`,
`tukey_weight`) for the few loops that are compiled as a whole because a call from Python would
cost more than the iteration (contour alignment, ring edges, reflectors, segments).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from numba import njit

from rendezview.estimation.linear_algebra import solve_scaled
from rendezview.geometry.pose import Array

_At = TypeVar("_At")  # parameters, of any type
Equations = tuple[float, Array, Array]  # cost, normal matrix (P, P), right side (P,)

MOST_STEPS = 30  # of a loop that a few steps end. Source: by construction, a bound only
# Damping, a share of the diagonal: the first after a plain step failed, and its factors after a
# worse and a better step. Source: Marquardt, SIAM J. 11(2), 1963, whose λ₀ is 0.01 and ν 10; 1e-4
# because the starts here are near.
FIRST_DAMPING = 1e-4  # Source: as above
DAMPING_GROWTH = 10.0  # Source: as above
DAMPING_DECAY = 0.1  # Source: as above
# By so much of itself a cost may rise at its minimum. Source: rounding of a sum of 10⁴ squares
ROUNDING = 1e-12


@dataclass(frozen=True, kw_only=True)
class Options:
    """When to stop."""

    iterations: int = 50  # a bound only. Source: by construction
    # Of damping, each ten times the last: at 1e4 of the diagonal a step is rounding.
    trials: int = 8  # Source: by construction
    # Of the cost χ²: a hundredth of a standard deviation, squared.
    least_gain: float = 1e-4  # Source: by construction
    relative_gain: float = 0.0  # of the cost, besides. Source: by construction
    # Of the diagonal; 0: plain Gauss–Newton steps first.
    first_damping: float = 0.0  # Source: by construction


@dataclass(frozen=True, slots=True, eq=False)
class Minimum(Generic[_At]):
    """Where the iteration ended."""

    at: _At  # the parameters
    cost: float
    iterations: int
    converged: bool


def minimise(
    equations: Callable[[_At], Equations],
    step: Callable[[_At, Array], _At],
    start: _At,
    *,
    cost: Callable[[_At], float] | None = None,
    options: Options | None = None,
) -> Minimum[_At] | None:
    """The least cost near ``start``; ``None`` where the cost there is not finite.

    Args:
        equations: parameters → cost, normal matrix JᵀWJ (P, P), right side JᵀWr (P,).
        step: (parameters, increment (P,)) → new parameters. For a pose, the left perturbation.
        start: the first parameters; any type that ``step`` takes.
        cost: parameters → cost, infinite where they mean nothing. None: that of ``equations``,
            where its normal matrix costs little more.
        options: when to stop.

    Levenberg 1944, Marquardt 1963. Robust weights belong to ``equations`` (iteratively
    reweighted), the same loss to the cost.
    """
    options = options or Options()
    here, normal, right = equations(start)
    if not np.isfinite(here):
        return None
    at, damping = start, options.first_damping
    increment, lower = np.empty(len(right)), np.empty_like(normal)
    for done in range(options.iterations):
        for _ in range(options.trials):
            if damped_step(normal, right, damping, lower, increment):
                trial = step(at, increment)
                if cost is None:
                    there, *ahead = equations(trial)
                else:
                    there, ahead = cost(trial), []
                if there <= here * (1.0 + ROUNDING):
                    break
            damping = max(DAMPING_GROWTH * damping, FIRST_DAMPING)
        else:
            return Minimum(at, here, done, True)  # no step lowers the cost
        gain, at, here = here - there, trial, there
        if gain <= options.least_gain + options.relative_gain * here:
            return Minimum(at, here, done + 1, True)
        normal, right = ahead or equations(at)[1:]
        damping *= DAMPING_DECAY
    return Minimum(at, here, options.iterations, False)


@njit(cache=True, nogil=True, error_model="numpy")
def damped_step(normal: Array, right: Array, damping: float, lower: Array, out: Array) -> bool:
    """Fill ``out`` (n,) with the solution of ``(N + damping diag N) out = right`` (Marquardt 1963).

    ``lower`` (n, n) is scratch. False where the equations do not determine a step.
    """
    n = right.shape[0]
    damped = normal.copy()
    for i in range(n):
        damped[i, i] *= 1.0 + damping
    return solve_scaled(damped, right, lower, out)


@njit(cache=True, nogil=True, error_model="numpy")
def tukey_weight(residual: float, cut: float) -> float:
    """Weight of a residual under Tukey's biweight; 0 beyond the cut."""
    q = residual / cut
    if q * q >= 1.0:
        return 0.0
    return (1.0 - q * q) ** 2
