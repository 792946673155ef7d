"""Poses found on sketches, alone and through the recognizer; the views that a model carries."""

from __future__ import annotations

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rendezview.geometry.pose import Pose
from rendezview.geometry.symmetry import Symmetry
from rendezview.sensors.appearance import Recognizer, ViewModel
from rendezview.sensors.appearance.edges.contour_at import target_box
from rendezview.sensors.appearance.hypothesis import Hypothesis
from rendezview.sensors.appearance.judge.found import Found
from rendezview.sensors.appearance.judge.near import Near
from rendezview.sensors.appearance.judge.sketch_choice import (
    CHOICE_FEATURES,
    PACKAGED,
    POSE_FEATURES,
    Passes,
    distinct,
    packaged,
    sketch_merit,
)
from rendezview.sensors.appearance.model.sketches import (
    EDGE,
    GRID,
    REACH,
    ViewSketches,
    centroid,
    on_grid,
)
from rendezview.sensors.appearance.search import sketch_search as search_module
from rendezview.sensors.appearance.search.sketch_search import SketchSearch, _last, _lines
from rendezview.sensors.appearance.sky import Sky
from rendezview.sensors.observation import Status
from rendezview_ground.learn.options import ViewGeometry
from rendezview_ground.learn.views.sketch_maps import sketched_view
from rendezview_ground.simulate.scene import SceneOptions, render_frame

LIGHT = slice(POSE_FEATURES.index("shading"), None)  # … and tones


@pytest.fixture(scope="module")
def search(refining_model, camera) -> SketchSearch:
    recognizer = Recognizer(refining_model, camera)
    assert recognizer.sketch is not None
    return recognizer.sketch


def hard_frame(mesh, model, camera, seed: int) -> tuple[np.ndarray, Pose]:
    """The body half in shadow before a mottled bright sky, where no threshold holds."""
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(random_state=rng).as_matrix()
    centre = np.array([*rng.uniform(-0.1, 0.1, 2), 1.0]) * 1.6 * model.sphere_radius_m
    pose = Pose(rotation, centre - rotation @ model.centre_m)
    options = SceneOptions()
    dark = render_frame(mesh, camera, pose, [0.6, -0.5, -0.6], options, rng).astype(float)
    cover = render_frame(mesh, camera, pose, [0.0, 0.0, -1.0], options, rng) > 30
    sky = cv2.GaussianBlur(rng.standard_normal((camera.height, camera.width)), (0, 0), 12.0)
    bright = 95.0 + 30.0 * sky / sky.std()
    return np.clip(np.where(cover, dark, bright), 0, 255).astype(np.uint8), pose


def test_a_model_keeps_its_views_and_one_without_loads(tmp_path, refining_model):
    assert refining_model.sketches is not None
    assert refining_model.sketches.maps.shape[2:] == (GRID, GRID)
    path = tmp_path / "copy.rvm"
    refining_model.save(path)
    again = ViewModel.load(path).sketches
    assert np.array_equal(again.maps, refining_model.sketches.maps)
    replace(refining_model, sketches=None).save(path)
    assert ViewModel.load(path).sketches is None


def test_a_model_without_views_is_searched_without_a_sketch(refining_model, camera):
    recognizer = Recognizer(replace(refining_model, sketches=None), camera)
    assert recognizer.sketch is None
    frame = np.full((camera.height, camera.width), 20, np.uint8)
    assert "sketch" not in recognizer.recognize(frame).stage_ms
    views, sketcher = recognizer.search.refiner.views, recognizer.outline.sketcher
    with pytest.raises(ValueError, match="no sketches"):
        SketchSearch(recognizer.model, camera, views, sketcher)


def test_a_turned_grid_is_the_turned_picture():
    rng = np.random.default_rng(2)
    maps = cv2.GaussianBlur(rng.random((200, 200)).astype(np.float32), (0, 0), 4.0)[None]
    turned = cv2.rotate(maps[0], cv2.ROTATE_90_CLOCKWISE)[None]  # right becomes down
    centre = np.array([99.5, 99.5])
    straight = on_grid(maps, centre, 40.0)
    assert on_grid(turned, centre, 40.0, np.pi / 2)[0] == pytest.approx(straight[0], abs=2e-2)


