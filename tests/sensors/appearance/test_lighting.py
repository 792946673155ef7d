"""The light of a frame, fitted to grey levels."""

from __future__ import annotations

import numpy as np
import pytest

from rendezview.sensors.appearance.edges.lighting import ROUNDS, light_strengths


@pytest.mark.parametrize("shadowed", [0.0, 0.3, 0.55])
def test_the_light_is_that_of_what_is_lit_where_white_parts_lie_in_shadow(shadowed):
    rng = np.random.default_rng(3)
    count = 400
    albedo = np.where(np.arange(count) % 2, 0.4, 0.8)
    facing = rng.uniform(0.3, 1.0, count)
    dark = (albedo > 0.5) & (rng.random(count) < 2.0 * shadowed)
    levels = albedo * (250.0 * np.where(dark, 0.0, facing) + 10.0) + rng.normal(0.0, 3.0, count)
    strengths = np.empty(2)
    cost = light_strengths(levels, albedo * facing, albedo, 15.0, np.inf, strengths, ROUNDS, False)
    assert strengths[0] == pytest.approx(250.0, rel=0.05)
    assert cost / count == pytest.approx(np.mean(dark), abs=0.08)
