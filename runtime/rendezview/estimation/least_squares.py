"""Damped robust least squares: Gauss–Newton with Levenberg's and Marquardt's damping.

One driver, `minimise`, for problems that are set up in Python; its pieces (`damped_step`,
`tukey_weight`) for the few loops that are compiled as a whole because a call from Python would
cost more than the iteration (contour alignment, reflectors, lights).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit

from rendezview.estimation.linear_algebra import solve_scaled
from rendezview.geometry.pose import Array

# Damping, a share of the diagonal: the first after a plain step failed, and its factors after a
# worse and a better step. Source: Marquardt, SIAM J. 11(2), 1963, whose λ₀ is 0.01 and ν 10; 1e-4
# because the starts here are near.
FIRST_DAMPING = 1e-4  # Source: as above
DAMPING_GROWTH = 10.0  # Source: as above
DAMPING_DECAY = 0.1  # Source: as above


@dataclass(frozen=True, kw_only=True)
class Options:
    """When to stop."""

    iterations: int = 50  # a bound only. Source: by construction
    # Of damping, each ten times the last: at 1e4 of the diagonal a step is rounding.
    trials: int = 8  # Source: by construction
    # Of the cost χ²: a hundredth of a standard deviation, squared.
    least_gain: float = 1e-4  # Source: by construction
    # Of the diagonal; 0: plain Gauss–Newton steps first.
    first_damping: float = 0.0  # Source: by construction


@dataclass(frozen=True, slots=True, eq=False)
class Minimum:
    """Where the iteration ended."""

    at: Any  # the parameters, of the type of the start
    cost: float
    normal: Array  # (P, P) undamped normal matrix there: the inverse of the covariance
    iterations: int
    converged: bool


def minimise(
    equations: Callable[[Any], tuple[float, Array, Array]],
    cost: Callable[[Any], float],
    step: Callable[[Any, Array], Any],
    start: Any,
    options: Options | None = None,
) -> Minimum | None:
    """The least cost near ``start``; ``None`` where the cost there is not finite.

    Args:
        equations: parameters → cost, normal matrix JᵀWJ (P, P), right side JᵀWr (P,).
        cost: parameters → cost, infinite where they mean nothing.
        step: (parameters, increment (P,)) → new parameters. For a pose, the left perturbation.
        start: the first parameters; any type that ``step`` takes.
        options: when to stop.

    Levenberg 1944, Marquardt 1963. Robust weights belong to ``equations`` (iteratively
    reweighted), the same loss to ``cost``.
    """
    options = options or Options()
    here, normal, right = equations(start)
    if not np.isfinite(here):
        return None
    at, damping, converged, done = start, options.first_damping, False, 0
    while done < options.iterations and not converged:
        done += 1
        accepted = False
        for _ in range(options.trials):
            increment, lower = np.empty(len(right)), np.empty_like(normal)
            if damped_step(normal, right, damping, lower, increment):
                trial = step(at, increment)
                there = cost(trial)
                if there <= here:
                    accepted = True
                    break
            damping = max(DAMPING_GROWTH * damping, FIRST_DAMPING)
        if not accepted:
            converged = True
            break
        converged = here - there <= options.least_gain
        at = trial
        here, normal, right = equations(at)
        damping *= DAMPING_DECAY
    return Minimum(at, here, normal, done, converged)


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
