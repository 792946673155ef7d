"""Whole frames and scenes: truth beside the pictures, and the same bytes every time."""

from __future__ import annotations

import gc
import json
import math
import warnings
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from tests.ground.mesh.mesh_samples import boxes, grey_mesh

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose
from rendezview_ground.simulate.background import Earth, Stars
from rendezview_ground.simulate.scene import SceneOptions, render_frame, simulate, sun_at_phase
from rendezview_ground.simulate.sensor import SensorOptions
from rendezview_ground.simulate.shading import ShadingOptions
from rendezview_ground.simulate.trajectories import TrajectoryOptions, trajectory

CAMERA = Camera.from_fov(64, 48, math.radians(40.0))
QUICK = ShadingOptions(samples=2)
CLEAN = SensorOptions(noise_sigma_grey=0.0, black_level_grey=0.0)


# A box with a wing.
MESH = grey_mesh(boxes((((1.0, 1.2, 2.0), (0.0, 0.0, 0.0)), ((4.0, 0.05, 0.8), (1.0, 0.0, 0.6)))))
CENTRE_M, RADIUS_M = MESH.bounding_sphere
PATH = trajectory(
    "spiral",
    TrajectoryOptions(
        frames=6, dt_s=2.0, start_range_m=12.0, end_range_m=8.0, centre_m=tuple(CENTRE_M)
    ),
)


