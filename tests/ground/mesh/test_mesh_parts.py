"""Parts of a target that are less trusted than the others."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.ground.mesh.mesh_samples import WING_BOXES_M, winged_mesh, winged_target
from tests.quick_training import CONTOURS_ALONE

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.io.target import Target
from rendezview.sensors.appearance import Recognizer, ViewModel
from rendezview.sensors.appearance.model.contours import NO_POINT, POINT_UNIT
from rendezview_ground.learn.options import TrainingOptions, view_geometry
from rendezview_ground.learn.target_job import train_target
from rendezview_ground.learn.views.contours import contour_points
from rendezview_ground.learn.views.surface_points import candidate_points
from rendezview_ground.mesh.mesh import Mesh, load_mesh
from rendezview_ground.mesh.parts import with_blankets, with_trust
from rendezview_ground.render.crossings import faces_beside
from rendezview_ground.simulate.scene import SceneOptions, render_frame

WING = f'[[parts]]\nname = "wing"\ntrust = {{}}\nboxes_m = {WING_BOXES_M}\n'
OPTIONS = TrainingOptions(contour_points=200, contour_resolution_px=256)


def trusting(folder: Path, trust: float) -> Target:
    return winged_target(folder, WING.format(trust))


def share_on_wing(mesh: Mesh) -> float:
    geometry = view_geometry(mesh, OPTIONS, None)
    view = contour_points(mesh, faces_beside(mesh), geometry, np.array([0.6, 0.48, 0.64]),
                          3.0 * geometry.target_radius_m, OPTIONS)  # fmt: skip
    points = view["point"][view["kind"] != NO_POINT] * POINT_UNIT * geometry.target_radius_m
    return float(np.mean(points[:, 1] + geometry.centre_m[1] > 0.79))


def test_a_less_trusted_part_has_fewer_contour_and_surface_points(tmp_path: Path) -> None:
    shares, surfaces = [], []
    for trust in (1.0, 0.3, 0.0):
        target = trusting(tmp_path / str(trust), trust)
        mesh = with_trust(load_mesh(target.mesh_path, target.unit), target)
        shares.append(share_on_wing(mesh))
        points, _ = candidate_points(mesh, view_geometry(mesh, OPTIONS, None), OPTIONS)
        centre_m = view_geometry(mesh, OPTIONS, None).centre_m
        surfaces.append(float(np.mean(points[:, 1] + centre_m[1] > 0.79)))
    plain = load_mesh(target.mesh_path, target.unit)
    assert shares[0] == share_on_wing(plain) > 0.3
    # With a share s of the edge length, trust t leaves t s / (t s + 1 − s) of the points.
    expected = 0.3 * shares[0] / (0.3 * shares[0] + 1.0 - shares[0])
    assert shares[1] == pytest.approx(expected, abs=0.06)
    assert shares[2] == 0.0 == surfaces[2]
    assert surfaces[0] > 1.5 * surfaces[1] > 0.0


def test_a_bent_part_that_is_not_trusted_costs_little(tmp_path: Path) -> None:
    camera = Camera.from_fov(480, 360, np.deg2rad(40.0))
    bent = winged_mesh(np.deg2rad(6.0))
    bent.export(tmp_path / "bent.obj")
    shown = load_mesh(tmp_path / "bent.obj", "m")
    rng, light = np.random.default_rng(3), SceneOptions(sky_frame="camera")
    frames = []
    for _ in range(6):
        turn = Rotation.random(random_state=rng).as_matrix()
        pose = Pose(turn, np.array([0.0, 0.0, 12.0]))
        sun = [0.2, 0.1, -1.0]
        frames.append((pose, render_frame(shown, camera, pose, sun, light, rng)))
    medians = []
    for trust in (1.0, 0.0):
        target = trusting(tmp_path / f"t{trust}", trust)
        mesh = load_mesh(target.mesh_path, target.unit)
        train_target(target, mesh, tmp_path / f"{trust}.rvm", options=CONTOURS_ALONE, jobs=1)
        recognizer = Recognizer(ViewModel.load(tmp_path / f"{trust}.rvm"), camera)
        errors = []
        for truth, frame in frames:
            found = recognizer.recognize(frame, prior=truth)
            # Where the bent part is trusted, a pose may be so far off that none is given.
            assert found.pose is not None or trust == 1.0
            errors.append(180.0 if found.pose is None else np.rad2deg(found.pose.angle_to(truth)))
        medians.append(np.median(errors))
    # degrees, 1.8 and 0.05 when it was written
    assert medians[0] < 5.0
    assert medians[1] < 0.3
    assert medians[1] < 0.3 * medians[0]


@pytest.mark.parametrize(
    ("part", "words"),
    [
        ('[[parts]]\nname = "a"\ntrust = 0.5\n', "nowhere"),
        ('[[parts]]\nname = "a"\ntrust = 1.5\nnodes = ["b"]\n', "trust"),
        ('[[parts]]\nname = "a"\ntrust = 0.5\nboxes_m = [[[1, 1, 1], [0, 2, 2]]]\n', "corners"),
        (f'[[parts]]\nname = "a"\ntrust = 1.0\nboxes_m = {WING_BOXES_M}\n' * 2, "more than once"),
    ],
)
def test_a_wrong_part_is_refused_with_its_reason(tmp_path: Path, part: str, words: str) -> None:
    with pytest.raises(RendezviewError, match=words):
        winged_target(tmp_path, part)


def test_parts_must_have_faces_and_leave_some(tmp_path: Path) -> None:
    nowhere = winged_target(
        tmp_path, '[[parts]]\nname = "a"\ntrust = 0.5\nboxes_m = [[[8, 8, 8], [9, 9, 9]]]\n'
    )
    mesh = load_mesh(nowhere.mesh_path, nowhere.unit)
    with pytest.raises(RendezviewError, match="no face"):
        with_trust(mesh, nowhere)
    everything = winged_target(
        tmp_path, '[[parts]]\nname = "a"\ntrust = 0.0\nboxes_m = [[[-9, -9, -9], [9, 9, 9]]]\n'
    )
    with pytest.raises(RendezviewError, match="no part"):
        with_trust(mesh, everything)
    assert with_trust(mesh, replace(everything, parts=())) is mesh


BLANKET = f'[[parts]]\nname = "wing"\ninsulation_m = {{}}\nboxes_m = {WING_BOXES_M}\n'


def wing_and_body(target: Target, rng: np.random.Generator | None = None) -> tuple[Mesh, Mesh]:
    """The mesh of the file, and the same with its blanket."""
    plain = load_mesh(target.mesh_path, target.unit)
    return plain, with_blankets(plain, target, rng=rng)


def test_a_blanket_over_a_part_makes_it_thicker_and_leaves_the_rest(tmp_path: Path) -> None:
    plain, mesh = wing_and_body(winged_target(tmp_path, BLANKET.format(0.06)))
    wing = mesh.vertices_m[:, 1] > 0.7
    assert np.ptp(mesh.vertices_m[wing, 2]) == pytest.approx(0.05 + 2.0 * 0.06, abs=1e-6)
    body = plain.vertices_m[plain.vertices_m[:, 1] < 0.7]
    assert mesh.vertices_m[~wing].min(0) == pytest.approx(body.min(0))
    assert mesh.vertices_m[~wing].max(0) == pytest.approx(body.max(0))
    again = wing_and_body(winged_target(tmp_path, BLANKET.format(0.06)))[1]
    assert np.array_equal(again.vertices_m, mesh.vertices_m)


def test_the_blanket_of_a_simulated_craft_has_bumps_about_the_mean(tmp_path: Path) -> None:
    target = winged_target(tmp_path, BLANKET.format(0.06))
    _, even = wing_and_body(target)
    _, bumpy = wing_and_body(target, np.random.default_rng(3))
    plain = winged_mesh().bounds[:, 2]
    upper = (even.vertices_m[:, 1] > 0.9) & (even.vertices_m[:, 2] > 0.08)
    heights = bumpy.vertices_m[upper, 2] - 0.025
    assert plain[1] > 0.025
    assert heights.mean() == pytest.approx(0.06, rel=0.5)
    assert 0.01 < heights.std() < 0.06
    assert heights.min() > -1e-9
    other = wing_and_body(target, np.random.default_rng(4))[1]
    assert not np.array_equal(other.vertices_m, bumpy.vertices_m)


def test_faces_under_a_blanket_keep_their_trust(tmp_path: Path) -> None:
    text = BLANKET.format(0.1).replace("boxes_m", "trust = 0.5\nboxes_m")
    target = winged_target(tmp_path, text)
    mesh = load_mesh(target.mesh_path, target.unit)
    covered = with_blankets(with_trust(mesh, target), target)
    assert covered.face_trust is not None
    middles = covered.vertices_m[covered.faces].mean(1)
    assert np.array_equal(covered.face_trust == np.float32(0.5), middles[:, 1] > 0.69)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("0.1", "-0.1"), "insulation_m"),
        (("0.1", "9.0"), "thick"),
        (("3.0, 1.0", "0.71, 1.0"), "no face"),
    ],
)
def test_blankets_that_cannot_be_are_refused(
    tmp_path: Path, change: tuple[str, str], message: str
) -> None:
    text = BLANKET.format(0.1).replace(*change)
    with pytest.raises(RendezviewError, match=message):
        wing_and_body(winged_target(tmp_path, text))
