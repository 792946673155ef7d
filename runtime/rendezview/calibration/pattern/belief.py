"""Which reflectors are off: every small set of them, weighed by the evidence of a run.

A run shows the shape of a pattern, but neither its place on the target nor, with one camera, its
size. These come from the file: the reflectors that are not off are where it says, within a
tolerance. Which these are, and what the tolerance is, is summed over (Bayes): where several
explain the spots, the places have the σ of all of them.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from rendezview.calibration.pattern.bundle import Information
from rendezview.geometry.pose import Array

_OFF = 0.05  # of a reflector to be off, before the run. Source: by construction
# Of the base: σ of where it then is, each as likely. Source: by construction, 1 to 7 mm of 368
_OFF_BY = (0.0025, 0.005, 0.01, 0.02)
WIDEST = _OFF_BY[-1]  # Source: as above
_SIZE = 0.1  # σ of the pattern's size where a length is given. Source: by construction
# Of the base: what a tolerance is at most, and at least where the file states none. Each is twice
# the one before. Source: by construction, 4 mm and 0.02 mm of 368
_MOST, _LEAST = 0.01, 5e-5
# A tolerance twice as large is so much as likely: of those that a file states, and does not state.
_STATED, _UNSTATED = 0.1, 0.5  # Source: by construction
_MOST_SETS = 3  # reflectors in a set. Source: by construction, a bound of time


@dataclass(frozen=True, slots=True, eq=False)
class Belief:
    """What is known of the places after a run."""

    moved_m: Array  # (3N,) beside the places in the file
    covariance: Array  # (3N, 3N)
    off: Array  # (N,) probability of each reflector to be off by more than the tolerance


def weigh(
    run: Information, places_m: Array, sigmas_m: Array, base_m: float, least_m: float,
    size_open: bool,
) -> Belief:  # fmt: skip
    """The posterior of the places.

    Args:
        run: what the spots, and lengths that are known, tell.
        places_m: (N, 3) of the file, about their middle.
        sigmas_m: (N,) σ that the file states, NaN where it states none.
        base_m: of the largest group.
        least_m: a tolerance is no smaller: what all readings of a spot may be off by.
        size_open: the pattern's size is not known by the file.
    """
    count, weights, means, spreads, members = len(places_m), [], [], [], []
    size = _SIZE * places_m.reshape(-1, 1) if size_open else np.empty((3 * count, 0))
    for chance, tolerances in _tolerances(sigmas_m, base_m, least_m):
        for off, by in itertools.product(_sets(count), _OFF_BY):
            if (not off and by > _OFF_BY[0]) or (off and by * base_m < 2.0 * tolerances.max()):
                continue
            sigma = tolerances.copy()
            sigma[list(off)] = np.hypot(sigma[list(off)], by * base_m)
            root = np.hstack([np.diag(np.repeat(sigma, 3)), size])  # of the prior's covariance
            inner = root.T @ run.matrix @ root + np.eye(root.shape[1])
            whole = root @ np.linalg.solve(inner, root.T)
            mean = whole @ run.vector
            evidence = 0.5 * (run.vector @ mean - np.linalg.slogdet(inner)[1])
            prior = len(off) * np.log(_OFF) + (count - len(off)) * np.log(1.0 - _OFF)
            prior -= np.log(len(_OFF_BY)) if off else 0.0
            weights.append(evidence + prior + np.log(chance))
            means.append(mean)
            spreads.append(whole)
            members.append(np.isin(np.arange(count), off))
    share = np.exp(np.array(weights) - max(weights))
    share /= share.sum()
    moved = share @ np.array(means)
    apart = np.array(means) - moved
    covariance = np.tensordot(share, np.array(spreads), 1) + (apart.T * share) @ apart
    return Belief(moved, covariance, share @ np.array(members))


def _sets(count: int) -> Iterator[tuple[int, ...]]:
    """Reflectors that may be off together: the spots must say more than where these are."""
    for size in range(max(min(_MOST_SETS, count - 3, (3 * count - 8) // 3), 0) + 1):
        yield from itertools.combinations(range(count), size)


def _tolerances(sigmas_m: Array, base_m: float, least_m: float) -> Iterator[tuple[float, Array]]:
    """Chance (that of the first is 1), and tolerance (N,) of each reflector."""
    stated = np.isfinite(sigmas_m)
    if stated.all():
        first, chance = sigmas_m, _STATED
    else:
        first, chance = np.where(stated, sigmas_m, _LEAST * base_m), _UNSTATED
    smallest = max(float(first.max()), least_m, _LEAST * base_m)
    for k in range(1 + max(int(np.log2(_MOST * base_m / smallest)), 0)):
        larger = np.where(stated & ~stated.all(), first, 2.0**k * first)
        yield chance**k, np.maximum(larger, least_m)
