"""Targets with joints: parts of the mesh, configurations, recognition and tracking of the angle."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from numba import typeof
from tests.ground.mesh.mesh_samples import winged_target
from tests.quick_training import REFINING

from rendezview.cli.compiling import load_loops, type_to_json
from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.geometry.symmetry import Symmetry
from rendezview.io.target import DockingRing, Target
from rendezview.sensors.appearance import Recognizer, ViewModel
from rendezview.sensors.appearance.edges.grey import point_of_slope, points_of_slopes
from rendezview.sensors.appearance.edges.refinement import Refiner
from rendezview.sensors.appearance.tracker import Tracker
from rendezview.sensors.observation import Status
from rendezview_ground.learn import joint_configurations
from rendezview_ground.learn.job import Trained
from rendezview_ground.learn.options import view_geometry
from rendezview_ground.learn.target_job import train_target
from rendezview_ground.mesh.joints import configuration_angles, posed, with_parts
from rendezview_ground.mesh.mesh import Mesh, load_mesh
from rendezview_ground.simulate.joint_motion import joint_motion
from rendezview_ground.simulate.scene import SceneOptions, render_frame

OPTIONS = replace(REFINING, order=1)
JOINT = """
[[joints]]
name = "wing"
boxes_m = [[[-1.0, 0.7, -1.0], [1.0, 3.0, 1.0]]]
axis = [0.0, 1.0, 0.0]
origin_m = [0.1, 0.0, 0.0]
limits_deg = [0.0, 30.0]
"""


def whole_mesh(target: Target) -> Mesh:
    return with_parts(load_mesh(target.mesh_path, target.unit), target)


@pytest.fixture(scope="module")
def target(tmp_path_factory: pytest.TempPathFactory) -> Target:
    return winged_target(tmp_path_factory.mktemp("winged"), JOINT)


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory, target: Target) -> ViewModel:
    path = tmp_path_factory.mktemp("model") / "winged.rvm"
    mesh = load_mesh(target.mesh_path, target.unit)
    train_target(target, mesh, path, options=OPTIONS, jobs=1)
    return ViewModel.load(path)


def frame_at(
    target: Target, camera: Camera, pose: Pose, angle_rad: float, seed: int = 0
) -> np.ndarray:
    joints = [parts.joint for parts in target.joints]
    mesh = posed(whole_mesh(target), joints, [angle_rad])
    options, rng = SceneOptions(sky_frame="camera"), np.random.default_rng(seed)
    return render_frame(mesh, camera, pose, [0.2, -0.3, -1.0], options, rng)


def some_pose(model: ViewModel, turn: float = 0.0) -> Pose:
    x, y, z = 0.7, 0.4 + turn, 0.5
    cx, sx, cy, sy, cz, sz = np.cos(x), np.sin(x), np.cos(y), np.sin(y), np.cos(z), np.sin(z)
    rotation = (
        np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
        @ np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
        @ np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    )
    return Pose(rotation, np.array([0.1, 0.0, 8.0]) - rotation @ model.centre_m)


def test_the_faces_in_the_box_are_the_part_and_turn(target: Target) -> None:
    mesh = whole_mesh(target)
    assert mesh.face_part is not None
    assert np.bincount(mesh.face_part).tolist() == [24, 12]
    joints = [parts.joint for parts in target.joints]
    turned = posed(mesh, joints, [np.deg2rad(30.0)])
    body, wing = (turned.vertices_m[turned.faces[mesh.face_part == k]] for k in (0, 1))
    before = mesh.vertices_m[mesh.faces]
    assert body == pytest.approx(before[mesh.face_part == 0])
    # The wing's edges at x = −0.5 and 0.7 swing about x = 0.1.
    assert np.abs(wing[..., 2]).max() == pytest.approx(
        0.6 * 0.5 + 0.025 * np.cos(np.pi / 6), abs=1e-6
    )
    assert wing[..., 1].min() == pytest.approx(0.8)


def test_a_pair_shares_an_angle_about_hinges_of_its_own(tmp_path: Path) -> None:
    other = """
