"""Pictures and the report, on a small model."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest
import trimesh
from matplotlib.figure import Figure
from tests.ground.evaluate.figures import pixels

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.io.results import ResultRow
from rendezview.io.sequences import Sequence, open_sequence
from rendezview.sensors.appearance import AppearanceObservation, Recognizer, ViewModel
from rendezview.sensors.appearance.outline.reading import OutlineReading
from rendezview.sensors.appearance.overlay import draw_observation
from rendezview.sensors.observation import Status
from rendezview_ground.evaluate import evaluate, frame_overlay, png, write_report
from rendezview_ground.evaluate.evaluation import Evaluation
from rendezview_ground.evaluate.page import _STYLE, WEBM, Card, figure
from rendezview_ground.evaluate.pictures.signature_pictures import signature_picture, tree_tests
from rendezview_ground.evaluate.pictures.sphere_pictures import model_picture, sphere_picture
from rendezview_ground.evaluate.pictures.track_pictures import (
    error_curves,
    observation_curves,
    point_cloud,
    stage_picture,
)
from rendezview_ground.evaluate.report_frames import shown_frames
from rendezview_ground.learn.job import train
from rendezview_ground.learn.options import TrainingOptions
from rendezview_ground.mesh.mesh import load_mesh
from rendezview_ground.simulate import (
    SceneOptions,
    ShadingOptions,
    TrajectoryOptions,
    simulate,
    trajectory,
)

ON_NODE_RGB = (230, 159, 0)


@dataclass(frozen=True)
class Run:
    model: ViewModel
    sequence: Sequence
    observations: list[AppearanceObservation]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    folder: Path = tmp_path_factory.mktemp("evaluation")
    box = trimesh.creation.box((2.0, 1.2, 0.8))
    bump = trimesh.creation.box((0.4, 0.5, 0.9)).apply_translation((0.7, 0.3, 0.7))
    trimesh.util.concatenate([box, bump]).export(folder / "box.stl")
    mesh = load_mesh(folder / "box.stl", "m")
    options = TrainingOptions(
        order=1, perturbed_views=400, held_out_views=100, resolution_px=96, seed=1,
        contour_radii=(1.0, 2.0), contour_resolution_px=256, shadowed_silhouettes=False,
        sketches=False, forest_trees=0, surface_points=0,
    )  # fmt: skip
    model = train(mesh, folder / "box.rvm", name="box", options=options, jobs=1).model
    camera = Camera.from_fov(160, 120, np.deg2rad(40.0))
    poses = trajectory(
        "circular", TrajectoryOptions(frames=10, start_range_m=7.0, centre_m=tuple(model.centre_m))
    )
    poses[3] = (poses[3][0], Pose(np.eye(3), np.array([0.0, 2.6, 7.0])))  # over the lower border
    scene = folder / "000007"
    light = SceneOptions(
        sun_phase_rad=0.1, sun_azimuth_rad=0.0, shading=ShadingOptions(shadows=False)
    )
    simulate(mesh, camera, poses, light, scene, seed=2)
    sequence = open_sequence(scene)
    recognizer = Recognizer(model, camera)
    observations = [recognizer.recognize(f.read(), f.camera_from_target) for f in sequence]
    return Run(model, sequence, observations)


def evaluation_of(run: Run) -> Evaluation:
    rows = [
        ResultRow(run.sequence.scene_id, frame.im_id, frame.obj_id, s.score, s.pose, 0.001)
        for frame, s in zip(run.sequence, run.observations, strict=True)
        if s.pose is not None
    ]
    return evaluate(run.sequence, rows, centre_m=run.model.centre_m)


def drawn(figure: Figure) -> npt.NDArray[np.uint8]:
    """The picture, which is of the figure's size and not empty."""
    picture = pixels(figure)
    width, height = figure.get_size_inches() * figure.dpi
    assert abs(picture.shape[1] - width) < 1 and abs(picture.shape[0] - height) < 1  # noqa: PT018
    shades = (
        picture[..., 0].astype(int) * 65536 + picture[..., 1].astype(int) * 256 + picture[..., 2]
    )
    assert np.count_nonzero(np.bincount(shades.ravel())) > 20
    return picture


def has_colour(picture: npt.NDArray[np.uint8], rgb: tuple[int, int, int]) -> bool:
    return bool((np.abs(picture.astype(int) - rgb).max(axis=2) < 12).any())


