"""A pose found on a sketch, in the form in which the recognizer gives poses."""

from __future__ import annotations

from dataclasses import dataclass, replace

from rendezview.geometry.pose import Pose
from rendezview.sensors.appearance.edges.refinement import Refined
from rendezview.sensors.appearance.judge.confidence import Found
from rendezview.sensors.appearance.judge.sketch_choice import Aligned, SketchChoice, SketchPose


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
