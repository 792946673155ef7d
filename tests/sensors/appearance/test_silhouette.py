"""Finding the target in a frame: thresholds, blobs, and every reason to find none."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from rendezview.errors import RendezviewError
from rendezview.sensors.appearance.outline.silhouette import (
    Cleaning,
    Missing,
    Silhouette,
    SilhouetteOptions,
    Threshold,
    find_silhouette,
)
from rendezview.sensors.appearance.sky import sky_level
from rendezview.sensors.observation import Status

BOX = (60, 40, 99, 69)  # left, top, right, bottom


def frame_with(
    *boxes: tuple[int, int, int, int], grey: float = 150.0, sky: float = 12.0, size=(120, 160)
) -> np.ndarray:
    frame = np.full(size, sky)
    for left, top, right, bottom in boxes:
        frame[top : bottom + 1, left : right + 1] = grey
    return frame.astype(np.uint8)


def noisy(frame: np.ndarray, sigma: float, seed: int = 0) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(0.0, sigma, frame.shape)
    return np.clip(np.rint(frame + noise), 0, 255).astype(np.uint8)


def area_of(silhouette: Silhouette) -> float:
    total = 0.0
    for x, y in (points.T for points in silhouette.outlines_px):
        total -= 0.5 * float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))
    return total


def found(frame: np.ndarray, options: SilhouetteOptions | None = None, at=None) -> Silhouette:
    result = find_silhouette(frame, options, at)
    assert isinstance(result, Silhouette), result
    return result


def missed(frame: np.ndarray, options: SilhouetteOptions | None = None, at=None) -> Missing:
    result = find_silhouette(frame, options, at)
    assert isinstance(result, Missing), result
    assert result.reason
    return result


EVERY_THRESHOLD = [
    SilhouetteOptions(),
    SilhouetteOptions(threshold=Threshold.OTSU),
    SilhouetteOptions(threshold=Threshold.FIXED, level_grey=80.0),
]


@pytest.mark.parametrize("options", EVERY_THRESHOLD, ids=lambda o: o.threshold)
@pytest.mark.parametrize("sigma", [0.0, 3.0])
def test_each_threshold_finds_a_bright_box_where_it_is(options, sigma):
    silhouette = found(noisy(frame_with(BOX), sigma), options)
    assert len(silhouette.outlines_px) == 1
    assert np.abs(np.subtract(silhouette.box_px, BOX)).max() <= 1
    assert area_of(silhouette) == pytest.approx(40 * 30, rel=0.01)
    assert silhouette.sky_grey == pytest.approx(12.0, abs=0.5)
    assert silhouette.sky_grey < silhouette.level_grey < 150.0
    middle = silhouette.outlines_px[0].mean(axis=0)
    assert middle == pytest.approx([79.5, 54.5], abs=0.3)


def test_the_noise_threshold_follows_sky_and_noise():
    for sky, sigma in ((12.0, 3.0), (40.0, 6.0)):
        silhouette = found(noisy(frame_with(BOX, sky=sky), sigma))
        assert silhouette.sky_grey == pytest.approx(sky, abs=0.5)
        assert sky + sigma < silhouette.level_grey <= sky + 5.5 * sigma


def test_sky_and_noise_are_measured_along_the_border():
    for sky, sigma in ((30.0, 2.0), (100.0, 8.0)):
        frame = noisy(frame_with(BOX, grey=250.0, sky=sky, size=(480, 640)), sigma)
        assert sky_level(frame) == pytest.approx((sky, sigma), rel=0.1)


@pytest.mark.requirement("RV-REC-3")
@pytest.mark.parametrize("sky", [0.0, 1.0, 20.0])  # noise is cut at zero in a black sky
@pytest.mark.parametrize("sigma", [3.0, 6.0])
def test_noise_gives_no_false_blobs(sky, sigma):
    for seed in range(5):
        frame = noisy(frame_with(BOX, sky=sky, size=(480, 640)), sigma, seed)
        silhouette = found(frame)
        assert len(silhouette.outlines_px) == 1
        assert np.abs(np.subtract(silhouette.box_px, BOX)).max() <= 2
        assert missed(noisy(np.full((480, 640), sky), sigma, seed)).status in (
            Status.EMPTY,
            Status.SMALL,
        )


@pytest.mark.parametrize("sigma", [0.0, 3.0])
def test_a_background_frame_is_subtracted(sigma):
    background = frame_with((5, 5, 40, 110), grey=90.0)  # a bright structure of our own craft
    frame = noisy(np.maximum(background, frame_with(BOX)), sigma, 1)
    assert missed(frame).status is Status.RIVALS
    silhouette = found(frame, SilhouetteOptions(background=noisy(background, sigma, 2)))
    assert np.abs(np.subtract(silhouette.box_px, BOX)).max() <= 1


@pytest.mark.parametrize(
    "background", [np.zeros((10, 10), np.uint8), np.zeros((120, 160)), np.zeros((120, 160, 3))]
)
def test_a_background_that_does_not_fit_is_refused(background):
    with pytest.raises(RendezviewError, match="background"):
        find_silhouette(frame_with(BOX), SilhouetteOptions(background=background))


def test_opening_takes_a_thin_boom_away_and_no_cleaning_keeps_it():
    boom = (100, 54, 120, 55)
    frame = frame_with(BOX, boom)
    assert found(frame).box_px[2] >= 119
    for averaged in (1, 3):
        options = SilhouetteOptions(
            cleaning=Cleaning.OPEN,
            threshold=Threshold.FIXED,
            level_grey=100.0,
            averaged_px=averaged,
        )
        assert found(frame, options).box_px[2] <= 101


def test_closing_bridges_a_gap_of_two_pixels():
    left, right = (40, 40, 79, 69), (82, 40, 99, 69)
    options = {"threshold": Threshold.FIXED, "level_grey": 100.0, "averaged_px": 1}
    apart = found(frame_with(left, right), SilhouetteOptions(**options))
    whole = found(frame_with(left, right), SilhouetteOptions(cleaning=Cleaning.CLOSE, **options))
    assert (len(apart.outlines_px), len(whole.outlines_px)) == (2, 1)


def test_blobs_across_a_thin_gap_are_one_target():
    body, panel = (40, 40, 79, 69), (84, 45, 99, 64)
    silhouette = found(frame_with(body, panel))
    assert len(silhouette.outlines_px) == 2
    assert silhouette.box_px[0] <= 40
    assert silhouette.box_px[2] >= 99
    assert area_of(silhouette) == pytest.approx(40 * 30 + 16 * 20, rel=0.02)


def test_blobs_in_a_chain_are_joined_one_by_one():
    chain = [(30 + 26 * k, 50, 30 + 26 * k + 21, 59) for k in range(4)]
    options = SilhouetteOptions(merge_gap=0.25)
    assert len(found(frame_with(*chain), options).outlines_px) == 4


TWO = ((20, 30, 49, 59), (105, 60, 134, 93))


def test_two_bodies_of_like_size_cannot_be_chosen_between_without_a_prior():
    assert missed(frame_with(*TWO)).status is Status.RIVALS


@pytest.mark.parametrize("which", [0, 1])
def test_of_two_bodies_the_one_at_the_expected_place_is_taken(which):
    box = TWO[which]
    at = (0.5 * (box[0] + box[2]) + 8.0, 0.5 * (box[1] + box[3]) - 5.0)
    silhouette = found(frame_with(*TWO), at=at)
    assert np.abs(np.subtract(silhouette.box_px, box)).max() <= 1


def test_a_much_smaller_body_far_away_is_no_rival():
    silhouette = found(frame_with(BOX, (130, 100, 139, 109)))
    assert np.abs(np.subtract(silhouette.box_px, BOX)).max() <= 1


@pytest.mark.parametrize(
    ("box", "side"),
    [
        ((0, 40, 30, 69), "left"),
        ((60, 0, 99, 30), "top"),
        ((120, 40, 159, 69), "right"),
        ((60, 90, 99, 119), "bottom"),
    ],
)
def test_a_silhouette_at_the_border_is_refused_and_the_side_is_named(box, side):
    miss = missed(frame_with(box))
    assert miss.status is Status.BORDER
    assert side in miss.reason


def test_all_sides_are_named_where_all_are_touched():
    frame = frame_with((0, 55, 159, 64), (75, 0, 84, 119))
    frame[:3], frame[-3:], frame[:, :3], frame[:, -3:] = 12, 12, 12, 12
    frame[60, :], frame[:, 80] = 150, 150
    miss = missed(frame)
    assert miss.status is Status.BORDER
    assert all(side in miss.reason for side in ("left", "top", "right", "bottom"))


@pytest.mark.parametrize("options", EVERY_THRESHOLD, ids=lambda o: o.threshold)
@pytest.mark.parametrize("grey", [0, 12, 200, 255])
def test_a_frame_of_one_grey_level_is_empty_or_full(grey, options):
    status = Status.FULL if grey >= 200 else Status.EMPTY
    assert missed(np.full((120, 160), grey, np.uint8), options).status is status


def test_a_body_of_few_pixels_is_small():
    miss = missed(frame_with((80, 60, 84, 64)))
    assert miss.status is Status.SMALL
    assert "60" in miss.reason


def test_hot_pixels_do_not_join_the_target():
    frame = frame_with(BOX)
    rng = np.random.default_rng(3)
    for x, y in zip(rng.integers(3, 157, 25), rng.integers(3, 117, 25), strict=True):
        if not (45 <= x <= 115 and 25 <= y <= 85):
            frame[y, x] = 255
    for averaged in (1, 3):
        silhouette = found(frame, SilhouetteOptions(averaged_px=averaged, merge_gap=0.15))
        assert np.abs(np.subtract(silhouette.box_px, BOX)).max() <= 1


def test_holes_and_shadows_inside_the_outline_do_not_show():
    frame = frame_with(BOX)
    frame[50:60, 70:90] = 12
    assert area_of(found(frame)) == pytest.approx(40 * 30, rel=0.01)


@pytest.mark.parametrize("level", [None, -1.0, 255.0, float("nan")])
def test_a_fixed_threshold_needs_its_level(level):
    with pytest.raises(ValueError, match="level_grey"):
        SilhouetteOptions(threshold=Threshold.FIXED, level_grey=level)


def test_the_frame_is_left_as_it_was():
    frame = frame_with(BOX)
    before = frame.copy()
    find_silhouette(frame, SilhouetteOptions(cleaning=Cleaning.OPEN, background=frame // 2))
    assert np.array_equal(frame, before)
    assert cv2.countNonZero(before) > 0
