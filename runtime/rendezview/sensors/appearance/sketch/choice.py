"""Choice of the best of a sketch's poses, and the probability that it is right."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

from rendezview.geometry.pose import Array, Pose
from rendezview.geometry.symmetry import Symmetry, angle_between

PACKAGED = Path(__file__).with_name("error_model.json")
# What a pose is judged by, in the order of the fields of ``SketchPose`` …
POSE_FEATURES = ("outline", "inner", "contrast", "visible", "overlap", "edges", "creases")
# … and the choice of one.
CHOICE_FEATURES = ("constant", "margin", "cut", "prior", *POSE_FEATURES)
# Source: the spacing of the nodes' views
_RIVAL_RAD = np.deg2rad(8.0)  # rad; a pose further away is another answer
_MOST_MARGIN = 4.0  # of log odds; a larger margin says no more. Source: by construction
_MOST_ODDS = 30.0  # of the log odds: exp stays finite. Source: by construction


@dataclass(frozen=True, slots=True, eq=False)
class SketchPose:
    """A pose on a sketch, with what agrees."""

    pose: Pose  # camera_from_target
    outline: float  # mean probability of an edge on the outline
    inner: float  # the same on creases and steps
    contrast: float  # mean step of the cover across the outline
    visible: float  # share of the outline that lies in the sketch
    overlap: float  # of covers, intersection over union
    edges: float  # correlation of edges
    creases: float  # correlation of creases

    @property
    def features(self) -> Array:
        """(7,) ``POSE_FEATURES``."""
        return np.array([getattr(self, name) for name in POSE_FEATURES])

    @property
    def merit(self) -> float:
        """Log odds against the other poses of the frame, but for a constant."""
        return float(self.features @ _packaged().merit)


@dataclass(frozen=True, slots=True, eq=False)
class SketchChoice:
    """The best pose of a frame, and its rival: the best one that is another answer."""

    best: SketchPose
    rival: SketchPose | None
    prior: bool  # found near a prior
    cut: bool  # the target leaves the frame
    covariance: Array | None = None  # (6, 6) rotation vector, translation; camera frame, left
    residual_px: float = float("nan")  # root mean square over the edges found

    @property
    def margin(self) -> float:
        """Merit of the best above its rival's."""
        return _MOST_MARGIN if self.rival is None else self.best.merit - self.rival.merit

    @property
    def features(self) -> Array:
        """(11,) ``CHOICE_FEATURES``."""
        margin = min(self.margin, _MOST_MARGIN)
        return np.array([1.0, margin, float(self.cut), float(self.prior), *self.best.features])

    @property
    def confidence(self) -> float:
        """Probability that the best pose is right, 0 … 1."""
        odds = float(self.features @ _packaged().log_odds)
        return float(1.0 / (1.0 + np.exp(-np.clip(odds, -_MOST_ODDS, _MOST_ODDS))))

    def with_covariance(
        self, covariance: Array, strained: Array, residual_px: float
    ) -> SketchChoice:
        """The choice with the covariance of independent edges, inflated as errors of poses show,
        and that of a strained craft."""
        inflated = covariance * _packaged().inflation + strained
        return replace(self, covariance=inflated, residual_px=residual_px)


def chosen(
    poses: Sequence[SketchPose], symmetries: Sequence[Symmetry], *, prior: bool, cut: bool
) -> SketchChoice | None:
    """The pose of most merit and its rival; None without any pose."""
    best = max(poses, key=lambda p: p.merit, default=None)
    if best is None:
        return None
    others = [p for p in poses if angle_between(p.pose, best.pose, symmetries) > _RIVAL_RAD]
    return SketchChoice(best, max(others, key=lambda p: p.merit, default=None), prior, cut)


def distinct(poses: Sequence[SketchPose], most: int, apart_rad: float) -> list[SketchPose]:
    """The poses of most merit that are some angle apart, the best first."""
    kept: list[SketchPose] = []
    for pose in sorted(poses, key=lambda p: -p.merit):
        if all(pose.pose.angle_to(k.pose) > apart_rad for k in kept):
            kept.append(pose)
            if len(kept) == most:
                break
    return kept


@dataclass(frozen=True, slots=True, eq=False)
class SketchErrorModel:
    """Coefficients fitted to frames of known pose (``experiments sketch-confidence``)."""

    merit: Array  # (7,) of POSE_FEATURES
    log_odds: Array  # (11,) of CHOICE_FEATURES
    inflation: float  # of the covariance of independent edges


@cache
def _packaged() -> SketchErrorModel:
    record = json.loads(PACKAGED.read_text(encoding="utf-8"))
    merit = [record["merit"][name] for name in POSE_FEATURES]
    odds = [record["log_odds"][name] for name in CHOICE_FEATURES]
    return SketchErrorModel(np.array(merit), np.array(odds), float(record["inflation"]))
