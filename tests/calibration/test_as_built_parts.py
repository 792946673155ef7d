"""Parts of a craft that are mounted otherwise than its model has them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.ground.mesh.mesh_samples import HINGE_M, WING_BOXES_M, winged_mesh, winged_target
from tests.quick_training import CONTOURS_ALONE

from rendezview.calibration.as_built import AsBuilt, ShapeEstimator
from rendezview.calibration.as_built.parts import Part, distrusted, remounted
from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.io.parts import TrustedPart
from rendezview.sensors.appearance import Recognizer, ViewModel
from rendezview.sensors.appearance.model.contours import NO_POINT, POINT_UNIT
from rendezview_ground.learn.target_job import train_target
from rendezview_ground.mesh.mesh import load_mesh
from rendezview_ground.simulate.scene import SceneOptions, render_frame

CAMERA = Camera.from_fov(480, 360, np.deg2rad(40.0))
BENT_DEG = 6.0
BOX_M = np.array([[-1.0, 0.7, -1.0], [1.0, 3.0, 1.0]])  # WING_BOXES_M
WING = TrustedPart("wing", 1.0, boxes_m=(BOX_M,))
Frames = list[tuple[Pose, np.ndarray]]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("winged")
    part = f'[[parts]]\nname = "wing"\ntrust = 1.0\nboxes_m = {WING_BOXES_M}\n'
    target = winged_target(made, part)
    mesh = load_mesh(target.mesh_path, target.unit)
    plain, options = replace(target, parts=()), replace(CONTOURS_ALONE, order=2)
    train_target(plain, mesh, made / "winged.rvm", options=options, jobs=1)
    return made


@pytest.fixture(scope="module")
def straight(folder: Path) -> ViewModel:
    return ViewModel.load(folder / "winged.rvm")


def shown(folder: Path, turns_deg: Iterable[float], seed: int) -> Frames:
    """Frames of the craft from any side, its wing turned about the hinge."""
    rng, light = np.random.default_rng(seed), SceneOptions(sky_frame="camera")
    frames = []
    for turn_deg in turns_deg:
        winged_mesh(np.deg2rad(turn_deg)).export(folder / "shown.obj")
        craft = load_mesh(folder / "shown.obj", "m")
        rotation = Rotation.random(random_state=rng).as_matrix()
        pose = Pose(rotation, np.array([0.0, 0.0, rng.uniform(10.0, 14.0)]))
        sun = np.array([*rng.normal(0.0, 0.2, 2), -1.0])
        frames.append((pose, render_frame(craft, CAMERA, pose, sun, light, rng)))
    return frames


def estimated(model: ViewModel, frames: Frames, parts: tuple[TrustedPart, ...]) -> AsBuilt:
    priors = [pose for pose, _ in frames]
    return ShapeEstimator(model, CAMERA).estimate([f for _, f in frames], priors, parts=parts)


def median_error_deg(model: ViewModel, frames: Frames) -> float:
    recognizer = Recognizer(model, CAMERA)
    turn = Rotation.from_rotvec(np.deg2rad([1.0, -2.0, 2.0])).as_matrix()
    nearby = [Pose(turn @ truth.rotation, truth.translation_m) for truth, _ in frames]
    seen = [
        (truth, recognizer.recognize(frame, prior=prior).pose)
        for (truth, frame), prior in zip(frames, nearby, strict=True)
    ]
    errors = [pose.angle_to(truth) for truth, pose in seen if pose is not None]
    assert len(errors) >= len(frames) - 1
    return float(np.rad2deg(np.median(errors)))


@pytest.fixture(scope="module")
def bent(folder: Path, straight: ViewModel) -> AsBuilt:
    return estimated(straight, shown(folder, [BENT_DEG] * 16, 3), (WING,))


@pytest.mark.requirement("RV-REC-5")
def test_a_bent_wing_is_found_where_it_is(bent: AsBuilt, straight: ViewModel) -> None:
    (wing,) = bent.mountings
    arm = BOX_M.mean(0) - HINGE_M
    turn = Rotation.from_rotvec(np.deg2rad([BENT_DEG, 0.0, 0.0]))
    expected = np.concatenate([turn.as_rotvec(), turn.apply(arm) - arm])
    error = wing.motion - expected
    assert np.abs(np.rad2deg(error[:3])).max() < 0.1
    assert np.abs(error[3:]).max() < 0.003
    assert np.abs(bent.components).max() < 1e-3
    assert wing.trust > 0.15
    assert wing.edges > 500
    assert bent.rms_after < 0.3 * bent.rms_before
    assert straight.provenance.get("mounted") is None
    assert bent.model.provenance["mounted"]["wing"] == wing.motion.tolist()


def test_its_model_gives_better_poses_of_other_frames(
    bent: AsBuilt, straight: ViewModel, folder: Path
) -> None:
    others = shown(folder, [BENT_DEG] * 12, 8)
    before, after = median_error_deg(straight, others), median_error_deg(bent.model, others)
    assert after < 0.1  # degrees; 0.05 when it was written, 0.9 with the straight wing
    assert after < 0.2 * before


def test_a_wing_that_flutters_loses_trust(folder: Path, straight: ViewModel) -> None:
    flutter = np.random.default_rng(1).uniform(-4.0, 4.0, 16)
    frames = shown(folder, flutter, 5)
    found = estimated(straight, frames, (WING,))
    (wing,) = found.mountings
    assert wing.trust < 0.1
    # degrees; 0.59 and 0.10 when it was written
    assert median_error_deg(found.model, frames) < 0.4 * median_error_deg(straight, frames)


def test_a_straight_wing_is_trusted_and_a_missing_one_is_not(
    folder: Path, straight: ViewModel
) -> None:
    (wing,) = estimated(straight, shown(folder, [0.0] * 12, 5), (WING,)).mountings
    assert wing.trust == 1.0
    assert np.rad2deg(np.linalg.norm(wing.motion[:3])) < 0.1
    # Folded by 90°, where the model has no edges of it.
    (wing,) = estimated(straight, shown(folder, [90.0] * 12, 7), (WING,)).mountings
    assert wing.trust < 0.05


def count(kind: np.ndarray) -> int:
    return int((kind != NO_POINT).sum())


def test_only_the_part_is_moved_and_thinned(straight: ViewModel) -> None:
    part = Part.of(WING, straight)
    unit_m = POINT_UNIT * straight.target_radius_m
    places = straight.contours.point * unit_m
    own = part.holds(places) & (straight.contours.kind != NO_POINT)
    step = np.array([0.0, 0.0, 0.1, 0.0, 0.0, 0.02])
    moved = remounted(straight, straight, [part.after(step)], np.zeros((3, 3)))
    change = moved.contours.point * unit_m - places
    turn = Rotation.from_rotvec(step[:3])
    expected = turn.apply(places[own] - part.middle_m) + part.middle_m + step[3:] - places[own]
    assert change[own] == pytest.approx(expected, abs=2.0 * unit_m)
    assert not change[~part.holds(places, 1e-3)].any()
    tangents = turn.apply(straight.contours.tangent[own])
    lengths = np.linalg.norm(tangents, axis=1)
    aligned = np.einsum("ij,ij->i", tangents, moved.contours.tangent[own].astype(float))
    assert (aligned > 0.99 * lengths * np.linalg.norm(moved.contours.tangent[own], axis=1)).all()

    thinned = distrusted(straight, straight, [(part, 0.3)])
    kept = part.holds(thinned.contours.point * unit_m) & (thinned.contours.kind != NO_POINT)
    assert kept.sum() == pytest.approx(0.3 * own.sum(), rel=0.1)
    rest = count(straight.contours.kind) - own.sum()
    assert count(thinned.contours.kind) - kept.sum() == rest
    gone = thinned.contours.kind == NO_POINT
    assert (np.diff(gone.astype(int), axis=-1) >= 0).all()  # rows without a point stand last
    assert distrusted(straight, straight, [(part, 1.0)]) is straight


def test_parts_must_have_boxes_with_points_in_them(straight: ViewModel) -> None:
    with pytest.raises(RendezviewError, match="boxes_m"):
        Part.of(TrustedPart("wing", 1.0, nodes=("wing",)), straight)
    with pytest.raises(RendezviewError, match="no contour point"):
        Part.of(TrustedPart("wing", 1.0, boxes_m=(BOX_M + 50.0,)), straight)
