"""Choice of the best of a sketch's poses, and the probability that it is right."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path

import numpy as np
from scipy.special import logit

from rendezview.estimation.hypotheses import choose
from rendezview.geometry.pose import Array, Pose
from rendezview.geometry.symmetry import Symmetry, angle_between
from rendezview.sensors.appearance.hypothesis import Hypothesis
from rendezview.sensors.appearance.judge.probability_forest import ProbabilityForest

PACKAGED = Path(__file__).with_name("sketch_error_model.json")
PACKAGED_TREES = Path(__file__).with_name("confidence.npz")
# What a pose is judged by: mean probability of an edge on the outline, and on creases and steps;
# mean step of the cover across the outline; share of the outline that lies in the sketch; share of
# the sketch's lines that lie next to an edge of the model; share of the grey levels' variance that
# light explains within small windows, and over the whole target (0: none, or no surface) …
POSE_FEATURES = ("outline", "inner", "contrast", "visible", "explained", "shading", "tones")
# … and the choice of one: in the closer pass, in the first one, and both together.
CHOICE_FEATURES = (
    "margin", "cut", "lead", "basin", "converged", "scatter", "spread", *POSE_FEATURES,
)  # fmt: skip
# Rad; a pose further away is another answer: so far grey edges move one, and a joint at a wrong
# angle. Source: the spacing of the nodes' views, experiment pose-joints (0.1)
NEAR_RAD = np.deg2rad(8.0)
_MOST_MARGIN = 4.0  # of log odds; a larger margin says no more. Source: by construction
_SAME_RAD = np.deg2rad(1.5)  # rad; poses nearer have converged. Source: error of a pose
_MOST_SCATTER_DEG = 10.0  # °; more says no more. Source: by construction
# Confidence from which to which a second opinion is asked: below, it is hardly ever right, above,
# hardly ever wrong. Source: experiment sketch-confidence
DOUBT = (0.1, 0.7)
_SUREST = 0.98  # probability; a surer opinion says no more. Source: leaves of ten frames


def sketch_merit(hypothesis: Hypothesis) -> float:
    """Log odds of a pose on a sketch against the other poses of the frame, but for a constant."""
    assert hypothesis.sketch is not None
    return float(hypothesis.sketch @ packaged().merit)


@dataclass(frozen=True, slots=True, eq=False)
class Passes:
    """The poses of one frame that were aligned to its sketch, in the order they were found."""

    first: list[Hypothesis]  # from all starts, on the first sketch
    around: list[Hypothesis]  # from around the best of them, on the finer sketch
    others: list[Hypothesis]  # from other ones of the first pass, on the finer sketch
    symmetries: Sequence[Symmetry] = ()
    prior: bool = False  # found near a prior
    cut: bool = False  # the target leaves the frame
    spread_deg: float = 0.0  # °; between the poses of two scales and their mean, at most

    @property
    def closer(self) -> list[Hypothesis]:
        """All poses on the finer sketch."""
        return self.around + self.others

    def chosen(self) -> tuple[Hypothesis, Hypothesis | None, float] | None:
        """The best pose of the closer pass, its rival, and its lead in merit; None without any."""
        poses = self.closer

        def same(k: int, known: int) -> bool:
            apart = angle_between(poses[k].pose, poses[known].pose, self.symmetries)
            return bool(apart <= NEAR_RAD)

        choice = choose([sketch_merit(one) for one in poses], same)
        if choice is None:
            return None
        if not choice.rivals:
            return poses[choice.best], None, _MOST_MARGIN
        return poses[choice.best], poses[choice.rivals[0]], choice.margin

    def lead(self, best: Pose) -> float:
        """Merit in the first pass of the poses that lead to the best, above the others'."""
        merits = np.array([sketch_merit(pose) for pose in self.first])
        same = np.array([pose.pose.angle_to(best) < NEAR_RAD for pose in self.first])
        if not same.any() or same.all():
            return _MOST_MARGIN if same.any() else -_MOST_MARGIN
        lead = float(merits[same].max() - merits[~same].max())
        return max(-_MOST_MARGIN, min(lead, _MOST_MARGIN))

    def basin(self, best: Pose) -> float:
        """Share of the first pass's poses that lead to the best."""
        return float(np.mean([pose.pose.angle_to(best) < NEAR_RAD for pose in self.first]))

    def scattered(self, best: Pose) -> tuple[float, float]:
        """Of the poses from around: share that converged to the best, median angle to it, °."""
        angles = np.array([pose.pose.angle_to(best) for pose in self.around])
        if not len(angles):
            return 0.0, _MOST_SCATTER_DEG
        median_deg = float(np.rad2deg(np.median(angles)))
        return float(np.mean(angles < _SAME_RAD)), min(median_deg, _MOST_SCATTER_DEG)

    @property
    def features(self) -> Array:
        """(14,) ``CHOICE_FEATURES`` of the best pose."""
        chosen = self.chosen()
        assert chosen is not None
        best, _, margin = chosen
        assert best.sketch is not None
        seen = [self.lead(best.pose), self.basin(best.pose), *self.scattered(best.pose)]
        seen.append(min(self.spread_deg, _MOST_SCATTER_DEG))
        return np.array([min(margin, _MOST_MARGIN), float(self.cut), *seen, *best.sketch])

    @property
    def probability(self) -> float:
        """Probability that the best pose is right, 0 … 1."""
        forest = packaged().near if self.prior else packaged().anywhere
        return forest.probability(self.features)


def opinion_features(own: float, other: float, *, agree: bool) -> Array:
    """(4,) of the logistic regression of two opinions, the more confident one first."""
    odds = logit(np.clip([own, other], 1.0 - _SUREST, _SUREST))
    return np.array([1.0, *odds, float(agree)])


def distinct(poses: Sequence[Hypothesis], most: int, apart_rad: float) -> list[Hypothesis]:
    """The poses of most merit that are some angle apart, the best first."""
    choice = choose(
        [sketch_merit(one) for one in poses],
        lambda k, known: poses[k].pose.angle_to(poses[known].pose) <= apart_rad,
        most=most - 1,
    )
    return [] if choice is None else [poses[k] for k in choice.answers]


@dataclass(frozen=True, slots=True, eq=False)
class SketchErrorModel:
    """What was fitted to frames of known pose (``experiments sketch-confidence``)."""

    merit: Array  # (7,) of POSE_FEATURES
    anywhere: ProbabilityForest  # of CHOICE_FEATURES: is the pose right, without a prior …
    near: ProbabilityForest  # … and near one
    opinions: Array  # (4,) of ``opinion_features``, without a prior
    inflation: float  # of the covariance of independent edges


@cache
def packaged() -> SketchErrorModel:
    """What comes with the package."""
    record = json.loads(PACKAGED.read_text(encoding="utf-8"))
    merit = [record["merit"][name] for name in POSE_FEATURES]
    with np.load(PACKAGED_TREES) as arrays:
        anywhere, near = (
            ProbabilityForest(
                *(arrays[f"{kind}_{field.name}"] for field in fields(ProbabilityForest))
            )
            for kind in ("anywhere", "near")
        )
    return SketchErrorModel(
        np.array(merit),
        anywhere,
        near,
        opinions=np.array(record["opinions"]),
        inflation=float(record["inflation"]),
    )
