"""A pose found on a sketch, in the form in which the recognizer gives poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import expit, logit

from rendezview.geometry.pose import Pose
from rendezview.geometry.symmetry import Symmetry, angle_between
from rendezview.sensors.appearance.edges.refinement import Refined
from rendezview.sensors.appearance.judge.confidence import Found
from rendezview.sensors.appearance.judge.rivals import Weighed
from rendezview.sensors.appearance.judge.sketch_choice import Aligned, SketchChoice, SketchPose

# Rad; error of a pose that grey edges have moved, or whose joint is at a wrong angle. Source:
# experiment pose-joints (0.1)
NEAR_RAD = np.deg2rad(8.0)
# Of the drawn look-alikes; a surer pose is no surer. Of .9, .95 and .99 it gives most right poses
# and none wrong. Source: docs/notes/rivals.md
_SUREST_SHARE = 0.95


@dataclass(frozen=True, slots=True, eq=False)
class SketchFound(Found):
    """The best pose of a sketch and its rival."""

    probability: float = 0.0
    aligned: Aligned | None = None  # other poses on the finer sketch

    @property
    def confidence(self) -> float:
        """Probability that the best pose is right, 0 … 1."""
        return self.probability

    @property
    def posterior(self) -> float:
        """The confidence: it counts the look-alikes where they were weighed."""
        return self.probability

    def beside(self, weighed: Sequence[Weighed], symmetries: Sequence[Symmetry]) -> SketchFound:
        """The same pose with the odds of its look-alikes in its probability, if it has any.

        The forest that knows how the search went has hardly seen craft that look alike from
        several sides, and drawings of look-alikes know nothing of the search: the odds of both
        are multiplied. A pose that the search holds for wrong gains nothing by its look-alikes.
        """
        pose = self.best.pose

        def same(one: Pose | None) -> bool:
            return one is not None and angle_between(one, pose, symmetries) < NEAR_RAD

        share = sum(w.probability for w in weighed if same(w.pose) or same(w.on_sketch))
        if share == 1.0 == len(weighed):
            return self  # it has no rival, and nothing was drawn
        odds = logit(self.probability) + logit(min(share, _SUREST_SHARE))
        together = float(expit(odds))
        if self.probability < 0.5:
            together = min(together, self.probability)
        return replace(self, probability=together, weighed=tuple(weighed))

    @property
    def without_grey_edges(self) -> Refined:
        """The best pose where grey edges have no hold: it has their least merit."""
        return replace(self.best, outline=0.0, inner=0.0)

    @classmethod
    def of(cls, choice: SketchChoice | None, *, dark: bool) -> SketchFound | None:
        """The choice as the recognizer gives it, if there is one; ``dark``: the sky is."""
        if choice is None:
            return None
        return cls(
            best=_refined(choice.best, choice.pose, choice),
            overshoot=0.0,
            margin=choice.margin,
            dark=dark,
            prior=choice.prior,
            rival=None
            if choice.rival is None
            else _refined(choice.rival, choice.rival.pose, choice),
            probability=choice.confidence,
            aligned=choice.aligned,
        )


def _refined(agrees: SketchPose, pose: Pose, choice: SketchChoice) -> Refined:
    """A pose of a sketch with what agrees, and the covariance and residual of the choice."""
    if choice.covariance is None:
        raise ValueError("the choice has no covariance")
    return Refined(
        pose,
        choice.covariance,
        outline=agrees.outline,
        inner=agrees.inner,
        visible=agrees.visible,
        residual_px=choice.residual_px,
        light=0.0,
    )