def test_the_scene_has_poses_and_one_frame_without(run: Run) -> None:
    found = evaluation_of(run)
    assert found.missing == (3,)
    assert run.observations[3].status is Status.BORDER


def test_an_overlay_shows_the_frame_with_its_outline(run: Run) -> None:
    frame, observation = run.sequence.frames[0], run.observations[0]
    picture = drawn(frame_overlay(frame.read(), observation, frame.camera, run.model))
    assert picture.shape[1] == 640
    assert picture.shape[0] > 480
    # the frame itself is at the top, each of its 160 × 120 pixels four wide and high
    image = frame.read()
    corner = picture[402:480:4, 2:80:4, 0].astype(int) - image[100:, :20]
    assert np.abs(corner).max() <= 2
    plain = replace(observation, pose=None, outline=OutlineReading())
    without = drawn(frame_overlay(image, plain, frame.camera, run.model))
    assert has_colour(picture[:480], ON_NODE_RGB)
    assert not has_colour(without[:480], ON_NODE_RGB)
    found = drawn(frame_overlay(image, replace(observation, pose=None), frame.camera, run.model))
    assert has_colour(found[:480], ON_NODE_RGB)  # of the silhouette


@pytest.mark.parametrize("k", [0, 3])
def test_an_overlay_is_the_drawn_observation_with_an_edge_where_it_is_a_problem(
    run: Run, k: int
) -> None:
    frame, observation = run.sequence.frames[k], run.observations[k]
    drawing = draw_observation(
        frame.read(), observation, frame.camera, run.model, title="frame   off by 3°"
    )
    for bad in (False, True):
        figure = frame_overlay(
            frame.read(), observation, frame.camera, run.model, title="frame", note="off by 3°",
            bad=bad,
        )  # fmt: skip
        picture = drawn(figure)
        assert np.array_equal(picture[:, 8:], drawing[:, 8:, ::-1])
        assert has_colour(picture[:400, :6], (255, 112, 67)) == (bad or k == 3)


def test_the_sphere_outlines_the_nodes_that_are_on(run: Run) -> None:
    direction = run.model.geodesic.nodes[4]
    quiet = drawn(sphere_picture(run.model, direction=direction))
    on = drawn(sphere_picture(run.model, direction=direction, truth=direction, active_nodes=[4]))
    assert has_colour(on, ON_NODE_RGB)
    assert not has_colour(quiet, ON_NODE_RGB)


def test_the_sphere_is_drawn_from_the_poles_and_with_values_that_are_missing(run: Run) -> None:
    count = len(run.model.geodesic.nodes)
    values = np.full(count, np.nan)
    unmeasured = replace(run.model, held_out_accuracy=values)
    without = replace(unmeasured, training_accuracy=values)
    for direction in ((0.0, 0.0, 1.0), (0.0, 0.0, -2.0)):
        drawn(sphere_picture(without, direction=direction))
        drawn(sphere_picture(run.model, active_nodes=range(count), truth=direction))
    drawn(model_picture(unmeasured))


def test_the_tests_of_a_tree_end_in_the_leaf_it_decides_by(run: Run) -> None:
    forest, readings = run.model.forest, run.model.views.readings
    for node in range(0, len(forest), 7):
        tests = tree_tests(forest, node, readings[node])
        assert len(tests) <= forest.depth(node)
        for test in tests:
            assert test.at_most == (readings[node][test.component] <= test.threshold)


def test_a_signature_is_drawn_with_and_without_a_node(run: Run) -> None:
    readings = run.model.views.readings[0]
    tests = tree_tests(run.model.forest, 0, readings)
    drawn(signature_picture(readings))
    figure = signature_picture(readings, run.model.views.readings[1], tests, node=0)
    drawn(figure)
    assert len(figure.axes[0].lines) == 2 + 2 * len(tests)


def test_error_curves_break_where_there_is_no_pose(run: Run) -> None:
    found = evaluation_of(run)
    figure = error_curves(found, [len(s.active_nodes) for s in run.observations])
    drawn(figure)
    y = np.asarray(figure.axes[0].lines[0].get_ydata())
    assert np.flatnonzero(np.isnan(y)).tolist() == [3]
    drawn(error_curves(found))
    drawn(error_curves(evaluate(run.sequence, [])))