def test_views_of_a_deformed_body_are_the_views_deformed(bumpy_mesh, refining_model):
    """Beside sketches drawn anew of the deformed mesh, from where its points say."""
    matrix = np.array([[1.03, 0.02, 0.0], [0.02, 0.98, 0.0], [0.0, 0.0, 1.07]])
    centre = np.array(refining_model.centre_m)
    moved = (bumpy_mesh.vertices_m - centre) @ matrix.T + centre
    radius_m = refining_model.target_radius_m
    geometry = ViewGeometry(centre, radius_m, 3.0 * radius_m, 256, 300.0, 300.0, 300.0)
    some = slice(0, None, 30)
    fields = ("rotation", "maps", "centre_radii", "size_radii")
    views = ViewSketches(*(getattr(refining_model.sketches, name)[some] for name in fields))
    deformed = views.deformed(matrix)
    gains = []
    for k in range(len(views.size_radii)):
        drawn = sketched_view(
            replace(bumpy_mesh, vertices_m=moved), geometry, -deformed.rotation[k, 2].astype(float)
        )
        assert deformed.size_radii[k] == pytest.approx(float(drawn["size_radii"]), rel=0.01)
        between = drawn["rotation"] @ deformed.rotation[k].T
        turn = np.arctan2(between[1, 0], between[0, 0])
        planes = drawn["maps"].astype(np.float32)
        middle, cells = np.full(2, 0.5 * (GRID - 1)), GRID / (2.0 * REACH)
        again = on_grid(planes, middle, cells, turn)
        likeness = [
            np.corrcoef(maps[EDGE].ravel(), again[EDGE].ravel())[0, 1]
            for maps in (deformed.maps[k], views.maps[k])
        ]
        gains.append(likeness[0] - likeness[1])
        assert likeness[0] > 0.93
    assert np.mean(gains) > 0.01


def test_centroid_and_size_of_a_cover():
    cover = np.zeros((50, 60), np.float32)
    cover[10:20, 30:50] = 1.0
    place, size = centroid(cover)
    assert place == pytest.approx([39.5, 14.5])
    assert size == pytest.approx(np.sqrt(200.0))


def test_poses_are_found_before_a_sky_where_no_threshold_holds(
    bumpy_mesh, refining_model, camera, search
):
    errors = []
    for seed in range(8):
        frame, truth = hard_frame(bumpy_mesh, refining_model, camera, seed)
        choice = search.anywhere(frame, Sky.of(frame))
        errors.append(180.0 if choice is None else np.rad2deg(choice.best.pose.angle_to(truth)))
        start = truth.perturbed([0.05, -0.06, 0.04, 0.05, -0.05, 0.2])
        near = search.near(
            frame, Sky.of(frame), Near(start, np.deg2rad(10.0), refining_model.centre_m)
        )
        assert near is not None
        assert near.prior
        assert near.best.pose.angle_to(start) < np.deg2rad(20.0)
        # The pose converges on the finer sketch from that of every second contour point.
        apart_deg = np.rad2deg(near.best.pose.angle_to(near.passes.chosen()[0].pose))
        assert 0.0 < apart_deg < 2.0 * near.passes.spread_deg + 0.5
        assert np.linalg.eigvalsh(near.best.covariance).min() > 0.0
    assert np.sum(np.array(errors) < 10.0) >= 5, errors


def lit_frame(mesh, pose: Pose, camera) -> np.ndarray:
    """The body before a black sky, the Sun aside."""
    sun = [0.6, -0.5, -0.6]
    return render_frame(mesh, camera, pose, sun, SceneOptions(), np.random.default_rng(1))


def test_light_on_the_surface_tells_a_pose_from_others(bumpy_mesh, refining_model, camera, search):
    """Read in the picture of the sketch; a half turn of the grey levels takes it away."""
    told = []
    for seed in range(6):
        _, pose = hard_frame(bumpy_mesh, refining_model, camera, seed)
        frame = lit_frame(bumpy_mesh, pose, camera)
        sky, at = Sky.of(frame), pose.apply(refining_model.centre_m)
        for fineness in (1, 2):
            sketch = search.sketcher.near(frame, target_box(refining_model, camera, pose), fineness)
            turned = replace(sketch, grey=np.ascontiguousarray(sketch.grey[::-1, ::-1]))
            lit, unlit = (
                search.aligned(search.read(seen, sky), pose.rotation[None].copy(), at[None].copy())
                for seen in (sketch, turned)
            )
            told += [(*lit[0].sketch[LIGHT], unlit[0].sketch[LIGHT][1])] if lit else []
    shading, tones, elsewhere = np.array(told).T
    assert len(told) >= 8
    assert np.median(shading) > 0.1
    assert np.median(tones) > 0.4
    assert np.median(elsewhere) < 0.5 * np.median(tones)


