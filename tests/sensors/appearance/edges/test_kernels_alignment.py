"""The alignment of a pose beside plain numpy, on drawn frames of a small model."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rendezview.geometry.lens import lens_vector
from rendezview.geometry.pose import Pose
from rendezview.sensors.appearance.edges.alignment import (
    DIVERGED,
    Stage,
    align,
    align_each,
    inlier_ratios,
    nearest_distance,
    normal_equations,
    take_step,
)
from rendezview.sensors.appearance.edges.grey import measure_edges
from rendezview.sensors.appearance.edges.lighting import fit_light
from rendezview.sensors.appearance.edges.predicted import (
    COLUMNS,
    FOUND,
    OUTSIDE,
    RESIDUAL,
    STATE,
    WEIGHT,
)
from rendezview.sensors.appearance.model.contours import NO_POINT, OUTLINE
from rendezview.sensors.appearance.model.view_tables import ViewTables, read_only
from rendezview.sensors.appearance.sky import Sky

BLUR_PX = 0.85
COARSE = [Stage(10, 4, 3, smooth_px=2, room_px=2, stride=2), Stage(5, 1.5, 2)]
FINE = [
    Stage(8, 3, 3, room_px=2, stop_px=1.0),
    Stage(6, 2, 3, damping=1e-4, relaxation=1.3, stop_px=0.6),
    Stage(5, 1.2, 10, lines=3, fit=1, damping=1e-4, relaxation=1.3, stop_px=0.4),
    Stage(4, 0.5, 1, lines=3, fit=1, views=3, damping=1e-4, relaxation=1.3),
]
Lens = tuple[np.ndarray, bool]
NO_LIGHT, NO_SUN = np.zeros(1), np.zeros(3)


@dataclass
class Scene:
    """A drawn frame, with what the kernels read."""

    image: np.ndarray
    lens: Lens
    frame: np.ndarray  # of the sky
    views: ViewTables
    rotation: np.ndarray  # the true pose
    centre: np.ndarray

    def start(self, degrees: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """The true pose, turned about a random axis and shifted a little."""
        rng = np.random.default_rng(seed)
        axis = rng.normal(size=3)
        turn = Rotation.from_rotvec(np.deg2rad(degrees) * axis / np.linalg.norm(axis))
        shift = np.deg2rad(degrees) * np.array([0.2, -0.2, 0.6])
        return np.ascontiguousarray(turn.as_matrix() @ self.rotation), self.centre + shift

    def edges(self, views: int = 3) -> np.ndarray:
        return np.zeros((views * self.views.point.shape[2], COLUMNS))

    def aligned(
        self, stages: list[Stage], rotation: np.ndarray, centre: np.ndarray
    ) -> tuple[float, np.ndarray]:
        """What ``align`` answers, with the edges; it moves the pose in place."""
        edges = self.edges()
        answer = align(
            self.image, self.lens, self.frame, np.array(stages), self.views, rotation, centre,
            edges,
        )  # fmt: skip
        return answer, edges

    def nearest(
        self, rotation: np.ndarray, centre: np.ndarray, count: int
    ) -> tuple[int, list[int]]:
        """Shell and views that show the target most nearly as a pose does."""
        inverse = np.abs(1.0 / self.views.shells_m - 1.0 / np.linalg.norm(centre))
        order = np.argsort(-(self.views.directions @ (-rotation.T @ centre)))
        return int(np.argmin(inverse)), order[:count].tolist()

    def off(self, rotation: np.ndarray, centre: np.ndarray) -> tuple[float, float]:
        """Errors of a pose: degrees and metres."""
        turn = Rotation.from_matrix(rotation @ self.rotation.T).magnitude()
        return float(np.rad2deg(turn)), float(np.linalg.norm(centre - self.centre))


@pytest.fixture(scope="module", params=[3, 11])
def scene(request, refining_model, bumpy_mesh, camera, draw) -> Scene:
    seed: int = request.param
    contours, rng = refining_model.contours, np.random.default_rng(seed)
    arrays = (
        refining_model.lattice.nodes, contours.shells_m, contours.point, contours.tangent,
        contours.kind, contours.run, contours.strip, contours.start, contours.palette,
    )  # fmt: skip
    views = ViewTables(*map(read_only, arrays), refining_model.target_radius_m, BLUR_PX, 0.0)
    rotation = np.ascontiguousarray(Rotation.random(random_state=rng).as_matrix())
    centre = np.array([0.1, -0.2, 8.0])
    pose = Pose(rotation, centre - rotation @ refining_model.centre_m)
    image = draw(bumpy_mesh, pose, camera, rng)
    lens = lens_vector(camera), camera.is_distorted
    return Scene(image, lens, Sky.of(image).vector, views, rotation, centre)


@pytest.mark.parametrize("seed", range(3))
def test_a_start_one_degree_off_reaches_the_truth(scene, seed):
    rotation, centre = scene.start(1.0, seed)
    before = scene.off(rotation, centre)
    answer, _ = scene.aligned(FINE, rotation, centre)
    degrees, metres = scene.off(rotation, centre)
    assert before[0] == pytest.approx(1.0)
    assert 0.0 < answer <= 1.0
    assert degrees < 0.35
    assert metres < 0.03
    assert rotation @ rotation.T == pytest.approx(np.eye(3), abs=1e-14)


def reference(
    scene: Scene, stages: list[Stage], rotation: np.ndarray, centre: np.ndarray
) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
    """Gauss–Newton with Tukey's weights, damped, in dense numpy on the same measurements."""
    views, focal, radius_m = scene.views, scene.lens[0][0], scene.views.radius_m
    shade, sun, explained = np.zeros(len(views.palette)), np.zeros(3), 0.0
    shell, nearest, counts = 0, [0], [0]
    edges: list[np.ndarray] = []
    for stage in stages:
        if stage.fit:
            explained = fit_light(
                scene.image, edges[0], counts[0], views.kind[shell, nearest[0]],
                views.strip[shell, nearest[0]], views.start[shell, nearest[0]], views.palette,
                rotation, centre, focal * radius_m / centre[2], scene.frame, sun, shade,
            )  # fmt: skip
        for _ in range(int(stage.steps)):
            shell, nearest = scene.nearest(rotation, centre, int(stage.views))
            edges = [scene.edges(1) for _ in nearest]
            counts = [
                measure_edges(
                    scene.image, scene.lens, scene.frame, views, shell, view, rotation, centre,
                    shade, sun, int(stage.reach_px), float(stage.spread_px), int(stage.smooth_px),
                    float(stage.room_px), int(stage.lines), int(stage.stride), bool(stage.fit),
                    rows,
                )
                for view, rows in zip(nearest, edges, strict=True)
            ]  # fmt: skip
            rows = np.concatenate(edges)
            cut = 2.5 * stage.spread_px
            rows = rows[(rows[:, STATE] == FOUND) & (np.abs(rows[:, RESIDUAL]) < cut)]
            if len(rows) < 12:
                return DIVERGED, rotation, centre, np.concatenate(edges)
            jacobian, residual = rows[:, :6], rows[:, RESIDUAL]
            w = rows[:, WEIGHT] * (1.0 - (residual / cut) ** 2) ** 2
            scale = focal / centre[2]
            damping = stage.damping * w.sum() * scale**2 * np.repeat([radius_m**2, 1.0], 3)
            step = stage.relaxation * np.linalg.solve(
                jacobian.T * w @ jacobian + np.diag(damping), jacobian.T @ (w * residual)
            )
            turn = np.linalg.norm(step[:3])
            moved = turn * radius_m + np.linalg.norm(step[3:] * [1.0, 1.0, 0.1])
            step *= min(1.0, 0.2 / turn)
            rotation = Rotation.from_rotvec(step[:3]).as_matrix() @ rotation
            centre = centre + step[3:]
            if scale * moved < stage.stop_px * min(1.0, 0.01 * scale * radius_m):
                break
    return explained, rotation, centre, np.concatenate(edges)


