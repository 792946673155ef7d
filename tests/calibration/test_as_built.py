"""The strain between a craft and its model, from frames of a craft that is not its model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rendezview.calibration.as_built import ShapeEstimator, ShapeOptions, estimation, strained
from rendezview.calibration.as_built.picture import shape_picture
from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Pose
from rendezview.sensors.appearance import Recognizer, ViewModel
from rendezview_ground.simulate import SceneOptions, ShadingOptions, render_frame, sun_at_phase

STRAIN = np.array([[-0.03, 0.0, 0.008], [0.0, 0.012, 0.0], [0.008, 0.0, 0.005]])
ABOUT = np.array([0.0, 0.0, 9.0])


@pytest.fixture(scope="module")
def fly_around(bumpy_mesh, camera, refining_model):
    """Frames of a strained craft from all sides, their poses and rough priors."""
    centre = np.array(refining_model.centre_m)
    moved = (bumpy_mesh.vertices_m - centre) @ (np.eye(3) + STRAIN).T + centre
    craft = replace(bumpy_mesh, vertices_m=moved)
    frames, poses, priors = [], [], []
    for k in range(24):
        rng = np.random.default_rng([4, k])
        rotation = Rotation.random(random_state=rng)
        pose = Pose(rotation.as_matrix(), ABOUT - rotation.apply(centre))
        sun = sun_at_phase(ABOUT, np.deg2rad(20.0), rng.uniform(0.0, 6.28))
        options = SceneOptions(sky_frame="camera", shading=ShadingOptions(samples=4))
        frames.append(render_frame(craft, camera, pose, sun, options, rng))
        poses.append(pose)
        off = Rotation.from_rotvec(rng.normal(size=3) * 0.03) * rotation
        priors.append(Pose(off.as_matrix(), ABOUT - off.apply(centre)))
    return frames, poses, priors


@pytest.fixture(scope="module")
def found(refining_model, camera, fly_around):
    frames, _, priors = fly_around
    known = {0: (STRAIN[0, 0], 1e-3)}
    return ShapeEstimator(refining_model, camera).estimate(frames[:16], priors[:16], known)


def test_the_strain_is_found_within_its_uncertainty(found):
    error = found.components - STRAIN[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    assert np.abs(error).max() < 0.004
    assert error @ np.linalg.solve(found.covariance, error) < 30.0
    assert found.size_known
    assert found.rms_after < 0.7 * found.rms_before


def test_a_wrong_focal_length_is_found_with_the_strain(refining_model, camera, fly_around):
    frames, _, priors = fly_around
    told = replace(camera, fx=1.03 * camera.fx, fy=1.03 * camera.fy, cx=camera.cx - 4.0)
    known = {0: (STRAIN[0, 0], 1e-3)}
    found = ShapeEstimator(refining_model, told).estimate(frames, priors, known, lens=True)
    off = [np.log(found.camera.fx / camera.fx), found.camera.cx - camera.cx]
    assert abs(off[0]) < 0.005
    assert abs(off[1]) < 2.0
    sigma = np.sqrt(np.diag(found.lens_covariance))
    assert (np.abs([*off, found.camera.cy - camera.cy])[[0, 1, 2]] < 4.0 * sigma).all()
    assert found.camera.fx / found.camera.fy == pytest.approx(camera.fx / camera.fy)
    error = found.components - STRAIN[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    assert np.abs(error).max() < 0.005


def test_what_all_edges_are_off_alike_is_in_the_uncertainty_of_the_lens(
    refining_model, camera, fly_around, monkeypatch
):
    """No residual and no scatter between frames shows it."""
    frames, _, priors = (part[:10] for part in fly_around)
    known = {0: (STRAIN[0, 0], 1e-3)}
    variances = []
    for shared_px in (0.0, 0.1, 0.2):
        monkeypatch.setattr(estimation, "SHARED_PX", shared_px)
        found = ShapeEstimator(refining_model, camera).estimate(frames, priors, known, lens=True)
        variances.append(found.lens_covariance[0, 0])
    more = np.diff(variances)
    assert more[0] > 0.0
    assert more[1] == pytest.approx(3.0 * more[0], rel=1e-6)


def test_frames_that_do_not_show_the_focal_length_are_refused(refining_model, camera, fly_around):
    frames, _, priors = (part[:8] for part in fly_around)
    well_known = ShapeOptions(focal_sigma=1e-4)  # the frames add nothing to that
    with pytest.raises(RendezviewError, match="focal length"):
        ShapeEstimator(refining_model, camera, well_known).estimate(frames, priors, lens=True)


def test_a_corrected_model_gives_better_poses_of_other_frames(
    refining_model, camera, fly_around, found
):
    frames, poses, priors = (part[16:] for part in fly_around)

    def errors(model):
        recognizer = Recognizer(model, camera)
        seen = [
            recognizer.recognize(f, p, np.deg2rad(6.0)) for f, p in zip(frames, priors, strict=True)
        ]
        return [o.pose.angle_to(t) for o, t in zip(seen, poses, strict=True) if o.pose is not None]

    before, after = errors(refining_model), errors(strained(refining_model, found.strain))
    assert len(after) >= len(before)
    assert np.median(after) < 0.4 * np.median(before)


def test_without_a_length_most_dimensions_stay_and_the_odd_one_changes(
    refining_model, camera, fly_around
):
    """One camera sees x shorter beside y and z; that y and z are longer beside x fits as well."""
    frames, _, priors = fly_around
    found = ShapeEstimator(refining_model, camera).estimate(frames[:16], priors[:16])
    assert not found.size_known
    x, y, z = np.diag(found.strain)
    assert x - y == pytest.approx(STRAIN[0, 0] - STRAIN[1, 1], abs=0.005)
    assert max(abs(y), abs(z)) < 0.25 * abs(x)


def test_what_calibration_left_is_in_the_covariance_of_poses(
    refining_model, camera, fly_around, found
):
    frames, _, priors = (part[16] for part in fly_around)
    angle = np.deg2rad(6.0)
    loose = strained(refining_model, found.strain, found.covariance + 0.02**2 * np.eye(6))
    exact = strained(refining_model, found.strain)
    wide, narrow = (Recognizer(m, camera).recognize(frames, priors, angle) for m in (loose, exact))
    added = np.diag(wide.covariance) - np.diag(narrow.covariance)
    assert (added > 0.0).all()
    assert np.sqrt(added[5]) > 0.005 * 9.0  # the range of a target of unknown size


def test_a_corrected_model_is_a_model_file(refining_model, found, tmp_path):
    model = strained(refining_model, found.strain, found.covariance)
    model.save(tmp_path / "as-built.rvm")
    read = ViewModel.load(tmp_path / "as-built.rvm")
    assert read.shape_covariance == pytest.approx(found.covariance)
    assert np.array_equal(read.contours.point, model.contours.point)
    assert read.provenance["strain"] == found.strain.tolist()


def test_one_view_does_not_show_the_shape(refining_model, camera, fly_around):
    frames, _, priors = fly_around
    with pytest.raises(RendezviewError, match="more sides"):
        ShapeEstimator(refining_model, camera).estimate([frames[0]] * 6, [priors[0]] * 6)


def test_empty_frames_do_not_show_the_shape(refining_model, camera):
    empty = np.zeros((camera.height, camera.width), np.uint8)
    with pytest.raises(RendezviewError, match="0 of 6 frames"):
        ShapeEstimator(refining_model, camera).estimate([empty] * 6)


def test_a_model_without_contours_is_refused(tiny_model, camera):
    with pytest.raises(RendezviewError, match="contour"):
        ShapeEstimator(tiny_model, camera)


@pytest.mark.requirement("RV-REC-5")
def test_a_wrong_mesh_that_nobody_mentions_widens_the_covariance(
    refining_model, camera, fly_around, found
):
    frames, poses, priors = fly_around

    def normalised(model):
        recognizer = Recognizer(model, camera)
        squares = []
        for frame, truth, prior in zip(frames, poses, priors, strict=True):
            seen = recognizer.recognize(frame, prior, np.deg2rad(6.0))
            if seen.pose is None:
                continue
            turn = Rotation.from_matrix(truth.rotation @ seen.pose.rotation.T).as_rotvec()
            error = np.concatenate([turn, truth.translation_m - seen.pose.translation_m])
            squares.append(error @ np.linalg.solve(seen.covariance, error))
        assert len(squares) > 15
        return np.median(squares)

    assert normalised(refining_model) < 30.0  # some 300 where only edges counted
    assert normalised(strained(refining_model, found.strain)) > 0.3


def test_the_picture_shows_residuals_before_and_after(found, refining_model):
    radius_m = refining_model.target_radius_m
    for residuals in (found.before, found.after):
        assert len(residuals.place_m) == len(residuals.share) > 500
        assert np.linalg.norm(residuals.place_m, axis=1).max() < 1.05 * radius_m
    assert np.abs(found.after.share).mean() < 0.7 * np.abs(found.before.share).mean()
    picture = shape_picture(found, "bumpy")
    half = picture.shape[0] // 2
    colourful = (picture.max(axis=2).astype(int) - picture.min(axis=2)) > 120
    assert colourful[:half].sum() > 2 * colourful[half:-60].sum()  # the legend is below
