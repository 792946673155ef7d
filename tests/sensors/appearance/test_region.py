"""Where to look: a box, a mask or a place in a frame that shows other things, too."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rendezview import RendezviewError
from rendezview.geometry.boxes import overlap
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.sensors.appearance import AppearanceObservation, Recognizer, Tracker
from rendezview.sensors.appearance.edges.contour_at import target_box
from rendezview.sensors.appearance.edges.network import Sketch
from rendezview.sensors.appearance.model.sketches import COVER, MAPS
from rendezview.sensors.appearance.pose_finder import PoseFinder
from rendezview.sensors.appearance.region import Region
from rendezview.sensors.appearance.search import windows
from rendezview.sensors.appearance.search.search import PoseSearch
from rendezview.sensors.appearance.search.sketch_search import SketchSearch
from rendezview.sensors.appearance.search.starts import half_turns, rotated_by
from rendezview.sensors.observation import Status
from rendezview_ground.simulate.scene import SceneOptions, render_frame

CAMERA = Camera.from_fov(640, 480, np.deg2rad(50.0))
RIGHT_RAD = np.deg2rad(5.0)


@pytest.fixture(scope="module")
def recognizer(refining_model) -> Recognizer:
    return Recognizer(refining_model, CAMERA)


def pose_of(model, seed: int) -> Pose:
    """The body, a quarter of the frame wide, anywhere but at the border."""
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(random_state=rng).as_matrix()
    range_m = 3.2 * model.sphere_radius_m
    centre = np.array([rng.uniform(-0.2, 0.2), rng.uniform(-0.12, 0.12), 1.0]) * range_m
    return Pose(rotation, centre - rotation @ model.centre_m)


def room(mesh, pose: Pose, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """The body in front of a wall full of plates, and its mask."""
    rng = np.random.default_rng([seed, 7])
    options, size = SceneOptions(), (CAMERA.height, CAMERA.width)
    body = render_frame(mesh, CAMERA, pose, [0.5, -0.5, -0.7], options, rng).astype(float)
    mask = render_frame(mesh, CAMERA, pose, [0.0, 0.0, -1.0], options, rng) > 30
    wall = np.full(size, 120.0)
    for _ in range(40):
        x, y = rng.integers(-40, CAMERA.width), rng.integers(-40, CAMERA.height)
        across, down = rng.integers(15, 140, 2)
        cv2.rectangle(wall, (int(x), int(y)), (int(x + across), int(y + down)),
                      float(rng.uniform(30.0, 220.0)), -1)  # fmt: skip
    wall = cv2.GaussianBlur(wall, (0, 0), 1.0) + rng.normal(0.0, 3.0, size)
    frame = np.where(cv2.dilate(mask.astype(np.uint8), np.ones((5, 5))) > 0, 60.0, wall)
    frame = np.where(mask, 40.0 + 0.8 * body, frame)
    return np.clip(frame, 0, 255).astype(np.uint8), mask


def told(pose: Pose, model) -> np.ndarray:
    """The box (4,) x, y, width, height of the body."""
    left, top, right, bottom = target_box(model, CAMERA, pose)
    return np.array([left, top, right - left, bottom - top])


def test_a_body_before_a_wall_full_of_plates_is_found(recognizer, bumpy_mesh):
    model, seed = recognizer.model, 4
    pose = pose_of(model, seed)
    frame, mask = room(bumpy_mesh, pose, seed)
    box = told(pose, model)
    rng = np.random.default_rng(seed)
    box[:2] += rng.uniform(-0.15, 0.15, 2) * box[2:]
    box[2:] *= rng.uniform(0.85, 1.15, 2)
    place = CAMERA.project(pose.apply(model.centre_m))
    range_m = np.linalg.norm(pose.apply(model.centre_m))
    for roi in (None, box, mask, place, [*place, 1.1 * range_m]):
        seen = recognizer.recognize(frame, roi=roi)
        assert seen.pose is not None, (seen.status, seen.reason)
        assert seen.pose.angle_to(pose) < RIGHT_RAD


def test_the_outline_of_a_part_is_in_the_pixels_of_the_frame(recognizer, bumpy_mesh):
    model, pose = recognizer.model, pose_of(recognizer.model, 3)
    frame = render_frame(
        bumpy_mesh, CAMERA, pose, [0.5, -0.5, -0.7], SceneOptions(), np.random.default_rng(3)
    )
    box = told(pose, model)
    whole, part = recognizer.recognize(frame), recognizer.recognize(frame, roi=box)
    assert part.pose.angle_to(whole.pose) < np.deg2rad(0.5)
    assert part.silhouette.box_px == pytest.approx(whole.silhouette.box_px, abs=2)
    outlines = [np.concatenate(seen.silhouette.outlines_px) for seen in (part, whole)]
    assert outlines[0].min(0) == pytest.approx(outlines[1].min(0), abs=1.0)
    lit = np.where(frame > 40, 1, 0)
    masked = recognizer.recognize(frame, roi=lit)
    assert masked.silhouette.box_px == pytest.approx(whole.silhouette.box_px, abs=3)


def test_a_pose_elsewhere_is_none(recognizer, bumpy_mesh):
    """The frame shows one body; the box is about nothing."""
    pose = pose_of(recognizer.model, 3)
    frame = render_frame(
        bumpy_mesh, CAMERA, pose, [0.5, -0.5, -0.7], SceneOptions(), np.random.default_rng(3)
    )
    x, y = CAMERA.project(pose.apply(recognizer.model.centre_m))
    away = [x + 200.0 if x < 320.0 else x - 200.0, y - 40.0]
    for roi in ([*away, 80.0, 80.0], away):
        seen = recognizer.recognize(frame, roi=roi)
        assert seen.pose is None
        assert seen.reason


def test_overlap_of_boxes():
    a = np.array([0.0, 0.0, 4.0, 2.0])
    assert overlap(a, a) == 1.0
    assert overlap(a, a + 1.0) == pytest.approx(3.0 / 13.0)
    assert overlap(a, a + 10.0) == 0.0


@pytest.mark.parametrize(
    ("roi", "fault"),
    [
        ([1.0, 2.0, 3.0, 4.0, 5.0], "shape"),
        ([np.nan, 2.0, 3.0, 4.0], "shape"),
        ([1.0, 2.0, 0.0, 4.0], "positive"),
        ([1.0, 2.0, -3.0], "positive"),
        ([700.0, 2.0, 30.0, 40.0], "outside"),
        ([-50.0, 2.0, 30.0, 40.0], "outside"),
        ([0.0, 0.0, 1e-300, 1.0], "smaller than a pixel"),
        ([-1e4, -1e4, 2e4, 2e4], "more than 4 times as large"),
        ([-1e300, 0.0, 2e300, 40.0], "more than 4 times as large"),
        ([3.0, 900.0], "place"),
        (np.zeros((480, 640)), "empty"),
        (np.ones((640, 480)), "shape"),
    ],
)
def test_a_region_that_is_none_is_refused(roi, fault):
    with pytest.raises(RendezviewError, match=fault):
        Region.of(roi, CAMERA)


def test_a_box_leaves_room_for_its_own_error():
    region = Region.of([100.0, 80.0, 60.0, 40.0], CAMERA)
    assert region.part == (82, 62, 178, 138)
    assert region.seen_by(CAMERA).project([0.0, 0.0, 1.0]) == pytest.approx(
        CAMERA.project([0.0, 0.0, 1.0]) - [82, 62]
    )
    corner = Region.of([-10.0, -10.0, 60.0, 40.0], CAMERA)
    assert corner.part[:2] == (0, 0)
    assert region.box_in_part == pytest.approx([17.5, 17.5, 77.5, 57.5])


def test_a_tracker_that_lost_its_target_looks_where_it_was_in_any_attitude(recognizer, bumpy_mesh):
    """Behind a hand for three frames the body has turned; a search without a box finds nothing."""
    model = recognizer.model
    pose = pose_of(model, 4)
    turn = Rotation.from_rotvec([0.0, np.deg2rad(150.0), 0.0]).as_matrix() @ pose.rotation
    centre = pose.apply(model.centre_m)
    turned = Pose(turn, centre - turn @ model.centre_m)
    first, _ = room(bumpy_mesh, pose, 4)
    last, _ = room(bumpy_mesh, turned, 4)
    assert recognizer.recognize(last, thorough=False).pose is None
    tracker = Tracker(recognizer, pose)
    assert tracker.update(0.0, first).pose.angle_to(pose) < RIGHT_RAD
    hand = np.full_like(first, 150)
    assert all(tracker.update(k, hand).pose is None for k in (1.0, 2.0, 3.0))
    looks = [tracker.update(k, last).pose for k in (4.0, 5.0)]
    assert looks[1] is not None  # it has turned far: the first look is confirmed
    assert looks[1].angle_to(turned) < RIGHT_RAD


class Network:
    """A sketcher whose network sees some bodies (4,) of a frame, wherever it is looked.

    In a coarse sketch they are 6 px too large on each side.
    """

    def __init__(self, *bodies: list[float]) -> None:
        self.bodies = np.array(bodies)

    def look(self, frame, box, most_px=(256, 256)) -> Sketch:
        left, top, right, bottom = np.round(np.clip(box, 0.0, [640.0, 480.0, 640.0, 480.0]))
        maps, fineness = np.zeros((MAPS, int(bottom - top), int(right - left)), np.float32), 1.0
        grown = np.zeros(4)
        if max(most_px) < 256:
            fineness, grown = 0.5, np.array([-6.0, -6.0, 6.0, 6.0])
        for x0, y0, x1, y1 in (self.bodies + grown - [left, top, left, top]).astype(int):
            maps[COVER, max(y0, 0) : max(y1, 0), max(x0, 0) : max(x1, 0)] = 1.0
        crossed = np.zeros((2, 2), bool)
        return Sketch(maps, maps[0].astype(np.uint8), 1.0, -left, -top, crossed, fineness)


def test_a_body_that_every_window_cuts_is_looked_at_whole(monkeypatch):
    alike = SimpleNamespace(likeness=lambda sketch: 1.0)
    cut = [(150.0 - x, 60.0, 250.0 - x, 300.0) for x in (20.0, 40.0)]
    monkeypatch.setattr(windows, "_windows", lambda height, width: iter(cut))
    frame, there = np.zeros((480, 640), np.uint8), [150.0, 100.0, 290.0, 220.0]
    [body] = windows.bodies_in_windows(Network(there), alike, frame, 3)
    assert body.box_px == pytest.approx(there, abs=1.0)


def test_bodies_of_windows_are_placed_and_ordered_by_a_finer_sketch_of_each():
    wide, tall = [80.0, 60.0, 220.0, 160.0], [400.0, 250.0, 480.0, 400.0]

    def likeness(sketch: Sketch) -> float:
        """In coarse sketches the wide one is more like the target, in finer ones the tall one."""
        rows, columns = np.nonzero(sketch.maps[COVER])
        is_wide = np.ptp(columns) > np.ptp(rows)
        return float(is_wide if sketch.fineness < 1.0 else not is_wide)

    frame, alike = np.zeros((480, 640), np.uint8), SimpleNamespace(likeness=likeness)
    bodies = windows.bodies_in_windows(Network(wide, tall), alike, frame, 3)
    assert [body.box_px.tolist() for body in bodies] == [
        pytest.approx(box, abs=0.6) for box in (tall, wide)
    ]
    assert [body.likeness for body in bodies] == [1.0, 0.0]
    [first] = windows.bodies_in_windows(Network(wide, tall), alike, frame, 1)
    assert first.box_px == pytest.approx(tall, abs=0.6)


def test_edges_that_the_sketch_contradicts_give_no_pose(recognizer, bumpy_mesh, monkeypatch):
    """Before a bright sky other things have edges, too."""
    model, pose = recognizer.model, pose_of(recognizer.model, 1)
    frame, _ = room(bumpy_mesh, pose, 1)
    box, best = told(pose, model), SketchSearch.best

    def another(self, frame, sky, sketch):
        found = best(self, frame, sky, sketch)
        rotation = Rotation.from_rotvec([0.0, 2.0, 0.0]).as_matrix() @ found.best.pose.rotation
        there = Pose(rotation, pose.apply(model.centre_m) - rotation @ model.centre_m)
        other = replace(found.best, pose=there)
        return replace(found, best=other, rival=found.best, probability=0.55)

    assert recognizer.recognize(frame, roi=box).pose.angle_to(pose) < RIGHT_RAD
    monkeypatch.setattr(SketchSearch, "best", another)
    seen = recognizer.recognize(frame, roi=box)
    assert seen.pose is None
    assert "grey edges and the sketch show poses" in seen.reason


def test_where_the_sketch_shows_nothing_likely_a_box_costs_no_search_on_grey_edges(
    recognizer, bumpy_mesh, monkeypatch
):
    """They could give no pose alone, and a pose that the sketch doubts is none."""
    model, pose = recognizer.model, pose_of(recognizer.model, 1)
    frame, _ = room(bumpy_mesh, pose, 1)
    box, best, probability = told(pose, model), SketchSearch.best, 0.45
    asked, proposed = [], PoseSearch.proposed

    def doubtful(self, frame, sky, sketch):
        return replace(best(self, frame, sky, sketch), probability=probability)

    def counted(self, *args, **named):
        asked.append(args)
        return proposed(self, *args, **named)

    monkeypatch.setattr(SketchSearch, "best", doubtful)
    monkeypatch.setattr(PoseSearch, "proposed", counted)
    monkeypatch.setattr(PoseSearch, "anywhere", counted)  # is not asked at all
    seen = recognizer.recognize(frame, roi=box)
    assert seen.pose is None
    assert seen.found.confidence == probability
    assert not asked
    probability = 0.55
    seen = recognizer.recognize(frame, roi=box)
    assert seen.pose.angle_to(pose) < RIGHT_RAD
    assert len(asked) == 1


def test_a_refusal_before_a_wall_says_how_the_likeliest_body_fits(recognizer, bumpy_mesh):
    """The grey levels of the wall are not why a body beside it is not the target."""
    model, pose = recognizer.model, pose_of(recognizer.model, 4)
    frame, mask = room(bumpy_mesh, pose, 4)
    rows, columns = np.nonzero(mask)
    middle = (int(columns.mean()), int(rows.mean()))
    cv2.ellipse(frame, middle, (90, 35), 20.0, 0.0, 360.0, 200.0, -1)  # another body
    seen = recognizer.recognize(frame)
    assert seen.pose is None
    assert "grey level" not in seen.reason
    assert seen.reason.endswith("if this is not the target, give a box around it (roi)")
    assert seen.candidates
    assert seen.stage_ms["windows"] > 0.0
    boxed = recognizer.recognize(frame, roi=told(pose, model))
    assert boxed.pose is None
    assert "grey level" not in boxed.reason
    assert "(roi)" not in boxed.reason


@pytest.mark.parametrize(("confidence", "asked"), [(0.9, 0), (0.3, 1)])
def test_a_target_that_its_look_alikes_leave_open_is_not_searched_in_windows(
    recognizer, bumpy_mesh, monkeypatch, confidence, asked
):
    """A second answer to the same pixels would be one by chance."""
    frame, _ = room(bumpy_mesh, pose_of(recognizer.model, 1), 1)
    found = SimpleNamespace(weighed=(1, 2), confidence=confidence, posterior=0.5, best=None)
    whole = AppearanceObservation(Status.AMBIGUOUS, "two poses", found=found)
    searches = []

    def bodies(*args):
        searches.append(args)
        return []

    monkeypatch.setattr(PoseFinder, "_anywhere", lambda *args: whole)
    monkeypatch.setattr(SketchSearch, "bodies", bodies)
    seen = recognizer.recognize(frame)
    assert seen.status is Status.AMBIGUOUS
    assert len(searches) == asked


def test_half_turns_turn_the_target_about_its_middle(recognizer):
    model, pose = recognizer.model, pose_of(recognizer.model, 1)
    turned = rotated_by(pose, half_turns(model), model.centre_m)
    assert len(turned) == 3
    for one in turned:
        assert one.angle_to(pose) == pytest.approx(np.pi)
        assert one.apply(model.centre_m) == pytest.approx(pose.apply(model.centre_m))
    apart = [a.angle_to(b) for k, a in enumerate(turned) for b in turned[:k]]
    assert min(apart) > 1.0