[[joints.others]]
boxes_m = [[[0.6, 0.0, 0.0], [1.2, 0.6, 1.0]]]
axis = [0.0, -1.0, 0.0]
origin_m = [0.9, 0.3, 0.0]
"""
    pair = winged_target(tmp_path, JOINT + other)
    mesh = whole_mesh(pair)
    assert mesh.face_part is not None
    assert np.bincount(mesh.face_part).tolist() == [12, 12, 12]
    joints = [parts.joint for parts in pair.joints]
    assert configuration_angles(joints).shape == (2, 1)
    turned = posed(mesh, joints, [0.2])
    for part, hinge in enumerate(joints[0].hinges, 1):
        before = mesh.vertices_m[mesh.faces[mesh.face_part == part]].reshape(-1, 3)
        after = turned.vertices_m[turned.faces[mesh.face_part == part]].reshape(-1, 3)
        assert after == pytest.approx(hinge.moved(before, 0.2))
    assert joints[0].hinges[1].axis == pytest.approx([0.0, -1.0, 0.0])
    both = other.replace("0.6, 0.0, 0.0", "-1.0, 0.7, -1.0").replace("1.2, 0.6", "1.0, 3.0")
    with pytest.raises(RendezviewError, match="shares faces"):
        whole_mesh(winged_target(tmp_path, JOINT + both))


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> tuple[Target, ViewModel]:
    """The wing, and another on the other side that turns the other way."""
    other = """
