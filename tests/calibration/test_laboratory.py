"""Calibration against simulated truth, against OpenCV on real pictures, and its files."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.plain_laboratory import rotation_of, write_record

from rendezview.calibration.board import BoardViews, Chessboard, calibrate_board
from rendezview.calibration.board import read_board_views as read_views
from rendezview.calibration.laboratory import (
    EVERYTHING,
    LaboratoryCalibration,
    LaboratoryRecord,
    calibrate_laboratory,
)
from rendezview.calibration.laboratory_files import load_record
from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.sensors.beacons import Lens, Rig, RigCamera, Spots, StereoTracker
from rendezview.sensors.beacons.match.agreement import LightsFit, difference
from rendezview.sensors.beacons.readings import picture_pairs
from rendezview.sensors.beacons.rig import INTRINSICS, POSE, intrinsics_of
from rendezview.sensors.beacons.rig_files import load_rig, save_opencv, save_rig
from rendezview_ground.simulate.led_laboratory import Laboratory, LaboratoryOptions
from rendezview_ground.simulate.led_pictures import PictureOptions, picture_rig

DATA = os.environ.get("RENDEZVIEW_TEST_DATA", "")
needs = pytest.mark.skipif(not DATA, reason="RENDEZVIEW_TEST_DATA is not set")
BOARD = Chessboard(9, 6, 0.025)
LENSES = (
    Lens((-0.25, 0.08, 0.0), (0.001, -0.002, 0.0), corrects=False),
    Lens((-0.22, 0.05, 0.0), (-0.001, 0.001, 0.0), corrects=False),
)


@pytest.fixture(scope="module")
def truth(leds: np.ndarray) -> Laboratory:
    return Laboratory(leds, LaboratoryOptions(), seed=51)


@pytest.fixture(scope="module")
def record(truth: Laboratory) -> LaboratoryRecord:
    return truth.calibration(np.random.default_rng(51), scans=30)


@pytest.fixture(scope="module")
def made(record: LaboratoryRecord) -> LaboratoryCalibration:
    return calibrate_laboratory(record)


def test_the_laboratorys_truth_is_recovered_within_the_reported_uncertainty(truth, made):
    scores = []
    for found, true in zip(made.rig.cameras, truth.rig.cameras, strict=True):
        error = dict(zip(INTRINSICS, intrinsics_of(found) - intrinsics_of(true), strict=True))
        error["f"] = error["fx"]
        a, b = found.camera_from_rig, true.camera_from_rig
        moved = difference(a.rotation, a.translation_m, b.rotation, b.translation_m)
        error |= dict(zip(POSE, moved, strict=True))
        scores += [error[name] / found.sigma[name] for name in (*EVERYTHING, *POSE)]
    assert np.abs(scores).max() < 4.0
    assert 0.5 < np.sqrt(np.mean(np.square(scores))) < 1.6
    assert 0.9 < made.together.chi2 / made.together.spare < 1.1


def test_every_step_leaves_less_than_it_found(made):
    assert len(made.steps) == 7
    for step in made.steps:
        assert step.after_m < step.before_m


def test_the_calibrated_rig_tracks(truth, made, scole, read):
    rng = np.random.default_rng(3)
    tracker = StereoTracker.of_target(made.rig, scole)
    pose = Pose(rotation_of(1.0, 0.1, 0.2), [0.02, 0.0, 0.1])
    for k, reading in enumerate(truth.currents([pose] * 20, rng)):
        observation = tracker.update(float(k), read(made.rig, reading))
        assert observation.fit is not None, observation.reason
        assert observation.fit.left_out == ()


def test_a_record_and_a_rig_survive_their_files(tmp_path: Path, record, made):
    write_record(record, tmp_path / "record.json")
    back = load_record(tmp_path / "record.json")
    assert back.cameras[0].scan == pytest.approx(record.cameras[0].scan, abs=1e-9)
    assert back.views[0].currents[1] is None
    assert back.views[5].rig_from_plate.rotation == pytest.approx(
        record.views[5].rig_from_plate.rotation
    )
    save_rig(made.rig, tmp_path / "rig.json")
    rig = load_rig(tmp_path / "rig.json")
    assert rig.covariance == pytest.approx(made.rig.covariance)
    for one, other in zip(rig.cameras, made.rig.cameras, strict=True):
        assert intrinsics_of(one).tolist() == intrinsics_of(other).tolist()
        assert one.camera_from_rig.rotation == pytest.approx(other.camera_from_rig.rotation)
        assert one.photodiode.response.coefficients == pytest.approx(
            other.photodiode.response.coefficients, rel=1e-15
        )
        assert (one.sigma, one.floor, one.rms) == (other.sigma, other.floor, other.rms)
        assert one.misfit == other.misfit


def test_a_record_without_what_it_needs_is_refused(record):
    unsurveyed = replace(record, views=record.views[:2])
    with pytest.raises(RendezviewError, match="surveyed"):
        calibrate_laboratory(unsurveyed)
    blind = replace(record, views=record.views[2:])
    with pytest.raises(RendezviewError, match="for its lens"):
        calibrate_laboratory(blind)
    dark = [replace(one, principal_beam=np.zeros((5, 4))) for one in record.cameras]
    with pytest.raises(RendezviewError, match="beam"):
        calibrate_laboratory(replace(record, cameras=tuple(dark)))


def simulated_views(noise_px: float, seed: int) -> tuple[BoardViews, Rig]:
    """Corners of a board in two cameras whose truth is known."""
    rng = np.random.default_rng(seed)
    right = Pose(rotation_of(0.01, -0.05, 0.02), [-0.1, 0.002, 0.001])
    rig = Rig(
        tuple(
            RigCamera(name, 530.0 + k, 531.0, 322.0, 238.0, pose, LENSES[k], (640, 480))
            for k, (name, pose) in enumerate((("left", Pose.identity()), ("right", right)))
        )
    )
    points = BOARD.points_m - BOARD.points_m.mean(axis=0)
    corners: list[list[np.ndarray]] = [[], []]
    for _ in range(14):
        place = Pose(rotation_of(*rng.uniform(-0.5, 0.5, 3)),
                     [*rng.uniform(-0.04, 0.04, 2), rng.uniform(0.35, 0.5)])  # fmt: skip
        for k, camera in enumerate(rig.cameras):
            seen = camera.project(place.apply(points))
            corners[k].append(seen + rng.normal(0.0, noise_px, seen.shape))
    views = BoardViews(BOARD, ("left", "right"), ((640, 480),) * 2, tuple(map(tuple, corners)))
    return views, rig


def test_two_picture_cameras_are_recovered_within_the_reported_uncertainty():
    views, truth = simulated_views(0.1, 61)
    made = calibrate_board(views)
    scores = []
    for k, (found, true) in enumerate(zip(made.rig.cameras, truth.cameras, strict=True)):
        error = dict(zip(INTRINSICS, intrinsics_of(found) - intrinsics_of(true), strict=True))
        if k == 1:
            a, b = found.camera_from_rig, true.camera_from_rig
            moved = difference(a.rotation, a.translation_m, b.rotation, b.translation_m)
            error |= dict(zip(POSE, moved, strict=True))
        scores += [error[name] / sigma for name, sigma in found.sigma.items()]
    assert len(scores) == 24
    assert np.abs(scores).max() < 4.0
    assert 0.5 < np.sqrt(np.mean(np.square(scores))) < 1.6
    assert made.together.rms == pytest.approx(0.1 * np.sqrt(2.0), rel=0.05)


def test_a_view_that_one_camera_misses_still_counts():
    views, _ = simulated_views(0.1, 62)
    fewer = ((*views.corners[0][:-1], None), (None, *views.corners[1][1:]))
    made = calibrate_board(replace(views, corners=fewer))
    assert len(made.together.bundle.views) == 14
    never = (views.corners[0][:7] + (None,) * 7, (None,) * 7 + views.corners[1][7:])
    with pytest.raises(RendezviewError, match="together"):
        calibrate_board(replace(views, corners=never))


def test_the_rig_goes_to_opencv_and_back(tmp_path: Path):
    _, truth = simulated_views(0.0, 63)
    save_opencv(truth, tmp_path / "stereo.yaml")
    storage = cv2.FileStorage(str(tmp_path / "stereo.yaml"), cv2.FILE_STORAGE_READ)
    assert storage.getNode("M2").mat()[0, 0] == 531.0
    assert storage.getNode("T").mat().ravel() == pytest.approx([-0.1, 0.002, 0.001])
    back = load_rig(tmp_path / "stereo.yaml")
    points = np.random.default_rng(1).uniform([-0.1, -0.1, 0.4], [0.1, 0.1, 0.6], (50, 3))
    for one, other in zip(back.cameras, truth.cameras, strict=True):
        assert one.project(points) == pytest.approx(other.project(points), abs=1e-9)


@pytest.mark.parametrize(
    "text",
    ["", "[]", "{}", "{\"format\": 1}", "M1: 3", "%YAML:1.0\nM1: [1]\n", "\x00\x01"],
)  # fmt: skip
def test_what_is_no_rig_file_is_refused(tmp_path: Path, text: str):
    path = tmp_path / "rig.json"
    path.write_text(text)
    with pytest.raises(RendezviewError, match=r"rig\.json"):
        load_rig(path)


def test_a_rig_file_with_a_wrong_number_names_it(tmp_path: Path, laboratory):
    path = tmp_path / "rig.json"
    save_rig(laboratory.rig, path)
    content = json.loads(path.read_text())
    content["cameras"][1]["fx"] = -1.0
    path.write_text(json.dumps(content))
    with pytest.raises(RendezviewError, match=r"cameras\.1\.fx"):
        load_rig(path)
    with pytest.raises(RendezviewError, match="photodiode"):
        save_opencv(laboratory.rig, tmp_path / "no.yaml")
    assert not (tmp_path / "no.yaml").exists()


@needs
def test_real_pairs_are_calibrated_at_least_as_well_as_by_opencv():
    views = read_views(picture_pairs(Path(DATA) / "opencv_stereo"), BOARD)
    made = calibrate_board(views)
    boards = [BOARD.points_m.astype(np.float32)] * 13
    for k, (one, published) in enumerate(zip(made.separate, (0.1955, 0.2075), strict=True)):
        corners = [found.astype(np.float32) for found in views.corners[k]]
        rms = cv2.calibrateCamera(boards, corners, views.sizes[k], None, None)[0]
        assert one.rms <= rms + 1e-6
        assert one.rms < published
    relative = made.rig.cameras[1].camera_from_rig
    assert np.linalg.norm(relative.translation_m) == pytest.approx(0.0833, abs=0.0005)


@needs
def test_minervas_poses_come_from_one_picture():
    folder = Path(DATA) / "minerva2"
    points = np.loadtxt(folder / "MinervaII2_Vertices.txt", delimiter=",")
    focal = 512.0 / np.tan(0.5 * np.deg2rad(68.89))
    camera = Camera(1024, 1024, focal, focal, 512.0, 512.0)
    rig = Rig((RigCamera.from_camera("camera", camera, Pose.identity()),))
    tracker = StereoTracker(rig, points)
    frames = json.loads((folder / "Tumble_annotations.json").read_text())
    assert len(frames) == 300
    for frame in frames:
        seen = np.array(frame["joints"])
        spots = Spots(seen, np.full(seen.shape, 0.02), np.arange(16))
        found = tracker.locate(rig.sights([spots], 16))
        assert isinstance(found, LightsFit)
        pose = Pose(found.rotation, found.translation)
        left = camera.project(pose.apply(points)) - seen
        assert np.sqrt((left**2).sum(axis=1).mean()) < 0.02
        truth = Pose.from_quat_wxyz(frame["pose"][:4], frame["pose"][4:])
        assert pose.angle_to(truth) < 1e-5


def test_a_picture_rig_knows_its_field(laboratory):
    rig = picture_rig(laboratory, PictureOptions())
    assert rig.cameras[0].reach == pytest.approx(0.2, rel=0.01)
    assert np.isnan(rig.cameras[0].project([[0.0, 0.0, -100.0]])).all()
