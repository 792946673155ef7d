"""Choice of the best of a sketch's poses, and the probability that it is right."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache
from itertools import islice
from pathlib import Path

import numpy as np
from scipy.special import expit, logit

from rendezview.geometry.pose import Array, Pose
from rendezview.geometry.symmetry import Symmetry, angle_between, first_of_each
from rendezview.sensors.appearance.judge.probability_forest import ProbabilityForest

PACKAGED = Path(__file__).with_name("sketch_error_model.json")
PACKAGED_TREES = Path(__file__).with_name("confidence.npz")
# What a pose is judged by, in the order of the fields of ``SketchPose`` …
POSE_FEATURES = ("outline", "inner", "contrast", "visible", "explained", "shading", "tones")
# … and the choice of one: in the closer pass, in the first one, and both together.
CHOICE_FEATURES = (
    "margin", "cut", "lead", "basin", "converged", "scatter", "spread", *POSE_FEATURES,
)  # fmt: skip
# Source: the spacing of the nodes' views
RIVAL_RAD = np.deg2rad(8.0)  # rad; a pose further away is another answer
_MOST_MARGIN = 4.0  # of log odds; a larger margin says no more. Source: by construction
_SAME_RAD = np.deg2rad(1.5)  # rad; poses nearer have converged. Source: error of a pose
_MOST_SCATTER_DEG = 10.0  # °; more says no more. Source: by construction
# Confidence from which to which a second opinion is asked: below, it is hardly ever right, above,
# hardly ever wrong. Source: experiment sketch-confidence
DOUBT = (0.1, 0.7)
_SUREST = 0.98  # probability; a surer opinion says no more. Source: leaves of ten frames


@dataclass(frozen=True, slots=True, eq=False)
class SketchPose:
    """A pose on a sketch, with what agrees."""

    pose: Pose  # camera_from_target
    outline: float  # mean probability of an edge on the outline
    inner: float  # the same on creases and steps
    contrast: float  # mean step of the cover across the outline
    visible: float  # share of the outline that lies in the sketch
    explained: float  # share of the sketch's lines that lie next to an edge of the model
    shading: float  # share of the grey levels' variance within small windows that light explains …
    tones: float  # … and over the whole target; 0: none, or the model has no surface

    @property
    def features(self) -> Array:
        """(7,) ``POSE_FEATURES``."""
        return np.array([getattr(self, name) for name in POSE_FEATURES])

    @property
    def merit(self) -> float:
        """Log odds against the other poses of the frame, but for a constant."""
        return float(self.features @ packaged().merit)


# Where a sketch leads poses (N) to, with what agrees there; None: no hold.
Aligned = Callable[[Sequence[Pose]], list[SketchPose | None]]


@dataclass(frozen=True, slots=True, eq=False)
class Passes:
    """The poses of one frame that were aligned, in the order in which they were found."""

    first: list[SketchPose]  # from all starts, on the first sketch
    around: list[SketchPose]  # from around the best of them, on the finer sketch
    others: list[SketchPose]  # from other ones of the first pass, on the finer sketch

    @property
    def closer(self) -> list[SketchPose]:
        """All poses on the finer sketch."""
        return self.around + self.others

    def lead(self, best: Pose) -> float:
        """Merit in the first pass of the poses that lead to the best, above the others'."""
        merits = np.array([pose.merit for pose in self.first])
        same = np.array([pose.pose.angle_to(best) < RIVAL_RAD for pose in self.first])
        if not same.any() or same.all():
            return _MOST_MARGIN if same.any() else -_MOST_MARGIN
        lead = float(merits[same].max() - merits[~same].max())
        return max(-_MOST_MARGIN, min(lead, _MOST_MARGIN))

    def basin(self, best: Pose) -> float:
        """Share of the first pass's poses that lead to the best."""
        return float(np.mean([pose.pose.angle_to(best) < RIVAL_RAD for pose in self.first]))

    def scattered(self, best: Pose) -> tuple[float, float]:
        """Of the poses from around: share that converged to the best, median angle to it, °."""
        angles = np.array([pose.pose.angle_to(best) for pose in self.around])
        if not len(angles):
            return 0.0, _MOST_SCATTER_DEG
        median_deg = float(np.rad2deg(np.median(angles)))
        return float(np.mean(angles < _SAME_RAD)), min(median_deg, _MOST_SCATTER_DEG)