[[joints.others]]
meshes = ["other.obj"]
axis = [0.0, -1.0, 0.0]
origin_m = [-0.2, 0.0, 0.0]
"""
    folder = tmp_path_factory.mktemp("pair")
    folder.mkdir(exist_ok=True)
    wing = trimesh.creation.box((1.0, 1.6, 0.05))
    wing.apply_translation([-0.2, -1.5, 0.0])
    wing.export(folder / "other.obj")
    target = winged_target(folder, JOINT + other)
    mesh = load_mesh(target.mesh_path, target.unit)
    train_target(target, mesh, folder / "pair.rvm", options=OPTIONS, jobs=1)
    return target, ViewModel.load(folder / "pair.rvm")


def test_the_angle_of_a_pair_comes_with_the_pose(
    pair: tuple[Target, ViewModel], camera: Camera
) -> None:
    target, model = pair
    assert len(model.joints) == 1
    assert len(model.joints[0].hinges) == 2
    pose, angle = some_pose(model), np.deg2rad(12.0)
    seen = Recognizer(model, camera, least_confidence=0.3).recognize(
        frame_at(target, camera, pose, angle)
    )
    assert seen.pose is not None, seen.reason
    assert seen.joints is not None
    assert np.rad2deg(seen.pose.angle_to(pose)) < 0.5
    assert np.rad2deg(seen.joints.angles_rad) == pytest.approx([12.0], abs=1.0)
    assert seen.joints.covariance.shape == (7, 7)


def test_a_model_has_a_sheet_for_each_angle_and_survives_its_file(model: ViewModel) -> None:
    configurations = (model, *model.configurations)
    assert np.rad2deg([s.angles_rad[0] for s in configurations]) == pytest.approx([7.5, 22.5])
    assert all(s.contours is not None and s.contours.part is not None for s in configurations)
    assert len({s.target_radius_m for s in configurations}) == 1
    assert all(s.centre_m == pytest.approx(model.centre_m) for s in configurations)


def test_its_tables_are_those_that_loops_are_compiled_for(model: ViewModel, camera: Camera) -> None:
    """Though its points are turned in place."""
    (listed,) = [e for e in load_loops("track") if e["loop"].endswith(".alignment:align")]
    assert type_to_json(typeof(Refiner(model, camera).views)) in listed["arguments"]


@pytest.mark.parametrize(
    ("change", "goes_on"),
    [
        ({}, True),
        ({"shape_error": 0.01}, False),
        ({"docking_ring": DockingRing(np.zeros(3), np.array([0.0, 0.0, 1.0]), 0.3)}, False),
        ({"symmetries": (Symmetry("discrete", np.array([0.0, 0.0, 1.0]), np.pi),)}, False),
    ],
)
def test_configurations_of_a_killed_training_are_kept_for_the_same_target_file_only(
    tmp_path: Path, target: Target, model: ViewModel, monkeypatch: pytest.MonkeyPatch,
    change: dict[str, Any], goes_on: bool,
) -> None:  # fmt: skip
    path, begun = tmp_path / "winged.rvm", list[Path]()
    path.with_name("winged.rvm.sheets").mkdir()
    for k, kept in enumerate((model, *model.configurations)):
        alone = replace(kept, joints=(), angles_rad=np.zeros(0), configurations=())
        alone.save(path.with_name("winged.rvm.sheets") / f"{k:02d}.rvm")

    def begin(mesh: Mesh, file: Path, **_: Any) -> Trained:
        begun.append(file)
        return Trained(ViewModel.load(file), None, view_geometry(mesh, OPTIONS, None))

    monkeypatch.setattr(joint_configurations, "train", begin)
    mesh = load_mesh(target.mesh_path, target.unit)
    train_target(replace(target, **change), mesh, path, options=OPTIONS, jobs=1)
    assert len(begun) == (0 if goes_on else 2)


@pytest.mark.parametrize("angle_deg", [2.0, 14.0, 26.0])
def test_a_first_pose_comes_with_the_angle(
    target: Target, model: ViewModel, camera: Camera, angle_deg: float
) -> None:
    pose = some_pose(model)
    image = frame_at(target, camera, pose, np.deg2rad(angle_deg))
    seen = Recognizer(model, camera, least_confidence=0.3).recognize(image)
    assert seen.status is Status.OK, seen.reason
    assert seen.pose is not None
    assert seen.joints is not None
    assert np.rad2deg(seen.pose.angle_to(pose)) < 0.5
    assert np.rad2deg(seen.joints.angles_rad[0]) == pytest.approx(angle_deg, abs=1.0)
    assert seen.joints.covariance.shape == (7, 7)
    assert np.linalg.eigvalsh(seen.joints.covariance).min() > 0.0
    line = seen.record()["joints"]
    assert line["names"] == ["wing"]
    assert line["angles_deg"][0] == pytest.approx(angle_deg, abs=1.0)


def test_a_turning_wing_is_tracked_across_sheets(
    target: Target, model: ViewModel, camera: Camera
) -> None:
    tracker = Tracker(Recognizer(model, camera, least_confidence=0.3), some_pose(model))
    for k in range(9):
        angle = np.deg2rad(10.0 + k)
        pose = some_pose(model, turn=0.005 * k)
        seen = tracker.update(float(k), frame_at(target, camera, pose, angle, k))
        assert seen.pose is not None, seen.reason
        assert seen.joints is not None
        assert np.rad2deg(seen.pose.angle_to(pose)) < 0.5
        assert np.rad2deg(abs(seen.joints.angles_rad[0] - angle)) < 1.0


def test_a_rigid_sheet_gets_another_pose_when_the_wing_is_elsewhere(
    target: Target, model: ViewModel, camera: Camera
) -> None:
    """The angle matters: held at its configuration, the pose explains less of the edges."""
    pose = some_pose(model)
    image = frame_at(target, camera, pose, np.deg2rad(13.0))
    recognizer = Recognizer(model, camera, least_confidence=0.3)
    free = recognizer.recognize(image, pose, angles_rad=[np.deg2rad(12.0)])
    search = recognizer.search
    assert search is not None
    search.refiner.articulation = None  # the points stay where the last frame turned them
    held = Recognizer(model.configurations[0], camera, least_confidence=0.3)
    assert held.search is not None
    held.search.refiner.articulation = None
    rigid = held.recognize(image, pose, angles_rad=[0.0])
    assert free.found is not None
    assert rigid.found is None or rigid.found.best.inlier_ratio < free.found.best.inlier_ratio


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("limits_deg = [0.0, 30.0]", "limits_deg = [30.0, 0.0]"), "must rise"),
        (("limits_deg = [0.0, 30.0]", "limits_deg = [0.0, 400.0]"), "more than a full turn"),
        (("boxes_m = [[[-1.0, 0.7, -1.0], [1.0, 3.0, 1.0]]]", ""), "has no parts"),
        (("[1.0, 3.0, 1.0]", "[1.0, 0.0, 1.0]"), "corners"),
        (("axis = [0.0, 1.0, 0.0]", "axis = [0.0, 0.0, 0.0]"), "must not be zero"),
        (("limits_deg", "symmetry_deg = 70.0\nlimits_deg"), "divide a full turn"),
    ],
)
def test_wrong_joints_are_refused_by_the_file(
    tmp_path: Path, change: tuple[str, str], message: str
) -> None:
    with pytest.raises(RendezviewError, match=message):
        winged_target(tmp_path, JOINT.replace(*change))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("0.7, -1.0]", "5.7, -1.0]"), "no face"),
        (("[-1.0, 0.7, -1.0], [1.0, 3.0, 1.0]", "[-9, -9, -9], [9, 9, 9]"), "all faces turn"),
        (("origin_m = [0.1", "origin_m = [100.1"), "its axis passes"),
    ],
)
def test_joints_that_do_not_fit_the_mesh_are_refused(
    tmp_path: Path, change: tuple[str, str], message: str
) -> None:
    text = JOINT.replace(*change).replace("[1.0, 3.0, 1.0]]", "[1.0, 9.0, 1.0]]")
    target = winged_target(tmp_path, text)
    with pytest.raises(RendezviewError, match=message):
        whole_mesh(target)


def test_a_joint_whose_turn_shows_nothing_is_refused(tmp_path: Path) -> None:
    body, drum = trimesh.creation.box((2.0, 1.0, 1.0)), trimesh.creation.cylinder(0.4, 1.0, 256)
    drum.apply_translation([0.0, 0.0, 2.0])
    text = JOINT.replace("[-1.0, 0.7, -1.0], [1.0, 3.0, 1.0]", "[-1.0, -1.0, 1.0], [1.0, 1.0, 3.0]")
    text = text.replace("[0.0, 1.0, 0.0]", "[0.0, 0.0, 1.0]").replace("[0.1, 0.0", "[0.0, 0.0")
    target = winged_target(tmp_path, text)
    trimesh.util.concatenate([body, drum]).export(target.mesh_path)
    with pytest.raises(RendezviewError, match="cannot be observed"):
        whole_mesh(target)


def test_too_many_sheets_are_refused(target: Target) -> None:
    with pytest.raises(RendezviewError, match="configurations, more than"):
        configuration_angles([parts.joint for parts in target.joints], np.deg2rad(0.2))


def test_joints_move_in_simulated_scenes(target: Target) -> None:
    joints = [parts.joint for parts in target.joints]
    motion = joint_motion(joints, ["wing=10,2"])
    assert np.rad2deg(motion.angles_rad(5.0)) == pytest.approx([20.0])
    assert np.rad2deg(motion.angles_rad(50.0)) == pytest.approx([30.0])  # held at its limit
    for setting in ("tail=3", "wing=x", "wing=50", "wing=1,2,3"):
        with pytest.raises(RendezviewError, match="--joint"):
            joint_motion(joints, [setting])


def test_the_slope_of_an_edge_with_the_angle_is_that_of_the_projection(model: ViewModel) -> None:
    """Beside numbers: the point of a pose slope, and what a small turn does to its projection."""
    rng = np.random.default_rng(4)
    pose = some_pose(model)
    centre = pose.apply(model.centre_m)
    normal = np.array([0.6, -0.8])

    def place(point: np.ndarray) -> float:
        x, y, z = pose.rotation @ point + centre
        return float(500.0 * normal @ np.array([x / z, y / z]))

    for _ in range(20):
        point = rng.normal(size=3)
        x, y, z = pose.rotation @ point + centre
        j = 500.0 / z * np.array([*normal, -(normal @ [x / z, y / z])])
        edge = np.concatenate([np.cross(pose.rotation @ point, j), j, np.zeros(7)])
        q, g = np.empty(3), np.empty(3)
        point_of_slope(edge, pose.rotation, centre, q, g)
        assert q == pytest.approx(point, abs=1e-9)
        assert np.array_equal(points_of_slopes(edge[None], pose.rotation, centre), q[None])
        (hinge,) = model.joints[0].hinges
        turned = hinge.moved([point + model.centre_m], 1e-6)[0] - model.centre_m
        slope = g @ np.cross(hinge.axis, point + model.centre_m - hinge.origin_m)
        assert slope == pytest.approx((place(turned) - place(point)) / 1e-6, rel=1e-4, abs=1e-3)
