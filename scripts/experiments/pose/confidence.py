"""Confidence and covariance of a pose, fitted to logs of ``pose-accuracy``."""

from __future__ import annotations

import json
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from scipy.optimize import minimize
from sklearn.linear_model import LogisticRegression

from rendezview.sensors.appearance.model.error_model import ErrorModel, inflation_features

WRONG_DEG, LEAST = 5.0, 0.6  # of a wrong pose; confidence of a pose that is given
_DARK = 7  # the feature that marks dark skies
_WEIGHT_OF_WRONG = 5.0  # a wrong answer costs more than one that is not given


def fitted(features: np.ndarray, right: np.ndarray, looked: np.ndarray) -> np.ndarray:
    """(2, 2, 11) coefficients: without the last feature and with it, bright and dark skies."""
    tables = []
    for look in (False, True):
        rows = []
        for dark in (False, True):
            these = ((features[:, _DARK] > 0.5) == dark) & (looked | (not look))
            weight = np.where(right[these], 1.0, _WEIGHT_OF_WRONG)
            known = features[these] * np.append(np.ones(features.shape[1] - 1), float(look))
            model = LogisticRegression(C=10.0, max_iter=10_000, fit_intercept=False)
            rows.append(model.fit(known, right[these], sample_weight=weight).coef_[0])
        tables.append(rows)
    return np.array(tables)


def probability(coefficients: np.ndarray, features: np.ndarray, looked: np.ndarray) -> np.ndarray:
    """(N,) of right poses."""
    rows = coefficients[looked.astype(int), (features[:, _DARK] > 0.5).astype(int)]
    return 1.0 / (1.0 + np.exp(-np.einsum("ij,ij->i", features, rows)))


def inflation(records: list[dict[str, Any]]) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients of log κ², on top of those of the logs, and the NEES that remain."""
    right = [r for r in records if r.get("rotation_deg", 180.0) < WRONG_DEG]
    features = np.array([inflation_features(*np.array(r["features"])[[1, 3, 7]]) for r in right])
    nees = np.array([r["nees"] for r in right])

    def unlikely(theta: np.ndarray) -> float:
        log = features @ theta
        return float(np.sum(6.0 * log + nees * np.exp(-log)) + 0.1 * theta[1:] @ theta[1:])

    theta = minimize(unlikely, np.array([1.5, 0.0, 0.0, 0.0]), method="Nelder-Mead",
                     options={"maxiter": 20_000, "maxfev": 20_000}).x  # fmt: skip
    return theta, nees * np.exp(-features @ theta)


def run(
    logs: list[Path], *, output: Annotated[Path | None, "JSON file of the coefficients"] = None
) -> None:
    """Fit confidence and covariance of a pose to logs of pose-accuracy.

    Prints, with each target left out in turn, how many answers would be given and wrong. --output
    writes the coefficients as edges/error_model.json has them, where training and models without
    their own read them. The logs must come from models that carry the packaged coefficients or
    none.
    """
    records = [json.loads(line) for log in logs for line in log.read_text().splitlines()]
    chosen = [r for r in records if "features" in r]
    features = np.array([r["features"] for r in chosen])
    right = np.array([r["best_deg"] < WRONG_DEG for r in chosen])
    looked = np.array([r["looked"] for r in chosen])
    target = np.array([r["target"] for r in chosen])
    held_out = np.zeros(len(chosen))
    for name in np.unique(target):
        others, these = target != name, target == name
        coefficients = fitted(features[others], right[others], looked[others])
        held_out[these] = probability(coefficients, features[these], looked[these])
    theta, rest = inflation(records)
    print("inflation", np.round(theta, 2).tolist())
    answers = [r for r in records if r.get("rotation_deg", 180.0) < WRONG_DEG]
    conditions = sorted({r["condition"] for r in records})
    for condition in conditions:
        part = rest[[r["condition"] == condition for r in answers]]
        print(f"NEES {condition}: mean {part.mean():.1f}, median {np.median(part):.1f}")
    log_odds = np.round(fitted(features, right, looked), 2)
    print("coefficients", log_odds.tolist())
    if output is not None:
        low = rest[[r["condition"] == "low" for r in answers]]
        if len(low):  # raised until the normalised error squared averages six there
            theta[0] += np.log(low.mean() / 6.0)
        provenance = {"command": "pose-confidence", "logs": [p.name for p in logs]}
        inflation_now = np.round(ErrorModel.packaged().log_inflation + theta, 2)
        made = ErrorModel(log_odds, inflation_now, provenance)
        output.write_text(json.dumps(made.record(), indent=2) + "\n", encoding="utf-8")
    for mode, condition in product(("first", "tracked"), conditions):
        these = np.array([(r["mode"], r["condition"]) == (mode, condition) for r in chosen])
        total = sum((r["mode"], r["condition"]) == (mode, condition) for r in records)
        given = these & (held_out >= LEAST)
        good, bad = (np.sum(given & which) / total for which in (right, ~right))
        print(f"{mode} {condition}: right {good:.1%}, wrong {bad:.1%}")