def test_a_few_large_errors_do_not_flatten_the_curves(run: Run) -> None:
    frame = run.sequence.frames[0]
    assert frame.camera_from_target is not None
    rows = []
    for k in range(8):
        pose = frame.camera_from_target.perturbed([0.001 if k else 3.0, 0, 0, 0, 0, 0.001])
        rows.append(ResultRow(run.sequence.scene_id, k, 1, 1.0, pose))
    frames = tuple(
        replace(frame, im_id=k, time_s=None) for k in range(8)
    )  # no times: over the number of the frame
    found = evaluate(replace(run.sequence, frames=frames), rows)
    figure = error_curves(found)
    drawn(figure)
    assert figure.axes[0].get_yscale() == "log"
    assert figure.axes[-1].get_xlabel() == "frame"


def test_clouds_and_curves_without_truth_are_drawn(run: Run) -> None:
    drawn(point_cloud(np.zeros((0, 3))))
    track = np.array([[9.0, 0.0, 0.0], [np.nan] * 3, [0.0, 9.0, 1.0]])
    drawn(point_cloud(track + 0.1, estimates_m=track, truth_m=track, joined=False))
    drawn(observation_curves([0.0, 1.0], [5.0, np.nan], [3, 0], x_label="time, s"))
    drawn(observation_curves([0.0], [np.nan], [0], x_label="frame"))
    drawn(stage_picture(run.observations))


def test_a_picture_is_a_png_of_the_same_bytes_each_time(run: Run) -> None:
    first, second = (png(sphere_picture(run.model)) for _ in range(2))
    assert first == second
    picture = cv2.imdecode(np.frombuffer(first, np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    assert picture.shape == pixels(sphere_picture(run.model)).shape


def test_the_strip_holds_eight_frames_with_some_of_the_problems() -> None:
    assert shown_frames(5, {1}, set()) == [0, 1, 2, 3, 4]
    missing, wrong = set(range(40, 60)), set(range(70, 80))
    chosen = set(shown_frames(100, missing, wrong))
    assert len(chosen) == 8
    assert (len(chosen & missing), len(chosen & wrong)) == (2, 1)
    assert {0, 99} <= chosen
    assert len(set(shown_frames(100, {50}, wrong)) & wrong) == 2
    assert len(set(shown_frames(100, missing, set())) & missing) == 3
    assert len(shown_frames(100, set(range(98)), set())) == 8
    assert len(shown_frames(20, set(), set(range(20)))) == 8


def test_a_report_is_one_page_that_needs_nothing_else(run: Run, tmp_path: Path) -> None:
    path = write_report(
        tmp_path / "report",
        target_name="Box <b>&",
        model=run.model,
        sequence=run.sequence,
        observations=run.observations,
        evaluation=evaluation_of(run),
    )
    text = path.read_text(encoding="utf-8")
    assert "http:" not in text
    assert "https:" not in text
    assert "<script" not in text
    assert "<link" not in text
    sources = re.findall(r'src="([^"]*)"', text)
    assert all(source.startswith("data:image/png;base64,") for source in sources)
    assert len(sources) == 8 + 6 == len(list(path.parent.glob("*.png")))
    assert "Box &lt;b&gt;&amp;" in text
    assert "9 of 10" in text
    assert "frame_000003.png" in {p.name for p in path.parent.iterdir()}


def test_a_video_of_known_shape_leaves_room_below_for_its_player() -> None:
    known = figure(Card("film", "Film", "of it", b"video", WEBM, 0.75))
    assert 'class="apart" style="--tall: 0.7500"' in known
    assert "apart" not in figure(Card("film", "Film", "of it", b"video", WEBM))
    assert "video.apart" in _STYLE


def test_a_report_without_truth_or_without_any_pose_is_whole(run: Run, tmp_path: Path) -> None:
    short = replace(run.sequence, frames=run.sequence.frames[:2])
    blind = [AppearanceObservation(Status.EMPTY, "nothing stands out from the background")] * 2
    for sequence, observations in ((run.sequence, run.observations), (short, blind)):
        path = write_report(
            tmp_path,
            target_name="box",
            model=run.model,
            sequence=sequence,
            observations=observations,
        )
        text = path.read_text(encoding="utf-8")
        assert "has no truth" in text
        assert "median attitude error" not in text
    assert "0 of 2" in text
    assert len(list(tmp_path.glob("frame_*.png"))) == 2  # those of the first report are gone
    with pytest.raises(ValueError, match="9 observations for 10 frames"):
        write_report(
            tmp_path,
            target_name="box",
            model=run.model,
            sequence=run.sequence,
            observations=run.observations[:9],
        )
