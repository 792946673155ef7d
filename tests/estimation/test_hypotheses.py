"""From hypotheses to a choice: the best, its rivals, and the probability of each."""

from __future__ import annotations

import numpy as np
import pytest

from rendezview.estimation.hypotheses import choose, posterior

PLACES = np.array([0.0, 0.1, 5.0, 5.1, 9.0, 0.2])
SCORES = [3.0, 4.0, 2.0, 2.5, 2.5, 4.0]


def near(k: int, known: int) -> bool:
    return abs(PLACES[k] - PLACES[known]) < 1.0


def test_the_first_of_equals_is_the_best_and_one_of_each_other_answer_is_a_rival():
    choice = choose(SCORES, near, most=9)
    assert choice == (1, (3, 4), 1.5)
    assert choose(SCORES, near) == (1, (3,), 1.5)


def test_rivals_have_at_most_so_much_less():
    assert choose(SCORES, near, within=1.5, most=9).rivals == (3, 4)
    assert choose(SCORES, near, within=1.4, most=9) == (1, (), np.inf)


def test_the_rivals_of_another_choice_may_have_more():
    choice = choose(SCORES, near, best=2, most=9)
    assert choice == (2, (1, 4), -2.0)


def test_the_same_is_asked_of_each_hypothesis_beside_those_kept():
    asked = []

    def same(k: int, known: int) -> bool:
        asked.append((k, known))
        return near(k, known)

    choose(SCORES, same, most=9)
    assert asked == [(5, 1), (0, 1), (3, 1), (4, 1), (4, 3), (2, 1), (2, 3)]


def test_no_hypothesis_is_no_choice_and_one_has_no_rival():
    assert choose([], near) is None
    assert choose([-np.inf], near) == (0, (), np.inf)


def test_posteriors_are_the_shares_of_the_odds():
    log_odds = np.array([1000.0, 1000.0 + np.log(3.0), -np.inf])
    assert posterior(log_odds) == pytest.approx([0.25, 0.75, 0.0])
