"""A pose beside its rivals: what drawn pictures say, and which poses look alike."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from tests.ground.mesh.mesh_samples import grey_mesh
from tests.sensors.appearance.judge.near_symmetric import twelve_sides

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.io.grey_frame import Picture
from rendezview.sensors.appearance.hypothesis import Hypothesis
from rendezview.sensors.appearance.judge.drawn import DrawnEvidence
from rendezview.sensors.appearance.judge.rivals import Rivals, line_scores
from rendezview.sensors.appearance.judge.sketch_choice import packaged, sketch_merit
from rendezview.sensors.appearance.model.shape import Shape
from rendezview.sensors.appearance.model.view_model import ViewModel
from rendezview.sensors.appearance.observation import AppearanceObservation
from rendezview.sensors.appearance.sky import Sky
from rendezview.sensors.appearance.verdict import beside_look_alikes
from rendezview.sensors.observation import Status
from rendezview_ground.learn.options import TrainingOptions, view_geometry
from rendezview_ground.learn.views.carried_shape import carried_shape
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.simulate.shading import ShadingOptions, render

CAMERA = Camera.from_fov(320, 320, np.deg2rad(40.0))
CAMERA_SHAPE = (320, 320)
SUN = np.array([0.5, -0.4, -0.77]) / np.linalg.norm([0.5, -0.4, -0.77])


@pytest.fixture(scope="module")
def drum() -> Mesh:
    return twelve_sides()


@pytest.fixture(scope="module")
def shape(drum: Mesh) -> Shape:
    return carried_shape(drum, view_geometry(drum, TrainingOptions(), None), seed=0)


@pytest.fixture(scope="module")
def model(tiny_model: ViewModel, drum: Mesh, shape: Shape) -> ViewModel:
    """Another model's trees, about the drum: only its shape, centre and radius are asked."""
    centre_m, radius_m = drum.bounding_sphere
    return dataclasses.replace(tiny_model, centre_m=centre_m, target_radius_m=radius_m, shape=shape)


def seen(rotation: Rotation, range_m: float = 6.0) -> Pose:
    return Pose(rotation.as_matrix(), np.array([0.2, -0.1, range_m]))


SIDE = seen(Rotation.from_euler("xyz", [70.0, 15.0, 20.0], degrees=True))


def picture(
    mesh: Mesh, pose: Pose, sun: np.ndarray = SUN, noise: float = 2.0, camera: Camera = CAMERA
) -> Picture:
    """A frame (H, W) by the simulator's own shading, with noise."""
    options = ShadingOptions(samples=3, specular=0.0, ambient=0.1, earthshine=0.0)
    radiance = render(mesh, camera, pose, sun, options).radiance
    grey = 8.0 + 200.0 * radiance / radiance.max()
    grey += np.random.default_rng(4).normal(0.0, noise, grey.shape)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


def aside(pose: Pose, angle_deg: float) -> Pose:
    """The drum turned about its own axis."""
    turn = Rotation.from_euler("z", angle_deg, degrees=True).as_matrix()
    return Pose(pose.rotation @ turn, pose.translation_m)


def under(poses: list[Pose]) -> list[Hypothesis]:
    """Poses under the Sun."""
    return [Hypothesis(pose, sun_camera=SUN) for pose in poses]


def test_the_true_pose_under_the_true_sun_explains_the_frame(model: ViewModel, drum: Mesh) -> None:
    frame = picture(drum, SIDE)
    evidence = DrawnEvidence(model.shape, model, CAMERA)
    window = evidence.window(frame, Sky.of(frame), SIDE)
    right, turned = evidence.drawn(window, SIDE), evidence.drawn(window, aside(SIDE, 60.0))
    assert right is not None
    assert turned is not None
    beside = window.beside([right, turned])
    right, turned = (dataclasses.replace(d, window=beside) for d in (right, turned))
    # Of 1257 cells of its disc, few are unexplained; the wrong pose may have any Sun.
    suns = Rotation.random(200, random_state=1).apply(SUN)
    best = min(turned.under(sun).cost for sun in suns)
    assert right.under(SUN).cost < 40.0
    assert best > 1.5 * right.under(SUN).cost