def files_of(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def frame(options: SceneOptions, sun: Any = (0.3, -0.4, -0.8), pose: Pose = PATH[0][1]) -> Array:
    image = render_frame(MESH, CAMERA, pose, sun, options, np.random.default_rng(1))
    assert image.shape == (48, 64)
    assert image.dtype == np.uint8
    return image.astype(np.float64)


@pytest.mark.requirement("RV-SIM-1")
def test_the_same_seed_gives_the_same_bytes_for_one_and_two_jobs(tmp_path: Path) -> None:
    options = SceneOptions(
        shading=QUICK, earth=Earth(), stars=Stars(), masks=True, sun_azimuth_each_frame=True
    )
    for name, seed, jobs in (("one", 4, 1), ("two", 4, 2), ("other", 5, 2)):
        simulate(MESH, CAMERA, PATH, options, tmp_path / name, seed, jobs=jobs)
    one, two, other = (files_of(tmp_path / name) for name in ("one", "two", "other"))
    assert one == two
    assert len(one) >= 2 * len(PATH) + 2
    pictures = [name for name in one if name.startswith("gray")]
    assert all(one[name] != other[name] for name in pictures)


def test_the_truth_beside_the_pictures_is_the_trajectory(tmp_path: Path) -> None:
    simulate(MESH, CAMERA, PATH, SceneOptions(shading=QUICK, masks=True), tmp_path / "s", 0)
    truth = json.loads((tmp_path / "s" / "scene_gt.json").read_text())
    cameras = json.loads((tmp_path / "s" / "scene_camera.json").read_text())
    assert list(truth) == [str(i) for i in range(len(PATH))]
    for i, (time_s, pose) in enumerate(PATH):
        (entry,) = truth[str(i)]
        np.testing.assert_allclose(entry["cam_R_m2c"], pose.rotation.ravel(), atol=1e-12)
        np.testing.assert_allclose(entry["cam_t_m2c"], pose.translation_m * 1000, atol=1e-9)
        assert cameras[str(i)]["timestamp_s"] == time_s


def test_a_mask_is_the_outline_of_the_true_pose(tmp_path: Path) -> None:
    simulate(MESH, CAMERA, PATH, SceneOptions(shading=QUICK, masks=True), tmp_path / "s", 0)
    for i, (_, pose) in enumerate(PATH):
        mask = cv2.imread(str(tmp_path / f"s/mask_visib/{i:06d}_000000.png"), 0)
        assert mask is not None
        assert set(np.unique(mask)) == {0, 255}
        rows, columns = np.nonzero(mask)
        corners = CAMERA.project(pose.apply(MESH.vertices_m))
        np.testing.assert_allclose(
            [columns.min(), columns.max(), rows.min(), rows.max()],
            [corners[:, 0].min(), corners[:, 0].max(), corners[:, 1].min(), corners[:, 1].max()],
            atol=1.5,  # a pointed end covers less than half of its last pixel
        )


def test_progress_counts_every_frame(tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    simulate(
        MESH, CAMERA, PATH, SceneOptions(shading=QUICK), tmp_path / "s", 0,
        jobs=2, progress=lambda done, total: seen.append((done, total)),
    )  # fmt: skip
    assert seen == [(i + 1, len(PATH)) for i in range(len(PATH))]


def test_a_frame_that_cannot_be_written_ends_the_others_in_silence(tmp_path: Path) -> None:
    many = [(float(k), PATH[0][1]) for k in range(60)]

    def full(done: int, total: int) -> None:
        raise RendezviewError(f"no space after {done} of {total}")

    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        with pytest.raises(RendezviewError, match="no space after 1 of 60"):
            simulate(
                MESH, CAMERA, many, SceneOptions(shading=QUICK), tmp_path / "s", 0,
                jobs=2, progress=full,
            )  # fmt: skip
        gc.collect()  # what is left of the frames ends here
    assert [str(each.message) for each in said] == []


def test_a_scene_that_exists_is_refused_unless_it_may_be_overwritten(tmp_path: Path) -> None:
    options = SceneOptions(shading=QUICK)
    simulate(MESH, CAMERA, PATH[:2], options, tmp_path / "s", 0)
    with pytest.raises(RendezviewError, match="already"):
        simulate(MESH, CAMERA, PATH[:2], options, tmp_path / "s", 0)
    simulate(MESH, CAMERA, PATH[:1], options, tmp_path / "s", 0, overwrite=True)


def test_automatic_exposure_brings_the_brightest_of_the_scene_near_200(tmp_path: Path) -> None:
    options = SceneOptions(shading=QUICK, sun_phase_rad=0.6, sensor=SensorOptions())
    simulate(MESH, CAMERA, PATH, options, tmp_path / "s", 0)
    greys = []
    for i in range(len(PATH)):
        image = cv2.imread(str(tmp_path / f"s/gray/{i:06d}.png"), 0)
        assert image is not None
        greys.append(image[image > 60])
    brightest = np.sort(np.concatenate(greys))
    assert 185 < np.median(brightest[-len(brightest) // 10 :]) < 215


@pytest.mark.parametrize("phase_rad", [0.0, 0.7, math.pi / 2, math.pi])
def test_the_phase_is_the_angle_sun_target_camera(phase_rad: float) -> None:
    for centre in ([0.0, 0.0, 9.0], [1.0, -2.0, 6.0], [5.0, 0.001, 0.0]):
        for azimuth in (0.0, 1.0, 4.0):
            sun = sun_at_phase(centre, phase_rad, azimuth)
            to_camera = -np.array(centre) / np.linalg.norm(centre)
            assert np.linalg.norm(sun) == pytest.approx(1.0)
            assert math.acos(np.clip(sun @ to_camera, -1, 1)) == pytest.approx(phase_rad, abs=1e-7)


def test_azimuth_zero_is_a_sun_on_the_right_and_a_quarter_turn_below() -> None:
    np.testing.assert_allclose(sun_at_phase([0, 0, 5], math.pi / 2, 0.0), [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(
        sun_at_phase([0, 0, 5], math.pi / 2, math.pi / 2), [0, 1, 0], atol=1e-12
    )


def test_a_fixed_sun_lights_the_same_side_of_the_target_from_everywhere(tmp_path: Path) -> None:
    # The Sun on +X: bright from +X, dark from −X.
    circle = trajectory(
        "circular", TrajectoryOptions(frames=3, start_range_m=9.0, centre_m=tuple(CENTRE_M))
    )
    options = SceneOptions(shading=QUICK, sensor=CLEAN, sun_direction_sky=(1.0, 0.0, 0.0))
    simulate(MESH, CAMERA, circle, options, tmp_path / "s", 0)
    means = [np.mean(cv2.imread(str(tmp_path / f"s/gray/{i:06d}.png"), 0)) for i in range(3)]  # type: ignore[arg-type]
    assert means[0] == pytest.approx(means[2], rel=0.01)
    assert means[1] < 0.1 * means[0]


def test_the_target_hides_the_earth_behind_it() -> None:
    fixed = SensorOptions(
        exposure=200.0, noise_sigma_grey=0.0, black_level_grey=0.0, blur_sigma_px=0.0
    )
    shading = ShadingOptions(samples=2, earthshine=0.0)
    plain = frame(SceneOptions(shading=shading, sensor=fixed))
    with_earth = frame(SceneOptions(shading=shading, sensor=fixed, earth=Earth()))
    corner = (slice(0, 6), slice(0, 6))
    assert not plain[corner].any()
    assert (with_earth[corner] > 5).all()
    target = plain > 60
    assert target.sum() > 50
    inside = cv2.erode(target.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    np.testing.assert_array_equal(with_earth[inside], plain[inside])


def test_the_sky_stands_still_in_the_frame_it_is_given_in() -> None:
    fixed = SensorOptions(exposure=250.0, noise_sigma_grey=0.0, black_level_grey=0.0)
    away = [
        Pose(Pose.from_quat_wxyz(quat, [0, 0, 0]).rotation, [0.0, 0.0, -50.0])
        for quat in ((1, 0, 0, 0), (0.9, 0.2, 0.1, 0.3))
    ]
    for sky_frame, same in (("camera", True), ("target", False)):
        options = SceneOptions(
            sky_frame=sky_frame,  # type: ignore[arg-type]
            stars=Stars(count=50_000),
            sensor=fixed,
        )
        first, second = (frame(options, pose=pose) for pose in away)
        assert first.any()
        assert np.array_equal(first, second) == same


def test_a_scene_lit_from_behind_is_exposed_for_its_albedo() -> None:
    image = frame(SceneOptions(shading=QUICK, sensor=CLEAN), sun=(0.0, 0.0, 1.0))
    assert image.max() < 60


def test_the_sky_glows_behind_the_target_and_not_before_it() -> None:
    fixed = SensorOptions(
        exposure=200.0, noise_sigma_grey=0.0, black_level_grey=0.0, blur_sigma_px=0.0,
        overexposure=3.0,
    )  # fmt: skip
    plain = frame(SceneOptions(shading=QUICK, sensor=fixed))
    glowing = frame(SceneOptions(shading=QUICK, sensor=fixed, sky_level_grey=40.0))
    target = cv2.dilate(plain.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    assert (glowing[~target] == 40).all()
    inside = cv2.erode((plain > 0).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    np.testing.assert_array_equal(glowing[inside], plain[inside])


def test_dust_adds_specks_that_hide_nothing() -> None:
    plain = frame(SceneOptions(shading=QUICK, sensor=CLEAN))
    dusty = frame(SceneOptions(shading=QUICK, sensor=CLEAN, dust=12))
    assert (dusty >= plain).all()
    assert 5 < np.count_nonzero(dusty > plain + 5) < 400


def test_a_scene_with_a_mesh_error_keeps_its_truth_and_moves_its_outline(tmp_path: Path) -> None:
    for name, share, jobs in (("plain", 0.0, 1), ("bent", 0.05, 1), ("again", 0.05, 2)):
        options = SceneOptions(shading=QUICK, masks=True, mesh_error=share)
        simulate(MESH, CAMERA, PATH[:3], options, tmp_path / name, 3, jobs=jobs)
    plain, bent, again = (files_of(tmp_path / name) for name in ("plain", "bent", "again"))
    assert bent == again
    assert bent["scene_gt.json"] == plain["scene_gt.json"]
    masks = [name for name in plain if name.startswith("mask_visib")]
    assert all(bent[name] != plain[name] for name in masks)


def test_a_blanket_keeps_the_truth_and_makes_the_outline_larger(tmp_path: Path) -> None:
    for name, share in (("plain", 0.0), ("wrapped", 0.05)):
        options = SceneOptions(shading=QUICK, masks=True, insulation=share)
        simulate(MESH, CAMERA, PATH[:3], options, tmp_path / name, 3)
    plain, wrapped = (files_of(tmp_path / name) for name in ("plain", "wrapped"))
    assert wrapped["scene_gt.json"] == plain["scene_gt.json"]
    for name in (name for name in plain if name.startswith("mask_visib")):
        masks = [
            cv2.imdecode(np.frombuffer(files[name], np.uint8), cv2.IMREAD_GRAYSCALE) > 0
            for files in (plain, wrapped)
        ]
        assert masks[1].sum() > masks[0].sum()
        assert (masks[1] | ~masks[0]).all()  # nothing of the craft is lost


def test_scenes_without_the_effects_of_a_photograph_draw_no_random_numbers_for_them() -> None:
    """Their pictures are those of the versions before: noise is drawn first."""
    sensor = SensorOptions(exposure=200.0)
    away = Pose(np.eye(3), [0.0, 0.0, -20.0])
    noise = np.random.default_rng(1).standard_normal((48, 64), dtype=np.float32)
    expected = np.clip(np.rint(5.0 + 3.0 * noise), 0, 255)
    np.testing.assert_array_equal(frame(SceneOptions(sensor=sensor), pose=away), expected)


def test_impossible_scenes_are_refused_before_a_folder_is_made(tmp_path: Path) -> None:
    folder, options = tmp_path / "s", SceneOptions(shading=QUICK)
    with pytest.raises(RendezviewError, match="no frames"):
        simulate(MESH, CAMERA, [], options, folder, 0)
    with pytest.raises(RendezviewError, match="rise"):
        simulate(MESH, CAMERA, [PATH[1], PATH[0]], options, folder, 0)
    with pytest.raises(RendezviewError, match="jobs"):
        simulate(MESH, CAMERA, PATH, options, folder, 0, jobs=0)
    assert not folder.exists()
