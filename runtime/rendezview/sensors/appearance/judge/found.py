"""The choice of a frame: its best pose, the rival, and the probability that the pose is right."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import expit, gammainc, logit

from rendezview.geometry.pose import Array, Pose
from rendezview.geometry.symmetry import Symmetry, angle_between, nearest_alike
from rendezview.sensors.appearance.hypothesis import Aligned, Hypothesis
from rendezview.sensors.appearance.judge.rivals import RIVAL_RAD
from rendezview.sensors.appearance.judge.sketch_choice import (
    NEAR_RAD,
    Passes,
    opinion_features,
    packaged,
)
from rendezview.sensors.appearance.model.error_model import ErrorModel

# Weights of the merit, beside an inlier ratio of weight 1.
# Of mean radii of the silhouette. Source: by hand, seeds of docs/notes/refinement.md
_OVERSHOOT_WEIGHT = 1.0
# Of the share of grey levels that one light explains. Source: by hand, seeds of
# docs/notes/refinement.md
_LIGHT_WEIGHT = 0.25
# Source: experiment pose-accuracy, seeds 1, 88, 99 (commits f070326, 5e90c44)
_RESIDUAL_WEIGHT = 0.08  # of log px
# px; a smaller residual is no better. Source: by hand, seeds of docs/notes/refinement.md
_LEAST_RESIDUAL_PX = 0.05
# Source: experiment pose-accuracy, seeds 1, 88, 99: of 1626 frames with a right and a wrong pose
# the wrong one came first in 13 with shading, in 34 without
_SHADING_WEIGHT = 0.4  # of a correlation
# Of overshoot and of margin in the regression, which saturate there. Source: fixed with the fit of
# error_model.json
MOST_FEATURE = 0.3
# Of the drawn look-alikes; a surer pose is no surer. Of .9, .95 and .99 it gives most right poses
# and none wrong. Source: docs/notes/rivals.md
_SUREST_SHARE = 0.95
_NOTHING, _SUREST_SEARCH = 1e-9, 1.0 - 1e-9  # probabilities. Source: by construction, no infinity
_AGREE_CHI2 = 16.8  # of six. Source: by construction, 99 %


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """The best pose of a frame and its rival, the best pose that is another answer."""

    best: Hypothesis
    # Merit of the best pose above its rival's, 1 without a rival; where look-alikes were drawn,
    # above that of the others; of a sketch log odds, at most 4
    margin: float
    dark: bool  # the sky is dark
    prior: bool  # found near a prior
    rival: Hypothesis | None = None
    votes: float | None = None  # log odds of the outline's forest about it; None: not asked
    single: bool = False  # only the pose next to the prior was tried
    weighed: tuple[Hypothesis, ...] = ()  # beside its look-alikes, likeliest first; (): not asked
    # Of a pose on a sketch: probability that it is right, with the odds of its look-alikes, too,
    # other poses on the finer sketch, and how the search went
    probability: float | None = None
    among: float | None = None
    aligned: Aligned | None = None
    passes: Passes | None = None

    @property
    def on_sketch(self) -> bool:
        """Whether the pose was found on a sketch."""
        return self.probability is not None

    @property
    def merit(self) -> float:
        """Merit of the best pose; see ``merit``."""
        return merit(self.best, self.best.shading)

    @property
    def posterior(self) -> float:
        """Probability of the pose among its look-alikes; 1 where they were not asked."""
        if not self.weighed:
            return 1.0
        return self.weighed[0].probability if self.among is None else self.among

    @property
    def answers(self) -> list[Pose]:
        """The best pose, and its rival if there is one."""
        return [found.pose for found in (self.best, self.rival) if found is not None]

    @property
    def features(self) -> Array:
        """(7,) in the order of ``CONFIDENCE_FEATURES``."""
        best = self.best
        return np.array(
            [
                1.0,
                best.outline,
                best.residual_px,
                min(best.overshoot, MOST_FEATURE),
                min(max(self.margin, 0.0), MOST_FEATURE),
                float(self.dark),
                best.shading or 0.0,
            ]
        )

    @property
    def confidence(self) -> float:
        """Probability 0 … 1 that the best pose is the right one, to the errors of its edges."""
        if self.probability is not None:
            return self.probability
        return ErrorModel.packaged().confidence(self.features)

    @property
    def certainty(self) -> float:
        """The same, and among its look-alikes."""
        return min(self.confidence, self.posterior)

    @property
    def right(self) -> float:
        """Probability 0 … 1 that the best pose is right to 5°."""
        return self.certainty * self.share_within(RIVAL_RAD)

    def share_within(self, error_rad: float) -> float:
        """Share 0 … 1 of its covariance where the attitude is off by less than some angle.

        The squared error is taken as gamma-distributed, with mean and variance of the covariance
        (Satterthwaite 1946).
        """
        covariance = self.best.covariance
        if covariance is None:
            return 0.0
        turn = covariance[:3, :3]
        mean, variance = float(np.trace(turn)), 2.0 * float((turn**2).sum())
        return float(gammainc(mean**2 / variance, error_rad**2 * mean / variance))

    def with_opinion(self, second: Found, symmetries: Sequence[Symmetry]) -> Found:
        """The more confident of two choices on sketches, with the probability that both give."""
        agree = bool(angle_between(self.best.pose, second.best.pose, symmetries) < NEAR_RAD)
        first, second = sorted((self, second), key=lambda one: -one.confidence)
        opinions = opinion_features(first.confidence, second.confidence, agree=agree)
        return replace(first, probability=float(expit(opinions @ packaged().opinions)))

    def beside(self, weighed: Sequence[Hypothesis], symmetries: Sequence[Symmetry]) -> Found:
        """A pose on a sketch beside its look-alikes, if it has any.

        The forest that knows how the search went has hardly seen craft that look alike from
        several sides, and drawings of look-alikes know nothing of the search: the odds of both
        are multiplied, as far as the pictures differ: between poses that look the same the search
        chose by chance. That is the probability among look-alikes. It says nothing of poses that
        nobody drew, so the confidence does not grow by it.
        """
        pose, own = self.best.pose, self.confidence

        def same(one: Hypothesis | None) -> bool:
            return one is not None and angle_between(one.pose, pose, symmetries) < NEAR_RAD

        alike = np.array([same(w) or same(w.on_sketch) for w in weighed])
        if len(weighed) == 1 and alike[0]:
            return self  # it has no rival, and nothing was drawn
        shares, distinct = np.array([(w.probability, w.distinct) for w in weighed]).T
        if alike.any() and not alike[0]:  # the likeliest's own is from itself
            distinct[0] = distinct[alike][0]
        # Poses that nobody proposed are the last, in case there is no other.
        rest, apart = np.append(shares[~alike], _NOTHING), np.append(distinct[~alike], 1.0)
        odds = float(np.exp(logit(np.clip(own, _NOTHING, _SUREST_SEARCH)) * -apart) @ rest)
        share = min(float(shares[alike].sum()), _SUREST_SHARE)
        together = float(expit(logit(share) - math.log(odds / rest.sum())))
        return replace(self, probability=min(own, together), among=together, weighed=tuple(weighed))

    def known_among(self, weighed: Sequence[Hypothesis], symmetries: Sequence[Symmetry]) -> Found:
        """A pose that was aligned alone, no surer than it is among look-alikes weighed before."""
        share = share_of(self.best.pose, weighed, symmetries)
        return replace(self, among=share, weighed=tuple(weighed))

    def confirming(self, grey: Found, symmetries: Sequence[Symmetry]) -> Found:
        """A pose on a sketch, with that of grey edges in its place if both agree and it is finer.

        They agree where they differ by no more than both covariances allow.
        """
        own, other = self.best, grey.best
        if own.covariance is None or other.covariance is None:
            return self
        finer = np.linalg.det(other.covariance) < np.linalg.det(own.covariance)
        return replace(self, best=other) if finer and agree(own, other, symmetries) else self


def agree(one: Hypothesis, other: Hypothesis, symmetries: Sequence[Symmetry]) -> bool:
    """Whether two poses differ by no more than their covariances allow, if they have any."""
    if one.covariance is None or other.covariance is None:
        return True
    apart = nearest_alike(other.pose, one.pose, symmetries).delta_from(one.pose)
    allowed = one.covariance + other.covariance
    return bool(apart @ np.linalg.solve(allowed, apart) <= _AGREE_CHI2)


def one_answer(weighed: Sequence[Hypothesis], symmetries: Sequence[Symmetry]) -> list[Hypothesis]:
    """Weighed poses, with those that are the same answer as the likeliest taken into it.

    It has their probability, and a covariance that holds them: the second moment of all about it.
    """
    best, others = weighed[0], []
    total, covariance = best.probability, best.covariance
    for one in weighed[1:]:
        there = nearest_alike(one.pose, best.pose, symmetries)
        if there.angle_to(best.pose) > RIVAL_RAD:
            others.append(one)
            continue
        total += one.probability
        if covariance is not None and total > 0.0:
            apart = there.delta_from(best.pose)
            spread = np.outer(apart, apart) + (0.0 if one.covariance is None else one.covariance)
            covariance = covariance + one.probability / total * (spread - covariance)
    return [replace(best, probability=total, covariance=covariance), *others]


def share_of(pose: Pose, weighed: Sequence[Hypothesis], symmetries: Sequence[Symmetry]) -> float:
    """Probability of a pose: of those weighed that are the same answer."""
    same = (one for one in weighed if angle_between(one.pose, pose, symmetries) < RIVAL_RAD)
    return float(sum(one.probability for one in same))


def merit(hypothesis: Hypothesis, shading: float | None) -> float:
    """One figure to compare poses of one frame by; ``shading``: None where it does not count."""
    one = hypothesis
    edges = one.inlier_ratio - _OVERSHOOT_WEIGHT * one.overshoot + _LIGHT_WEIGHT * one.light
    edges -= _RESIDUAL_WEIGHT * math.log(max(one.residual_px, _LEAST_RESIDUAL_PX))
    return edges if shading is None else edges + _SHADING_WEIGHT * shading