def test_a_small_part_of_a_craft_with_long_wings_tells_its_ends_apart(
    tiny_model: ViewModel,
) -> None:
    wing = trimesh.creation.box((9.0, 0.35, 0.03))
    nozzle = trimesh.creation.annulus(0.18, 0.27, 0.12)
    nozzle.apply_translation((0.0, 0.0, 0.55))
    craft = grey_mesh([trimesh.creation.cylinder(0.42, 1.0, sections=8), wing, nozzle])
    geometry = view_geometry(craft, TrainingOptions(), None)
    centre_m, radius_m = craft.bounding_sphere
    model = dataclasses.replace(
        tiny_model, centre_m=centre_m, target_radius_m=radius_m,
        shape=carried_shape(craft, geometry, seed=0),
    )  # fmt: skip
    camera = Camera.from_fov(480, 480, np.deg2rad(40.0))
    pose = seen(Rotation.from_euler("xyz", [-30.0, 25.0, 60.0], degrees=True), 15.0)
    turn = Rotation.from_euler("x", 180.0, degrees=True).as_matrix()
    frame = picture(craft, pose, camera=camera)
    evidence = DrawnEvidence(model.shape, model, camera)
    window = evidence.window(frame, Sky.of(frame), pose)
    other = Pose(pose.rotation @ turn, pose.translation_m)
    drawn = [evidence.drawn(window, one) for one in (pose, other)]
    assert all(one is not None for one in drawn)
    window = window.beside(drawn)
    right, turned = (dataclasses.replace(one, window=window).under(SUN).cost for one in drawn)
    assert turned > 1.5 * right  # 1.06 where the craft is drawn half as large, probability 0.64
    weighed = Rivals(model, camera).weigh(frame, Sky.of(frame), under([other, pose]), np.ones(2))
    assert weighed[0].pose is pose
    assert weighed[0].probability > 0.95


def test_a_look_alike_that_edges_have_moved_is_drawn_in_its_place_too(
    model: ViewModel, drum: Mesh
) -> None:
    """Else a pose that is wrong, and lies well, explains more of the frame than the right one."""
    frame = picture(drum, SIDE)
    moved = Rotation.from_rotvec([3.0, 2.0, 0.0], degrees=True).as_matrix()
    right = Pose(moved @ SIDE.rotation, SIDE.translation_m)
    rivals = Rivals(model, CAMERA)
    weighed = rivals.weigh(
        frame, Sky.of(frame), under([aside(SIDE, 60.0), right]), np.array([1.1, 1.0])
    )
    assert weighed[0].pose is right
    assert weighed[0].cost < 40.0  # as drawn at the true pose


def test_a_sun_that_is_known_is_used(model: ViewModel, drum: Mesh) -> None:
    frame, known = picture(drum, SIDE), np.array([0.0, 0.0, -1.0])
    poses = [SIDE, aside(SIDE, 60.0)]
    weighed = Rivals(model, CAMERA).weigh(frame, Sky.of(frame, known), under(poses), np.ones(2))
    for one in weighed:
        np.testing.assert_array_equal(one.sun_camera, known)


def test_shadows_fall_where_the_simulator_has_them(model: ViewModel, drum: Mesh) -> None:
    options = ShadingOptions(samples=3, specular=0.0, ambient=0.0, earthshine=0.0)
    low = np.array([0.9, 0.1, -0.42]) / np.linalg.norm([0.9, 0.1, -0.42])
    radiance = render(drum, CAMERA, SIDE, low, options).radiance
    frame = np.rint(200.0 * radiance / radiance.max()).astype(np.uint8)
    evidence = DrawnEvidence(model.shape, model, CAMERA)
    sky = Sky(0.0, 1.0, dark=True)
    drawn = evidence.drawn(evidence.window(frame, sky, SIDE), SIDE)
    assert drawn is not None
    lit = drawn.sunlit(low) > 0.05
    levels = drawn.window.levels.ravel()[drawn.where] > 10.0
    assert 0.2 < lit.mean() < 0.8
    assert (lit == levels).mean() > 0.95  # the border of a shadow is a pixel or two wide


