"""Poses next to a prior where the target overflows the picture, on views of its near part."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.ground.mesh.docking_face import RING, docking_mesh
from tests.quick_training import REFINING

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.sensors.appearance import Recognizer, Tracker, ViewModel
from rendezview.sensors.appearance.edges.lit_inliers import lit_inliers
from rendezview.sensors.appearance.edges.predicted import (
    COLUMNS,
    FOUND,
    NOT_FOUND,
    RESIDUAL,
    STATE,
    U,
    V,
)
from rendezview.sensors.appearance.search.close import CloseSearch
from rendezview.sensors.observation import Status
from rendezview_ground.learn.job import train
from rendezview_ground.simulate import SceneOptions, render_frame, sun_at_phase

CAMERA = Camera(640, 640, 500.0, 500.0, 319.5, 319.5)


@pytest.fixture(scope="module")
def mesh():
    return docking_mesh()


@pytest.fixture(scope="module")
def model(tmp_path_factory, mesh) -> ViewModel:
    path = tmp_path_factory.mktemp("docking") / "docking.rvm"
    options = replace(REFINING, order=1, contour_radii=(1.0,), sketches=False, forest_trees=0)
    train(mesh, path, name="docking", options=options, docking_ring=RING, jobs=1)
    return ViewModel.load(path)


def before(range_m: float, roll_deg: float = 20.0) -> Pose:
    """A camera before the ring, a little off its axis."""
    facing = Rotation.from_euler("xyz", [180.0 + 1.5, 2.0, roll_deg], degrees=True).as_matrix()
    centre = np.array([0.01, -0.02, 1.0]) * range_m
    return Pose(facing, centre - facing @ RING.centre_m)


def off(pose: Pose, degrees: float, share: float) -> Pose:
    """The pose turned about the ring's centre, and moved by a share of the range."""
    turn = Rotation.from_rotvec(np.deg2rad(degrees) * np.array([0.6, -0.64, 0.48])).as_matrix()
    rotation, centre = turn @ pose.rotation, pose.apply(RING.centre_m)
    centre = centre + share * centre[2] * np.array([0.6, 0.0, 0.8])
    return Pose(rotation, centre - rotation @ RING.centre_m)


def frame_of(mesh, pose: Pose) -> np.ndarray:
    rng = np.random.default_rng(3)
    sun = sun_at_phase(pose.apply(RING.centre_m), np.deg2rad(35.0), 0.8)
    return render_frame(mesh, CAMERA, pose, sun, SceneOptions(), rng)


@pytest.mark.parametrize("range_m", [4.0, 2.5, 1.5, 1.2])
def test_a_part_of_the_target_gives_the_pose(mesh, model, range_m):
    truth = before(range_m)
    frame = frame_of(mesh, truth)
    seen = Recognizer(model, CAMERA).recognize(frame, off(truth, 0.5, 0.005))
    assert seen.status is Status.OK
    assert seen.pose.angle_to(truth) < np.deg2rad(0.15)
    centre = seen.pose.apply(RING.centre_m) - truth.apply(RING.centre_m)
    assert np.linalg.norm(centre) < 1e-3 * range_m
    error = np.concatenate(
        [
            Rotation.from_matrix(seen.pose.rotation @ truth.rotation.T).as_rotvec(),
            seen.pose.translation_m - truth.translation_m,
        ]
    )
    assert error @ np.linalg.solve(seen.covariance, error) < 22.5  # χ² of 6: 1 in 1000
    without = Recognizer(replace(model, near=()), CAMERA).recognize(frame, off(truth, 0.5, 0.005))
    assert without.pose is None


def test_a_ring_alone_tells_no_roll(mesh, model):
    """Its facets fit at every few degrees; on a flight that was taken for a sudden turn."""
    truth = before(0.95)
    assert Recognizer(model, CAMERA).recognize(frame_of(mesh, truth), truth).pose is None


def test_a_prior_that_is_far_off_and_an_empty_frame_give_no_pose(mesh, model):
    truth = before(2.0)
    close = Recognizer(model, CAMERA)
    assert close.recognize(frame_of(mesh, truth), off(truth, 12.0, 0.0)).pose is None
    noise = np.random.default_rng(1).normal(8.0, 2.0, (640, 640)).clip(0, 255).astype(np.uint8)
    assert close.recognize(noise, truth).pose is None
    boxes = np.kron(np.random.default_rng(2).integers(0, 256, (40, 40)), np.ones((16, 16)))
    assert close.recognize(boxes.astype(np.uint8), truth).pose is None


