"""Closed form, Bales' iterations, least squares: each against the pose that made the spots."""

import json
from dataclasses import astuple, replace

import numpy as np
import pytest

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.sensors.beacons import SixNumbers, pose_of, predict_spots, six_numbers
from rendezview.sensors.beacons.closed_form import ClosedFormCalibration, calibrate, closed_form
from rendezview.sensors.beacons.pose.refinement import SpotFit
from rendezview.sensors.beacons.triangulation import (
    alternate_iteration,
    newton_raphson,
    pose_from_distances,
)

SIX = SixNumbers(4.0, 0.1, -0.08, 0.4, -0.2, 0.3)
DISTORTED = Camera(512, 384, 652.0, 648.0, 250.0, 195.0, (-0.2, 0.05, 1e-3, -5e-4, 0.01))


def test_six_numbers_and_the_pose_are_each_others_inverse(three):
    np.testing.assert_allclose(
        astuple(six_numbers(pose_of(SIX, three), three)), astuple(SIX), atol=1e-12
    )


def test_signs_of_the_six_numbers(three, paper_camera):
    def spots(**change):
        values = {
            "range_m": 3.0, "azimuth_rad": 0.0, "elevation_rad": 0.0,
            "roll_rad": 0.0, "pitch_rad": 0.0, "yaw_rad": 0.0,
        } | change  # fmt: skip
        return predict_spots(paper_camera, three, pose_of(SixNumbers(**values), three))

    left, post, right = spots()
    assert left[0] < post[0] < right[0]
    assert post == pytest.approx((255.5, 191.5))
    assert spots(azimuth_rad=0.1)[1, 0] > 260  # right
    assert spots(elevation_rad=0.1)[1, 1] < 187  # up
    assert spots(roll_rad=0.3)[2, 1] > 200  # clockwise: the right end goes down
    assert spots(yaw_rad=0.3)[1, 0] > 260  # the post's tip goes right
    assert spots(pitch_rad=0.3)[1, 1] > 196  # … and down


@pytest.mark.parametrize("camera", [DISTORTED, Camera(512, 384, 652.0, 652.0, 255.5, 191.5)])
@pytest.mark.parametrize("which", [[0, 1, 2], [0, 1, 2, 3, 4], [3, 1, 4], [0, 3, 4, 1]])
def test_least_squares_returns_to_the_pose_through_the_cameras_model(five, camera, which):
    truth = pose_of(SIX, five)
    spots = predict_spots(camera, five, truth)[which]
    start = truth.perturbed([0.05, -0.04, 0.03, 0.05, 0.02, -0.1])
    found = SpotFit(camera, five).fit(spots, np.array(which), start, 0.02)
    assert found is not None
    assert found.camera_from_target.angle_to(truth) < 1e-9
    np.testing.assert_allclose(
        found.camera_from_target.translation_m, truth.translation_m, rtol=1e-9
    )


def test_covariance_is_the_scatter_of_the_poses(three, paper_camera):
    rng = np.random.default_rng(0)
    # A target frame far from the reflectors: rotation and translation are then correlated.
    shifted = type(three)(
        "far",
        three.names,
        three.positions_m + np.array([1.0, -2.0, 0.5]),
        three.normals,
        three.diameters_m,
    )
    truth = pose_of(SIX, shifted)
    spots = predict_spots(paper_camera, shifted, truth)
    steps = []
    for _ in range(400):
        noisy = spots + rng.normal(0.0, 0.02, spots.shape)
        found = SpotFit(paper_camera, shifted).fit(noisy, np.arange(3), truth, 0.02)
        d = found.camera_from_target.rotation @ truth.rotation.T
        turn = 0.5 * np.array([d[2, 1] - d[1, 2], d[0, 2] - d[2, 0], d[1, 0] - d[0, 1]])
        steps.append([*turn, *(found.camera_from_target.translation_m - truth.translation_m)])
    scatter = np.cov(np.array(steps).T)
    told = SpotFit(paper_camera, shifted).fit(spots, np.arange(3), truth, 0.02).covariance
    whiten = np.linalg.inv(np.linalg.cholesky(told))
    np.testing.assert_allclose(np.linalg.eigvalsh(whiten @ scatter @ whiten.T), 1.0, atol=0.35)


def test_a_tilted_disc_is_not_seen_at_its_centre(three, paper_camera):
    near = pose_of(SixNumbers(1.0, 0.0, 0.0, 0.0, 0.0, 0.5), three)
    middle = paper_camera.project(near.apply(three.positions_m))
    assert np.abs(predict_spots(paper_camera, three, near) - middle).max() > 0.03


def test_spots_behind_the_camera_give_no_pose(three, paper_camera):
    spots = predict_spots(paper_camera, three, pose_of(SIX, three))
    fit, behind = SpotFit(paper_camera, three).fit, Pose(np.eye(3), np.array([0, 0, -3.0]))
    assert fit(spots, np.arange(3), behind, 0.02) is None
    assert fit(spots[:2], np.arange(2), pose_of(SIX, three), 0.02) is None


@pytest.mark.parametrize("tilt", [0.0, 0.1, 0.5])
def test_newton_raphson_finds_the_distances(three, tilt):
    pose = pose_of(SixNumbers(5.0, 0.05, -0.1, 0.3, -tilt, tilt / 2), three)
    order = [1, 0, 2]  # tip, left, right
    seen = pose.apply(three.positions_m[order])
    found = newton_raphson(seen, 0.3683, 0.1016)
    assert found.converged
    assert found.iterations < 10
    np.testing.assert_allclose(found.distances_m, np.linalg.norm(seen, axis=1), rtol=1e-10)
    again = pose_from_distances(seen, found.distances_m, three.positions_m[order])
    assert again.angle_to(pose) < 1e-8


