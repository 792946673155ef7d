"""Errors of the files' numbers in a pose's covariance, by cause; none is averaged away."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from tests.plain_readings import difference, squared_error

from rendezview.calibration.one_camera import camera_of_corners
from rendezview.fusion import Fusion
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.io.camera_files import load_camera, save_camera
from rendezview.io.target import Reflector, Target
from rendezview.sensors.beacons import SixNumbers, patterns_of, pose_of, predict_spots
from rendezview.sensors.beacons.budget import budget_of, budget_rows, common_of, unknown_causes
from rendezview.sensors.beacons.pose.refinement import SpotFit
from rendezview.sensors.beacons.tracker import ReflectorSensor
from rendezview.sensors.measurement import PoseMeasurement
from rendezview.sensors.observation import Status

SIX = SixNumbers(3.0, 0.05, -0.03, 0.2, 0.15, -0.25)
SIGMA = np.array([0.8, 0.7, 1.5, 1.2])  # px, of fx fy cx cy
MIX = np.eye(4) + 0.3 * np.eye(4, k=1)
COVARIANCE = SIGMA[:, None] * (MIX @ MIX.T) * SIGMA


def fitted(camera, pattern, spots, pose):
    return SpotFit(camera, pattern).fit(spots, np.arange(len(pattern)), pose, 0.02)


def test_the_camera_moves_a_pose_by_the_slope_of_the_fit(paper_camera, five):
    truth = pose_of(SIX, five)
    rng = np.random.default_rng(0)
    spots = predict_spots(paper_camera, five, truth) + rng.normal(0.0, 0.02, (5, 2))
    slopes = np.empty((6, 4))
    for k, name in enumerate(("fx", "fy", "cx", "cy")):
        ends = [
            fitted(replace(paper_camera, **{name: getattr(paper_camera, name) + step}), five,
                   spots, truth).camera_from_target
            for step in (0.01, -0.01)
        ]  # fmt: skip
        slopes[:, k] = difference(*ends) / 0.02
    known = replace(paper_camera, covariance=COVARIANCE.tolist())
    found, wanted = fitted(known, five, spots, truth), slopes @ COVARIANCE @ slopes.T
    np.testing.assert_allclose(found.shares[2], wanted, atol=1e-3 * wanted.max())
    plain = fitted(paper_camera, five, spots, truth)
    np.testing.assert_allclose(found.shares[:2], plain.shares[:2])
    assert not plain.shares[2:].any()
    np.testing.assert_allclose(found.covariance, plain.covariance + found.shares[2])
    np.testing.assert_allclose(found.scatter, plain.covariance)


def test_the_place_of_a_reflector_moves_a_pose_by_the_slope_of_the_fit(paper_camera, five):
    truth, sigmas = pose_of(SIX, five), np.array([0.0, 0.0, 1e-3, 5e-4, 0.0])
    spots = predict_spots(paper_camera, five, truth)
    loose = replace(five, sigmas_m=sigmas)
    wanted = np.zeros((6, 6))
    for k in (2, 3):
        for axis in range(3):
            step = np.zeros((5, 3))
            step[k, axis] = 1e-5
            ends = [
                fitted(paper_camera, replace(loose, positions_m=five.positions_m + sign * step),
                       spots, truth).camera_from_target
                for sign in (1.0, -1.0)
            ]  # fmt: skip
            slope = difference(*ends) / 2e-5 * sigmas[k]
            wanted += np.outer(slope, slope)
    found = fitted(paper_camera, loose, spots, truth)
    np.testing.assert_allclose(found.shares[3], wanted, atol=1e-3 * wanted.max())
    exact = fitted(paper_camera, five, spots, truth)
    assert np.trace(found.shares[3][3:, 3:]) > 0.0
    # What is mounted loosely counts less: the noise of the others counts more.
    assert np.trace(found.shares[0]) > np.trace(exact.shares[0])


def test_poses_with_a_wrong_camera_are_off_by_what_they_claim(paper_camera, five):
    rng, root, nees = np.random.default_rng(1), np.linalg.cholesky(COVARIANCE), []
    for _ in range(200):
        truth = pose_of(replace(SIX, roll_rad=rng.uniform(-3, 3), yaw_rad=rng.normal(0, 0.3)), five)
        numbers = np.array([652.0, 652.0, 255.5, 191.5]) + root @ rng.normal(size=4)
        exact = replace(paper_camera, fx=652.0, fy=652.0)
        spots = predict_spots(exact, five, truth) + rng.normal(0.0, 0.02, (5, 2))
        given = Camera(512, 384, *numbers.tolist(), covariance=COVARIANCE.tolist())
        found = fitted(given, five, spots, truth)
        off = difference(found.camera_from_target, truth)
        nees.append(off @ np.linalg.solve(found.covariance, off))
    assert 4.5 < np.mean(nees) < 7.0


def test_a_camera_of_corners_is_off_by_what_it_claims():
    rng, true = np.random.default_rng(2), Camera(640, 480, 620.0, 625.0, 322.0, 236.0)
    grid = np.stack(np.meshgrid(np.arange(9), np.arange(6)), axis=-1).reshape(-1, 2)
    board = np.column_stack([0.025 * (grid - grid.mean(axis=0)), np.zeros(len(grid))])
    nees = []
    for _ in range(25):
        corners = []
        while len(corners) < 12:
            turn = rng.uniform(-0.6, 0.6, 3)
            place = rng.uniform((-0.1, -0.08, 0.4), (0.1, 0.08, 0.6))
            seen = true.project(Pose.identity().perturbed([*turn, *place]).apply(board))
            if (seen > 5.0).all() and (seen < (635, 475)).all():
                corners.append(seen + rng.normal(0.0, 0.1, seen.shape))
        found, _ = camera_of_corners([board] * 12, corners, (640, 480))
        off = np.array([found.fx - 620.0, found.fy - 625.0, found.cx - 322.0, found.cy - 236.0,
                        *found.distortion])  # fmt: skip
        nees.append(off @ np.linalg.solve(np.array(found.covariance), off))
    assert 6.5 < np.mean(nees) < 12.0  # 9 is right


def test_a_camera_file_keeps_the_covariance(tmp_path):
    path = tmp_path / "camera.yaml"
    camera = Camera(640, 480, 620.0, 625.0, 322.0, 236.0, (0.1, 0.01, 0.0, 0.0, 0.02))
    matrix = np.diag([1.0, 1.1, 2.0, 2.1, 1e-4, 1e-3, 1e-6, 1e-6, 1e-2])
    matrix[0, 1] = matrix[1, 0] = 0.9
    save_camera(replace(camera, covariance=matrix.tolist()), path)
    read = load_camera(path)
    np.testing.assert_array_equal(read.covariance, matrix)
    np.testing.assert_allclose(read.sigma, np.sqrt(np.diag(matrix)))
    np.testing.assert_allclose(read.binned(2).sigma[:4], 0.5 * read.sigma[:4])
    np.testing.assert_array_equal(read.cropped(10, 10, 100, 100).covariance, matrix)
    save_camera(camera, path)
    assert load_camera(path).covariance is None
    text = path.read_text()
    path.write_text(text + "intrinsics_covariance: [0.5, 0.5, 1, 1]\n")
    np.testing.assert_array_equal(load_camera(path).sigma, [0.5, 0.5, 1.0, 1.0])
    path.write_text(text + "intrinsics_covariance: [0.5, 0.5]\n")
    with pytest.raises(Exception, match="covariance must be of 4 numbers"):
        load_camera(path)


def test_what_is_no_covariance_is_refused():
    with pytest.raises(ValueError, match="not negative"):
        Camera(64, 48, 60.0, 60.0, 31.5, 23.5, covariance=np.diag([1.0, -1, 1, 1]).tolist())
    with pytest.raises(ValueError, match="fx fy cx cy"):
        Camera(64, 48, 60.0, 60.0, 31.5, 23.5, covariance=np.eye(3).tolist())


def test_a_lens_that_is_known_only_by_its_sigma_moves_spots_at_the_rim(paper_camera, five):
    truth = pose_of(replace(SIX, range_m=1.0, azimuth_rad=0.25), five)
    spots = predict_spots(paper_camera, five, truth)
    sigma = np.diag([0.0] * 4 + [0.01**2, 0.0, 0.0, 0.0])
    bent = fitted(replace(paper_camera, covariance=sigma.tolist()), five, spots, truth)
    ends = [
        fitted(replace(paper_camera, distortion=(k1, 0.0, 0.0, 0.0)), five, spots, truth)
        for k1 in (1e-3, -1e-3)
    ]
    slope = difference(*(end.camera_from_target for end in ends)) * 0.01 / 2e-3
    np.testing.assert_allclose(
        bent.shares[2], np.outer(slope, slope), atol=0.02 * np.abs(slope).max() ** 2
    )


def test_a_reading_says_its_errors_by_cause_and_what_is_not_known(paper_camera, three, picture):
    rng = np.random.default_rng(4)
    known = replace(paper_camera, covariance=COVARIANCE.tolist())
    loose = replace(three, sigmas_m=np.full(3, 1e-4), sigmas_known=True)
    readings = []
    for camera, pattern in ((paper_camera, three), (known, loose)):
        sensor = ReflectorSensor(camera, [pattern])
        frames = picture(three, SIX, rng)
        readings.append([sensor.update(t, frames) for t in (0.0, 0.1, 0.2)][-1])
    plain, whole = readings
    assert plain.budget["camera"] is None
    assert plain.budget["places"] is None
    assert "intrinsics_covariance" in unknown_causes(plain.budget)
    assert unknown_causes(whole.budget) is None
    assert whole.budget["camera"].place_m > plain.budget["spots"].place_m
    np.testing.assert_allclose(whole.covariance - whole.common, whole.covariance - whole.common.T)
    record = whole.as_dict()
    assert set(record["budget"]) == {"spots", "light", "camera", "places", "cover"}
    assert np.array(record["common_covariance"]).shape == (6, 6)
    rows = budget_rows([plain.budget, whole.budget])
    assert [row[0] for row in rows] == ["spots", "light", "camera", "places", "cover", "all"]
    # The rates of a target at rest do not suffer from an error that never changes.
    assert np.trace(whole.rates.covariance) < 1.5 * np.trace(plain.rates.covariance)


def test_a_hundred_readings_leave_what_they_have_in_common():
    spots, camera = np.diag([1e-6] * 3 + [1e-6] * 3), np.diag([4e-6] * 3 + [9e-6, 9e-6, 9e-4])
    shares = {"spots": spots, "camera": camera, "places": None, "cover": spots}
    common = common_of(shares)
    np.testing.assert_array_equal(common, camera)
    assert budget_of(shares)["camera"].turn_rad == pytest.approx(np.sqrt(12e-6))
    pose = Pose.identity().perturbed([0.1, 0.0, 0.0, 0.0, 0.0, 5.0])
    ends = []
    for known in (None, common):
        fusion = Fusion()
        for k in range(100):
            fusion.add(PoseMeasurement(0.1 * k, "card", pose, spots + camera, known))
        ends.append(fusion.state_at(9.9).covariance[:6, :6])
    averaged, held = ends
    assert averaged[5, 5] < common[5, 5]
    assert np.linalg.eigvalsh(held - common)[0] > -1e-12
    assert (np.diag(held) < np.diag(spots + camera) * 1.001).all()


def test_a_target_file_gives_the_sigma_of_a_place(tmp_path):
    given = Reflector("a", "g", np.zeros(3), np.array([0.0, 0, 1]), 0.02, 1e-3)
    assert Reflector.of_record(given.record()).position_sigma_m == 1e-3
    old = {key: value for key, value in given.record().items() if key != "position_sigma_m"}
    assert Reflector.of_record(old).position_sigma_m is None
    text = "name = 't'\n"
    for name, place, more in (("a", [0, 0, 0], "0.001"), ("b", [1, 0, 0], "0.0"),
                              ("c", [0, 1, 0], "0.002")):  # fmt: skip
        text += (
            f"[[reflectors]]\nname = '{name}'\ngroup = 'g'\nposition_m = {place}\n"
            f"normal = [0, 0, 1]\ndiameter_m = 0.02\nposition_sigma_m = {more}\n"
        )
    (tmp_path / "target.toml").write_text(text)
    (pattern,) = patterns_of(Target.load(tmp_path / "target.toml"))
    np.testing.assert_array_equal(pattern.sigmas_m, [0.001, 0.0, 0.002])
    assert pattern.sigmas_known


def test_places_that_are_not_known_apart_leave_the_roll_open(three):
    off = np.array([[0.0, 0.0, 0.0], [8e-4, 5e-4, 1e-3], [0.0, 0.0, 0.0]])
    aside = replace(three, positions_m=three.positions_m + off)
    assert len(three.symmetries()) == 1
    assert aside.symmetries() == []
    assert replace(aside, sigmas_m=np.array([0.0, 1e-3, 0.0])).symmetries() == [(2, 1, 0)]
    larger = replace(aside, sigmas_m=np.full(3, 1e-3), diameters_m=np.array([0.025, 0.025, 0.026]))
    assert larger.symmetries() == []  # the third dot is another


def test_the_reflector_that_is_mounted_aside_is_named(paper_camera, five, picture):
    places = five.positions_m.copy()
    places[3, 0] += 3e-3
    mounted = replace(five, positions_m=places)
    frames = picture(mounted, pose_of(SIX, five), np.random.default_rng(6))
    reading = ReflectorSensor(paper_camera, [five]).update(0.0, frames)
    assert reading.status is Status.AMBIGUOUS
    assert "'top'" in reading.reason
    aside_mm = float(re.search(r"([\d.]+) mm aside", reading.reason)[1])
    assert aside_mm == pytest.approx(3.0, abs=0.3)
    # Stated in the file, it is an error like others.
    known = replace(five, sigmas_m=np.array([0.0, 0.0, 0.0, 3e-3, 0.0]), sigmas_known=True)
    sensor = ReflectorSensor(paper_camera, [known])
    found = [sensor.update(t, frames) for t in (0.0, 0.1)][-1]
    assert squared_error(found, pose_of(SIX, five)) < 25.0
