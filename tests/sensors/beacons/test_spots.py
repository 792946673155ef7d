"""Difference, threshold, opening, spots, centroids."""

import cv2
import numpy as np
import pytest

from rendezview.errors import RendezviewError
from rendezview.sensors.beacons import Centroid, LitDark, Opening, ThresholdOptions, find_spots
from rendezview.sensors.beacons.detect.difference import noise_grey, registered, spot_mask

PLACES = np.array([[40.3, 30.7], [90.1, 40.4], [60.6, 80.2]])


def blank(noise, rng, height=120, width=130):
    return np.clip(np.rint(20 + rng.normal(0, noise, (height, width))), 0, 255).astype(np.uint8)


def spotted(places, rng, sigma=1.5, peak=180.0, noise=2.0, height=120, width=130):
    y, x = np.mgrid[:height, :width]
    picture = np.full((height, width), 20.0)
    for u, v in places:
        picture += peak * np.exp(-0.5 * ((x - u) ** 2 + (y - v) ** 2) / sigma**2)
    picture += rng.normal(0, noise, picture.shape)
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)


def offsets(spots, places):
    nearest = np.argmin(np.linalg.norm(spots[:, None] - places[None], axis=-1), axis=1)
    return spots - places[nearest]


def test_three_centroids_are_as_good_as_published():
    """RMS at σ = 2 grey and peak 180: binary 0.1 px or so, weighted 0.04, windowed 0.013."""
    rng = np.random.default_rng(1)
    rms = {}
    for kind in Centroid:
        found = []
        for _ in range(60):
            places = PLACES + rng.uniform(-0.5, 0.5, PLACES.shape)
            frames = LitDark(spotted(places, rng))
            spots = find_spots(frames, ThresholdOptions(lower_grey=60.0), kind)
            assert len(spots) == 3
            found.append(offsets(spots.centroids_px, places))
        rms[kind] = float(np.sqrt(np.mean(np.square(found))))
        assert np.abs(np.mean(found)) < 0.01
    assert rms[Centroid.WINDOWED] < 0.0105 < rms[Centroid.WEIGHTED] < 0.04 < rms[Centroid.BINARY]


def test_the_error_told_is_the_error_made():
    rng = np.random.default_rng(2)
    errors, told = [], []
    for _ in range(100):
        places = PLACES + rng.uniform(-0.5, 0.5, PLACES.shape)
        spots = find_spots(LitDark(spotted(places, rng), blank(2.0, rng)))
        errors.append(offsets(spots.centroids_px, places))
        told.append(spots.sigma_px)
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(np.mean(told), rel=0.12)


@pytest.mark.parametrize("sigma", [1.0, 2.0, 4.0])
def test_size_is_the_sigma_of_a_gaussian_spot(sigma):
    spots = find_spots(LitDark(spotted(PLACES, np.random.default_rng(3), sigma)))
    np.testing.assert_allclose(spots.size_px, sigma, rtol=0.05)


def test_the_compiled_spots_are_those_of_connected_components():
    rng = np.random.default_rng(4)
    noise = cv2.GaussianBlur(rng.normal(120.0, 300.0, (90, 77)), (0, 0), 1.5)
    frames = LitDark(np.clip(noise, 0, 255).astype(np.uint8))
    options = ThresholdOptions(lower_grey=190.0, opening=Opening.NONE)
    spots = find_spots(frames, options, Centroid.BINARY)
    mask = spot_mask(frames, 190.0, options)
    count, _, stats, centroids = cv2.connectedComponentsWithStats(mask, connectivity=8)
    assert len(spots) == count - 1
    assert sorted(spots.area_px) == sorted(stats[1:, cv2.CC_STAT_AREA])
    order, other = np.lexsort(spots.centroids_px.T), np.lexsort(centroids[1:].T)
    np.testing.assert_allclose(spots.centroids_px[order], centroids[1:][other])


def test_noise_is_measured_from_the_picture():
    rng = np.random.default_rng(5)
    lit, dark = blank(3.0, rng, 400, 500), blank(4.0, rng, 400, 500)
    assert noise_grey(LitDark(lit)) == pytest.approx(3.0, rel=0.05)
    assert noise_grey(LitDark(lit, dark)) == pytest.approx(5.0, rel=0.05)
    assert noise_grey(LitDark(np.full((5, 5), 9, np.uint8))) > 0.0


def test_what_both_pictures_show_is_no_spot():
    rng = np.random.default_rng(6)
    lit = spotted(PLACES, rng)
    dark = spotted(PLACES[:1], rng)
    assert len(find_spots(LitDark(lit, dark))) == 2


def test_the_upper_threshold_removes_glints():
    rng = np.random.default_rng(7)
    lit = np.maximum(spotted(PLACES[:2], rng, peak=120.0), spotted(PLACES[2:], rng, 2.5, 400.0))
    dark = blank(2.0, rng)
    assert len(find_spots(LitDark(lit, dark))) == 3
    spots = find_spots(LitDark(lit, dark), ThresholdOptions(upper_grey=200.0))
    glint = np.linalg.norm(spots.centroids_px - PLACES[2], axis=1) < 1.0
    assert not glint[spots.size_px < 2.0].any()


def test_saturated_pixels_are_counted():
    spots = find_spots(LitDark(spotted(PLACES, np.random.default_rng(8), 2.0, 400.0)))
    assert (spots.saturated_px > 5).all()
    assert np.abs(offsets(spots.centroids_px, PLACES)).max() < 0.05


@pytest.mark.parametrize(
    ("opening", "left"),
    [(Opening.NONE, 4), (Opening.SMALL, 2), (Opening.CROSS, 2), (Opening.SQUARE, 1)],
)
def test_opening_removes_the_smallest_and_keeps_the_rest_in_place(opening, left):
    picture = np.zeros((60, 60), np.uint8)
    picture[10, 10] = 200  # a pixel
    picture[20:22, 20:22] = 200  # 2 × 2
    picture[29:32, 40] = picture[30, 39:42] = 200  # a plus
    picture[40:45, 10:15] = 200
    options = ThresholdOptions(lower_grey=100.0, opening=opening)
    spots = find_spots(LitDark(picture), options, Centroid.BINARY)
    assert len(spots) == left
    assert [12.0, 42.0] in spots.centroids_px.tolist()


@pytest.mark.parametrize("level", [0, 255])
def test_a_picture_of_nothing_has_no_spots(level):
    picture = np.full((50, 60), level, np.uint8)
    assert len(find_spots(LitDark(picture, picture))) == 0


@pytest.mark.parametrize(
    "picture", [np.zeros((0, 5), np.uint8), np.zeros((4, 4, 3), np.uint8), np.full((4, 4), np.nan)]
)
def test_what_is_no_picture_is_refused(picture):
    with pytest.raises(RendezviewError, match="8-bit grey"):
        LitDark(picture)


def test_pictures_of_two_sizes_are_refused():
    with pytest.raises(RendezviewError, match="differ in size"):
        LitDark(np.zeros((4, 4), np.uint8), np.zeros((4, 5), np.uint8))


def test_a_second_camera_is_brought_under_the_first():
    rng = np.random.default_rng(9)
    dark = spotted(PLACES, rng, noise=0.0)
    moved = registered(dark, [[1.0, 0.0, 5.0], [0.0, 1.0, -3.0]])
    spots = find_spots(LitDark(moved))
    np.testing.assert_allclose(
        offsets(spots.centroids_px, PLACES + np.array([5.0, -3.0])), 0.0, atol=0.02
    )
    with pytest.raises(ValueError, match="inverted"):
        registered(dark, np.zeros((2, 3)))
