"""Photographs in hard light: each physical step alone, with fixed conditions."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest

from rendezview_ground.simulate import hard_light
from rendezview_ground.simulate.hard_light import HardLightOptions, photograph

SIDE = 64
NOTHING = HardLightOptions(
    **{field.name: 0.0 for field in fields(HardLightOptions) if field.name.endswith("_share")},
    ambient=(1e-9, 1e-9), percentiles=(50.0,), level_grey=(100.0, 100.0),
    blur_sigma_px=(0.2, 0.2), black_level_grey=(0.0, 0.0), noise_sigma_grey=(1e-6, 1e-6),
)  # fmt: skip
SKY = np.ones((SIDE + 8, SIDE + 8), np.float32)


def disc(radius: float = 20.0) -> np.ndarray:
    y, x = np.mgrid[:SIDE, :SIDE] - 0.5 * (SIDE - 1)
    return (np.hypot(x, y) < radius).astype(np.float32)


COVER = disc()
INNER, OUTER = disc(16.0) > 0, disc(24.0) == 0


def taken(sunlit: np.ndarray = 0.4 * COVER, seed: int = 1, **changed: object) -> np.ndarray:
    options = replace(NOTHING, **changed)
    return photograph(sunlit, COVER, COVER, SKY, np.random.default_rng(seed), options)


def test_without_effects_the_metered_percentile_gets_its_level_on_black() -> None:
    picture = taken()
    assert picture[INNER] == pytest.approx(100.0, abs=0.5)
    assert picture[OUTER] == pytest.approx(0.0, abs=0.5)


def test_a_face_beyond_the_range_saturates_and_keeps_its_outline() -> None:
    sunlit = 0.4 * COVER
    sunlit[:, : SIDE // 2] *= 50.0
    picture = taken(sunlit, percentiles=(25.0,))
    assert (picture[:, : SIDE // 2][INNER[:, : SIDE // 2]] == 255.0).all()
    assert picture[:, SIDE // 2 + 3 :][INNER[:, SIDE // 2 + 3 :]].max() < 110.0
    assert (picture[:, : SIDE // 2][OUTER[:, : SIDE // 2]] < 1.0).all()


def test_a_craft_without_sunlight_is_seen_in_the_light_of_the_sky_alone() -> None:
    dark = taken(shade_share=1.0, ambient=(0.1, 0.1))
    assert dark[INNER] == pytest.approx(100.0, abs=0.5)


def test_light_falls_off_across_the_craft_by_its_exponent() -> None:
    picture = taken(falloff_share=1.0, falloff=(2.0, 2.0), level_grey=(40.0, 40.0))
    logarithm = np.log(picture[INNER])
    y, x = np.nonzero(INNER)
    slope = np.linalg.lstsq(np.column_stack([x, y, np.ones(len(x))]), logarithm, rcond=None)[0]
    assert SIDE * np.hypot(slope[0], slope[1]) == pytest.approx(2.0, rel=0.02)


def test_the_sky_glows_around_the_craft_and_not_before_it() -> None:
    picture = taken(np.zeros_like(COVER), ambient=(1e-9, 1e-9), level_grey=(1.0, 1.0),
                    sky_share=1.0, sky_level_grey=(80.0, 80.0), glow_share=1.0,
                    glow_grey=(6.0, 6.0))  # fmt: skip
    assert picture[OUTER] == pytest.approx(86.0, abs=0.5)
    assert picture[INNER].max() < 2.0


def test_the_black_level_lifts_everything() -> None:
    raised = taken(raised_black_share=1.0, raised_black_level_grey=(30.0, 30.0))
    np.testing.assert_allclose(raised, taken() + 30.0, atol=0.01)


def test_a_terminator_leaves_one_side_of_the_sky_dark() -> None:
    sky = taken(
        sky_share=1.0, terminator_share=1.0, terminator_place=(0.0, 0.0),
        terminator_sharpness=(40.0, 40.0), sky_level_grey=(200.0, 200.0),
    )[OUTER]  # fmt: skip
    assert np.mean(sky < 10.0) == pytest.approx(0.5, abs=0.15)
    assert np.mean(sky > 190.0) == pytest.approx(0.5, abs=0.15)


def test_bloom_adds_a_halo_that_fades_outwards() -> None:
    more = taken(bloom_share=1.0, bloom=(0.1, 0.1), bloom_sigma_px=(6.0, 6.0)) - taken()
    middle = more[SIDE // 2]
    assert more[INNER].mean() == pytest.approx(10.0, abs=1.5)
    assert middle[SIDE // 2 + 22] > 2.0 * middle[SIDE // 2 + 28] > 0.0


def test_glare_reaches_further_than_the_bloom() -> None:
    bloom = {"bloom_share": 1.0, "bloom": (0.02, 0.02), "bloom_sigma_px": (2.0, 2.0)}
    plain = taken(**bloom)
    more = taken(**bloom, glare_share=1.0, glare=(0.05, 0.05)) - plain
    corner, middle = more[:8, :8].mean(), more[INNER].mean()
    assert middle > 3.0 > corner > 0.05
    assert plain[:8, :8].max() < 0.01


def test_wrinkled_foil_has_sharp_bright_lines() -> None:
    options = replace(NOTHING, wrinkles_share=1.0, wrinkles=(6, 7), wrinkles_depth=(1.0, 1.0))
    factor = hard_light.mottled_reflectance(128, np.random.default_rng(4), options)
    assert 0.0 < factor.min() < factor.max() <= 1.0
    across = np.diff(np.log(factor), n=2, axis=1)
    assert -across.min() > 3.0 * across.max()  # it bends at the crests alone


def test_compression_changes_what_is_fine_and_little_else() -> None:
    noisy = {"noise_sigma_grey": (3.0, 3.0)}
    difference = taken(**noisy, jpeg_share=1.0, jpeg_quality=(60, 61)) - taken(**noisy)
    assert 0.5 < difference[INNER].std() < 4.0
    assert abs(difference[INNER].mean()) < 1.0


def test_a_lens_out_of_focus_spreads_each_point_evenly_over_a_disc() -> None:
    point = np.zeros((SIDE, SIDE), np.float32)
    point[31, 31] = 10.0
    lit = {"defocus_share": 1.0, "defocus_px": (3.0, 3.0), "blur_sigma_px": (0.01, 0.01)}
    spread = hard_light.through_optics(
        100.0 * point, np.random.default_rng(1), replace(NOTHING, **lit)
    )
    assert spread.sum() == pytest.approx(1000.0, rel=1e-4)
    y, x = np.mgrid[:SIDE, :SIDE] - 31.0
    far = np.hypot(x, y)
    assert spread[far > 3.8].max() == 0.0
    assert spread[far < 2.2] == pytest.approx(1000.0 / (9.0 * np.pi), rel=0.03)


def test_stray_light_is_brighter_on_one_side() -> None:
    more = taken(stray_share=1.0, stray_grey=(10.0, 10.0), stray_slope=(1.0, 1.0)) - taken()
    assert more[0, 0] < 0.1
    assert more[-1, -1] == pytest.approx(15.0, abs=0.5)


def test_dust_shines_before_sky_and_craft() -> None:
    more = taken(dust_share=1.0, specks=(24, 25)) - taken()
    assert more.min() > -0.1
    assert 5 < np.count_nonzero(more > 10.0) < 400


def test_noise_has_its_sigma_and_grows_with_light() -> None:
    picture = taken(noise_sigma_grey=(2.0, 2.0), shot_noise=(3.0, 3.0), level_grey=(200.0, 200.0))
    assert picture[INNER].std() == pytest.approx(2.0 * np.sqrt(1 + 3 * 200 / 255), rel=0.1)


@pytest.mark.parametrize("effect", ["patches", "dirt"])
def test_mottled_reflectance_multiplies(effect: str) -> None:
    rng = np.random.default_rng(3)
    changed = {f"{effect}_share": 1.0, f"{effect}_depth": (0.3, 0.3)}
    factor = hard_light.mottled_reflectance(SIDE, rng, replace(NOTHING, **changed))
    assert factor.min() > 0.0
    assert 0.15 < np.log(factor).std() < 0.4


def test_the_conditions_of_the_training_set_reach_from_dark_to_burnt_out() -> None:
    rng = np.random.default_rng(0)
    sunlit = 0.4 * COVER * np.linspace(0.1, 1.0, SIDE, dtype=np.float32)
    shown = [photograph(sunlit, COVER, COVER, SKY, rng) for _ in range(200)]
    again = photograph(sunlit, COVER, COVER, SKY, np.random.default_rng(0))
    np.testing.assert_array_equal(shown[0], again)
    assert all(np.isfinite(p).all() and p.min() >= 0.0 and p.max() <= 255.0 for p in shown)
    burnt = np.array([np.mean(p[INNER] > 254.0) for p in shown])
    assert np.mean(burnt > 0.5) > 0.06
    assert np.mean([np.median(p[INNER]) < 30.0 for p in shown]) > 0.05