@pytest.mark.parametrize("stages", [FINE, COARSE], ids=["fine", "coarse"])
@pytest.mark.parametrize("degrees", [1.0, 6.0])
def test_alignment_is_damped_gauss_newton(scene, stages, degrees):
    rotation, centre = scene.start(degrees)
    expected = reference(scene, stages, rotation.copy(), centre.copy())
    answer, edges = scene.aligned(stages, rotation, centre)
    assert answer == pytest.approx(expected[0], abs=1e-7)
    assert rotation == pytest.approx(expected[1], abs=1e-8)
    assert centre == pytest.approx(expected[2], abs=1e-8)
    last = expected[3]
    assert edges[: len(last), STATE].tolist() == last[:, STATE].tolist()
    found = last[:, STATE] == FOUND
    assert edges[: len(last)][found] == pytest.approx(last[found], rel=1e-6, abs=1e-6)
    assert np.all(edges[len(last) :, STATE] == OUTSIDE)


def test_a_step_turns_no_more_than_a_fifth_of_a_radian(scene):
    rotation, centre = scene.start(1.0)
    before = rotation.copy()
    answer, _ = scene.aligned(
        [Stage(10, 4, 1, smooth_px=2, relaxation=1000.0)], rotation, centre
    )  # fmt: skip
    turn = Rotation.from_matrix(rotation @ before.T).magnitude()
    assert answer == 0.0
    assert turn == pytest.approx(0.2, abs=1e-9)


