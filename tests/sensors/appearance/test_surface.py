"""Bright and dark of the surface beside pictures of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Pose
from rendezview.sensors.appearance import Recognizer, Tracker, TrackerOptions, ViewModel
from rendezview.sensors.appearance.judge.shading import Shading
from rendezview.sensors.appearance.search import search
from rendezview.sensors.appearance.sky import Sky
from rendezview.sensors.observation import Status
from rendezview_ground.simulate import SceneOptions, ShadingOptions, render_frame, sun_at_phase


def seen_at(model, seed: int, range_m: float = 8.0) -> Pose:
    rotation = Rotation.random(random_state=np.random.default_rng(seed)).as_matrix()
    return Pose(rotation, np.array([0.1, -0.2, range_m]) - rotation @ model.centre_m)


def agreement(shading: Shading, image, sky: Sky, pose: Pose) -> float:
    shade = shading.of(image, sky, pose)
    assert shade is not None
    return shade.agreement


def shaded(mesh, camera, pose, seed: int, phase_deg: float) -> np.ndarray:
    rng = np.random.default_rng(seed)
    sun = sun_at_phase(pose.translation_m, np.deg2rad(phase_deg), rng.uniform(0.0, 6.28))
    options = SceneOptions(sky_frame="camera", shading=ShadingOptions(samples=2))
    return render_frame(mesh, camera, pose, sun, options, rng)


@pytest.mark.parametrize("phase_deg", [10.0, 45.0])
def test_bright_and_dark_agree_with_the_true_pose_and_less_with_others(
    refining_model, bumpy_mesh, camera, phase_deg
):
    shading = Shading(refining_model, camera)
    true, other = [], []
    for seed in range(8):
        pose = seen_at(refining_model, seed)
        image = shaded(bumpy_mesh, camera, pose, seed, phase_deg)
        sky = Sky.of(image)
        true.append(agreement(shading, image, sky, pose))
        turn = Rotation.from_euler("y", 25.0, degrees=True).as_matrix()
        other.append(agreement(shading, image, sky, Pose(turn @ pose.rotation, pose.translation_m)))
    assert np.median(true) > 0.75
    assert np.sum(np.array(true) > np.array(other)) >= 7
    assert np.median(true) - np.median(other) > 0.2


def test_a_mirrored_contrast_disagrees(refining_model, bumpy_mesh, camera):
    pose = seen_at(refining_model, 3)
    image = shaded(bumpy_mesh, camera, pose, 3, 45.0)
    shading = Shading(refining_model, camera)
    level = np.uint8(image.max())
    target = image > 40
    negative = np.where(target, level - image, image).astype(np.uint8)
    assert agreement(shading, image, Sky.of(image), pose) > 0.7
    assert agreement(shading, negative, Sky.of(image), pose) < 0.3


def test_a_target_out_of_the_picture_says_nothing(refining_model, camera):
    shading = Shading(refining_model, camera)
    image = np.full((camera.height, camera.width), 30, np.uint8)
    away = Pose(np.eye(3), np.array([30.0, 0.0, 8.0]))
    assert agreement(shading, image, Sky.of(image), away) == 0.0
    behind = Pose(np.eye(3), np.array([0.0, 0.0, -8.0]))
    assert agreement(shading, image, Sky.of(image), behind) == 0.0


def test_an_even_picture_agrees_with_nothing(refining_model, camera):
    shading = Shading(refining_model, camera)
    image = np.full((camera.height, camera.width), 30, np.uint8)
    assert abs(agreement(shading, image, Sky.of(image), seen_at(refining_model, 1))) < 0.05


def test_a_model_without_its_surface_finds_poses_by_edges_alone(
    refining_model, bumpy_mesh, camera, tmp_path
):
    replace(refining_model, surface=None).save(tmp_path / "old.rvm")
    model = ViewModel.load(tmp_path / "old.rvm")
    assert model.surface is None
    pose = seen_at(refining_model, 5)
    observation = Recognizer(model, camera).recognize(
        shaded(bumpy_mesh, camera, pose, 5, 10.0), pose, np.deg2rad(5.0)
    )
    assert observation.status is Status.OK
    assert observation.found is not None
    assert observation.found.best.shading is None
    assert observation.pose is not None
    assert observation.pose.angle_to(pose) < np.deg2rad(1.0)


@pytest.mark.parametrize("name", ["point", "normal", "albedo", "seen"])
def test_a_surface_whose_arrays_do_not_match_is_refused(refining_model, tmp_path, name):
    surface = refining_model.surface
    assert surface is not None
    short = replace(surface, **{name: getattr(surface, name)[:-8]})
    replace(refining_model, surface=short).save(tmp_path / "short.rvm")
    with pytest.raises(RendezviewError, match="surface"):
        ViewModel.load(tmp_path / "short.rvm")


def test_a_pose_that_a_search_bore_out_is_kept_with_less_support_for_a_while(
    refining_model, bumpy_mesh, camera, monkeypatch
):
    pose = seen_at(refining_model, 5)
    image = shaded(bumpy_mesh, camera, pose, 5, 10.0)
    recognizer = Recognizer(refining_model, camera)
    monkeypatch.setattr(search, "_ENOUGH", 2.0)  # no single pose is confident
    tracker = Tracker(recognizer, pose, TrackerOptions(confirmed_frames=3))
    observations = [tracker.update(float(k), image) for k in range(9)]
    assert [s.found.single for s in observations] == [*2 * [False, True, True, True], False]
    assert all(s.pose.angle_to(pose) < np.deg2rad(1.0) for s in observations)
