"""A reflector that is partly hidden: its spot is narrower than its neighbours' and moved."""

from __future__ import annotations

import math

import numpy as np
import pytest
from tests import plain_pictures as plain
from tests.plain_readings import CAMERA, HALF_TURN, PINHOLE, frames_of, squared_error

from rendezview.geometry.pose import Pose
from rendezview.sensors.beacons import ReflectorSensor, TrackingOptions, predict_spots
from rendezview.sensors.beacons.detect.cover import compare_spots, middle, uncovered_sizes
from rendezview.sensors.beacons.detect.spot_columns import (
    AMPLITUDE,
    COLUMNS,
    LONG_X,
    LONG_XY,
    SIGMA,
    SIZE,
)
from rendezview.sensors.beacons.pose.refinement import SpotFit

EDGE = {0.1: 0.687, 0.2: 0.492, 0.35: 0.238, 0.5: 0.0}  # radii from the middle that hide this share


def reading(five, rng, covers, range_m=3.0, margin_px=80.0):
    """One reading of the plain simulator, and the truth."""
    truth = Pose(*plain.look_at(rng, PINHOLE, range_m, 0.5, margin_px))
    frames = frames_of(PINHOLE, five, truth, rng, covers=covers)
    sensor = ReflectorSensor(CAMERA, [five], tracking=TrackingOptions(confirm=False))
    return sensor.update(0.0, frames), truth


@pytest.mark.parametrize(("share", "edge"), EDGE.items())
def test_edges_hide_the_share_that_is_said(share, edge):
    hidden = (math.acos(edge) - edge * math.sqrt(1.0 - edge * edge)) / math.pi
    assert hidden == pytest.approx(share, abs=0.002)


@pytest.mark.parametrize("share", [0.2, 0.35, 0.5])
def test_a_covered_spot_counts_by_how_far_it_has_moved(five, share):
    rng, moved, claimed = np.random.default_rng(1), [], []
    for _ in range(8):
        found, truth = reading(five, rng, {1: (rng.uniform(0.0, 6.3), EDGE[share])})
        places = predict_spots(CAMERA, five, truth)
        away = np.linalg.norm(places[:, None] - found.spots.centroids_px, axis=2)
        nearest = away.argmin(axis=1)
        cover = compare_spots(found.spots.table[nearest], five, np.arange(5), truth, 650.0, 0.75)[0]
        assert not cover[[0, 2, 3, 4]].any()
        moved.append(away[1].min())
        claimed.append(cover[1])
    assert np.mean(moved) > 30.0 * 0.012  # of the noise
    assert 0.8 < np.mean(moved) / (math.sqrt(2.0) * np.mean(claimed)) < 1.25


def test_a_pose_of_a_covered_reflector_is_off_by_what_it_claims(three):
    """Of three, whose pose fits any three spots: nothing but the shape tells."""
    rng, nees = np.random.default_rng(2), []
    for _ in range(16):
        covers = {int(rng.integers(3)): (rng.uniform(0.0, 6.3), EDGE[0.2])}
        found, truth = reading(three, rng, covers)
        if found.pose is None:
            continue
        nees.append(squared_error(found, truth, truth @ HALF_TURN))
    assert len(nees) >= 12
    assert np.mean(nees) < 10.0  # 138 without


@pytest.mark.parametrize("range_m", [0.8, 1.5])
def test_a_disc_that_is_covered_by_a_third_is_found_near_by(three, range_m):
    """It is 0.2 smaller (ln) than its neighbours, which no triplet passes; its shape says so."""
    rng, right, poses = np.random.default_rng(3), 0, 0
    for _ in range(10):
        covers = {int(rng.integers(3)): (rng.uniform(0.0, 6.3), EDGE[0.35])}
        found, truth = reading(three, rng, covers, range_m, min(80.0 + 163.0 / range_m, 187.0))
        if found.pose is not None:
            poses += 1
            right += min(found.pose.angle_to(t) for t in (truth, truth @ HALF_TURN)) < 0.09
    assert right == poses >= 8