def test_no_edges_no_pose_and_none_that_runs_away(scene):
    rotation, centre = scene.start(0.0)
    black = replace(scene, image=np.zeros_like(scene.image))
    assert black.aligned(COARSE, rotation, centre)[0] == DIVERGED
    assert scene.off(rotation, centre) == (pytest.approx(0.0, abs=1e-6), 0.0)
    near = np.array([0.0, 0.0, 1.01 * scene.views.radius_m])
    assert scene.aligned(COARSE, rotation, near)[0] == DIVERGED


def ratios_of(
    scene: Scene, rotation: np.ndarray, centre: np.ndarray, spread_px: float, stride: int
) -> np.ndarray:
    """Shares of the outline and the inner edges in place, and of the outline in the picture."""
    shell, (view,) = scene.nearest(rotation, centre, 1)
    edges = scene.edges(1)
    measure_edges(
        scene.image, scene.lens, scene.frame, scene.views, shell, view, rotation, centre, NO_LIGHT,
        NO_SUN, int(np.ceil(2.5 * spread_px)), spread_px, 1, 0.0, 1, stride, False, edges,
    )  # fmt: skip
    kind, rows = scene.views.kind[shell, view][::stride], edges[::stride]
    agrees = np.exp(-0.5 * (rows[:, RESIDUAL] / (0.53 * spread_px)) ** 2)
    agrees[rows[:, STATE] != FOUND] = 0.0
    outline, inner = kind == OUTLINE, (kind != OUTLINE) & (kind != NO_POINT)
    visible = rows[outline, STATE] >= 0.0
    return np.array([agrees[outline].mean(), agrees[inner].mean(), visible.mean()])


@pytest.mark.parametrize("width_px", [400, 210])
@pytest.mark.parametrize(("spread_px", "stride"), [(1.5, 1), (3.0, 2)])
def test_inlier_ratios_are_means_over_outline_and_inner_edges(scene, width_px, spread_px, stride):
    rotation, centre = scene.start(1.0)
    scene = replace(scene, image=np.ascontiguousarray(scene.image[:, :width_px]))
    found = inlier_ratios(
        scene.image, scene.lens, scene.frame, scene.views, rotation, centre, spread_px, stride,
        scene.edges(1),
    )  # fmt: skip
    expected = ratios_of(scene, rotation, centre, spread_px, stride)
    assert found == pytest.approx(expected, abs=1e-8)
    assert 0.0 < found[0] < 0.999
    assert (found[2] < 0.999) == (width_px < 400)