def test_a_lens_is_taken_out_of_the_window(model: ViewModel) -> None:
    bent = dataclasses.replace(CAMERA, distortion=np.array([-0.2, 0.05, 0.0, 0.0, 0.0]))
    columns = np.arange(320)
    ramp = np.tile((columns // 2).astype(np.uint8), (320, 1))
    evidence = DrawnEvidence(model.shape, model, bent)
    pose = Pose(SIDE.rotation, np.array([0.3, 0.0, 6.0]))
    window = evidence.window(ramp, Sky(0.0, 1.0, dark=True), pose)
    row = window.levels.shape[0] // 2
    for column in (5, window.levels.shape[1] // 2, window.levels.shape[1] - 6):
        ray = [(column - window.cx) / window.fx, (row - window.cy) / window.fy, 1.0]
        u = bent.project(np.array(ray))[0]
        assert window.levels[row, column] == pytest.approx(0.5 * u, abs=1.0)


@pytest.mark.parametrize("range_m", [6.0, 2.6, 1.4])
def test_a_window_shows_the_frame_where_its_camera_has_it(model: ViewModel, range_m: float) -> None:
    """A blurred spot between pixels, in windows of one to four times fewer of them."""
    u, v, sigma = 171.3, 149.6, 4.0
    rows, columns = np.mgrid[:320, :320]
    blob = 200.0 * np.exp(-0.5 * ((columns - u) ** 2 + (rows - v) ** 2) / sigma**2)
    frame = np.rint(blob).astype(np.uint8)
    evidence = DrawnEvidence(model.shape, model, CAMERA)
    pose = Pose(SIDE.rotation, np.array([0.02, -0.03, range_m]))
    window = evidence.window(frame, Sky(0.0, 1.0, dark=True), pose)
    at_row, at_column = np.mgrid[: window.levels.shape[0], : window.levels.shape[1]]
    total = window.levels.sum()
    x = ((at_column * window.levels).sum() / total - window.cx) / window.fx
    y = ((at_row * window.levels).sum() / total - window.cy) / window.fy
    assert x * CAMERA.fx + CAMERA.cx == pytest.approx(u, abs=0.1)
    assert y * CAMERA.fy + CAMERA.cy == pytest.approx(v, abs=0.1)


def test_from_afar_look_alikes_have_the_outline_of_the_pose(model: ViewModel) -> None:
    camera = Camera.from_fov(320, 320, np.deg2rad(3.0))
    side = Pose(SIDE.rotation, np.array([0.3, -0.2, 80.0]))
    rivals = Rivals(model, camera)
    evidence = DrawnEvidence(model.shape, model, camera)
    window = evidence.window(np.zeros((320, 320), np.uint8), Sky(0.0, 1.0, dark=True), side)

    def cover(pose: Pose) -> np.ndarray:
        drawn, mask = evidence.drawn(window, pose), np.zeros(window.levels.size, np.bool_)
        assert drawn is not None
        mask[drawn.where] = True
        return mask

    own = cover(side)
    overlaps = []
    for pose in rivals.look_alikes(side):
        assert np.linalg.det(pose.rotation) == pytest.approx(1.0)  # also of a mirror image
        other = cover(pose)
        overlaps.append((own & other).sum() / (own | other).sum())
    likest = overlaps[: int((model.shape.alike > 0.85).sum())]
    assert len(likest) >= 12
    assert likest[0] > 0.97  # its mirror image: box and stub stay
    assert min(likest) > 0.8


def test_look_alikes_that_are_turned_too_far_are_left_out(model: ViewModel) -> None:
    rivals = Rivals(model, CAMERA)
    every = rivals.look_alikes(SIDE)
    near = rivals.look_alikes(SIDE, np.deg2rad(70.0))
    expected = [one for one in every if one.angle_to(SIDE) <= np.deg2rad(70.0)]
    assert 0 < len(near) == len(expected) < len(every)
    for one, other in zip(near, expected, strict=True):
        np.testing.assert_array_equal(one.rotation, other.rotation)
        np.testing.assert_array_equal(one.translation_m, other.translation_m)


def test_the_frame_tells_turns_by_sixty_degrees_apart(model: ViewModel, drum: Mesh) -> None:
    frame = picture(drum, SIDE)
    poses = [aside(SIDE, angle) for angle in (120.0, 0.0, 60.0)]
    weighed = Rivals(model, CAMERA).weigh(frame, Sky.of(frame), under(poses), np.ones(3))
    assert weighed[0].pose is poses[1]
    assert weighed[0].probability > 0.99
    assert sum(one.probability for one in weighed) == pytest.approx(1.0)


def test_what_no_pose_explains_does_not_hide_the_part_that_tells(
    model: ViewModel, drum: Mesh
) -> None:
    """Foil as grains of 3 px leaves most of every pose unexplained, alike."""
    side = seen(Rotation.from_euler("xyz", [30.0, 15.0, 20.0], degrees=True))
    grains = np.random.default_rng(7).normal(0.0, 1.0, CAMERA_SHAPE)
    grains = cv2.GaussianBlur(grains, (0, 0), 1.5)
    foil = 1.0 + 0.25 * grains / grains.std()
    frame = np.clip(picture(drum, side) * foil, 0.0, 255.0).astype(np.uint8)
    poses = [aside(side, angle) for angle in (30.0, 0.0, 330.0)]
    weighed = Rivals(model, CAMERA).weigh(frame, Sky.of(frame), under(poses), np.ones(3))
    assert weighed[0].pose is poses[1]
    assert weighed[0].cost > 60.0
    assert weighed[0].probability > 0.9


def test_merits_of_poses_that_look_the_same_decide_nothing(model: ViewModel, drum: Mesh) -> None:
    below = seen(Rotation.from_euler("xyz", [0.0, 0.0, 3.0], degrees=True))
    frame = picture(drum, below)
    poses = [aside(below, angle) for angle in (90.0, 180.0)]
    merits = np.array([1.0, 1.3])
    weighed = Rivals(model, CAMERA).weigh(frame, Sky.of(frame), under(poses), merits)
    assert weighed[0].probability < 0.9


def test_what_tells_poses_apart_counts_less_where_the_materials_are_unlike_the_mesh(
    model: ViewModel, drum: Mesh
) -> None:
    poses = under([SIDE, aside(SIDE, 60.0)])
    odds = []
    for spots in (0.0, 60.0):
        frame = picture(drum, SIDE).astype(np.float64)
        # Patches of 16 px, lighter and darker than the mesh says.
        patches = np.random.default_rng(3).choice([-spots, spots], (20, 20))
        frame += np.where(frame > 40.0, np.kron(patches, np.ones((16, 16))), 0.0)
        grey = np.clip(np.rint(frame), 0, 255).astype(np.uint8)
        weighed = Rivals(model, CAMERA).weigh(grey, Sky.of(grey), poses, np.zeros(2))
        share = next(one.probability for one in weighed if one.pose is SIDE)
        odds.append(np.log(share / (1.0 - share)))
    assert odds[0] > 2.0 * odds[1]
    assert odds[1] > -1.0


def test_a_sun_is_found_that_explains_as_much_as_the_true_one(model: ViewModel, drum: Mesh) -> None:
    """From one behind the camera, in six of eight frames; plane sides leave some Suns open."""
    rng, evidence, found = np.random.default_rng(1), DrawnEvidence(model.shape, model, CAMERA), 0
    for k in range(8):
        pose = seen(Rotation.random(random_state=k))
        phase, azimuth = rng.uniform(0.1, 1.2), rng.uniform(0.0, 2.0 * np.pi)
        sun = Rotation.from_euler("xz", [phase, azimuth]).apply([0.0, 0.0, -1.0])
        frame = picture(drum, pose, sun)
        drawn = evidence.drawn(evidence.window(frame, Sky.of(frame), pose), pose)
        assert drawn is not None
        started = drawn.under(np.array([0.0, 0.0, -1.0]))
        found += drawn.under_best_sun(started).cost < drawn.under(sun).cost + 4.0
    assert found >= 6


def test_where_box_and_stub_are_hidden_no_pose_is_sure(model: ViewModel, drum: Mesh) -> None:
    """From below, the drum shows twelve sides and a cone."""
    below = seen(Rotation.from_euler("xyz", [0.0, 0.0, 3.0], degrees=True))
    frame = picture(drum, below)
    poses = [aside(below, angle) for angle in (90.0, 180.0, 270.0)]
    weighed = Rivals(model, CAMERA).weigh(frame, Sky.of(frame), under(poses), np.ones(3))
    assert weighed[0].probability < 0.9


def test_a_pose_alone_is_not_drawn(model: ViewModel) -> None:
    frame = np.zeros((320, 320), np.uint8)
    alone = Rivals(model, CAMERA).weigh(frame, Sky(0.0, 1.0, dark=True), under([SIDE]), np.ones(1))
    assert alone[0].probability == 1.0
    assert np.isnan(alone[0].cost)


def test_poses_that_no_frame_shows_are_not_weighed(model: ViewModel) -> None:
    frame = np.zeros((320, 320), np.uint8)
    tiny = [Pose(SIDE.rotation, np.array([0.0, 0.0, z])) for z in (900.0, 950.0)]
    weighed = Rivals(model, CAMERA).weigh(frame, Sky(0.0, 1.0, dark=True), under(tiny), np.ones(2))
    assert weighed == []


def on_a_sketch(pose: Pose, merit: float) -> Hypothesis:
    """A pose on a sketch whose merit is some figure: that of one feature alone."""
    weights = packaged().merit
    return Hypothesis(pose, sketch=np.append(merit / weights[0], np.zeros(len(weights) - 1)))


def test_no_hold_on_a_sketch_counts_as_the_worst_of_the_others() -> None:
    np.testing.assert_allclose(line_scores(np.array([2.0, np.nan, 12.0])), [1.0, 1.0, 6.0])
    np.testing.assert_array_equal(line_scores(np.full(3, np.nan)), np.zeros(3))


@pytest.mark.parametrize("from_below", [True, False])
def test_a_sketch_tells_only_poses_apart_whose_pictures_differ(
    model: ViewModel, drum: Mesh, from_below: bool
) -> None:
    """From below nothing does: merits on a sketch differ by chance there, too."""
    pose = seen(Rotation.from_euler("xyz", [0.0, 0.0, 3.0], degrees=True)) if from_below else SIDE
    frame = picture(drum, pose)
    angles = (90.0, 180.0, 270.0) if from_below else (60.0, 0.0, 270.0)
    poses = [aside(pose, angle) for angle in angles]
    sketch = [on_a_sketch(one, merit) for one, merit in zip(poses, (5.0, 15.0, 5.0), strict=True)]
    lines = line_scores(np.array([sketch_merit(one) for one in sketch]))
    led = [
        dataclasses.replace(one, on_sketch=there)
        for one, there in zip(under(poses), sketch, strict=True)
    ]
    odds = []
    for known in (None, lines):
        weighed = Rivals(model, CAMERA).weigh(frame, Sky.of(frame), led, np.ones(3), known)
        first, second = (next(w for w in weighed if w.pose is one) for one in poses[:2])
        assert second.on_sketch is sketch[1]
        assert second.probability < 0.9 or not from_below
        odds.append(np.log(second.probability / first.probability))
    share = (odds[1] - odds[0]) / (lines[1] - lines[0])
    assert share < 0.3 if from_below else share > 0.8


def of_trees(pose: Pose) -> AppearanceObservation:
    return AppearanceObservation(Status.OK, pose=pose, covariance=1e-4 * np.eye(6))


@pytest.mark.parametrize("off_deg", [0.0, 2.0])
def test_a_pose_of_the_trees_is_given_with_its_probability_beside_look_alikes(
    model: ViewModel, drum: Mesh, off_deg: float
) -> None:
    frame, pose = picture(drum, SIDE), aside(SIDE, off_deg)
    weighed = Rivals(model, CAMERA).weigh_coarse(frame, Sky.of(frame, SUN), pose)
    given = beside_look_alikes(of_trees(pose), weighed, [])
    assert given.pose is pose
    assert given.confidence is not None
    assert 0.5 < given.confidence <= 1.0


@pytest.mark.parametrize("off_deg", [60.0, 180.0, 240.0])
def test_a_pose_of_the_trees_that_a_look_alike_contradicts_is_not_given(
    model: ViewModel, drum: Mesh, off_deg: float
) -> None:
    frame, wrong = picture(drum, SIDE), aside(SIDE, off_deg)
    weighed = Rivals(model, CAMERA).weigh_coarse(frame, Sky.of(frame, SUN), wrong)
    seen = beside_look_alikes(of_trees(wrong), weighed, [])
    assert seen.status is Status.AMBIGUOUS
    assert seen.pose is None
    assert seen.covariance is None
    assert seen.confidence is not None
    assert seen.confidence < 0.1
    assert "look-alikes" in (seen.reason or "")


def test_a_pose_of_the_trees_that_is_too_small_to_draw_stays(model: ViewModel) -> None:
    frame = np.zeros((320, 320), np.uint8)
    tiny = Pose(SIDE.rotation, np.array([0.0, 0.0, 900.0]))
    weighed = Rivals(model, CAMERA).weigh_coarse(frame, Sky(0.0, 1.0, dark=True), tiny)
    seen = of_trees(tiny)
    assert beside_look_alikes(seen, weighed, []) is seen