@pytest.mark.parametrize("range_m", [0.8, 3.0])
def test_a_half_covered_disc_of_three_is_tracked_and_off_by_what_its_pose_claims(three, range_m):
    """Its spot moves by up to 5 px, which the pose follows along a curve: 29 without that.

    Its rates do not follow: NEES 4.8 and 7.5 where the readings' errors count as white noise.
    """
    rng, values, of_rates = np.random.default_rng(6), [], []
    for _ in range(8):
        placed = plain.look_at(rng, PINHOLE, range_m, 0.5, min(80.0 + 163.0 / range_m, 187.0))
        sensor, which = ReflectorSensor(CAMERA, [three]), int(rng.integers(3))
        way, truth = rng.uniform(0.0, 6.3), Pose(*placed)
        for k, edge in enumerate([1.0, 1.0, *np.linspace(0.9, 0.0, 7)]):
            frames = frames_of(PINHOLE, three, truth, rng, covers={which: (way, edge)})
            found = sensor.update(0.1 * k, frames)
        if found.pose is None:
            continue
        values.append(squared_error(found, truth, truth @ HALF_TURN))
        rates = np.append(found.rates.turn_rad_s, found.rates.velocity_m_s)  # it is at rest
        of_rates.append(rates @ np.linalg.solve(found.rates.covariance, rates))
    assert len(values) >= 7
    assert np.mean(values) < 9.0
    assert np.mean(of_rates) < 3.0


def test_the_second_order_of_a_spot_grows_with_the_fourth_power_of_its_error(three):
    """Far off, no pose shows a spot: less is tried then, and nothing is left out."""
    rng = np.random.default_rng(8)

    def attitude(spots, pose, which, sigma_px):
        sigmas = np.full(3, 0.014)
        sigmas[which] = sigma_px
        found = SpotFit(CAMERA, three).fit(spots, np.arange(3), pose, sigmas)
        return None if found is None else np.trace(found.covariance[:3, :3])

    counts = []
    for range_m in (0.8, 1.5, 3.0, 6.0) * 4:
        pose = Pose(*plain.look_at(rng, PINHOLE, range_m, 0.7, min(80.0 + 163.0 / range_m, 187.0)))
        seen = predict_spots(CAMERA, three, pose), pose, int(rng.integers(3))
        near, far = attitude(*seen, 0.06), attitude(*seen, 0.12)  # of first order
        slope = (far - near) / (0.12**2 - 0.06**2)
        bent = []
        for sigma_px in (0.5, 4.0, 8.0):
            whole = attitude(*seen, sigma_px)
            if whole is not None:
                bent.append((whole - near - slope * (sigma_px**2 - 0.06**2)) / sigma_px**4)
        np.testing.assert_allclose(bent, bent[0], rtol=0.1)
        counts.append(len(bent))
    assert np.sum(counts) > 2.8 * len(counts)


def test_round_spots_keep_their_sizes():
    rows = np.zeros((5, COLUMNS))
    rows[:, SIZE], rows[:, LONG_X] = 4.0, [0.05, 0.02, -0.02, 0.0, 0.08]
    np.testing.assert_array_equal(uncovered_sizes(rows, 0.75), 4.0)
    rows[4, LONG_X] = 0.25
    sizes = uncovered_sizes(rows, 0.75)
    np.testing.assert_array_equal(sizes[:4], 4.0)
    assert 0.12 < math.log(sizes[4] / 4.0) < 0.25
    rows[2:, LONG_X] = np.nan  # saturated
    np.testing.assert_array_equal(uncovered_sizes(rows, 0.75), 4.0)


