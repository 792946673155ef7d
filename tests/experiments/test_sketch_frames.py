"""Training pictures of the sketch network: the maps lie on what the picture shows."""

from __future__ import annotations

from dataclasses import fields

import cv2
import numpy as np
import pytest
import trimesh

from experiments.training.sketch_frames import (
    SKY_PX,
    CraftDrawing,
    draw_craft,
    draw_sky,
    magnified,
    take,
)
from rendezview.sensors.appearance.edges.network import SIDE_PX
from rendezview.sensors.appearance.model.sketches import COVER, CREASE, EDGE, MAPS
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.simulate.hard_light import HardLightOptions
from rendezview_ground.simulate.random_craft import any_craft

# No effect but sunlight and a little light of the sky, on black.
CLEAN = HardLightOptions(
    **{field.name: 0.0 for field in fields(HardLightOptions) if field.name.endswith("_share")},
    ambient=(0.3, 0.3), level_grey=(100.0, 100.0), blur_sigma_px=(0.2, 0.2),
    black_level_grey=(0.0, 0.0), noise_sigma_grey=(1e-6, 1e-6),
)  # fmt: skip


@pytest.fixture(scope="module")
def drawings() -> list[CraftDrawing]:
    rngs = [np.random.default_rng([3, k]) for k in range(6)]
    return [draw_craft(any_craft(rng), rng) for rng in rngs]


def box() -> Mesh:
    made = trimesh.creation.box((1.0, 1.2, 1.4))
    faces = np.asarray(made.faces, np.int32)
    return Mesh(np.asarray(made.vertices), faces, np.full((len(faces), 3), 0.5, np.float32), ())


def test_a_frame_is_a_picture_with_its_maps_and_the_same_for_a_seed() -> None:
    def frame() -> tuple[np.ndarray, np.ndarray]:
        rng = np.random.default_rng(5)
        return take(draw_craft(any_craft(rng), rng), draw_sky(rng), rng)

    picture, maps = frame()
    assert picture.shape == (SIDE_PX, SIDE_PX)
    assert maps.shape == (MAPS, SIDE_PX, SIDE_PX)
    assert picture.dtype == maps.dtype == np.float32
    assert 0.0 <= picture.min() < picture.max() <= 255.0
    assert maps.min() >= 0.0
    assert maps.max() <= 1.0
    again = frame()
    np.testing.assert_array_equal(picture, again[0])
    np.testing.assert_array_equal(maps, again[1])


def test_light_comes_from_the_craft_alone(drawings: list[CraftDrawing]) -> None:
    for drawing in drawings:
        cover = drawing.maps[COVER] / 255.0
        sunlit, ambient = drawing.light.astype(np.float32)
        assert not sunlit[cover == 0.0].any()
        assert not ambient[cover == 0.0].any()
        assert (ambient[cover == 1.0] > 0.0).mean() > 0.99
        assert cover.mean() > 4 / 255


def test_picture_and_maps_are_turned_together(drawings: list[CraftDrawing]) -> None:
    sky = np.ones((SKY_PX, SKY_PX), np.float32)
    views = set()
    for k in range(12):
        picture, maps = take(drawings[0], sky, np.random.default_rng(k), CLEAN)
        shown = picture > 0.5
        assert np.mean(shown != (maps[COVER] > 0.0)) < 0.02
        views.add(maps[COVER].tobytes())
    assert len(views) >= 5  # of eight


def test_edges_lie_on_the_outline_of_a_convex_craft_and_creases_within() -> None:
    for k in range(4):
        maps = draw_craft(box(), np.random.default_rng(k)).maps / 255.0
        cover, edge, crease = maps[COVER], maps[EDGE], maps[CREASE]
        step = np.zeros_like(cover)
        step[:, 1:] = np.abs(np.diff(cover, axis=1))
        step[1:] = np.maximum(step[1:], np.abs(np.diff(cover, axis=0)))
        outline = step > 0.6
        assert np.median(edge[outline]) > 0.4
        beyond = cv2.dilate((cover > 0.0).astype(np.uint8), np.ones((3, 3), np.uint8)) == 0
        assert edge[beyond].max(initial=0.0) < 0.3  # two pixels off the craft
        assert crease[cover < 0.5].max() < 0.5
        assert np.count_nonzero(crease > 0.5) < 0.2 * np.count_nonzero(cover > 0.5)


def test_a_larger_picture_shows_the_same_craft_more_closely() -> None:
    small, large = (draw_craft(box(), np.random.default_rng(1), s) for s in (SIDE_PX, 2 * SIDE_PX))
    halved = large.maps[COVER].reshape(SIDE_PX, 2, SIDE_PX, 2).mean((1, 3))
    assert np.abs(halved - small.maps[COVER]).mean() < 0.5  # of 255
    picture, maps = take(large, draw_sky(np.random.default_rng(2)), np.random.default_rng(3))
    assert picture.shape == maps.shape[1:] == (2 * SIDE_PX, 2 * SIDE_PX)
    closer = magnified(HardLightOptions(), 2.0)
    assert closer.blur_sigma_px == (0.2, 2.6)


def test_a_texture_darkens_the_light_and_leaves_the_maps() -> None:
    stripes = np.tile(np.float32([0.1, 1.0]).repeat(8), (128, 8))
    plain, printed = (
        draw_craft(box(), np.random.default_rng(2), SIDE_PX, texture) for texture in (None, stripes)
    )
    np.testing.assert_array_equal(plain.maps, printed.maps)
    whole = plain.maps[COVER] == 255
    ratio = printed.light[1][whole].astype(float) / plain.light[1][whole]
    assert ratio.min() == pytest.approx(0.1, abs=0.02)
    assert ratio.max() == pytest.approx(1.0, abs=0.02)
    assert 0.2 < ratio.mean() < 0.95


def test_skies_are_of_both_kinds_and_bright() -> None:
    for k in range(4):
        sky = draw_sky(np.random.default_rng([2, k]))
        assert sky.shape == (SKY_PX, SKY_PX)
        assert np.isfinite(sky).all()
        assert 0.3 < np.percentile(sky, 99.0) <= 1.3
