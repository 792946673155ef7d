"""Rooms behind a target, bodies beside it, hands before it."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.training.cluttered_rooms import INDOORS, crowded, room
from experiments.training.random_objects import random_object
from experiments.training.sketch_frames import SKY_PX, CraftDrawing, draw_craft, take
from rendezview.sensors.appearance.edges.network import SIDE_PX
from rendezview.sensors.appearance.model.sketches import COVER


@pytest.fixture(scope="module")
def drawings() -> list[CraftDrawing]:
    rngs = [np.random.default_rng([4, k]) for k in range(8)]
    return [draw_craft(random_object(rng), rng) for rng in rngs]


def test_rooms_are_bright_and_differ() -> None:
    rooms = [room(SKY_PX, np.random.default_rng(k)) for k in range(8)]
    for one in rooms:
        assert one.shape == (SKY_PX, SKY_PX)
        assert one.dtype == np.float32
        assert np.isfinite(one).all()
        assert one.min() > -0.5
        assert np.percentile(one, 99.0) == pytest.approx(1.0, abs=1e-3)
    assert len({float(one.mean()) for one in rooms}) == len(rooms)


def test_what_is_before_a_target_is_cut_from_its_maps_and_hides_the_sky(
    drawings: list[CraftDrawing],
) -> None:
    cut = 0
    for k in range(16):
        drawing = drawings[k % len(drawings)]
        made = crowded(drawing, [], np.random.default_rng(k))
        assert made.covered is not None
        assert (made.maps <= drawing.maps).all()  # no edges of its own
        assert (made.covered >= made.maps[COVER]).all()
        before, now = (d.maps[COVER].astype(float).sum() for d in (drawing, made))
        assert now > 0.59 * before
        cut += now < 0.99 * before
    assert cut >= 4


def test_bodies_beside_a_target_are_smaller_and_behind_it(drawings: list[CraftDrawing]) -> None:
    seen = 0
    for k in range(8):
        target, other = drawings[k], drawings[(k + 1) % len(drawings)]
        rng = np.random.default_rng([5, k])
        made = crowded(target, [other], rng)
        assert made.covered is not None
        whole = made.maps[COVER] == 255
        np.testing.assert_array_equal(made.light[:, whole], target.light[:, whole])
        beside = (made.covered > 127) & (target.maps[COVER] < 128)
        seen += beside.any()
    assert seen >= 4


def test_a_photograph_of_a_crowd_has_the_maps_of_the_target(drawings: list[CraftDrawing]) -> None:
    rng = np.random.default_rng(6)
    made = crowded(drawings[0], drawings[1:3], rng)
    picture, maps = take(made, room(SKY_PX, rng), rng, INDOORS)
    assert picture.shape == (SIDE_PX, SIDE_PX)
    assert 0.0 <= picture.min() < picture.max() <= 255.0
    assert maps[COVER].sum() == pytest.approx(made.maps[COVER].sum() / 255.0, rel=1e-4)
