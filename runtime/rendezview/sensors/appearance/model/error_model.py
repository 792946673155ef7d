"""The probability that a refined pose is right, and its error scale: coefficients fitted to data.

Two small regressions: log odds that a pose is right to 5°, and log of the factor by which the
covariance of independent edges is multiplied. Their coefficients are data with provenance
(``error_model.json``).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from rendezview.geometry.pose import Array

PACKAGED = Path(__file__).with_name("error_model.json")

# The features of the odds, in the order of the coefficients. Inner edges, light, what of the
# outline lies in the picture and whether there is a prior say nothing more: with all ten, and
# coefficients of their own for each sky, the log loss of craft left out is no lower
CONFIDENCE_FEATURES = (
    "constant", "outline", "residual_px", "overshoot", "margin", "dark", "shading",
)  # fmt: skip
INFLATION_FEATURES = ("constant", "outline_missing", "residual_px", "dark")
_MOST_ODDS = 30.0  # of the log odds: exp stays finite. Source: by construction


@dataclass(frozen=True, slots=True, eq=False)
class ErrorModel:
    """Coefficients of both regressions, by feature."""

    log_odds: Array  # (7,)
    log_inflation: Array  # (4,)
    provenance: Mapping[str, Any] = field(default_factory=dict)  # data and program of the fit

    @classmethod
    def packaged(cls) -> ErrorModel:
        """The one that comes with the program."""
        return _packaged()

    @classmethod
    def of_record(cls, record: Mapping[str, Any]) -> ErrorModel:
        """The error model of a JSON object, see ``record``.

        Raises:
            ValueError: a coefficient is missing, unknown or no number; which one is said.
        """
        return cls(
            np.array(_row(record["log_odds"], CONFIDENCE_FEATURES, "log_odds")),
            np.array(_row(record["log_inflation"], INFLATION_FEATURES, "log_inflation")),
            dict(record.get("provenance", {})),
        )

    def record(self) -> dict[str, Any]:
        """As a JSON object: coefficients by name of feature. Floats keep every bit."""
        return {
            "log_odds": dict(zip(CONFIDENCE_FEATURES, self.log_odds.tolist(), strict=True)),
            "log_inflation": dict(
                zip(INFLATION_FEATURES, self.log_inflation.tolist(), strict=True)
            ),
            "provenance": dict(self.provenance),
        }

    def confidence(self, features: Array) -> float:
        """Probability that a pose is right to 5°, 0 … 1, of its ``CONFIDENCE_FEATURES`` (7,)."""
        odds = float(features @ self.log_odds)
        return float(1.0 / (1.0 + np.exp(-np.clip(odds, -_MOST_ODDS, _MOST_ODDS))))

    def inflation(self, outline: float, residual_px: float, dark: float) -> float:
        """Factor of a covariance that takes edges as independent: neighbouring ones err together.

        The less of the outline is found, the more.
        """
        features = inflation_features(outline, residual_px, dark)
        return float(np.exp(features @ self.log_inflation))


def inflation_features(outline: float, residual_px: float, dark: float) -> Array:
    """(4,) ``INFLATION_FEATURES`` of a refined pose."""
    return np.array([1.0, 1.0 - outline, residual_px, dark])


@cache
def _packaged() -> ErrorModel:
    return ErrorModel.of_record(json.loads(PACKAGED.read_text(encoding="utf-8")))


def _row(coefficients: Mapping[str, Any], names: tuple[str, ...], what: str) -> list[float]:
    """Coefficients in the order of the features."""
    if set(coefficients) != set(names):
        odd = ", ".join(sorted(set(coefficients) ^ set(names)))
        raise ValueError(f"error_model.{what} has other features than the program: {odd}")
    row = [float(coefficients[name]) for name in names]
    if not np.all(np.isfinite(row)):
        raise ValueError(f"error_model.{what} must hold finite numbers: {row}")
    return row