def test_discs_that_lean_alike_are_covered_by_nothing(five):
    rng = np.random.default_rng(3)
    for _ in range(8):
        found, truth = reading(five, rng, {})
        places = predict_spots(CAMERA, five, truth)
        away = np.linalg.norm(places[:, None] - found.spots.centroids_px, axis=2)
        rows = found.spots.table[away.argmin(axis=1)].copy()
        assert not compare_spots(rows, five, np.arange(5), truth, 650.0, 0.75)[0].any()
        rows[2, [LONG_X, LONG_XY]] = np.nan  # saturated
        assert not compare_spots(rows, five, np.arange(5), truth, 650.0, 0.75)[0].any()
        rows[1, LONG_X] += 0.1
        assert compare_spots(rows, five, np.arange(5), truth, 650.0, 0.75)[0][1] > 0.1


def test_an_edge_below_the_limit_counts_the_more_the_nearer_the_spot_is_to_it(five):
    rng = np.random.default_rng(9)
    found, truth = reading(five, rng, {}, 8.0)
    away = np.linalg.norm(
        predict_spots(CAMERA, five, truth)[:, None] - found.spots.centroids_px, axis=2
    )
    rows = found.spots.table[away.argmin(axis=1)].copy()
    claimed = []
    for more in np.arange(0.0, 0.12, 0.0005):
        changed = rows.copy()
        changed[1, LONG_X] = np.median(rows[:, LONG_X]) + more
        cover, unsure, _ = compare_spots(changed, five, np.arange(5), truth, 650.0, 0.75)
        assert not (cover * unsure).any()  # one or the other
        claimed.append(math.hypot(cover[1], unsure[1]))
    assert claimed[0] < 0.1 * rows[1, SIGMA]
    assert claimed[-1] > 8.0 * rows[1, SIGMA]
    assert (np.diff(claimed) >= -1e-3 * rows[1, SIGMA]).all()
    assert np.diff(claimed).max() < rows[1, SIGMA]  # no step


def test_the_light_of_a_spot_tells_whether_it_is_its_reflector(five):
    rng = np.random.default_rng(4)
    found, truth = reading(five, rng, {})
    away = np.linalg.norm(
        predict_spots(CAMERA, five, truth)[:, None] - found.spots.centroids_px, axis=2
    )
    rows = found.spots.table[away.argmin(axis=1)].copy()
    before, ago = rows[:, AMPLITUDE].copy(), np.zeros(5, np.int64)

    def compared(column, factor):
        changed = rows.copy()
        changed[3, column] *= factor
        return compare_spots(
            changed, five, np.arange(5), truth, 650.0, 0.75, brightness=before, aged=ago
        )  # fmt: skip

    cover, _, light = compared(SIZE, 1.0)
    assert not cover.any()
    assert light.sum() < 5.0  # of ten numbers, with generous σ
    for column in (SIZE, AMPLITUDE):
        cover, _, light = compared(column, 0.75)  # another light
        assert light[3] > 20.0
        assert not cover.any()
        cover, _, light = compared(column, 1.3)  # another light over it: its place is uncertain
        assert light.sum() < 5.0
        assert np.flatnonzero(cover).tolist() == [3]
    *_, aged = compare_spots(
        rows, five, np.arange(5), truth, 650.0, 0.75, brightness=0.8 * before[[0, 0, 0, 0, 0]],
        aged=np.full(5, 400),
    )  # fmt: skip
    assert aged.sum() < 5.0  # long ago tells little
    rows[3, SIGMA] = rows[3, SIZE]  # nor does a spot that hardly is one
    assert compared(AMPLITUDE, 0.75)[2][3] < 1.0


def test_middle_is_the_median_of_what_is_finite():
    rng = np.random.default_rng(5)
    for count in range(3, 9):
        values = rng.normal(size=count)
        assert middle(values) == pytest.approx(np.median(values))
        values[0] = np.nan
        if count > 3:
            assert middle(values) == pytest.approx(np.median(values[1:]))
    assert math.isnan(middle(np.array([1.0, 2.0, np.inf])))
