"""From hypotheses to a choice: the comparison that all sensors share.

A sensor proposes hypotheses, aligns them with its frame and judges each by a score: the logarithm
of its probability, or any figure that orders hypotheses in the same way. `choose` finds the best
and its rivals, the best ones that are other answers; `posterior` gives probabilities.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from rendezview.geometry.pose import Array

T = TypeVar("T")


class Choice(NamedTuple):
    """The best of some hypotheses beside its rivals, by their numbers."""

    best: int
    rivals: tuple[int, ...]  # other answers, one hypothesis of each, best first
    margin: float  # score of the best above that of the first rival; inf without one

    @property
    def answers(self) -> tuple[int, ...]:
        """The best and its rivals."""
        return (self.best, *self.rivals)


def choose(
    scores: npt.ArrayLike, same: Callable[[int, int], bool], *, best: int | None = None,
    within: float = np.inf, most: int = 1,
) -> Choice | None:  # fmt: skip
    """The hypothesis with the highest score, the first of equals; None where there are none.

    Args:
        scores: (N,) of the hypotheses.
        same: whether the hypotheses of two numbers are one answer; the second is the best one or
            a rival before.
        best: something else has chosen this one; its rivals are asked for.
        within: a rival's score is at most so much lower than the best one's.
        most: rivals at most.
    """
    scores = np.asarray(scores, dtype=np.float64)
    if not len(scores):
        return None
    order = np.argsort(-scores, kind="stable").tolist()
    kept = [order[0] if best is None else best]
    least = scores[kept[0]] - within
    for k in order:
        if len(kept) > most or scores[k] < least:
            break
        if k != kept[0] and not any(same(k, known) for known in kept):
            kept.append(k)
    margin = float(scores[kept[0]] - scores[kept[1]]) if len(kept) > 1 else np.inf
    return Choice(kept[0], tuple(kept[1:]), margin)


def best_by(score: Callable[[T], float], hypotheses: Iterable[T]) -> T | None:
    """The hypothesis with the highest score, the first of equals; None where there are none."""
    return max(hypotheses, key=score, default=None)


def posterior(log_odds: Array) -> Array:
    """(N,) probabilities of hypotheses of which one is right, from log odds up to a constant."""
    odds = np.exp(log_odds - log_odds.max())
    return np.asarray(odds / odds.sum())
