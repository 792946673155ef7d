"""Compiled loops of the reflector sensor against plain numpy."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rendezview.estimation.p3p import MAX_ROOTS, p3p_roots, solve_p3p_batch
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.sensors.beacons import SixNumbers, pose_of, predict_spots
from rendezview.sensors.beacons.constellation import Face
from rendezview.sensors.beacons.detect.difference import Centroid
from rendezview.sensors.beacons.detect.discs import (
    LAW,
    camera_doubts,
    camera_numbers,
    disc_radius,
    expected_size,
    placed,
    project_all,
    project_disc,
    turned,
)
from rendezview.sensors.beacons.detect.labels import gather
from rendezview.sensors.beacons.detect.spot_columns import (
    ABOVE,
    AREA,
    BINARY_X,
    COLUMNS,
    COVER,
    PEAK,
    RIVALS,
    SIGMA,
    SIZE,
    WEIGHTED_X,
    X,
    Y,
)
from rendezview.sensors.beacons.detect.spots import place, recentre, window_centroid
from rendezview.sensors.beacons.match.matching import expect_spots, match_spots
from rendezview.sensors.beacons.pose.refinement import Refined, adjust, solve_spots
from rendezview.sensors.beacons.pose.shares import (
    CAUSES,
    COVERED,
    share_out,
    spot_slopes,
    whole_sigma,
)
from rendezview.sensors.beacons.rates import RateEstimator
from rendezview.sensors.beacons.track import Branch, Track
from rendezview.sensors.beacons.windows import VISIBLE, place_windows, read_windows, window_noise

DISTORTED = Camera(512, 384, 652.0, 648.0, 250.0, 195.0, (-0.2, 0.05, 1e-3, -5e-4, 0.01))
SIX = SixNumbers(4.0, 0.1, -0.08, 0.4, -0.2, 0.3)
NO_DARK = np.zeros((0, 0), np.uint8)


def spot_picture(x, y, sigma, peak=180.0, sky=10.0, noise=0.0, seed=0):
    rows, columns = np.mgrid[:60, :80]
    grey = sky + peak * np.exp(-0.5 * ((columns - x) ** 2 + (rows - y) ** 2) / sigma**2)
    grey = grey + noise * np.random.default_rng(seed).standard_normal(grey.shape)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


def test_placed_and_turned_are_matrix_products():
    rng = np.random.default_rng(0)
    rotation, shift, points = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3), np.eye(3)
    for i in range(3):
        np.testing.assert_allclose(placed(rotation, shift, points, i), rotation[:, i] + shift)
        np.testing.assert_allclose(turned(rotation, points, i), rotation[:, i])


def test_a_disc_is_seen_at_the_middle_of_its_dual_conic():
    rng = np.random.default_rng(1)
    lens = camera_numbers(DISTORTED, 0.75)
    for _ in range(50):
        c = np.array([*rng.uniform(-0.3, 0.3, 2), rng.uniform(1.0, 5.0)])
        n = -c / np.linalg.norm(c) + rng.normal(0.0, 0.3, 3)
        n /= np.linalg.norm(n)
        radius, r2 = 0.0125, c @ c
        square = (radius * DISTORTED.fx) ** 2 / r2
        k = 0.5 + 0.131 * square / (square + 5.0 * 0.75**2)
        bright = c - 2.0 * k * k * radius**2 / r2 * (c - (n @ c) * n)
        dual = np.outer(bright, bright) - radius**2 * (np.eye(3) - np.outer(n, n))
        middle = DISTORTED.project(dual[:, 2] / dual[2, 2])
        np.testing.assert_allclose(project_disc(lens, *c, *n, radius), middle, atol=1e-9)
        # Mean square of both half axes of the ellipse in the picture, by the projection's slope
        slope = np.array([[1.0, 0.0, -c[0] / c[2]], [0.0, 1.0, -c[1] / c[2]]]) / c[2] * 652.0
        spread = slope @ (np.eye(3) - np.outer(n, n)) @ slope.T * radius**2
        wanted = math.sqrt(0.5 * np.trace(spread))
        assert disc_radius(652.0, *c, *n, radius) == pytest.approx(wanted, rel=1e-9)
    assert np.isnan(project_disc(lens, 0.0, 0.0, -1.0, 0.0, 0.0, -1.0, 0.01)).all()


def test_expected_spots_are_the_predicted_ones_where_they_face_the_camera(five, paper_camera):
    pose, out = pose_of(SIX, five), np.empty((5, 3))
    lens = camera_numbers(paper_camera, 0.75)
    expect_spots(
        lens, five.positions_m, five.normals, five.diameters_m, pose.rotation,
        pose.translation_m, paper_camera.fx, 0.75, out,
    )  # fmt: skip
    np.testing.assert_allclose(out[:, :2], predict_spots(paper_camera, five, pose), atol=1e-9)
    table = np.zeros((5, COLUMNS))
    table[:, [X, Y]], table[:, SIZE] = out[:, :2] + 0.1, out[:, 2]
    which, where = np.empty(5, np.int64), np.empty(5, np.int64)
    count = match_spots(
        lens, five.positions_m, five.normals, five.diameters_m, pose.rotation,
        pose.translation_m, paper_camera.fx, 0.75, np.arange(5), table[::-1].copy(),
        np.arange(5), np.array([4, 3, 2]), (1.5, 0.28), which, where,
    )  # fmt: skip
    assert count == 5
    assert (which + where).tolist() == [4] * 5
    away = Pose(pose.rotation @ np.diag([-1.0, 1.0, -1.0]), pose.translation_m)
    expect_spots(
        lens, five.positions_m, five.normals, five.diameters_m,
        np.ascontiguousarray(away.rotation), away.translation_m, paper_camera.fx, 0.75, out,
    )  # fmt: skip
    assert np.isnan(out[:, 0]).all()


def test_p3p_roots_are_those_of_the_front_door():
    rng = np.random.default_rng(2)
    points = rng.uniform(-1.0, 1.0, (3, 3))
    rays = points @ Rotation.random(rng=rng).as_matrix().T + [0.1, 0.2, 5.0]
    rotations, translations = np.empty((MAX_ROOTS, 3, 3)), np.empty((MAX_ROOTS, 3))
    count = p3p_roots(rays, points, 1e-11, rotations, translations)
    wanted, _, counts = solve_p3p_batch(rays[None], points)
    assert count == counts[0] >= 1
    np.testing.assert_allclose(wanted[0, :count], rotations[:count], atol=1e-12)


def test_the_adjusted_pose_is_the_minimum_and_its_covariance_the_inverse_normal_matrix(
    five, paper_camera
):
    rng = np.random.default_rng(3)
    truth, lens = pose_of(SIX, five), camera_numbers(paper_camera, 0.75)
    spots = predict_spots(paper_camera, five, truth) + rng.normal(0.0, 0.05, (5, 2))
    sigma = rng.uniform(0.03, 0.08, 5)
    arms = five.positions_m - five.centre_m
    rotation, shift = np.array(truth.rotation), truth.apply(five.centre_m)
    shares, residuals = np.empty((len(CAUSES), 6, 6)), np.empty((5, 2))
    used = adjust(
        lens, camera_doubts(paper_camera), arms, five.normals, five.discs, spots, sigma,
        np.zeros(5), rotation, shift, shares, residuals,
    )  # fmt: skip
    assert 0 < used < 30
    assert not shares[2:].any()
    covariance = shares.sum(axis=0)

    def misfit(step):
        r = Rotation.from_rotvec(step[:3]).as_matrix() @ rotation
        pose = Pose(r, shift + step[3:] - r @ five.centre_m)
        return ((spots - predict_spots(paper_camera, five, pose)) / sigma[:, None]).ravel()

    slopes = np.array([(misfit(1e-6 * e) - misfit(-1e-6 * e)) / 2e-6 for e in np.eye(6)])
    normal = slopes @ slopes.T
    np.testing.assert_allclose(slopes @ misfit(np.zeros(6)) / np.sqrt(np.diag(normal)), 0.0,
                               atol=1e-4)  # fmt: skip
    wanted = np.linalg.inv(normal)
    # Even light, 1 / 0.6 σ away, would move all spots together.
    even = lens.copy()
    even[LAW] = 0.0
    pulls = []
    for arm, normal_ in zip(arms @ rotation.T + shift, five.normals @ rotation.T, strict=True):
        there = [project_disc(law, *arm, *normal_, 0.0125) for law in (lens, even)]
        pulls.append(0.6 * np.subtract(*there))
    moved = wanted @ -slopes @ (np.array(pulls) / sigma[:, None]).ravel()
    wanted = wanted + np.outer(moved, moved)
    scale = np.sqrt(np.outer(np.diag(wanted), np.diag(wanted)))
    np.testing.assert_allclose(covariance / scale, wanted / scale, atol=1e-4)
    np.testing.assert_allclose(residuals / sigma[:, None], misfit(np.zeros(6)).reshape(5, 2),
                               atol=1e-6)  # fmt: skip


def test_shares_are_those_of_the_slopes_of_the_spots(five, paper_camera):
    truth, lens = pose_of(SIX, five), camera_numbers(paper_camera, 0.75)
    arms, rotation = five.positions_m - five.centre_m, np.array(truth.rotation)
    shift, sigmas_m = truth.apply(five.centre_m), np.array([0.0, 1e-3, 0.0, 2e-3, 0.0])
    discs, noise = np.column_stack([five.diameters_m, sigmas_m]), np.full(5, 0.02)
    sigma = whole_sigma(lens, discs, arms, noise, rotation, shift)
    away = paper_camera.fx * sigmas_m / (arms @ rotation.T + shift)[:, 2]
    np.testing.assert_allclose(sigma, np.hypot(noise, away))

    def spots(step):
        r = Rotation.from_rotvec(step[:3]).as_matrix() @ rotation
        pose = Pose(r, shift + step[3:] - r @ five.centre_m)
        return predict_spots(paper_camera, five, pose)

    slopes, own = np.empty((5, 2, 6)), np.empty((2, 6))
    for k, e in enumerate(np.eye(6)):
        slopes[:, :, k] = (spots(1e-6 * e) - spots(-1e-6 * e)) / 2e-6
    for i in range(5):
        spot_slopes(lens, arms, five.normals, five.diameters_m, rotation, shift, i, own)
        np.testing.assert_allclose(own, slopes[i], rtol=1e-3, atol=0.1)
    weighted = slopes / sigma[:, None, None] ** 2
    inverse = np.linalg.inv(np.einsum("nai,naj->ij", weighted, slopes))
    shares = np.empty((len(CAUSES), 6, 6))
    shares[0], cover = inverse, np.array([0.0, 0.01, 0.0, 0.0, 0.015])
    share_out(
        lens, camera_doubts(paper_camera), arms, five.normals, discs, noise, cover, sigma,
        rotation, shift, shares,
    )  # fmt: skip
    by_noise = np.einsum("nai,n,naj->ij", weighted, noise**2 - cover**2, weighted)
    by_cover = np.einsum("nai,n,naj->ij", weighted, cover**2, weighted)
    pulls = np.einsum("nai,nac,n->nic", weighted, slopes[:, :, 3:], sigmas_m)
    by_place = np.einsum("nic,njc->ij", pulls, pulls)
    for cause, pull in ((0, by_noise), (3, by_place), (COVERED, by_cover)):
        share = shares[cause]
        wanted = inverse @ pull @ inverse
        scale = np.sqrt(np.outer(np.diag(wanted), np.diag(wanted)))
        np.testing.assert_allclose(share / scale, wanted / scale, atol=2e-3)
    assert not shares[2].any()


def test_solve_spots_uses_the_named_rows_and_refuses_a_line(five, paper_camera):
    truth, lens = pose_of(SIX, five), camera_numbers(paper_camera, 0.75)
    table = np.full((5, COLUMNS), np.nan)
    table[:, [X, Y]], table[:, SIGMA] = predict_spots(paper_camera, five, truth), 0.02
    table[:, COVER] = 0.0
    start = truth.perturbed([0.02, 0.01, -0.02, 0.01, 0.0, 0.02])
    arms = five.positions_m - five.centre_m
    for rows, good in (([0, 1, 4], True), ([0, 1, 2, 3], True), ([0, 2, 2], False)):
        rotation, translation = np.array(start.rotation), np.empty(3)
        which = np.array(rows, dtype=np.int64)
        used = solve_spots(
            lens, camera_doubts(paper_camera), arms, five.normals, five.discs, five.centre_m,
            table, which, 0.01, rotation, start.translation_m.copy(), translation,
            np.empty((len(CAUSES), 6, 6)), np.empty((len(rows), 2)),
        )  # fmt: skip
        assert (used > 0) == good
        if good:
            np.testing.assert_allclose(rotation, truth.rotation, atol=1e-9)
            np.testing.assert_allclose(translation, truth.translation_m, atol=1e-8)


def test_gathered_moments_are_numpys():
    image = spot_picture(30.3, 25.7, 2.0)
    mask = np.where(image > 60, 255, 0).astype(np.uint8)
    rows, columns = np.nonzero(mask)
    row = np.zeros(COLUMNS)
    start = int(np.flatnonzero(mask)[0])
    gather(mask.reshape(-1).copy(), 80, 60, start, image, NO_DARK, 60.0,
           np.empty(4800, np.int32), row)  # fmt: skip
    weight = image[rows, columns] - 60.0
    assert row[AREA] == len(rows)
    assert row[PEAK] == image.max()
    assert row[ABOVE] == pytest.approx(weight.sum())
    np.testing.assert_allclose(row[[BINARY_X, BINARY_X + 1]], [columns.mean(), rows.mean()])
    middle = np.average(np.column_stack([columns, rows]), axis=0, weights=weight)
    np.testing.assert_allclose(row[[WEIGHTED_X, WEIGHTED_X + 1]], middle)
    spread = np.average((columns - middle[0]) ** 2 + (rows - middle[1]) ** 2, weights=weight)
    assert row[SIZE] == pytest.approx(math.sqrt(0.5 * spread + 1.0 / 12.0))
    filled = row.copy()
    window_centroid(image, image[:0, :0], filled, 2.0, np.empty(80), np.empty(60))
    np.testing.assert_allclose(filled[[X, Y]], [30.3, 25.7], atol=0.01)
    assert filled[SIZE] == pytest.approx(2.0, rel=0.03)
    table = np.array([row, row])
    place(image, NO_DARK, table, 2.0)
    np.testing.assert_array_equal(table, [filled, filled])
    recentre(table, 2.0, Centroid.WEIGHTED)
    np.testing.assert_array_equal(table[0, [X, Y]], row[[WEIGHTED_X, WEIGHTED_X + 1]])


def test_the_expected_size_is_where_a_gaussian_window_settles():
    rows, columns = np.mgrid[-30:31, -30:31] / 10.0 * 2.0
    for radius in (0.5, 1.5, 4.0):
        disc = (np.hypot(columns, rows) <= radius).astype(float)
        f = np.fft.fftfreq(61, 0.2)
        blur = np.exp(-2.0 * (np.pi * 0.75) ** 2 * (f[:, None] ** 2 + f**2))
        spot = np.real(np.fft.ifft2(np.fft.fft2(disc) * blur))
        sigma = 1.0
        for _ in range(200):
            w = np.exp(-0.5 * (columns**2 + rows**2) / sigma**2) * spot
            sigma = math.sqrt(np.sum(w * (columns**2 + rows**2)) / np.sum(w))
        assert expected_size(0.75, radius) == pytest.approx(sigma, rel=0.03)


def test_windows_keep_the_next_best_spot_beside_the_best():
    image = np.maximum(spot_picture(30.3, 25.7, 2.0, noise=2.0), spot_picture(44.0, 20.0, 2.0))
    expected = np.array([[33.0, 25.0, 2.0]])
    for half, rivals, near in ((16.0, 1.0, 44.0), (6.0, 0.0, np.nan)):
        table, rival, outcome = np.empty((1, COLUMNS)), np.empty((1, COLUMNS)), np.zeros(1, int)
        read_windows(
            image, NO_DARK, expected, np.array([half]), np.array([30.0]), 2.0, table,
            rival, outcome,
        )  # fmt: skip
        np.testing.assert_allclose(table[0, [X, Y]], [30.3, 25.7], atol=0.1)
        assert table[0, RIVALS] == rivals
        np.testing.assert_allclose(rival[0, X], near, atol=0.1)


def test_windows_find_the_spot_and_the_noise():
    image = spot_picture(30.3, 25.7, 2.0, noise=2.0)
    expected = np.array([[31.0, 25.0, 2.0], [np.nan, 0.0, 2.0], [60.0, 50.0, 2.0]])
    half, level = np.full(3, 8.0), np.full(3, 30.0)
    table, outcome = np.full((3, COLUMNS), np.nan), np.zeros(3, np.int64)
    rival = table.copy()
    read_windows(image, NO_DARK, expected, half, level, 2.0, table, rival, outcome)
    assert outcome.tolist() == [VISIBLE, 0, 1]
    np.testing.assert_allclose(table[0, [X, Y]], [30.3, 25.7], atol=0.1)
    assert window_noise(image, NO_DARK, expected, half) == pytest.approx(2.0, rel=0.3)
    last = Track.begun(0.0, Pose.identity(), 3, roll_known=True)
    last.brightness, last.aged = np.array([1.0, 2.0, 3.0]), np.array([4, 5, 6])
    refined = Refined(Pose.identity(), np.zeros((len(CAUSES), 6, 6)), np.zeros((0, 2)))
    after = Track.after(last, 1.0, table, refined, 2.0, False, Branch.SURE, 5)
    assert after.aged.tolist() == [0, 6, 7]
    assert after.brightness[1:].tolist() == [2.0, 3.0]


def test_windows_move_by_the_last_step_and_grow_with_what_is_unknown():
    expected = np.array([[10.0, 10.0, 1.0], [100.0, 10.0, 1.0], [200.0, 90.0, 1.0]])
    places, before = expected[:, :2].copy(), expected[:, :2] - [2.0, 1.0]
    before[1] += 1.0
    before[2] = np.nan
    half, level = np.empty(3), np.empty(3)
    place_windows(
        expected, places, before, np.array([90.0, np.nan, 30.0]), np.array([0, 2, 0]), 0.5, 1,
        (4.0, 6.0, 4.0, 0.45, 12.0), half, level,
    )  # fmt: skip
    wanted = places + 0.5 * np.array([[2.0, 1.0], [1.0, 0.0], [1.5, 0.5]])
    np.testing.assert_allclose(expected[:, :2], wanted)
    np.testing.assert_allclose(half, [14.0, 22.0, 14.0])
    np.testing.assert_allclose(level, [30.0, 20.0, 12.0])


def test_rates_of_the_six_numbers_follow_those_of_the_pose(three):
    estimator, rates, face = RateEstimator(), None, Face.of(three)
    for t in np.arange(0.0, 4.0, 0.25):
        six = SixNumbers(4.0 - 0.05 * t, 0.1, -0.08 + 0.01 * t, 0.4 + 0.02 * t, -0.2, 0.3)
        rates = estimator.add(float(t), pose_of(six, three), 1e-8 * np.eye(6), face)
    wanted = [-0.05, 0.0, 0.01, 0.02, 0.0, 0.0]
    np.testing.assert_allclose(rates.six_per_s, wanted, atol=2e-4)
    assert rates.readings == 16
    assert rates.span_s == pytest.approx(3.75)
    estimator.clear()
    assert estimator.add(9.0, pose_of(SIX, three), 1e-8 * np.eye(6), face) is None


def test_all_discs_are_projected_as_each_is(five):
    """About a middle: arms and its place, as a bundle has them."""
    pose, out = pose_of(SIX, five), np.empty((5, 2))
    numbers, centre = camera_numbers(DISTORTED), five.centre_m
    arms, radii = five.positions_m - centre, 0.5 * five.diameters_m
    project_all(
        numbers, arms, five.normals, five.diameters_m, pose.rotation.copy(), pose.apply(centre), out
    )
    places, normals = pose.apply(five.positions_m), five.normals @ pose.rotation.T
    for k in range(5):
        alone = project_disc(numbers, *places[k], *normals[k], radii[k])
        np.testing.assert_allclose(out[k], alone, atol=1e-9)
    np.testing.assert_allclose(out, predict_spots(DISTORTED, five, pose), atol=1e-9)
