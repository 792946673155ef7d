"""Limits of options: what is refused, and in which words."""

from __future__ import annotations

from math import inf, nan
from types import SimpleNamespace

import pytest

from rendezview.errors import RendezviewError
from rendezview_ground.limits import POSITIVE, check, check_rising


@pytest.mark.parametrize(
    ("low", "high", "right", "wrong", "words"),
    [
        (0.0, 2.0, 2.0, 2.1, "x must be 0 to 2, not 2.1"),
        (0.0, inf, 0.0, -0.1, "x must be 0 or more, not -0.1"),
        (POSITIVE, inf, 1e-9, 0.0, "x must be positive, not 0.0"),
        (POSITIVE, 5.0, 5.0, 6.0, "x must be positive, at most 5, not 6.0"),
        (-inf, inf, -1e9, inf, "x must be finite, not inf"),
        (0.0, 1.0, None, nan, "x must be 0 to 1, not nan"),
        (0.0, 1.0, (0.0, 1.0), (0.0, 2.0), "x must be 0 to 1, not (0.0, 2.0)"),
    ],
)
def test_a_number_beyond_its_limits_is_named(low, high, right, wrong, words) -> None:
    check(SimpleNamespace(x=right), low, high, "x")
    with pytest.raises(RendezviewError) as refused:
        check(SimpleNamespace(x=wrong), low, high, "x")
    assert str(refused.value) == words


@pytest.mark.parametrize("wrong", [(0.2, 0.1), (nan, 1.0), (1.0, 2.0, 3.0)])
def test_a_range_that_falls_is_refused(wrong) -> None:
    check_rising(SimpleNamespace(x=(0.1, 0.1)), "x")
    with pytest.raises(RendezviewError, match="x must be a range"):
        check_rising(SimpleNamespace(x=wrong), "x")