@pytest.mark.parametrize("survivors", [2, 4])
def test_each_of_several_poses_is_aligned_as_by_itself(scene, survivors):
    first, then = [Stage(20, 9, 2, smooth_px=4, room_px=4, stride=4)], COARSE
    starts = [scene.start(degrees, seed) for seed, degrees in enumerate((2.0, 90.0, 4.0, 1.0, 7.0))]
    starts.append(
        (starts[0][0].copy(), np.array([0.0, 0.0, 1.01 * scene.views.radius_m]))
    )  # is lost
    rotations = np.array([rotation for rotation, _ in starts])
    centres = np.array([centre for _, centre in starts])
    ratios = np.full((len(starts), 3), np.nan)
    expected = np.zeros((len(starts), 3))
    rough = np.zeros(len(starts))
    for k, pose in enumerate(starts):
        if scene.aligned(first, *pose)[0] != DIVERGED:
            rough[k] = ratios_of(scene, *pose, 3.0, 2)[:2] @ [1.0, 0.5]
    for k in np.argsort(-rough)[:survivors]:
        if rough[k] >= 0.65 * rough.max() and scene.aligned(then, *starts[k])[0] != DIVERGED:
            expected[k] = ratios_of(scene, *starts[k], 1.5, 1)
    align_each(
        scene.image, scene.lens, scene.frame, np.array(first), np.array(then), scene.views,
        rotations, centres, survivors, ratios,
    )  # fmt: skip
    assert ratios == pytest.approx(expected, abs=1e-8)
    assert rotations == pytest.approx(np.array([rotation for rotation, _ in starts]), abs=1e-9)
    assert centres == pytest.approx(np.array([centre for _, centre in starts]), abs=1e-9)
    assert 1 <= np.sum(np.any(expected > 0.0, axis=1)) <= survivors


def test_a_step_is_the_damped_solution_and_refuses_to_leave(scene):
    rng = np.random.default_rng(8)
    edges = np.zeros((40, COLUMNS))
    edges[:, :6], edges[:, RESIDUAL] = rng.normal(size=(40, 6)), 0.01 * rng.normal(size=40)
    edges[:, STATE], edges[:, WEIGHT] = FOUND, 1.0
    views = scene.views._replace(radius_m=2.0, shells_m=read_only(np.array([4.0])))
    lens, damping, place = scene.lens, 0.003, np.array([0.1, 0.2, 9.0])
    matrix, right = np.empty((6, 6)), np.empty(6)
    _, weights = normal_equations(edges, 0.1, matrix, right)
    held = damping * weights * (lens[0][0] / place[2]) ** 2
    step = np.linalg.solve(matrix + np.diag([4.0 * held] * 3 + [held] * 3), right)
    rotation, centre = np.eye(3), place.copy()
    assert take_step(edges, 0.1, damping, 1.0, lens, views, rotation, centre) > 0.0
    assert rotation == pytest.approx(Rotation.from_rotvec(step[:3]).as_matrix(), abs=1e-9)
    assert centre == pytest.approx(place + step[3:], abs=1e-9)
    near = np.array([0.0, 0.0, 1.0])  # within the target
    assert take_step(edges, 0.1, damping, 1.0, lens, views, np.eye(3), near.copy()) < 0.0
    within = views._replace(shells_m=read_only(np.array([0.5])))  # a part of it has nearer views
    assert take_step(edges, 0.1, damping, 1.0, lens, within, np.eye(3), near.copy()) > 0.0
    few = edges[:11]
    assert take_step(few, 0.1, damping, 1.0, lens, views, np.eye(3), place.copy()) < 0.0


def test_the_nearest_distance_is_outside_the_target_or_inside_its_nearest_view(scene):
    views = scene.views
    assert nearest_distance(views) == pytest.approx(1.02 * views.radius_m)
    near = views._replace(shells_m=np.array([0.5, 0.8]) * views.radius_m)
    assert nearest_distance(near) == pytest.approx(0.4 * views.radius_m)
