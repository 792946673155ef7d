"""Outlines: crack points of masks, sub-pixel edges of frames, vector areas."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rendezview.sensors.appearance.model.signature import vector_area
from rendezview.sensors.appearance.outline.silhouette import (
    Silhouette,
    SilhouetteOptions,
    find_silhouette,
    outer_borders,
    outlines_of_mask,
)
from rendezview.sensors.appearance.outline.tracing import crack_outline


def signed_area(points: np.ndarray) -> float:
    """Shoelace; positive where x turns towards y, which is clockwise on the screen."""
    x, y = points.T
    return 0.5 * float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))


def centroid(points: np.ndarray) -> np.ndarray:
    x, y = points.T
    cross = x * np.roll(y, -1) - np.roll(x, -1) * y
    sums = [np.sum((v + np.roll(v, -1)) * cross) for v in (x, y)]
    return np.array(sums) / (3.0 * np.sum(cross))


def blurred_disc(
    centre: tuple[float, float], radius: float, size: int = 64, sky: float = 12.0
) -> np.ndarray:
    fine = 16
    at = (np.arange(size * fine) + 0.5) / fine - 0.5
    inside = (at[None] - centre[0]) ** 2 + (at[:, None] - centre[1]) ** 2 <= radius**2
    cover = cv2.resize(inside.astype(np.float32), (size, size), interpolation=cv2.INTER_AREA)
    return np.rint(sky + 150.0 * cv2.GaussianBlur(cover, (0, 0), 0.7)).astype(np.uint8)


@pytest.mark.parametrize("length", [1, 2, 3, 9])
@pytest.mark.parametrize("turned", [False, True])
def test_a_line_one_pixel_wide_has_both_its_sides(length, turned):
    mask = np.zeros((12, 12), dtype=np.uint8)
    mask[4, 2 : 2 + length] = 255
    (points,) = outlines_of_mask(mask.T.copy() if turned else mask)
    sense = -1.0  # counter-clockwise on the screen, where y points down
    if turned:
        points, sense = points[:, ::-1], 1.0
    expected = [(x, y) for x in range(2, 2 + length) for y in (3.5, 4.5)]
    expected += [(1.5, 4.0), (1.5 + length, 4.0)]
    assert sorted(map(tuple, points)) == sorted(expected)
    assert signed_area(points) == pytest.approx(sense * (length - 0.5))  # four corners are cut


@pytest.mark.parametrize("side", [2, 3, 10])
def test_a_square_has_its_area_less_the_cut_corners(side):
    mask = np.zeros((16, 16), dtype=np.uint8)
    mask[3 : 3 + side, 2 : 2 + side] = 255
    (points,) = outlines_of_mask(mask)
    assert len(points) == 4 * side
    assert signed_area(points) == pytest.approx(-(side**2 - 4 * 0.125))
    assert np.allclose(centroid(points), [2 + (side - 1) / 2, 3 + (side - 1) / 2])


def test_every_side_to_the_outside_gives_one_point_whatever_the_shape():
    rng = np.random.default_rng(0)
    for _ in range(50):
        mask = np.zeros((20, 20), dtype=np.uint8)
        mask[2:-2, 2:-2] = np.where(rng.random((16, 16)) < 0.55, 255, 0)
        # what the 4-connected outside touches: OpenCV's own filling is the reference
        outside = cv2.floodFill(mask.copy(), None, (0, 0), 77, flags=4)[1] == 77
        expected = set()
        for y, x in zip(*np.nonzero(mask), strict=True):
            for dx, dy in ((1, 0), (0, 1), (-1, 0), (0, -1)):
                if outside[y + dy, x + dx]:
                    expected.add((x + 0.5 * dx, y + 0.5 * dy))
        found = [tuple(p) for points in outlines_of_mask(mask) for p in points]
        assert len(found) == len(set(found))
        assert set(found) == expected


def test_a_diagonal_staircase_becomes_a_straight_line():
    mask = np.tri(12, 12, -1, dtype=np.uint8)[:, ::-1] * 255
    mask = cv2.copyMakeBorder(np.ascontiguousarray(mask), 2, 2, 2, 2, cv2.BORDER_CONSTANT)
    (points,) = outlines_of_mask(mask)
    slanted = points[np.isclose(points.sum(axis=1), points.sum(axis=1).min())]
    assert len(slanted) == 22  # two for each of the eleven steps
    assert np.allclose(slanted.sum(axis=1), slanted[0].sum(), atol=1e-12)


@pytest.mark.parametrize("centre", [(31.0, 30.0), (31.25, 30.4), (30.63, 31.87), (31.5, 31.5)])
@pytest.mark.parametrize("mask_grey", [40.0, 60.0, 87.0])
def test_a_blurred_disc_is_found_to_a_fiftieth_of_a_pixel(centre, mask_grey):
    frame = blurred_disc(centre, 20.0)
    mask = cv2.threshold(frame, mask_grey, 255, cv2.THRESH_BINARY)[1]
    (border,) = outer_borders(mask)
    points = crack_outline(border, frame, 12.0, 8.0, 2)
    assert np.abs(centroid(points) - centre).max() < 0.02
    assert np.sqrt(-signed_area(points) / np.pi) == pytest.approx(20.0, abs=0.1)


# The mean over 3 × 3 pixels sees the blurred edge early; by default the search inwards ends
# before the full level, for the sake of dim panels before bright bodies.
@pytest.mark.parametrize("radius", [8.0, 20.0])
@pytest.mark.parametrize(
    ("options", "fat_px"),
    [
        (SilhouetteOptions(), 0.55),
        (SilhouetteOptions(reach_px=3), 0.2),
        (SilhouetteOptions(averaged_px=1, least_contrast_grey=8.0), 0.2),
    ],
)
def test_a_noisy_disc_is_neither_displaced_nor_fatter_than_said(radius, options, fat_px):
    rng = np.random.default_rng(8)
    for _ in range(10):
        centre = tuple(rng.uniform(31.0, 32.0, 2))
        frame = blurred_disc(centre, radius) + rng.normal(0.0, 3.0, (64, 64))
        found = find_silhouette(np.clip(np.rint(frame), 0, 255).astype(np.uint8), options)
        assert isinstance(found, Silhouette)
        (points,) = found.outlines_px
        assert np.sqrt(-signed_area(points) / np.pi) == pytest.approx(radius, abs=fat_px)
        assert np.abs(centroid(points) - centre).max() < 0.15


def test_the_edge_of_a_frame_at_the_picture_border_stays_in_reach():
    frame = np.full((8, 8), 200, dtype=np.uint8)
    (border,) = outer_borders(frame)
    points = crack_outline(border, frame, 10.0, 8.0, 2)
    assert np.abs(signed_area(points)) == pytest.approx(64 - 0.5)


def cone(half_angle: float, count: int = 4000) -> np.ndarray:
    """Rays around the boresight, counter-clockwise on the screen."""
    angle = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    tangent = np.tan(half_angle)
    return np.stack([tangent * np.cos(angle), -tangent * np.sin(angle), np.ones(count)], axis=1)


@pytest.mark.parametrize("half_angle_deg", [0.01, 1.0, 10.0, 40.0, 80.0])
def test_vector_area_of_a_cone_is_pi_sine_squared_along_its_axis(half_angle_deg):
    half_angle = np.deg2rad(half_angle_deg)
    area = vector_area(cone(half_angle))
    assert area[2] == pytest.approx(np.pi * np.sin(half_angle) ** 2, rel=1e-5)
    assert np.abs(area[:2]).max() < 1e-9 * area[2] + 1e-15


def test_vector_area_turns_with_the_rays_and_ignores_their_length():
    rng = np.random.default_rng(3)
    rays = cone(0.2, 100) * (1.0 + 0.3 * rng.random((100, 1)) * [1.0, 1.0, 0.0])
    area = vector_area(rays)
    for _ in range(5):
        turn = Rotation.random(random_state=rng).as_matrix()
        lengths = rng.uniform(0.1, 10.0, size=(100, 1))
        assert np.allclose(vector_area(lengths * rays @ turn.T), turn @ area, atol=1e-14)


def test_vector_area_changes_sign_with_the_sense_of_turning():
    rays = cone(0.3, 50)
    assert np.allclose(vector_area(rays[::-1].copy()), -vector_area(rays))


def test_vector_area_of_a_concave_outline_is_the_sum_of_its_parts_and_the_integral():
    corners = [(0.0, 0.0), (0.4, 0.0), (0.4, 0.1), (0.1, 0.1), (0.1, 0.5), (0.0, 0.5)]  # an L
    corners = corners[::-1]  # counter-clockwise on the screen
    dense = [
        np.linspace(corners[k - 1], corners[k], 200, endpoint=False) for k in range(len(corners))
    ]
    rays = np.concatenate([np.concatenate(dense), np.ones((1200, 1))], axis=1)
    step = 0.0005
    total = np.zeros(3)
    for (x0, x1), (y0, y1) in (((0.0, 0.4), (0.0, 0.1)), ((0.0, 0.1), (0.1, 0.5))):
        x, y = np.meshgrid(np.arange(x0 + step / 2, x1, step), np.arange(y0 + step / 2, y1, step))
        rays_in = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
        total += np.sum(rays_in / np.sum(rays_in**2, axis=1, keepdims=True) ** 2, axis=0)
    assert np.allclose(vector_area(rays), total * step**2, rtol=1e-4)


def test_vector_area_of_nothing_is_zero():
    assert np.array_equal(vector_area(np.zeros((0, 3))), np.zeros(3))