def test_the_alternate_iteration_converges_in_most_cases_and_says_where_not(three):
    rng = np.random.default_rng(1)
    right = 0
    for _ in range(200):
        pitch, yaw = rng.uniform(-0.06, 0.06, 2)
        pose = pose_of(SixNumbers(rng.uniform(1.0, 3.0), 0.0, 0.0, 0.0, pitch, yaw), three)
        seen = pose.apply(three.positions_m[[1, 0, 2]])
        found = alternate_iteration(seen, 0.3683, 0.1016)
        close = np.allclose(found.distances_m, np.linalg.norm(seen, axis=1), rtol=1e-6)
        right += found.converged and close
        assert close or not found.converged
    assert right > 190


def test_iterations_refuse_wrong_input():
    with pytest.raises(ValueError, match="rays"):
        newton_raphson(np.full((3, 3), np.nan), 1.0, 1.0)
    with pytest.raises(ValueError, match="longer than 0"):
        newton_raphson(np.eye(3), 0.0, 1.0)


def test_the_closed_form_is_exact_far_away_and_head_on(three, paper_camera):
    far = SixNumbers(400.0, 0.0, 0.0, 0.5, 0.3, -0.4)
    spots = predict_spots(paper_camera, three, pose_of(far, three))
    found = closed_form(paper_camera, three, spots)
    np.testing.assert_allclose(astuple(found)[3:], astuple(far)[3:], atol=1e-3)
    assert found.range_m == pytest.approx(400.0, rel=1e-3)
    ahead = SixNumbers(3.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    found = closed_form(
        paper_camera, three, predict_spots(paper_camera, three, pose_of(ahead, three))
    )
    np.testing.assert_allclose(astuple(found), astuple(ahead), atol=1e-4)


def test_calibration_brings_the_closed_form_within_a_percent_and_a_degree(
    three, paper_camera, tmp_path
):
    def run(seed, count):
        rng = np.random.default_rng(seed)
        for _ in range(count):
            six = SixNumbers(
                rng.uniform(1.5, 12.0), *rng.uniform(-0.1, 0.1, 2), rng.uniform(-1, 1),
                *rng.uniform(-0.35, 0.35, 2),
            )  # fmt: skip
            spots = predict_spots(paper_camera, three, pose_of(six, three))
            yield spots + rng.normal(0.0, 0.013, spots.shape), six

    fitted = calibrate(paper_camera, three, run(0, 200))
    fitted.save(tmp_path / "c.json")
    assert ClosedFormCalibration.load(tmp_path / "c.json") == fitted

    def errors(constants):
        return np.array(
            [
                np.abs(
                    np.subtract(
                        astuple(closed_form(paper_camera, three, spots, constants)), astuple(six)
                    )
                )
                / [six.range_m / 100, *([np.pi / 180] * 5)]
                for spots, six in run(1, 300)
            ]
        )

    before, after = errors(None), errors(fitted)
    assert np.quantile(after, 0.95, axis=0).max() < 1.0
    assert np.quantile(before, 0.95, axis=0).max() > 2.0


def test_a_calibration_on_a_straight_approach_is_no_worse_than_none(three, paper_camera):
    def run(seed, tilted):
        rng = np.random.default_rng(seed)
        for range_m in np.linspace(8.0, 5.0, 60):
            bearing = rng.normal([0.0, 0.95 / range_m], 0.005)
            tilt = rng.uniform(-0.35, 0.35, 2) if tilted else np.zeros(2)
            six = SixNumbers(range_m, *bearing, 0.0, *tilt)
            spots = predict_spots(paper_camera, three, pose_of(six, three))
            yield spots + rng.normal(0.0, 0.02, spots.shape), six

    def worst(constants):
        errors = [
            np.abs(
                np.subtract(
                    astuple(closed_form(paper_camera, three, spots, constants)), astuple(six)
                )
            )
            for spots, six in run(1, tilted=True)
        ]
        return np.max(errors, axis=0)[4:].max()  # of pitch and yaw

    assert worst(calibrate(paper_camera, three, run(0, tilted=False))) < 1.2 * worst(None)


def test_calibration_files_and_runs_that_cannot_work_are_told(three, paper_camera, five, tmp_path):
    (tmp_path / "c.json").write_text(json.dumps({"c5_m": 0.1, "c99": 1}))
    with pytest.raises(RendezviewError, match="c99: "):
        ClosedFormCalibration.load(tmp_path / "c.json")
    with pytest.raises(RendezviewError, match="needs 12 readings"):
        calibrate(paper_camera, three, [])
    spots = predict_spots(paper_camera, three, pose_of(SIX, three))
    with pytest.raises(RendezviewError, match="does not vary"):
        calibrate(paper_camera, three, [(spots, SIX)] * 20)
    assert closed_form(paper_camera, five, spots) == closed_form(paper_camera, three, spots)
    aside = np.add(three.positions_m, [[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.0, 0.0]])
    corner = replace(three, positions_m=aside)
    with pytest.raises(ValueError, match="on a post"):
        closed_form(paper_camera, corner, spots)
    assert closed_form(paper_camera, three, spots[[0, 0, 0]]) is None
