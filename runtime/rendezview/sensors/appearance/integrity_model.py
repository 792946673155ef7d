"""The fitted numbers of protection levels: tails of errors, odds of a wrong pose, drift.

They are data with provenance (``integrity.json``, written by ``experiments integrity-fit``).
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from rendezview.estimation.protection import Overbound
from rendezview.geometry.pose import Array
from rendezview.sensors.appearance.evidence import Evidence, Second

PACKAGED = Path(__file__).with_name("integrity.json")

# What one frame says against its pose; smoothed over the frames of a track.
FRAME_FEATURES = (
    "constant", "doubt", "outline_missing", "inner_missing", "log_residual", "overshoot", "hidden",
    "dim", "bright_sky", "rival", "unshaded", "shading_known", "sketched", "searched", "no_prior",
    "trees_missing",
)  # fmt: skip
# What the track and a second witness say.
TRACK_FEATURES = ("young", "second_agrees", "second_disagrees", "no_second")
_MOST_ODDS = 8.0  # of the log odds of a confidence. Source: by construction
_LEAST_RESIDUAL_PX = 0.03  # px; a smaller one is no better. Source: by construction
_MOST_OVERSHOOT, _MOST_MARGIN = 0.3, 0.3  # merit. Source: as in the confidence of edges
_MOST_YEARS = 20.0  # frames; an older track is no better. Source: length of the fit's sequences
SAME_RAD = math.radians(10.0)  # rad; two witnesses agree. Source: a sketch's error, photo-accuracy


@dataclass(frozen=True, slots=True, eq=False)
class IntegrityModel:
    """The fitted numbers."""

    attitude: Overbound  # bias in rad
    position: Overbound  # bias as a share of the range
    wrong: Array  # (20,) log odds of FRAME_FEATURES and TRACK_FEATURES
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
        names = FRAME_FEATURES + TRACK_FEATURES
        given = record["wrong"]
        if set(given) != set(names):
            odd = ", ".join(sorted(set(given) ^ set(names)))
            raise ValueError(f"integrity.wrong has other features than the program: {odd}")
        wrong = np.array([float(given[name]) for name in names])
        if not np.all(np.isfinite(wrong)):
            raise ValueError(f"integrity.wrong must hold finite numbers: {given}")
        numbers = {
            name: float(record[name])
            for name in ("at_rival", "smoothing", "allowance", "most", "limit")
        }
        return cls(
            attitude=Overbound(**record["attitude"]),
            position=Overbound(**record["position"]),
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
            "wrong": dict(zip(names, self.wrong.tolist(), strict=True)),
            "at_rival": self.at_rival,
            "smoothing": self.smoothing,
            "allowance": self.allowance,
            "most": self.most,
            "limit": self.limit,
            "provenance": dict(self.provenance),
        }

    def probability_wrong(self, features: Array) -> float:
        """That another answer is the truth, of (20,) ``FRAME_FEATURES`` and ``TRACK_FEATURES``."""
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
        else 1.0 - min(max(e.margin, 0.0), _MOST_MARGIN) / _MOST_MARGIN
    )
    return np.array(
        [
            1.0,
            doubt,
            1.0 - e.outline,
            1.0 - e.inner,
            math.log(max(e.residual_px, _LEAST_RESIDUAL_PX)),
            min(e.overshoot, _MOST_OVERSHOOT),
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


def track_features(followed: int, second: Second | None) -> Array:
    """(4,) ``TRACK_FEATURES`` of a pose after so many frames, and the last second witness."""
    young = 1.0 / (1.0 + min(followed, _MOST_YEARS))
    agrees = disagrees = 0.0
    if second is not None:
        if second.angle_rad < SAME_RAD:
            agrees = second.confidence
        else:
            disagrees = second.confidence
    return np.array([young, agrees, disagrees, float(second is None)])


@cache
def _packaged() -> IntegrityModel:
    return IntegrityModel.of_record(json.loads(PACKAGED.read_text(encoding="utf-8")))
