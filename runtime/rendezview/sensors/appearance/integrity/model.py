"""The fitted numbers of protection levels: tails of errors, odds of a wrong pose, drift.

They are data with provenance (``integrity.json``, written by ``experiments integrity-fit``).
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from rendezview.estimation.protection import Overbound
from rendezview.geometry.pose import Array
from rendezview.sensors.appearance.integrity.evidence import Evidence, Second
from rendezview.sensors.appearance.judge.found import MOST_FEATURE

PACKAGED = Path(__file__).with_name("integrity.json")

# What one frame says against its pose; smoothed over the frames of a track.
FRAME_FEATURES = (
    "constant", "doubt", "outline_missing", "inner_missing", "log_residual", "overshoot", "hidden",
    "dim", "bright_sky", "rival", "unshaded", "shading_known", "sketched", "searched", "no_prior",
    "trees_missing",
)  # fmt: skip
# What the track and a second estimator say, which is asked again and again.
TRACK_FEATURES = ("young", "second_agrees", "agrees_again", "second_disagrees", "no_second")
_MOST_AGAIN = 3.0  # agreements after the first; more tell nothing new. Source: by construction
_MOST_AGAINST = 3.0  # disagreements, weighted by confidence. Source: by construction
SURE = 0.6  # probability; an estimator below it raises no alarm. Source: the recognizer's threshold
# What tells how far errors are from their covariance: a frame's features, and that covariance.
SPREAD_FEATURES = (*FRAME_FEATURES, "log_sigma")
_LEAST_SHARE = 1e-6  # rad or of the range; no deviation is smaller. Source: by construction
_MOST_ODDS = 8.0  # of the log odds of a confidence. Source: by construction
_LEAST_RESIDUAL_PX = 0.03  # px; a smaller one is no better. Source: by construction
_MOST_YEARS = 20.0  # frames; an older track is no better. Source: length of the fit's sequences
SAME_RAD = math.radians(10.0)  # rad; two estimators agree. Source: a sketch's error, photo-accuracy


@dataclass(frozen=True, slots=True, eq=False)
class Spread:
    """By what factor errors are larger than their covariance says, as the frame shows it."""

    weights: Array  # (17,) of SPREAD_FEATURES; their sum is the logarithm of the factor
    least: float  # logarithms; the fit has seen none beyond
    most: float

    @classmethod
    def none(cls) -> Spread:
        """Errors are as large as they say everywhere."""
        return cls(np.zeros(len(SPREAD_FEATURES)), 0.0, 0.0)

    @classmethod
    def of_record(cls, record: Mapping[str, Any], what: str) -> Spread:
        """Of a JSON object."""
        weights = _weights(record["weights"], SPREAD_FEATURES, what)
        return cls(weights, float(record["least"]), float(record["most"]))

    def record(self) -> dict[str, Any]:
        """As a JSON object."""
        weights = dict(zip(SPREAD_FEATURES, self.weights.tolist(), strict=True))
        return {"weights": weights, "least": self.least, "most": self.most}

    def factor(self, share: float, features: Array) -> float:
        """Of a standard deviation.

        Args:
            share: the whole standard deviation, rad or of the range.
            features: (16,) ``FRAME_FEATURES``, smoothed over the track.
        """
        log_sigma = math.log(max(share, _LEAST_SHARE))
        log_ratio = float(self.weights[:-1] @ features) + float(self.weights[-1]) * log_sigma
        return math.exp(max(self.least, min(log_ratio, self.most)))

    def widened(self, covariance: Array, features: Array, unit: float) -> Array:
        """A covariance (3, 3) of the errors as they are, of a frame's features (16,).

        Args:
            covariance: of the pose's rotation or translation.
            features: ``FRAME_FEATURES``, smoothed over the track.
            unit: of the covariance's square root: 1, or a range.
        """
        share = math.sqrt(float(np.trace(covariance))) / unit
        return np.asarray(self.factor(share, features) ** 2 * covariance)


@dataclass(frozen=True, slots=True, eq=False)
class IntegrityModel:
    """The fitted numbers."""

    attitude: Overbound  # bias in rad
    position: Overbound  # bias as a share of the range
    attitude_spread: Spread
    position_spread: Spread
    wrong: Array  # (21,) log odds of FRAME_FEATURES and TRACK_FEATURES
    at_rival: float  # share of the wrong poses whose rival is right
    smoothing: float  # weight of a new frame in the mean over the track
    allowance: float  # of drifts, standard deviations
    most: float  # an innovation counts at most so many standard deviations
    limit: float  # of a drift's cumulative sum, standard deviations
    provenance: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def packaged(cls) -> IntegrityModel:
        """The one that comes with the program."""
        return _packaged()

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> IntegrityModel:
        """The model of a JSON object, see ``record``.

        Raises:
            ValueError: a coefficient is missing, unknown or no number.
        """
        wrong = _weights(record["wrong"], FRAME_FEATURES + TRACK_FEATURES, "integrity.wrong")
        numbers = {
            name: float(record[name])
            for name in ("at_rival", "smoothing", "allowance", "most", "limit")
        }
        return cls(
            attitude=Overbound(**record["attitude"]),
            position=Overbound(**record["position"]),
            attitude_spread=Spread.of_record(record["attitude_spread"], "attitude_spread"),
            position_spread=Spread.of_record(record["position_spread"], "position_spread"),
            wrong=wrong,
            provenance=dict(record.get("provenance", {})),
            **numbers,
        )

    def record(self) -> dict[str, Any]:
        """As a JSON object, coefficients by name of feature."""
        names = FRAME_FEATURES + TRACK_FEATURES
        return {
            "attitude": dataclasses.asdict(self.attitude),
            "position": dataclasses.asdict(self.position),
            "attitude_spread": self.attitude_spread.record(),
            "position_spread": self.position_spread.record(),
            "wrong": dict(zip(names, self.wrong.tolist(), strict=True)),
            "at_rival": self.at_rival,
            "smoothing": self.smoothing,
            "allowance": self.allowance,
            "most": self.most,
            "limit": self.limit,
            "provenance": dict(self.provenance),
        }

    def probability_wrong(self, features: Array) -> float:
        """That another answer is the truth, of (21,) ``FRAME_FEATURES`` and ``TRACK_FEATURES``."""
        odds = float(self.wrong @ features)
        return 1.0 / (1.0 + math.exp(-max(-30.0, min(odds, 30.0))))


def frame_features(evidence: Evidence) -> Array:
    """(16,) ``FRAME_FEATURES``."""
    e = evidence
    inside = max(min(e.confidence, 1.0 - 1e-12), 1e-12)
    doubt = -max(-_MOST_ODDS, min(math.log(inside / (1.0 - inside)), _MOST_ODDS))
    shaded = not math.isnan(e.shading)
    rival = (
        0.0
        if math.isnan(e.rival_rad)
        else 1.0 - min(max(e.margin, 0.0), MOST_FEATURE) / MOST_FEATURE
    )
    return np.array(
        [
            1.0,
            doubt,
            1.0 - e.outline,
            1.0 - e.inner,
            math.log(max(e.residual_px, _LEAST_RESIDUAL_PX)),
            min(e.overshoot, MOST_FEATURE),
            1.0 - e.visible,
            1.0 - e.light,
            float(not e.dark),
            rival,
            1.0 - e.shading if shaded else 0.0,
            float(shaded),
            float(e.sketched),
            float(not e.followed),
            float(not e.prior),
            math.exp(-e.trees),
        ]
    )


@dataclass(frozen=True, slots=True)
class SecondEstimator:
    """What a second estimator has said along a track."""

    agreed: float = 0.0  # times, however sure: two searches agree by chance once in a thousand
    against: float = 0.0  # sum of the confidences of those that disagreed
    last: Second | None = None

    def after(self, second: Second | None) -> SecondEstimator:
        """With one more answer; ``None``: it saw nothing."""
        if second is None:
            return replace(self, last=None)
        if second.angle_rad < SAME_RAD:
            return SecondEstimator(self.agreed + 1.0, self.against, second)
        return SecondEstimator(self.agreed, self.against + second.confidence, second)

    def contradicts(self, attitude_rad: float) -> bool:
        """Whether the last answer is surely another attitude than one with this level."""
        last = self.last
        if last is None or last.confidence < SURE:
            return False
        return last.angle_rad > max(attitude_rad, SAME_RAD)


def track_features(followed: int, second: SecondEstimator) -> Array:
    """(5,) ``TRACK_FEATURES`` of a pose after so many frames, and the second estimator's."""
    return np.array(
        [
            1.0 / (1.0 + min(followed, _MOST_YEARS)),
            min(second.agreed, 1.0),
            min(max(second.agreed - 1.0, 0.0), _MOST_AGAIN),
            min(second.against, _MOST_AGAINST),
            float(second.agreed + second.against == 0.0),
        ]
    )


def _weights(given: Mapping[str, float], names: tuple[str, ...], what: str) -> Array:
    """The coefficients of some features, in their order."""
    if set(given) != set(names):
        odd = ", ".join(sorted(set(given) ^ set(names)))
        raise ValueError(f"{what} has other features than the program: {odd}")
    weights = np.array([float(given[name]) for name in names])
    if not np.all(np.isfinite(weights)):
        raise ValueError(f"{what} must hold finite numbers: {given}")
    return weights


@cache
def _packaged() -> IntegrityModel:
    return IntegrityModel.of_record(json.loads(PACKAGED.read_text(encoding="utf-8")))
