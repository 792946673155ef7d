"""The confidence of poses by grey edges, fitted to random craft."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated
from unittest import mock

import numpy as np
from sklearn.linear_model import LogisticRegression
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from experiments.frame import show, table_of
from experiments.pose.confidence import (
    RIGHT_DEG,
    WRONG_DEG,
    Rows,
    looks,
    losses,
    of_each_craft,
)
from experiments.pose.sketch_confidence import FOLDS
from rendezview.estimation.hypotheses import Choice
from rendezview.geometry.pose import Array
from rendezview.sensors.appearance.judge.candidates import Candidates
from rendezview.sensors.appearance.judge.found import Found
from rendezview.sensors.appearance.model.error_model import (
    CONFIDENCE_FEATURES,
    PACKAGED,
    ErrorModel,
)
from rendezview.sensors.appearance.search import search

WEIGHT_OF_WRONG = 3.0  # a wrong answer costs more than one that is not given


@contextmanager
def every_choice() -> Iterator[list[Found]]:
    """The best poses that searches choose meanwhile, in order; none of them ends a search."""
    made: list[Found] = []
    usual = Candidates._found

    def noted(candidates: Candidates, chosen: Choice) -> Found:
        made.append(usual(candidates, chosen))
        return made[-1]

    with (
        mock.patch.object(Candidates, "_found", noted),
        mock.patch.multiple(search, _CONFIDENT=2.0, _ENDS=2.0),
    ):
        yield made


def rows_of(number: int, seed: int, frames: int, folder: Path) -> Rows:
    """What speaks for each choice by grey edges, and its error, for the frames of one craft.

    Confidence ends a search, so it must hold of what has been tried till then, too.
    """
    rows = []
    with every_choice() as made:
        for look, seen in enumerate(looks(number, seed, frames, folder, sketch=False)):
            rows += [
                (*found.features, seen.error_deg(found.best.pose), look, found is made[-1])
                for found in made
            ]
            made.clear()
    *features, error_deg, look_number, last = np.array(rows, dtype=np.float64).T
    return {
        "features": np.array(features).T, "error_deg": error_deg, "look": look_number, "last": last,
    }  # fmt: skip


def fitted(features: Array, right: Array) -> Array:
    """(7,) coefficients of ``CONFIDENCE_FEATURES``."""
    fit = make_pipeline(StandardScaler(), LogisticRegression())
    weight = np.where(right, 1.0, WEIGHT_OF_WRONG)
    fit.fit(features[:, 1:], right, logisticregression__sample_weight=weight)
    scaler, regression = (step for _, step in fit.steps)
    slopes = regression.coef_[0] / scaler.scale_
    return np.array([regression.intercept_[0] - slopes @ scaler.mean_, *slopes])


def left_out(features: Array, right: Array, last: Array, number: Array) -> Array:
    """(N,) confidence of each choice by a fit to the last ones of other craft, in five folds."""
    confidence = np.empty(len(right))
    for fold in range(FOLDS):
        out = number % FOLDS == fold
        odds = features[out] @ fitted(features[~out & last], right[~out & last])
        confidence[out] = 1.0 / (1.0 + np.exp(-odds))
    return confidence


def run(
    *, craft_count: int = 40, frames: Annotated[int, "of each craft"] = 18, seed: int = 21,
    rows: Annotated[Path | None, "folder that keeps the answers for each craft"] = None,
    write: Annotated[bool, "into the package"] = False,
) -> None:  # fmt: skip
    """Fit the confidence of poses by grey edges to the frames of ``pose-confidence``.

    To the last choice of each search; a wrong one counts three times. The table is of craft that
    the fit did not see (five folds), beside the coefficients in the package: mean log loss, for how
    many craft it is better, last choices that are right and wrong from a confidence on, and frames
    with any choice that would end a search, right and wrong.
    """
    number, choices = of_each_craft(rows_of, craft_count, seed, frames, rows)
    features, error_deg, last = choices["features"], choices["error_deg"], choices["last"] > 0.5
    right, wrong = error_deg < RIGHT_DEG, error_deg > WRONG_DEG
    _, frame = np.unique(np.column_stack([number, choices["look"]]), axis=0, return_inverse=True)
    columns = f"confidence | log loss | better | from 0.6 | 0.9 | any at {search._ENDS}"
    table = table_of("grey edges", columns)
    package = np.array([ErrorModel.packaged().confidence(one) for one in features])
    means = []
    for name, confidence in (
        ("in the package", package), ("left out", left_out(features, right, last, number)),
    ):  # fmt: skip
        loss = losses(confidence, right)
        means.append(np.array([loss[last & (number == k)].mean() for k in np.unique(number)]))
        counts = [
            f"{(last & right & (confidence >= least)).sum()}, "
            f"{(last & wrong & (confidence >= least)).sum()}"
            for least in (0.6, 0.9)
        ]
        ends = confidence >= search._ENDS
        counts.append(", ".join(str(len(set(frame[ends & kind]))) for kind in (right, wrong)))
        better = f"{(means[-1] < means[0]).sum()} of {len(means[0])} craft"
        table.add_row(name, f"{loss[last].mean():.4f}", better, *counts)
    show(table)
    record = json.loads(PACKAGED.read_text(encoding="utf-8"))
    coefficients = np.round(fitted(features[last], right[last]), 2)
    record["log_odds"] = dict(zip(CONFIDENCE_FEATURES, coefficients.tolist(), strict=True))
    record["provenance"]["log_odds"] = {
        "experiment": "confidence-fit", "random_craft": craft_count, "frames_of_each": frames,
        "seed": seed, "searches": int(last.sum()),
    }  # fmt: skip
    text = json.dumps(record, indent=2, ensure_ascii=False) + "\n"
    print(text)
    if write:
        PACKAGED.write_text(text, encoding="utf-8")