def test_a_model_without_a_surface_knows_no_light(bumpy_mesh, refining_model, camera, search):
    bare = Recognizer(replace(refining_model, surface=None), camera).sketch
    _, pose = hard_frame(bumpy_mesh, refining_model, camera, 0)
    frame = lit_frame(bumpy_mesh, pose, camera)
    sky = Sky.of(frame)
    near = Near(pose, 0.1, refining_model.centre_m)
    known, unknown = (one.near(frame, sky, near).best for one in (search, bare))
    assert known.sketch[LIGHT].min() > 0.0
    assert not unknown.sketch[LIGHT].any()


def test_lines_are_explained_alike_in_a_finer_sketch(bumpy_mesh, refining_model, camera, search):
    _, pose = hard_frame(bumpy_mesh, refining_model, camera, 0)
    frame = lit_frame(bumpy_mesh, pose, camera)
    sky, at = Sky.of(frame), pose.apply(refining_model.centre_m)
    shares = []
    for fineness in (1, 2):
        sketch = search.sketcher.near(frame, target_box(refining_model, camera, pose), fineness)
        lines, place = _lines(sketch)
        assert lines.sum() == pytest.approx(1.0, abs=1e-4)
        assert place[0] == pytest.approx(sketch.scale / fineness)
        # The first pixels of both begin at the same place of the frame.
        edge = [(-0.5 - p[1:]) / p[0] for p in (place, sketch.place)]
        assert edge[0] == pytest.approx(edge[1])
        poses = search.aligned(
            search.read(sketch, sky), pose.rotation[None].copy(), at[None].copy()
        )
        shares.append(poses[0].sketch[POSE_FEATURES.index("explained")])
    assert shares[0] > 0.5
    assert shares[1] == pytest.approx(shares[0], abs=0.2)


def test_a_pose_in_doubt_gets_a_second_opinion(
    bumpy_mesh, refining_model, camera, search, monkeypatch
):
    frame, _ = hard_frame(bumpy_mesh, refining_model, camera, 2)
    monkeypatch.setattr(search_module, "DOUBT", (0.0, 1.01))
    sky = Sky.of(frame)
    asked = search.best(frame, sky)
    alone = [search.anywhere(frame, sky, turned=t) for t in (False, True)]
    better = max(alone, key=lambda choice: choice.confidence)
    assert np.array_equal(asked.best.pose.rotation, better.best.pose.rotation)
    assert asked.confidence == alone[0].with_opinion(alone[1], ()).confidence
    assert asked.confidence != better.confidence
    monkeypatch.setattr(search_module, "DOUBT", (0.0, 0.0))
    assert search.best(frame, sky).confidence == alone[0].confidence


def test_an_opinion_is_surer_where_the_other_agrees():
    one = Found(some_pose(0.5, 0.0), 1.0, dark=True, prior=False, probability=0.5)
    elsewhere = replace(one, best=some_pose(0.5, 30.0), probability=0.4)
    near = replace(elsewhere, best=some_pose(0.5, 7.0))
    same, apart = (one.with_opinion(other, ()) for other in (near, elsewhere))
    assert same.best is apart.best is elsewhere.with_opinion(one, ()).best is one.best
    assert same.confidence > apart.confidence
    half_turn = Symmetry("discrete", np.array([0.0, 1.0, 0.0]), np.deg2rad(30.0))
    assert one.with_opinion(elsewhere, [half_turn]).confidence == same.confidence


def test_lengths_of_the_last_alignment_grow_with_the_sketch(search, refining_model, camera):
    frame = np.full((camera.height, camera.width), 20, np.uint8)
    box = (100.0, 100.0, 300.0, 300.0)
    first, finer = (_last(search.sketcher.near(frame, box, times)) for times in (1, 2))
    assert finer[0, :2] == pytest.approx(2.0 * first[0, :2])
    assert np.array_equal(finer[0, 2:], first[0, 2:])


def test_the_recognizer_sketches_only_where_the_edges_give_no_pose(
    bumpy_mesh, refining_model, camera, draw
):
    """Frames that the edges answer cost no sketch; the switch turns it off."""
    recognizer = Recognizer(refining_model, camera, least_confidence=0.0)
    rotation = Rotation.from_rotvec([0.4, -0.7, 0.2]).as_matrix()
    pose = Pose(rotation, [0.0, 0.0, 1.6 * refining_model.sphere_radius_m])
    clear = recognizer.recognize(draw(bumpy_mesh, pose, camera), pose)
    assert clear.status is Status.OK
    assert "sketch" not in clear.stage_ms
    hard, truth = hard_frame(bumpy_mesh, refining_model, camera, 1)
    strict = Recognizer(refining_model, camera, least_confidence=2.0)
    assert "sketch" in strict.recognize(hard, truth).stage_ms
    without = Recognizer(refining_model, camera, sketch=False, least_confidence=2.0)
    assert "sketch" not in without.recognize(hard, truth).stage_ms


