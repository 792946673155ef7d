"""Errors against protection levels: what misleads, and how sure the count is."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binom

from rendezview_ground.evaluate.pictures.palette import png
from rendezview_ground.evaluate.pictures.stanford_pictures import stanford_picture
from rendezview_ground.evaluate.stanford import Judged, stanford_dict, stanford_text, upper_limit


def judged() -> Judged:
    """Right, misleading by attitude, by position, alarmed, and no target at all with an alarm."""
    return Judged(
        np.array([0.01, 0.30, 0.01, 0.30, np.inf]),
        np.array([0.10, 0.10, 0.10, 0.10, np.pi]),
        np.array([0.10, 0.10, 9.00, 9.00, np.inf]),
        np.array([1.00, 1.00, 1.00, 1.00, np.inf]),
        np.array([False, False, False, True, True]),
    )


def test_an_error_beyond_its_level_misleads_unless_there_is_an_alarm():
    assert judged().misleading.tolist() == [False, True, True, False, False]
    assert judged().ratio[:4] == pytest.approx([0.1, 3.0, 9.0, 9.0])


def test_the_upper_limit_is_that_of_the_binomial():
    assert upper_limit(0, 3000) == pytest.approx(1e-3, rel=2e-3)  # the rule of three
    limit = upper_limit(4, 200)
    assert binom.cdf(4, 200, limit) == pytest.approx(0.05, abs=1e-9)
    assert upper_limit(5, 5) == 1.0


def test_words_and_numbers_tell_the_counts():
    assert "5 poses: 2 misleading" in stanford_text(judged())
    assert "60.0 % available" in stanford_text(judged())
    assert stanford_dict(judged())["alarms"] == 2


def test_the_diagram_is_drawn_and_repeats():
    pictures = [png(stanford_picture(judged(), "five poses")) for _ in range(2)]
    assert pictures[0] == pictures[1]
    assert pictures[0][:4] == b"\x89PNG"
