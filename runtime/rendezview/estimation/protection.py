"""Protection levels: how large an error may be, at a probability that the user sets.

As in the integrity of satellite navigation. Normalised errors are bounded by a distribution with
heavier tails (overbounding: DeCleene, ION GPS 2000; Student's t: Lange et al., JASA 84, 1989).
Other answers that fit stand beside the pose with their probabilities (multiple hypotheses: Pervan
et al., Navigation 45, 1998; Blanch et al., IEEE TAES 51, 2015), and the level is the least length
that keeps the sum of all risks below the user's. A cumulative sum finds drifts (Page, Biometrika
41, 1954).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from scipy.special import fdtri, stdtrit

from rendezview.geometry.pose import Array

LEAST_RISK, MOST_RISK = 1e-9, 0.1  # Source: precision of the quantiles; `radius` is a bound below


@dataclass(frozen=True, slots=True)
class Overbound:
    """A distribution whose tails lie above those of the normalised errors, and a bias."""

    scale: float  # factor of a standard deviation
    degrees: float  # of freedom of Student's t; small: heavy tails
    bias: float = 0.0  # that no covariance has, such as of a wrong mesh: nominal bias of ARAIM

    def __post_init__(self) -> None:
        if not (0.0 < self.scale < math.inf and 0.0 < self.degrees < math.inf):
            raise ValueError(f"an overbound needs positive numbers: {self}")
        if not 0.0 <= self.bias < math.inf:
            raise ValueError(f"a bias must not be negative: {self}")

    def radius(self, covariance: Array, unit: float = 1.0) -> Callable[[float], float]:
        """The length that an error exceeds with a probability of at most a risk, by that risk.

        The error has Student's t distribution in D dimensions. With the largest eigenvalue λ of its
        covariance, its squared length has tails below those of λ n F(n, ν), n = trace / λ: both
        have the same mean, and unequal axes disperse less (convex order; for risks below 0.1).

        Args:
            covariance: (D, D) of the error.
            unit: of the bias; a range where the bias is a share of it.
        """
        largest = float(np.linalg.eigvalsh(covariance)[-1])
        axes = float(np.trace(covariance)) / largest
        longest = self.scale * math.sqrt(largest * axes)
        bias = self.bias * unit
        return lambda risk: bias + longest * math.sqrt(fdtri(axes, self.degrees, 1.0 - risk))

    def each(self, covariance: Array, risk: float, unit: float = 1.0) -> Array:
        """(D,) half the interval of each axis, which an error leaves with probability ``risk``."""
        reach = -float(stdtrit(self.degrees, 0.5 * risk))
        return np.asarray(self.bias * unit + self.scale * reach * np.sqrt(np.diag(covariance)))


@dataclass(frozen=True, slots=True)
class Share:
    """How a risk is shared between a pose's own error and the other answers."""

    risk: float  # left for the error of the pose itself; 0: the other answers take it all
    covered: float  # distance of the farthest answer that the level must reach

    def level(self, radius: Callable[[float], float]) -> float:
        """The protection level; infinite where no risk is left."""
        return math.inf if self.risk < LEAST_RISK else max(self.covered, radius(self.risk))


def shared(
    radius: Callable[[float], float], alternatives: Iterable[tuple[float, float]], risk: float
) -> Share:
    """The sharing of a risk with the least level L: Σ pₖ [dₖ > L] + P(error > L) ≤ risk.

    An error exceeds L if an answer farther than L is the truth, or by itself.

    Args:
        radius: length that the error of the pose itself exceeds with a given probability.
        alternatives: distance of each other answer, with its own uncertainty, and its probability.
        risk: the user's.
    """
    nearest_first = sorted(alternatives)
    outside = sum(probability for _, probability in nearest_first)
    best = Share(max(risk - outside, 0.0), 0.0)
    least = best.level(radius)
    for distance, probability in nearest_first:
        if distance >= least:
            break
        outside -= probability  # from here on this one is inside
        share = Share(max(risk - outside, 0.0), distance)
        if share.level(radius) < least:
            best, least = share, share.level(radius)
    return best


@dataclass(frozen=True, slots=True, eq=False)
class Drift:
    """Two-sided cumulative sums of normalised innovations (Page 1954)."""

    above: Array  # (D,)
    below: Array  # (D,)

    @classmethod
    def none(cls, size: int) -> Drift:
        """Before the first innovation."""
        return cls(np.zeros(size), np.zeros(size))

    def after(self, normalised: Array, allowance: float, most: float) -> Drift:
        """The sums after one more innovation.

        Args:
            normalised: (D,) innovation in standard deviations.
            allowance: standard deviations; a smaller mean is no drift.
            most: standard deviations; a single outlier counts no more.
        """
        step = np.clip(normalised, -most, most)
        return Drift(
            np.maximum(self.above + step - allowance, 0.0),
            np.maximum(self.below - step - allowance, 0.0),
        )

    @property
    def largest(self) -> float:
        """The largest sum, standard deviations."""
        return float(max(self.above.max(), self.below.max()))