def test_a_sketch_of_a_body_that_overflows_proposes_nothing(
    bumpy_mesh, refining_model, camera, search, monkeypatch
):
    frame, _ = hard_frame(bumpy_mesh, refining_model, camera, 2)
    assert search.anywhere(frame, Sky.of(frame)) is not None
    closer = SketchSearch.closer_sketch

    def overflowing(self, *args, **kwargs):
        return replace(closer(self, *args, **kwargs), crossed=np.ones((2, 2), bool))

    monkeypatch.setattr(SketchSearch, "closer_sketch", overflowing)
    assert search.anywhere(frame, Sky.of(frame)) is None


def test_an_empty_sky_gives_no_pose(refining_model, camera, search):
    rng = np.random.default_rng(4)
    noise = rng.normal(30.0, 4.0, (camera.height, camera.width))
    frame = np.clip(noise, 0, 255).astype(np.uint8)
    observation = Recognizer(refining_model, camera).recognize(frame)
    assert observation.pose is None
    far = Pose(np.eye(3), [100.0, 0.0, 5.0])
    behind = Pose(np.eye(3), [0.0, 0.0, -9.0])
    for prior in (far, behind):
        near = Near(prior, 0.1, refining_model.centre_m)
        assert search.near(frame, Sky.of(frame), near) is None


def some_pose(merit: float, turn_deg: float) -> Hypothesis:
    rotation = Rotation.from_rotvec([0.0, np.deg2rad(turn_deg), 0.0]).as_matrix()
    features = np.array([merit, 0.2, 0.5, 1.0, 0.5, 0.5, 0.5])
    return Hypothesis(Pose(rotation, [0.0, 0.0, 5.0]), sketch=features)


def passes(poses: list[Hypothesis]) -> Passes:
    """A first pass at some poses, and a closer one at the same."""
    return Passes(poses, poses[:2], poses[2:])


def test_the_choice_names_the_best_and_its_rival():
    poses = [some_pose(0.5, 0.0), some_pose(0.48, 2.0), some_pose(0.4, 40.0)]
    seen, clearer = passes(poses), passes(poses[:2])
    best, rival, margin = seen.chosen()
    assert best is poses[0]
    assert rival is poses[2]  # 2° away is the same answer
    assert margin == pytest.approx(sketch_merit(poses[0]) - sketch_merit(poses[2]))
    assert 0.0 < seen.probability < 1.0
    assert clearer.chosen()[1] is None
    assert clearer.probability > seen.probability
    assert passes([]).chosen() is None
    assert distinct(poses, 5, np.deg2rad(4.0)) == [poses[0], poses[2]]


def test_what_leads_to_the_best_pose_makes_it_more_probable():
    best, near, far = some_pose(0.5, 0.0), some_pose(0.45, 1.0), some_pose(0.3, 50.0)
    clear = Passes([best, near, near, far], [best, near, near], [far])
    assert clear.lead(best.pose) == pytest.approx(min(sketch_merit(best) - sketch_merit(far), 4.0))
    assert clear.basin(best.pose) == 0.75
    assert clear.scattered(best.pose) == pytest.approx((1.0, 1.0))
    better = some_pose(0.7, 50.0)  # in the first pass only
    unclear = Passes([best, far, better, far], [best, far], [far])
    assert unclear.lead(best.pose) < 0.0
    assert unclear.basin(best.pose) == 0.25
    assert unclear.scattered(best.pose) == pytest.approx((0.5, 10.0))
    assert Passes([best], [], []).scattered(best.pose) == (0.0, 10.0)
    assert clear.chosen()[0] is unclear.chosen()[0]
    assert clear.probability > unclear.probability


def test_the_fitted_file_names_every_feature_and_its_data():
    record = json.loads(PACKAGED.read_text(encoding="utf-8"))
    assert set(record["merit"]) == set(POSE_FEATURES)
    assert np.isfinite(record["opinions"]).all()
    assert len(record["opinions"]) == 4
    for trees in (packaged().anywhere, packaged().near):
        assert trees.feature.max() == len(CHOICE_FEATURES) - 1
    assert record["inflation"] >= 1.0
    assert min(record["merit"][name] for name in ("explained", "shading", "tones")) > 0.0
    assert record["provenance"]["frames_of_each"] >= 100
