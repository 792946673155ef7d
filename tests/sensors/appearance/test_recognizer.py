"""Poses from drawn frames, against the truth they were drawn from."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.geometry.geodesic import angle_between
from rendezview.geometry.pose import Pose
from rendezview.sensors.appearance import AppearanceObservation, Recognizer
from rendezview.sensors.appearance.model.signature import Signature
from rendezview.sensors.appearance.outline.placement import range_from_area
from rendezview.sensors.appearance.outline.votes import Matcher
from rendezview.sensors.observation import Status
from rendezview_ground.learn.job import train
from rendezview_ground.mesh.mesh import Mesh

POSES = 16
# The model is a sphere of 162 nodes, 17° apart: these are its errors, not the method's.
MEDIAN_DEG, WORST_DEG = 6.0, 20.0


def some_pose(rng: np.random.Generator, model, off_boresight: bool = True) -> Pose:
    rotation = Rotation.random(random_state=rng).as_matrix()
    range_m = model.sphere_radius_m * rng.uniform(1.5, 2.5)
    bearing = rng.uniform(-0.1, 0.1, 2) if off_boresight else np.zeros(2)
    line = np.array([*bearing, 1.0])
    centre = range_m * line / np.linalg.norm(line)
    return Pose(rotation, centre - rotation @ model.centre_m)


def tilted(pose: Pose, rng: np.random.Generator, angle_deg: float) -> Pose:
    axis = rng.normal(size=3)
    axis *= np.deg2rad(angle_deg) / np.linalg.norm(axis)
    return Pose(Rotation.from_rotvec(axis).as_matrix() @ pose.rotation, pose.translation_m)


def errors(
    model, observation: AppearanceObservation, truth: Pose
) -> tuple[float, float, float, float]:
    """Direction and roll (degrees), range (fraction), bearing (degrees)."""
    assert observation.status is Status.OK, observation.reason
    pose = observation.pose
    true_centre, centre = truth.apply(model.centre_m), pose.apply(model.centre_m)
    line = true_centre / np.linalg.norm(true_centre)
    turn = Rotation.from_matrix(pose.rotation @ truth.rotation.T).as_rotvec()
    roll = float(turn @ line)
    return (
        float(np.rad2deg(np.linalg.norm(turn - roll * line))),
        float(np.rad2deg(abs(roll))),
        float(abs(np.linalg.norm(centre) / np.linalg.norm(true_centre) - 1.0)),
        float(np.rad2deg(angle_between(centre / np.linalg.norm(centre), line))),
    )


def all_errors(model, camera, mesh, draw, seed: int, prior_deg: float | None) -> np.ndarray:
    rng = np.random.default_rng(seed)
    recognizer = Recognizer(model, camera)
    rows = []
    for _ in range(POSES):
        truth = some_pose(rng, model)
        prior = None if prior_deg is None else tilted(truth, rng, prior_deg)
        observation = recognizer.recognize(draw(mesh, truth, camera, rng), prior)
        if observation.status is Status.OK:
            rows.append(errors(model, observation, truth))
        else:
            assert observation.status in (Status.AMBIGUOUS, Status.UNRECOGNIZED), observation.reason
            assert observation.reason
            assert observation.pose is None
    return np.array(rows)


@pytest.mark.requirement("RV-REC-1")
@pytest.mark.parametrize("prior_deg", [0.0, 20.0])
def test_poses_are_near_the_truth_from_a_prior_20_degrees_off(
    tiny_model, camera, bumpy_mesh, draw, prior_deg
):
    found = all_errors(tiny_model, camera, bumpy_mesh, draw, 1, prior_deg)
    assert len(found) >= 0.85 * POSES
    median, worst = np.median(found, axis=0), found.max(axis=0)
    assert median[0] < MEDIAN_DEG
    assert worst[0] < WORST_DEG
    assert median[1] < 2.0
    assert worst[1] < 8.0
    assert median[2] < 0.03
    assert worst[2] < 0.10
    assert median[3] < 0.45
    assert worst[3] < 1.0


def test_poses_are_near_the_truth_without_any_prior(tiny_model, camera, bumpy_mesh, draw):
    found = all_errors(tiny_model, camera, bumpy_mesh, draw, 2, None)
    assert np.mean(found[:, 0] < WORST_DEG) >= 0.75  # others have a double from another side
    assert len(found) >= 0.4 * POSES
    assert np.median(found[:, 0]) < MEDIAN_DEG
    assert np.median(found[:, 2]) < 0.03


def test_the_covariance_is_symmetric_positive_definite_and_of_the_size_of_the_errors(
    tiny_model, camera, bumpy_mesh, draw
):
    rng = np.random.default_rng(3)
    recognizer = Recognizer(tiny_model, camera)
    squares = []
    for _ in range(40):
        truth = some_pose(rng, tiny_model)
        observation = recognizer.recognize(draw(bumpy_mesh, truth, camera, rng), truth)
        if observation.status is not Status.OK:
            continue
        covariance = observation.covariance
        assert covariance.shape == (6, 6)
        assert np.allclose(covariance, covariance.T, rtol=1e-12, atol=0.0)
        assert np.linalg.eigvalsh(covariance).min() > 0.0
        turn = Rotation.from_matrix(observation.pose.rotation @ truth.rotation.T).as_rotvec()
        error = np.concatenate([turn, observation.pose.translation_m - truth.translation_m])
        squares.append(error @ np.linalg.solve(covariance, error))
    assert len(squares) > 30
    assert 2.0 < np.mean(squares) < 12.0  # six degrees of freedom


def test_points_stand_around_the_camera_where_it_is_in_the_target_frame(
    tiny_model, camera, bumpy_mesh, draw
):
    rng = np.random.default_rng(5)
    recognizer = Recognizer(tiny_model, camera)
    off = []
    for _ in range(POSES):
        truth = some_pose(rng, tiny_model)
        observation = recognizer.recognize(draw(bumpy_mesh, truth, camera, rng), truth)
        if observation.status is not Status.OK:
            assert len(observation.points_m) == 0
            continue
        assert (
            len(observation.points_m)
            == len(observation.active_nodes)
            == len(observation.weights)
            > 0
        )
        where = truth.inverse().translation_m
        mean = observation.weights @ observation.points_m / observation.weights.sum()
        off.append(np.linalg.norm(mean - where) / np.linalg.norm(where - tiny_model.centre_m))
        # each point lies on its node's direction from the view centre
        arms = observation.points_m - tiny_model.centre_m
        arms /= np.linalg.norm(arms, axis=1, keepdims=True)
        assert np.allclose(arms, tiny_model.geodesic.nodes[observation.active_nodes])
    assert len(off) >= 0.8 * POSES
    assert np.median(off) < 0.15
    assert max(off) < 0.4


def test_a_target_off_the_boresight_is_recognised_as_on_it(tiny_model, camera, bumpy_mesh, draw):
    """The same view after a pure rotation of the camera: the same direction, turned pose."""
    recognizer = Recognizer(tiny_model, camera)
    rng = np.random.default_rng(6)
    apart = []
    for _ in range(12):
        ahead = some_pose(rng, tiny_model, off_boresight=False)
        ahead = Pose(ahead.rotation, ahead.translation_m * 1.2)
        turn = Rotation.from_rotvec([*rng.uniform(-0.14, 0.14, 2), 0.0])
        aside = Pose(turn.as_matrix() @ ahead.rotation, turn.as_matrix() @ ahead.translation_m)
        a, b = (
            recognizer.recognize(draw(bumpy_mesh, truth, camera), truth) for truth in (ahead, aside)
        )
        if Status.UNRECOGNIZED in (a.status, b.status):
            continue  # an outline at the limit of what the small model knows
        apart.append(a.pose.angle_to(Pose(turn.as_matrix().T @ b.pose.rotation, np.zeros(3))))
        if apart[-1] < 0.12:
            ranges = [np.linalg.norm(s.pose.apply(tiny_model.centre_m)) for s in (a, b)]
            assert ranges[0] == pytest.approx(ranges[1], rel=0.05)
    assert len(apart) >= 8
    # the noise of a pixel's staircase may turn single trees of so small a model over
    assert np.median(apart) < 0.06
    assert np.mean(np.array(apart) < 0.12) >= 0.75


def test_pose_is_that_of_the_cad_frame_however_far_its_origin(
    tmp_path, tiny_model, tiny_options, camera, bumpy_mesh, draw
):
    shift = np.array([5.0, -3.0, 2.0])
    moved = Mesh(bumpy_mesh.vertices_m + shift, bumpy_mesh.faces, bumpy_mesh.face_rgb, ())
    model = train(moved, tmp_path / "m.rvm", name="moved", options=tiny_options, jobs=1).model
    assert np.allclose(model.centre_m, tiny_model.centre_m + shift)
    rng = np.random.default_rng(7)
    for _ in range(6):
        truth = some_pose(rng, tiny_model)
        frame = draw(bumpy_mesh, truth, camera)
        plain = Recognizer(tiny_model, camera).recognize(frame, truth).pose
        cad_truth = truth @ Pose(np.eye(3), -shift)
        assert np.allclose(cad_truth.apply(model.centre_m), truth.apply(tiny_model.centre_m))
        observation = Recognizer(model, camera).recognize(frame, cad_truth)
        direction, roll, range_error, bearing = errors(model, observation, cad_truth)
        assert direction < WORST_DEG
        assert roll < 8.0
        assert range_error < 0.1
        assert bearing < 1.0
        # the same body recognised in either frame is in one place
        expected = plain @ Pose(np.eye(3), -shift)
        assert np.linalg.norm(observation.pose.apply(shift) - expected.apply(shift)) < 0.3
        assert np.linalg.eigvalsh(observation.covariance).min() > 0.0


def test_a_turn_about_the_view_centre_moves_a_far_origin_in_the_covariance(
    tmp_path, tiny_model, camera, bumpy_mesh, draw
):
    far = dataclasses.replace(tiny_model, centre_m=tiny_model.centre_m + np.array([50.0, 0.0, 0.0]))
    truth = some_pose(np.random.default_rng(8), tiny_model)
    frame = draw(bumpy_mesh, truth, camera)
    observation = Recognizer(far, camera).recognize(frame, truth)
    # t = centre − R centre_m: propagate by differences and compare
    pose, covariance = observation.pose, observation.covariance
    centre = pose.apply(far.centre_m)
    jacobian = np.zeros((3, 3))
    for k, w in enumerate(1e-6 * np.eye(3)):
        turned = Rotation.from_rotvec(w).as_matrix() @ pose.rotation
        jacobian[:, k] = (centre - turned @ far.centre_m - pose.translation_m) / 1e-6
    assert np.allclose(covariance[3:, :3], jacobian @ covariance[:3, :3], rtol=1e-4, atol=1e-6)
    own = covariance[3:, 3:] - jacobian @ covariance[:3, :3] @ jacobian.T
    assert np.linalg.eigvalsh(own).min() > 0.0
    assert np.trace(covariance[3:, 3:]) > 4.0


def test_a_camera_of_half_the_resolution_gives_the_same_poses(tiny_model, camera, bumpy_mesh, draw):
    half = Camera.from_fov(camera.width // 2, camera.height // 2, np.deg2rad(40.0))
    rng = np.random.default_rng(9)
    found = []
    for _ in range(POSES):
        truth = some_pose(rng, tiny_model)
        observation = Recognizer(tiny_model, half).recognize(
            draw(bumpy_mesh, truth, half, rng), truth
        )
        if observation.status is Status.OK:
            found.append(errors(tiny_model, observation, truth))
    assert len(found) >= 0.75 * POSES
    assert np.median(found, axis=0)[0] < 1.5 * MEDIAN_DEG
    assert np.median(found, axis=0)[2] < 0.05
    assert np.max(found, axis=0)[3] < 1.0


def test_a_roll_of_the_camera_rolls_the_pose_and_nothing_else(tiny_model, camera, bumpy_mesh, draw):
    rng = np.random.default_rng(10)
    recognizer = Recognizer(tiny_model, camera)
    truth = some_pose(rng, tiny_model)
    directions = []
    for roll in np.linspace(0.0, 2.0 * np.pi, 7)[:-1]:
        turn = Rotation.from_rotvec([0.0, 0.0, roll]).as_matrix()
        rolled = Pose(turn @ truth.rotation, turn @ truth.translation_m)
        observation = recognizer.recognize(draw(bumpy_mesh, rolled, camera), rolled)
        assert errors(tiny_model, observation, rolled)[1] < 5.0
        directions.append(observation.pose.rotation.T @ turn @ [0.0, 0.0, 1.0])
    assert np.rad2deg(angle_between(directions, directions[0])).max() < 5.0


def test_a_wrong_prior_is_not_answered_by_a_pose_far_from_it(tiny_model, camera, bumpy_mesh, draw):
    rng = np.random.default_rng(11)
    recognizer = Recognizer(tiny_model, camera)
    options = recognizer.outline.matcher.options
    reach = options.prior_error_rad + (options.margin_edges + 3.0) * (
        tiny_model.geodesic.mean_edge_rad
    )
    for _ in range(8):
        truth = some_pose(rng, tiny_model)
        wrong = tilted(truth, rng, 150.0)
        observation = recognizer.recognize(draw(bumpy_mesh, truth, camera), wrong)
        if observation.status is Status.OK:
            lines = [p.rotation.T @ [0.0, 0.0, 1.0] for p in (observation.pose, wrong)]
            assert float(angle_between(*lines)) < reach
        else:
            assert observation.status is Status.UNRECOGNIZED


def test_a_frame_without_a_target_has_a_status_and_a_reason_and_no_pose(tiny_model, camera):
    observation = Recognizer(tiny_model, camera).recognize(np.zeros((400, 400), np.uint8))
    assert observation.status is Status.EMPTY
    assert observation.reason
    assert observation.pose is None
    assert observation.covariance is None
    assert observation.score == 0.0
    assert len(observation.points_m) == 0


def test_of_two_like_bodies_the_prior_chooses(tiny_model, camera, bumpy_mesh, draw):
    rotation = Rotation.from_rotvec([0.3, 0.8, -0.5]).as_matrix()
    poses = [Pose(rotation, [x, 0.2, 22.0]) for x in (-3.5, 3.5)]
    frame = np.maximum(*(draw(bumpy_mesh, pose, camera) for pose in poses))
    recognizer = Recognizer(tiny_model, camera)
    assert recognizer.recognize(frame).status is Status.RIVALS
    for pose in poses:
        found = recognizer.recognize(frame, pose)
        assert found.status is Status.OK
        assert found.pose.translation_m[0] == pytest.approx(pose.translation_m[0], abs=0.4)


def test_a_prior_behind_the_camera_does_no_harm(tiny_model, camera, bumpy_mesh, draw):
    truth = some_pose(np.random.default_rng(12), tiny_model)
    behind = Pose(truth.rotation, -truth.translation_m)
    observation = Recognizer(tiny_model, camera).recognize(draw(bumpy_mesh, truth, camera), behind)
    assert errors(tiny_model, observation, truth)[0] < WORST_DEG


@pytest.mark.parametrize(
    "image", [np.zeros((400, 399), np.uint8), np.full((400, 400), np.nan), np.zeros((400, 400))]
)
def test_an_image_of_another_kind_is_refused(tiny_model, camera, image):
    with pytest.raises(RendezviewError, match=r"frame"):
        Recognizer(tiny_model, camera).recognize(image)


def test_range_without_perspective_is_equation_4a(tiny_model):
    # d = d_ref sqrt(A_ref / A_obs) with areas as the eye sees them
    area_ref_sr = 0.02
    area_m2 = np.array([area_ref_sr * tiny_model.sphere_radius_m**2])
    for factor in (1.0, 2.0, 3.5):
        found = range_from_area(tiny_model, area_m2, np.zeros(1), area_ref_sr / factor**2)
        assert found[0] == pytest.approx(factor * tiny_model.sphere_radius_m)


def test_range_with_perspective_inverts_the_area_law_of_the_view(tiny_model):
    radius = tiny_model.sphere_radius_m
    slope, area_m2 = np.array([-0.2, 0.1, 0.4]), np.array([0.5, 0.5, 0.5])
    for range_m in (1.0 * radius, 1.7 * radius, 4.0 * radius):
        observed = area_m2 * (1.0 + slope * (radius / range_m - 1.0)) / range_m**2
        for k in range(3):
            found = range_from_area(
                tiny_model, area_m2[k : k + 1], slope[k : k + 1], float(observed[k])
            )
            assert found[0] == pytest.approx(range_m, rel=2e-3)


def test_views_of_the_lattice_are_recognised_as_themselves(tiny_model):
    matcher = Matcher(tiny_model)
    views = tiny_model.views
    off = []
    for k in range(0, len(views.area_m2), 9):
        signature = Signature(views.readings[k].astype(np.float32), 0.01, np.eye(3))
        match = matcher.match(signature, views.centred_from_target[k])
        assert match is not None
        off.append(float(angle_between(match.direction, tiny_model.lattice.nodes[k])))
    edges = np.array(off) / tiny_model.geodesic.mean_edge_rad
    assert np.median(edges) < 0.25
    assert np.mean(edges < 0.6) > 0.9


def test_a_prior_is_turned_to_the_line_of_sight_of_a_target_off_the_boresight(
    tiny_model, camera, bumpy_mesh, draw, monkeypatch
):
    asked = []
    monkeypatch.setattr(
        Matcher, "match", lambda _self, _signature, prior=None, *_rest: asked.append(prior)
    )
    rotation = Rotation.from_rotvec([0.4, -0.9, 0.2]).as_matrix()
    for bearing in (0.2, -0.2):
        line = np.array([bearing, 0.5 * bearing, 1.0])
        centre = 3.5 * tiny_model.sphere_radius_m * line / np.linalg.norm(line)
        truth = Pose(rotation, centre - rotation @ tiny_model.centre_m)
        Recognizer(tiny_model, camera).recognize(draw(bumpy_mesh, truth, camera), truth)
        seen_from = truth.inverse().translation_m - tiny_model.centre_m
        seen_from /= np.linalg.norm(seen_from)
        # the boresight is 13° off; what is left is the centroid's distance to the view centre
        assert np.rad2deg(angle_between(-rotation[2], seen_from)) > 12.0
        assert np.rad2deg(angle_between(-asked[-1][2], seen_from)) < 2.0
