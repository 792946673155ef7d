"""Refinement on drawn and shaded frames of a small asymmetric body."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.special import ndtr

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.sensors.appearance import Recognizer, Tracker, ViewModel
from rendezview.sensors.appearance.edges import refinement
from rendezview.sensors.appearance.edges.measured import MeasuredEdges
from rendezview.sensors.appearance.edges.profile_fit import fit_profile
from rendezview.sensors.appearance.edges.refinement import RefineOptions, Refiner
from rendezview.sensors.appearance.hypothesis import Hypothesis
from rendezview.sensors.appearance.model.container import read_container, write_container
from rendezview.sensors.appearance.sky import Sky
from rendezview.sensors.observation import Status
from rendezview_ground.simulate import (
    Earth,
    SceneOptions,
    SensorOptions,
    ShadingOptions,
    render_frame,
    sun_at_phase,
)


def random_pose(seed: int, range_m: float = 9.0) -> Pose:
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(random_state=rng).as_matrix()
    place = np.array([*rng.uniform(-0.08, 0.08, 2), 1.0]) * range_m
    return Pose(rotation, place)


def off_by(pose: Pose, degrees: float, seed: int) -> Pose:
    axis = np.random.default_rng(seed).normal(size=3)
    turn = Rotation.from_rotvec(np.deg2rad(degrees) * axis / np.linalg.norm(axis)).as_matrix()
    return Pose(turn @ pose.rotation, pose.translation_m * 1.02)


def shaded(mesh, camera, pose, seed, phase_deg=20.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    sun = sun_at_phase(pose.translation_m, np.deg2rad(phase_deg), rng.uniform(0.0, 6.28))
    options = SceneOptions(sky_frame="camera", shading=ShadingOptions(samples=4))
    return render_frame(mesh, camera, pose, sun, options, rng)


def placed(profile, start, depths, levels, sigma=0.85, held=True) -> float | None:
    """Place of an edge in a profile whose place 0 is its pixel 10, sky 12."""
    result = np.zeros(2)
    found = fit_profile(
        profile, len(profile), 10, start, np.asarray(depths, float), np.asarray(levels, float),
        len(depths), 12.0, held, sigma, 1.0, result,
    )  # fmt: skip
    return float(result[0]) if found else None


def blurred(place, depths, levels, sigma=0.85) -> np.ndarray:
    x = np.arange(-10.0, 11.0)
    return 12.0 + sum(
        b * ndtr((place - x - d) / sigma) for d, b in zip(depths, levels, strict=True)
    )


@pytest.mark.parametrize(("sigma", "place"), [(0.7, 0.3), (0.85, -0.4), (1.2, 0.1)])
def test_a_blurred_step_is_placed_to_a_hundredth_of_a_pixel(sigma, place):
    profile = blurred(place, [0.0], [100.0], sigma)
    assert placed(profile, np.rint(place), [0.0], [100.0], sigma) == pytest.approx(place, abs=0.01)


def test_a_step_twice_as_bright_as_expected_is_placed_all_the_same():
    profile = blurred(0.3, [0.0], [200.0])
    assert placed(profile, 0.0, [0.0], [100.0]) == pytest.approx(0.3, abs=0.05)


def test_a_bright_frame_around_a_dark_panel_does_not_shift_its_edge():
    depths, levels = [0.0, 0.8], [150.0, -110.0]
    profile = blurred(0.2, depths, levels)
    assert placed(profile, 0.5, depths, levels) == pytest.approx(0.2, abs=0.02)
    as_a_plain_step = placed(profile, 0.5, [0.0], [100.0])
    assert as_a_plain_step is None or abs(as_a_plain_step - 0.2) > 0.1


def test_an_edge_before_a_background_that_is_not_known_is_placed():
    profile = blurred(-0.3, [0.0], [60.0]) + 70.0
    assert placed(profile, 0.0, [0.0], [60.0], held=False) == pytest.approx(-0.3, abs=0.02)


def test_a_thin_bar_is_placed_where_its_edge_is_and_not_where_the_slope_is_steepest():
    depths, levels = [0.0, 1.0], [100.0, -100.0]
    profile = blurred(0.2, depths, levels)
    assert placed(profile, 0.7, depths, levels) == pytest.approx(0.2, abs=0.02)
    steepest = np.arange(-10.0, 10.0)[np.argmin(np.diff(profile))] + 0.5
    assert abs(steepest - 0.2) > 0.2


def test_the_light_of_a_frame_tells_lit_facets_from_unlit_ones(refining_model, bumpy_mesh, camera):
    pose = random_pose(3)
    sun = sun_at_phase(pose.translation_m, np.deg2rad(30.0), 1.0)
    frame = render_frame(
        bumpy_mesh, camera, pose, sun,
        SceneOptions(sky_frame="camera", shading=ShadingOptions(samples=4, shadows=False)),
        np.random.default_rng(3),
    )  # fmt: skip
    refiner = Refiner(refining_model, camera)
    right = refiner.refine(frame, Sky.of(frame), pose)
    told = refiner.refine(frame, Sky.of(frame, sun), pose)
    wrong = refiner.refine(frame, Sky.of(frame, -sun), pose)
    assert right is not None
    assert told is not None
    assert wrong is not None
    assert right.light > 0.6
    assert told.light > 0.6
    assert wrong.light < told.light - 0.1


def test_refinement_finds_the_pose_from_five_degrees_off(refining_model, bumpy_mesh, camera):
    refiner = Refiner(refining_model, camera)
    errors, shares = [], []
    for seed in range(12):
        truth = random_pose(seed)
        frame = shaded(bumpy_mesh, camera, truth, seed)
        found = refiner.refine(frame, Sky.of(frame), off_by(truth, 4.0, seed))
        assert found is not None
        errors.append(np.rad2deg(found.pose.angle_to(truth)))
        shift = np.linalg.norm(found.pose.translation_m - truth.translation_m)
        shares.append(shift / np.linalg.norm(truth.translation_m))
    assert np.median(errors) < 0.3
    assert np.median(shares) < 0.004
    assert np.mean(np.array(errors) < 1.0) > 0.8


def test_a_model_made_before_strips_had_surfaces_is_read_and_refines(
    refining_model, bumpy_mesh, camera, tmp_path
):
    refining_model.save(tmp_path / "now.rvm")
    header, arrays = read_container(tmp_path / "now.rvm")
    strip = arrays["contours.strip"]
    cells = np.concatenate([strip, strip[..., -1:], strip[..., -1:], strip[..., -1:]], axis=-1)
    arrays["contours.strip"] = np.ascontiguousarray(cells)
    start = arrays.pop("contours.start")
    arrays["contours.rim"] = np.zeros_like(start[..., 0, :])
    write_container(tmp_path / "before.rvm", header, arrays)
    refiner = Refiner(ViewModel.load(tmp_path / "before.rvm"), camera)
    errors = []
    for seed in range(6):
        pose = random_pose(seed)
        image = shaded(bumpy_mesh, camera, pose, seed)
        found = refiner.refine(image, Sky.of(image), off_by(pose, 3.0, seed))
        assert found is not None
        errors.append(found.pose.angle_to(pose))
    assert np.rad2deg(np.median(errors)) < 1.0

    arrays["contours.strip"] = strip[..., :3]
    write_container(tmp_path / "wrong.rvm", header, arrays)
    with pytest.raises(RendezviewError, match="does not hold together"):
        ViewModel.load(tmp_path / "wrong.rvm")


def test_a_distorted_camera_is_refined_through_its_lens(refining_model, bumpy_mesh):
    bent = Camera(400, 400, 550.0, 550.0, 199.5, 199.5, (-0.25, 0.12, 0.001, -0.001, 0.0))
    truth = Pose(random_pose(3).rotation, [1.2, -0.9, 8.0])  # where the lens bends most
    frame = shaded(bumpy_mesh, bent, truth, 3)
    start = off_by(truth, 2.0, 3)
    found = Refiner(refining_model, bent).refine(frame, Sky.of(frame), start)
    straight = Camera(400, 400, 550.0, 550.0, 199.5, 199.5)
    wrong = Refiner(refining_model, straight).refine(frame, Sky.of(frame), start)
    assert found is not None
    assert np.rad2deg(found.pose.angle_to(truth)) < 0.6
    if wrong is not None:
        error = np.linalg.norm(wrong.pose.translation_m - truth.translation_m)
        assert error > 2.0 * np.linalg.norm(found.pose.translation_m - truth.translation_m)


@pytest.mark.requirement("RV-REC-4")
def test_the_covariance_is_symmetric_positive_and_of_the_size_of_the_errors(
    refining_model, bumpy_mesh, camera
):
    refiner = Refiner(refining_model, camera)
    squares = []
    for seed in range(20, 36):
        truth = random_pose(seed)
        frame = shaded(bumpy_mesh, camera, truth, seed)
        found = refiner.refine(frame, Sky.of(frame), off_by(truth, 2.0, seed))
        assert found is not None
        assert found.covariance == pytest.approx(found.covariance.T)
        assert np.linalg.eigvalsh(found.covariance).min() > 0.0
        turn = Rotation.from_matrix(truth.rotation @ found.pose.rotation.T).as_rotvec()
        error = np.concatenate([turn, truth.translation_m - found.pose.translation_m])
        squares.append(error @ np.linalg.solve(found.covariance, error))
    assert 0.5 < np.median(squares) < 20.0  # six for perfect statistics


def test_a_model_said_to_be_inexact_gives_a_covariance_that_holds_its_errors(
    refining_model, bumpy_mesh, camera
):
    sigma = 0.03
    plain = Refiner(refining_model, camera)
    told = Refiner(replace(refining_model, shape_error=sigma), camera)
    trusting, careful = [], []
    for seed in range(20, 36):
        rng = np.random.default_rng(seed)
        strain = rng.normal(0.0, sigma, (3, 3)) * np.where(np.eye(3) > 0.0, 1.0, np.sqrt(0.5))
        strain = np.triu(strain) + np.triu(strain, 1).T
        craft = replace(bumpy_mesh, vertices_m=bumpy_mesh.vertices_m @ (np.eye(3) + strain))
        truth = random_pose(seed)
        frame = shaded(craft, camera, truth, seed)
        for refiner, squares in ((plain, trusting), (told, careful)):
            found = refiner.refine(frame, Sky.of(frame), off_by(truth, 2.0, seed))
            assert found is not None
            turn = Rotation.from_matrix(truth.rotation @ found.pose.rotation.T).as_rotvec()
            error = np.concatenate([turn, truth.translation_m - found.pose.translation_m])
            squares.append(error @ np.linalg.solve(found.covariance, error))
    assert np.median(trusting) > 12.0
    assert 1.0 < np.median(careful) < 12.0  # six for perfect statistics


def test_less_of_the_outline_seen_gives_a_larger_covariance(
    refining_model, bumpy_mesh, camera, monkeypatch
):
    # The coarse model's own misfit, which is larger where more is seen, is left out.
    monkeypatch.setattr(refinement, "_STRAIN_OF_RESIDUAL", 0.0)
    monkeypatch.setattr(MeasuredEdges, "likely_strain", lambda edges, loose, sigma_px: 0.0)
    refiner = Refiner(refining_model, camera)
    truth = random_pose(5)
    whole = shaded(bumpy_mesh, camera, truth, 5)
    half = whole.copy()
    half[:, : int(camera.project(truth.translation_m)[0])] = 12  # as black as the sky
    start = off_by(truth, 1.0, 5)
    of_whole, of_half = (refiner.refine(f, Sky.of(f), start) for f in (whole, half))
    assert of_whole is not None
    if of_half is not None:
        assert of_half.outline < of_whole.outline
        assert np.trace(of_half.covariance[:3, :3]) > 2.0 * np.trace(of_whole.covariance[:3, :3])


def test_nothing_to_hold_on_to_gives_no_pose(refining_model, camera):
    refiner = Refiner(refining_model, camera)
    flat = np.full((camera.height, camera.width), 12, np.uint8)
    assert refiner.refine(flat, Sky.of(flat), random_pose(0)) is None


@pytest.mark.requirement("RV-REC-2")
def test_first_poses_without_a_prior_are_right_or_not_given(refining_model, bumpy_mesh, camera):
    recognizer = Recognizer(refining_model, camera)
    errors = []
    for seed in range(40, 52):
        truth = random_pose(seed)
        observation = recognizer.recognize(shaded(bumpy_mesh, camera, truth, seed))
        if observation.pose is None:
            assert observation.status is not Status.OK
            assert observation.reason
            errors.append(np.inf)
        else:
            assert observation.confidence is not None
            assert observation.confidence >= recognizer.least_confidence
            errors.append(np.rad2deg(observation.pose.angle_to(truth)))
    found = np.isfinite(errors)
    assert np.mean(found) >= 0.75
    assert np.max(np.array(errors)[found]) < 5.0


def test_the_trees_of_a_sure_first_pose_are_asked_around_it(refining_model, bumpy_mesh, camera):
    recognizer = Recognizer(refining_model, camera)
    asked = 0
    for seed in range(40, 52):
        observation = recognizer.recognize(shaded(bumpy_mesh, camera, random_pose(seed), seed))
        if observation.pose is None or len(observation.active_nodes) == 0:
            continue
        centred = observation.signature.centred_from_camera @ observation.pose.rotation
        cosines = refining_model.geodesic.nodes[observation.active_nodes] @ -centred[2]
        options = recognizer.outline.matcher.options
        reach = (options.margin_edges + 2.0) * refining_model.geodesic.mean_edge_rad
        assert np.all(cosines >= np.cos(reach) - 1e-9)
        assert set(observation.stage_ms) >= {"silhouette", "signature", "refine", "trees"}
        asked += 1
    assert asked >= 8


def test_hard_light_is_told_apart_with_lit_silhouettes(refining_model, bumpy_mesh, camera):
    recognizer = Recognizer(refining_model, camera)
    found = 0
    for seed in range(60, 70):
        truth = random_pose(seed)
        rng = np.random.default_rng(seed)
        sun = sun_at_phase(truth.translation_m, np.deg2rad(55.0), rng.uniform(0.0, 6.28))
        options = SceneOptions(sky_frame="camera", shading=ShadingOptions(samples=3))
        frame = render_frame(bumpy_mesh, camera, truth, sun, options, rng)
        observation = recognizer.recognize(frame, sun_camera=sun)
        best = observation.found
        if best is not None and np.rad2deg(best.best.pose.angle_to(truth)) < 5.0:
            found += 1
    assert found >= 6


def test_a_field_of_clouds_alone_has_no_pose(refining_model, bumpy_mesh, camera):
    recognizer = Recognizer(refining_model, camera)
    behind = Pose(np.eye(3), [0.0, 0.0, 9.0])
    for seed in range(3):
        away = Pose(behind.rotation, [200.0, 0.0, 9.0])  # out of the picture
        rng = np.random.default_rng(seed)
        options = SceneOptions(
            sky_frame="camera", earth=Earth(seed=seed), sensor=SensorOptions(exposure=250.0)
        )
        frame = render_frame(bumpy_mesh, camera, away, [0.3, 0.2, -1.0], options, rng)
        assert recognizer.recognize(frame).pose is None


def test_a_sequence_survives_a_jump_and_an_outage(refining_model, bumpy_mesh, camera):
    """1.5° a frame, then a jump of 10° and 10 % of range, then three black frames."""
    tracker = Tracker(Recognizer(refining_model, camera), prior=random_pose(90))
    truth, time_s, errors = random_pose(90), 0.0, []
    for k in range(14):
        turn = np.deg2rad(10.0 if k == 6 else 1.5)
        rotation = Rotation.from_rotvec([0.3 * turn, 0.9 * turn, 0.3 * turn]).as_matrix()
        reach = 1.1 if k == 6 else 1.0
        truth = Pose(rotation @ truth.rotation, truth.translation_m * reach)
        frame = shaded(bumpy_mesh, camera, truth, 200 + k)
        if 9 <= k < 12:
            frame = np.full_like(frame, 5)
        time_s += 1.0
        observation = tracker.update(time_s, frame)
        if 9 <= k < 12:
            assert observation.pose is None
        elif observation.pose is not None:
            errors.append(np.rad2deg(observation.pose.angle_to(truth)))
    assert len(errors) >= 10
    assert np.max(errors) < 2.0


def test_blur_out_of_range_is_refused():
    with pytest.raises(ValueError, match="blur_px"):
        RefineOptions(blur_px=0.0)


@pytest.mark.parametrize(
    ("ends", "asked", "given"),
    [
        ([0.70], [4], 0.70),
        ([0.40, 0.50, 0.66], [4, 3, 2], 0.66),
        ([None, 0.50, 0.40, 0.30], [4, 3, 2, 1], 0.50),
    ],
)
def test_stages_that_lead_away_from_a_better_start_are_left_out(
    refining_model, camera, monkeypatch, ends, asked, given
):
    """The start explains 0.65; if all stages lead away, the first that found a hold counts."""
    refiner, stages, left = Refiner(refining_model, camera), [], list(ends)

    def moved(image, sky, start, of, least) -> Hypothesis | None:
        stages.append(len(of))
        share = left.pop(0)
        return None if share is None else Hypothesis(start, outline=share, inner=share)

    monkeypatch.setattr(refiner, "_ratio", lambda *given: 0.65)
    monkeypatch.setattr(refiner, "_moved", moved)
    frame = np.zeros((4, 4), np.uint8)
    found = refiner.refine(frame, Sky.of(frame), random_pose(0))
    assert found.inlier_ratio == pytest.approx(given)
    assert stages == asked
