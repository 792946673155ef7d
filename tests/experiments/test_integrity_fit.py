"""The fit of protection levels: what misled tracks tell, and what widens a covariance."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.integrity.fit import NAMES, Poses, spread, widened, wrong_odds
from rendezview.sensors.appearance.integrity.model import FRAME_FEATURES, SPREAD_FEATURES

DOUBT = NAMES.index("doubt")


def drawn(count: int, wrong_share: float, misled: bool, rng: np.random.Generator) -> Poses:
    """Poses, one a track; of wrong ones the doubt is 3 larger, its σ is 1."""
    wrong = rng.random(count) < wrong_share
    features = np.zeros((count, len(NAMES)))
    features[:, 0] = 1.0
    features[:, DOUBT] = rng.normal(size=count) + 3.0 * wrong - 3.0
    errors = np.ones((count, 4))
    flags = np.full(count, misled)
    tracks = np.arange(count) + 10**6 * misled
    return Poses(features, wrong, np.zeros(count, bool), errors, errors, np.zeros(count),
                 np.full(count, "plain"), tracks, flags)  # fmt: skip


def joined(a: Poses, b: Poses) -> Poses:
    return Poses(*(np.concatenate([getattr(a, n), getattr(b, n)]) for n in Poses.__slots__))


def test_misled_tracks_tell_what_wrong_looks_like_but_not_how_frequent_it_is() -> None:
    rng = np.random.default_rng(5)
    plain = drawn(20000, 0.002, False, rng)
    misled = drawn(3000, 1.0, True, rng)
    both = wrong_odds(joined(plain, misled))
    # Two normal distributions 3 σ apart: the log odds rise by 3 with each unit.
    assert both[DOUBT] == pytest.approx(3.0, abs=0.3)
    told = 1.0 / (1.0 + np.exp(-plain.features @ both))
    assert told.sum() == pytest.approx(plain.wrong.sum(), rel=0.5)


def test_the_spread_is_that_of_the_errors() -> None:
    rng = np.random.default_rng(2)
    count = 6000
    features = np.zeros((count, len(FRAME_FEATURES)))
    features[:, 0], features[:, 3] = 1.0, rng.uniform(0.0, 1.0, count)
    claimed = np.exp(rng.normal(-4.0, 0.6, count))
    true = 0.05 * claimed**0.5 * np.exp(1.5 * features[:, 3])
    length = true * np.linalg.norm(rng.normal(size=(count, 3)), axis=1) / np.sqrt(3.0)
    errors = np.stack([length, claimed**2 / 3.0, np.full(count, 3.0), np.ones(count)], axis=1)
    found = spread(features, errors, np.full(count, "plain"))
    assert found.weights[3] == pytest.approx(1.5, abs=0.15)
    assert found.weights[SPREAD_FEATURES.index("log_sigma")] == pytest.approx(-0.5, abs=0.05)
    out = widened(found, features, errors)
    ratio = np.sqrt(out[:, 1] * out[:, 2]) / true
    assert np.ptp(np.log(ratio)) < 0.3  # the same everywhere
    assert (out[:, 0] == length).all()