@dataclass(frozen=True, slots=True, eq=False)
class SketchChoice:
    """The best pose of a frame, and its rival: the best one that is another answer."""

    best: SketchPose
    rival: SketchPose | None
    passes: Passes
    prior: bool  # found near a prior
    cut: bool  # the target leaves the frame
    pose: Pose  # that the best leads to in the finer sketch
    spread_deg: float = 0.0  # °; between those of two scales and their mean, at most
    overflows: bool = False  # … on two opposite sides: what is seen does not tell poses apart
    other: float | None = None  # confidence of the less confident of two opinions, and …
    agree: bool = False  # … whether both are the same answer
    covariance: Array | None = None  # (6, 6) rotation vector, translation; camera frame, left
    residual_px: float = float("nan")  # root mean square over the edges found
    aligned: Aligned | None = None  # other poses on the finer sketch

    @property
    def margin(self) -> float:
        """Merit of the best above its rival's."""
        return _MOST_MARGIN if self.rival is None else self.best.merit - self.rival.merit

    @property
    def features(self) -> Array:
        """(14,) ``CHOICE_FEATURES``."""
        pose, passes = self.best.pose, self.passes
        margin = min(self.margin, _MOST_MARGIN)
        seen = [passes.lead(pose), passes.basin(pose), *passes.scattered(pose)]
        seen.append(min(self.spread_deg, _MOST_SCATTER_DEG))
        return np.array([margin, float(self.cut), *seen, *self.best.features])

    @property
    def confidence(self) -> float:
        """Probability that the best pose is right, 0 … 1; 0 where the target overflows the frame.

        The trees have hardly seen such frames, and are sure of wrong poses there.
        """
        if self.overflows:
            return 0.0
        model = packaged()
        own = (model.near if self.prior else model.anywhere).probability(self.features)
        if self.other is None:
            return own
        opinions = opinion_features(own, self.other, agree=self.agree)
        return float(expit(opinions @ model.opinions))

    @property
    def in_doubt(self) -> bool:
        """Whether a second opinion may change whether the pose is given."""
        return not self.overflows and DOUBT[0] <= self.confidence < DOUBT[1]

    def beside(self, second: SketchChoice, symmetries: Sequence[Symmetry]) -> SketchChoice:
        """The more confident of two opinions, with the other's confidence and if they agree."""
        agree = bool(angle_between(self.pose, second.pose, symmetries) < RIVAL_RAD)
        ours, theirs = self.confidence, second.confidence
        if ours >= theirs:
            return replace(self, other=theirs, agree=agree)
        return replace(second, other=ours, agree=agree)

    def with_covariance(self, covariance: Array, others: Array, residual_px: float) -> SketchChoice:
        """The choice with the covariance of independent edges, inflated as errors of poses show.

        ``others``: (6, 6) of a strained craft and of the scatter between sketches.
        """
        inflated = covariance * packaged().inflation + others
        return replace(self, covariance=inflated, residual_px=residual_px)


def chosen(
    passes: Passes, symmetries: Sequence[Symmetry], *, prior: bool, cut: bool
) -> SketchChoice | None:
    """The pose of most merit in the closer pass and its rival; None without any pose."""
    poses = passes.closer
    best = max(poses, key=lambda p: p.merit, default=None)
    if best is None:
        return None
    others = [p for p in poses if angle_between(p.pose, best.pose, symmetries) > RIVAL_RAD]
    rival = max(others, key=lambda p: p.merit, default=None)
    return SketchChoice(best, rival, passes, prior, cut, best.pose)


def opinion_features(own: float, other: float, *, agree: bool) -> Array:
    """(4,) of the logistic regression of two opinions, the more confident one first."""
    odds = logit(np.clip([own, other], 1.0 - _SUREST, _SUREST))
    return np.array([1.0, *odds, float(agree)])


def distinct(poses: Sequence[SketchPose], most: int, apart_rad: float) -> list[SketchPose]:
    """The poses of most merit that are some angle apart, the best first."""
    ranked = sorted(poses, key=lambda p: -p.merit)
    chosen = first_of_each((one.pose for one in ranked), apart_rad)
    return [ranked[k] for k in islice(chosen, most)]


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