def test_a_prior_that_is_a_tenth_nearer_or_farther_is_enough(mesh, model):
    truth = before(2.5)
    recognizer, frame = Recognizer(model, CAMERA), frame_of(mesh, truth)

    def seen_from(share: float) -> Pose | None:
        away = share * truth.apply(RING.centre_m)
        return recognizer.recognize(frame, Pose(truth.rotation, truth.translation_m + away)).pose

    for share in (-0.1, 0.1):
        pose = seen_from(share)
        assert pose is not None, share
        assert pose.angle_to(truth) < np.deg2rad(0.15)
    assert seen_from(0.5) is None


def test_the_spheres_serve_where_their_views_are(model):
    close = CloseSearch(model, CAMERA)
    large, small = (sphere.radius_m for sphere in model.near)
    for range_m, radius_m in ((1.4 * large, large), (1.4 * small, small), (0.6 * small, small)):
        assert close.refiner(before(range_m)).sphere.radius_m == radius_m
    assert close.refiner(before(3.0 * large)) is None
    aside = before(2.0)
    turned = aside.rotation @ Rotation.from_rotvec([0.7, 0.0, 0.0]).as_matrix()
    assert close.refiner(Pose(turned, aside.apply(RING.centre_m) - turned @ RING.centre_m)) is None
    assert close.refiner(Pose(np.eye(3), np.array([0.0, 0.0, -2.0]))) is None  # behind


def test_a_tracker_flies_in_to_the_ring(mesh, model):
    tracker = Tracker(Recognizer(model, CAMERA), prior=off(before(5.0), 0.5, 0.005))
    for k, range_m in enumerate(np.linspace(5.0, 1.25, 9)):
        truth = before(range_m, roll_deg=20.0 + 0.3 * k)
        seen = tracker.update(float(k), frame_of(mesh, truth))
        assert seen.status is Status.OK, (range_m, seen.reason)
        assert seen.pose.angle_to(truth) < np.deg2rad(0.25)


def test_where_the_target_overflows_nothing_is_searched_in_vain(mesh, model, monkeypatch):
    """A near frame that fits no prior is refused at once, however often."""
    recognizer = Recognizer(model, CAMERA)

    def searched(*_: object, **__: object) -> None:
        raise AssertionError("a search for the whole target")

    for name in ("near", "anywhere", "proposed"):
        monkeypatch.setattr(recognizer.search, name, searched)
    tracker = Tracker(recognizer, prior=off(before(2.0), 15.0, 0.0))
    for k in range(5):
        seen = tracker.update(float(k), frame_of(mesh, before(2.0)))
        assert seen.status in (Status.BORDER, Status.FULL)
        assert seen.pose is None


def test_a_model_file_keeps_its_near_spheres(model, tmp_path):
    model.save(tmp_path / "again.rvm")
    again = ViewModel.load(tmp_path / "again.rvm")
    assert len(model.near) == len(again.near) == 2
    for one, other in zip(model.near, again.near, strict=True):
        assert one.radius_m == other.radius_m
        assert np.array_equal(one.contours.point, other.contours.point)
        assert np.array_equal(one.directions, other.directions)


def test_a_wing_in_the_dark_does_not_count_against_a_pose():
    """Points without an edge count where the picture is lit, not where the Sun does not reach."""
    image = np.full((100, 100), 4, np.uint8)
    image[:, :50] = 150
    edges = np.zeros((4, COLUMNS))
    edges[:, STATE] = [FOUND, FOUND, NOT_FOUND, NOT_FOUND]
    edges[:, (U, V)] = [[20.0, 20.0], [20.0, 60.0], [30.0, 50.0], [80.0, 50.0]]
    assert lit_inliers(edges, image, 3.0) == (pytest.approx(2.0 / 3.0), 3)
    edges[:2, RESIDUAL] = 30.0
    assert lit_inliers(edges, image, 3.0) == (pytest.approx(0.0), 3)
    edges[:, STATE] = NOT_FOUND
    assert lit_inliers(edges, image, 3.0) == (0.0, 4)
