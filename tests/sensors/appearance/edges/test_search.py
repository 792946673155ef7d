"""Poses that another estimator proposes, judged by the grey edges."""

from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rendezview.geometry.pose import Pose
from rendezview.sensors.appearance import Recognizer
from rendezview.sensors.appearance.edges.refinement import Refiner
from rendezview.sensors.appearance.hypothesis import Hypothesis
from rendezview.sensors.appearance.judge.candidates import Candidates
from rendezview.sensors.appearance.judge.found import Found
from rendezview.sensors.appearance.judge.near import Near
from rendezview.sensors.appearance.observation import StageClock
from rendezview.sensors.appearance.search.search import PoseSearch
from rendezview.sensors.appearance.search.starts import half_turns
from rendezview.sensors.appearance.sky import Sky


@pytest.fixture
def truth(refining_model) -> Pose:
    turn = np.linalg.qr(np.random.default_rng(8).normal(size=(3, 3)))[0]
    rotation = turn * np.sign(np.linalg.det(turn))
    centre = np.array([0.1, -0.05, 1.4 * refining_model.sphere_radius_m])
    return Pose(rotation, centre - rotation @ refining_model.centre_m)


def turned(pose: Pose, turn: np.ndarray, centre_m: np.ndarray) -> Pose:
    """The pose turned in the target's frame about the view centre."""
    rotation = pose.rotation @ turn
    return Pose(rotation, pose.apply(centre_m) - rotation @ centre_m)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_proposal_that_is_half_a_turn_off_leads_to_the_pose(
    refining_model, bumpy_mesh, camera, draw, truth, axis
):
    search = PoseSearch(refining_model, camera)
    frame = draw(bumpy_mesh, truth, camera)
    wrong = turned(truth, half_turns(refining_model)[axis], refining_model.centre_m)
    found = search.proposed(frame, Sky.of(frame), [wrong], None)
    assert found is not None
    assert found.best.pose.angle_to(truth) < np.deg2rad(0.5)
    assert not found.prior  # the proposal is no evidence of its own
    assert found.confidence > 0.9


def test_half_turns_are_left_out_where_the_witness_has_ruled_them_out(
    refining_model, bumpy_mesh, camera, draw, truth, monkeypatch
):
    search, tried = PoseSearch(refining_model, camera), []
    frame = draw(bumpy_mesh, truth, camera)
    half_turned = PoseSearch._half_turned

    def seen(*args):
        tried.append(args[2])
        half_turned(*args)

    monkeypatch.setattr(PoseSearch, "_half_turned", seen)
    wrong = turned(truth, half_turns(refining_model)[0], refining_model.centre_m)
    search.proposed(frame, Sky.of(frame), [wrong], None, half_turns=False)
    assert tried == []
    found = search.proposed(frame, Sky.of(frame), [wrong], None)
    assert len(tried) == 1
    assert found.best.pose.angle_to(truth) < np.deg2rad(0.5)
    right = search.proposed(frame, Sky.of(frame), [truth], None, half_turns=False)
    assert right is not None
    assert right.best.pose.angle_to(truth) < np.deg2rad(0.5)


def test_starts_whose_edges_are_not_found_are_not_refined(
    refining_model, bumpy_mesh, camera, draw, truth
):
    refiner, frame = Refiner(refining_model, camera), draw(bumpy_mesh, truth, camera)
    away = Rotation.random(20, random_state=1).as_matrix()

    def refined(rotations: np.ndarray, least: float) -> list[float]:
        starts = (
            rotations.copy(),
            np.tile(truth.apply(refining_model.centre_m), (len(rotations), 1)),
        )
        found = refiner.best(frame, Sky.of(frame), *starts, 6, least=least)
        return [r.pose.angle_to(truth) for r in found]

    assert min(refined(away, 0.0)) > np.deg2rad(5.0)
    assert refined(away, 0.6) == []
    assert refined(truth.rotation[None], 0.6) == pytest.approx([0.0], abs=np.deg2rad(0.5))


def test_a_start_that_may_be_given_up_is_aligned_as_well_as_any_other(
    refining_model, bumpy_mesh, camera, draw, truth
):
    """The stage after which poses are given up has measured the edges on which light is fitted."""
    refiner, frame = Refiner(refining_model, camera), draw(bumpy_mesh, truth, camera)
    rng, sky = np.random.default_rng(0), Sky.of(frame)
    for _ in range(8):
        turn = Rotation.from_rotvec(np.deg2rad(0.5) * rng.normal(size=3)).as_matrix()
        start = Pose(turn @ truth.rotation, truth.translation_m * (1.0 + 0.003 * rng.normal()))
        ours, plain = (
            refiner.refine(frame, sky, start, closely=True, least=least) for least in (0.05, 0.0)
        )
        assert ours.light == pytest.approx(plain.light, abs=0.02)
        assert ours.pose.angle_to(plain.pose) < np.deg2rad(0.02)


@pytest.mark.parametrize("how", [{}, {"give_up": 0.5}])
def test_beside_a_sketch_right_poses_are_found_as_without_and_others_given_up(
    refining_model, bumpy_mesh, camera, draw, truth, how
):
    recognizer = Recognizer(refining_model, camera, trees=False)
    frame = draw(bumpy_mesh, truth, camera)
    outlines = recognizer.outline.trace(frame, None, StageClock(), bright_sky=False).outlines
    found = recognizer.search.anywhere(frame, Sky.of(frame), outlines, **how)
    assert found is not None
    assert found.confidence > 0.9
    assert found.best.pose.angle_to(truth) < np.deg2rad(0.5)
    blurred = np.asarray(cv2.GaussianBlur(frame, (0, 0), 9.0))  # an outline, and no edge in place
    found = recognizer.search.anywhere(blurred, Sky.of(blurred), outlines, **how)
    assert found is None or found.confidence < 0.5


def test_of_several_proposals_the_edges_choose(refining_model, bumpy_mesh, camera, draw, truth):
    search = PoseSearch(refining_model, camera)
    frame = draw(bumpy_mesh, truth, camera)
    aside = Pose(truth.rotation, truth.translation_m).perturbed([0.03, -0.02, 0.02, 0.0, 0.0, 0.0])
    quarter = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    other = turned(truth, quarter, refining_model.centre_m)
    found = search.proposed(frame, Sky.of(frame), [other, aside], None)
    assert found is not None
    assert found.best.pose.angle_to(truth) < np.deg2rad(0.5)


def test_an_empty_frame_bears_no_proposal_out(refining_model, camera, truth):
    frame = np.random.default_rng(1).normal(8.0, 2.0, (camera.height, camera.width))
    frame = np.clip(frame, 0, 255).astype(np.uint8)
    found = PoseSearch(refining_model, camera).proposed(frame, Sky.of(frame), [truth], None)
    assert found is None or found.confidence < 0.5


@pytest.mark.parametrize(("give_up", "asked"), [(0.0, 1), (0.5, 1), (1.0, 0)])
def test_look_alikes_of_proposals_that_fit_too_little_are_not_tried(
    refining_model, bumpy_mesh, camera, draw, truth, monkeypatch, give_up, asked
):
    search, bests = PoseSearch(refining_model, camera), []
    frame = draw(bumpy_mesh, truth, camera)

    def beside(self, candidates, found, sketched):
        bests.append(found.best)
        return found

    monkeypatch.setattr(PoseSearch, "_beside_look_alikes", beside)
    found = search.proposed(frame, Sky.of(frame), [truth], None, give_up=give_up)
    assert 0.9 < found.confidence < 1.0
    assert found.best.pose.angle_to(truth) < np.deg2rad(0.5)
    assert len(bests) == asked


def test_where_coarse_stages_lead_away_from_a_prior_the_pose_next_to_it_counts_too(
    refining_model, bumpy_mesh, camera, draw, truth, monkeypatch
):
    """A flat face seen end-on: its edges fit nearly as well some degrees away."""
    search = PoseSearch(refining_model, camera)
    frame, refiner = draw(bumpy_mesh, truth, camera), search.refiner
    refine, away = refiner.refine, Rotation.from_rotvec([0.1, 0.0, 0.0]).as_matrix()

    def another_optimum(image, sky, start, *, closely=False, least=0.0):
        found = refine(image, sky, start, closely=closely, least=least)
        if closely or found is None:
            return found
        pose = turned(found.pose, away, refining_model.centre_m)
        return replace(found, pose=pose, outline=0.9 * found.outline, inner=0.8 * found.inner)

    monkeypatch.setattr(refiner, "refine", another_optimum)
    found = search.at(frame, Sky.of(frame), Near(truth, np.deg2rad(20.0), refining_model.centre_m))
    assert found is not None
    assert found.best.pose.angle_to(truth) < np.deg2rad(0.5)


def test_few_edges_are_enough_only_where_the_prediction_speaks_for_the_pose_too(
    refining_model, bumpy_mesh, camera, draw, truth, monkeypatch
):
    """Followed into shadow: a pose that leaves the prediction may be a local optimum."""
    search, frame = PoseSearch(refining_model, camera), draw(bumpy_mesh, truth, camera)
    centre_m, refine = refining_model.centre_m, search.refiner.refine

    def in_shadow(*args, **how):
        found = refine(*args, **how)
        assert found is not None
        return replace(found, outline=0.6 * found.outline, inner=0.6 * found.inner)

    monkeypatch.setattr(search.refiner, "refine", in_shadow)

    def followed(prior: Pose, confirmed: float) -> Found | None:
        return search.at(frame, Sky.of(frame), Near(prior, np.deg2rad(20.0), centre_m), confirmed)

    found = followed(truth, 0.35)
    assert found is not None
    assert found.best.pose.angle_to(truth) < np.deg2rad(0.5)
    assert followed(truth, 0.45) is None  # the search before found more edges
    aside = turned(truth, Rotation.from_euler("x", 6.0, degrees=True).as_matrix(), centre_m)
    assert followed(aside, 0.35) is None
    monkeypatch.setattr(search.refiner, "refine", refine)
    assert followed(aside, 0.35) is not None  # edges enough on their own


def test_every_pose_that_pictures_speak_for_has_its_look_alikes_aligned(refining_model, camera):
    """Pictures speak for another pose twice, and then for one whose look-alikes are known."""
    poses = [Pose(np.eye(3), [0.0, 0.0, z]) for z in (5.0, 6.0, 7.0)]
    by_pictures, asked, aligned = iter([poses[1], poses[2], poses[0]]), [], []

    def found(pose: Pose) -> SimpleNamespace:
        return SimpleNamespace(best=Hypothesis(pose))

    def look_alikes(pose: Pose, most_rad: float) -> list[Pose]:
        asked.append(pose)
        return [Pose(np.diag([-1.0, -1.0, 1.0]), pose.translation_m)]

    candidates = SimpleNamespace(
        level=SimpleNamespace(rivals=SimpleNamespace(look_alikes=look_alikes)),
        sky=Sky(0.0, 1.0, dark=True),
        reach_rad=np.pi,
        may_be=lambda pose: True,
        refine_closely=lambda others, least: aligned.extend(others),
        choose=lambda: found(poses[0]),
        weighed=lambda on_sketch: found(next(by_pictures)),
    )
    search = PoseSearch(refining_model, camera)
    chosen = search._beside_look_alikes(candidates, found(poses[0]))
    assert chosen.best.pose is poses[0]
    assert asked == poses
    assert [one.translation_m[2] for one in aligned] == [5.0, 6.0, 7.0]


def test_the_surroundings_of_a_pose_in_doubt_are_searched_until_it_is_sure(
    refining_model, camera, monkeypatch
):
    """Each better pose has its surroundings searched, a sure one does not."""
    found = [
        SimpleNamespace(best=Hypothesis(Pose(np.eye(3), [0.0, 0.0, z])), confidence=confidence)
        for z, confidence in ((5.0, 0.7), (5.6, 0.8), (6.1, 0.999))
    ]
    searched = []
    monkeypatch.setattr(PoseSearch, "_around", lambda self, _, best: searched.append(best))
    search, best = PoseSearch(refining_model, camera), iter(found)
    assert search._settled(SimpleNamespace(choose=lambda: next(best))) is found[2]
    assert searched == [one.best.pose for one in found[:2]]
    searched.clear()
    assert search._settled(SimpleNamespace(choose=lambda: found[0])) is found[0]
    assert searched == [found[0].best.pose]


@pytest.mark.parametrize("times", [0.87, 1.0, 1.15])
def test_a_pose_is_found_from_nine_degrees_aside_and_a_sixth_too_near_or_too_far(
    refining_model, bumpy_mesh, camera, draw, truth, times
):
    search, frame = PoseSearch(refining_model, camera), draw(bumpy_mesh, truth, camera)
    candidates = search._candidates(frame, Sky.of(frame), truth, None)
    turn = Rotation.from_rotvec(np.deg2rad([5.0, -5.0, 5.0])).as_matrix()
    aside = turned(truth, turn, refining_model.centre_m)
    centre = times * aside.apply(refining_model.centre_m)
    search._around(
        candidates, Pose(aside.rotation, centre - aside.rotation @ search.model.centre_m)
    )
    best = candidates.most_inliers
    assert best is not None
    assert best.pose.angle_to(truth) < np.deg2rad(0.5)


def test_look_alikes_near_a_prior_are_tried_too(
    refining_model, bumpy_mesh, camera, draw, truth, monkeypatch
):
    """They are those within the error of the prior; next to it, the prior itself speaks."""
    search, frame = PoseSearch(refining_model, camera), draw(bumpy_mesh, truth, camera)
    centre_m, aligned = refining_model.centre_m, []
    turns = [Rotation.from_euler("z", deg, degrees=True).as_matrix() for deg in (12.0, 40.0)]
    alike = [turned(truth, turn, centre_m) for turn in turns]

    class FewRivals:
        def look_alikes(self, pose: Pose, most_rad: float) -> list[Pose]:
            assert most_rad < np.deg2rad(50.0)
            return alike

        def weigh(self, *_args: object) -> list[Hypothesis]:
            return []

    refine = Candidates.refine_closely

    def seen(self, poses, **how):
        poses = list(poses)
        aligned.extend(poses)
        refine(self, poses, **how)

    monkeypatch.setattr(Candidates, "refine_closely", seen)
    level = search.levels.whole
    monkeypatch.setitem(search.levels._levels, 1, replace(level, rivals=FewRivals()))
    monkeypatch.setattr(search.levels, "whole", replace(level, rivals=FewRivals()))
    aside = turned(truth, Rotation.from_euler("x", 6.0, degrees=True).as_matrix(), centre_m)
    near = Near(aside, np.deg2rad(20.0), centre_m)
    for search_near in (search.at, search.near):
        more = () if search_near == search.at else (None,)
        found = search_near(frame, Sky.of(frame), near, *more)
        assert found is not None
        assert found.best.pose.angle_to(truth) < np.deg2rad(0.5)
        assert any(one is alike[0] for one in aligned)
        assert not any(one is alike[1] for one in aligned)
        aligned.clear()
    assert search.at(frame, Sky.of(frame), Near(truth, np.deg2rad(20.0), centre_m)) is not None
    assert aligned == []


def test_edges_need_not_lead_look_alikes_that_were_drawn(refining_model, camera, truth):
    """Those have the same edges: pictures tell. Other poses may show a local optimum."""

    def about_z(degrees: float) -> Pose:
        turn = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
        return turned(truth, turn, refining_model.centre_m)

    def found(degrees: float, outline: float) -> Hypothesis:
        return Hypothesis(about_z(degrees), None, outline, outline, residual_px=0.1, shading=0.8)

    class Drawn:
        def look_alikes(self, _pose: Pose) -> list[Pose]:
            return [about_z(179.0)]

        def weigh(self, *args) -> list[Hypothesis]:
            return [replace(one, probability=1.0 / (k + 1)) for k, one in enumerate(args[2])]

    level = PoseSearch(refining_model, camera).levels.whole
    frame = np.zeros((camera.height, camera.width), np.uint8)
    candidates = Candidates(replace(level, rivals=Drawn()), None, frame, Sky.of(frame), None)
    candidates.add([found(0.0, 0.6), found(180.0, 0.59), found(90.0, 0.2)])
    assert candidates.weighed().margin == pytest.approx(0.4, abs=1e-6)
    candidates.add([found(40.0, 0.55)])
    assert candidates.weighed().margin == pytest.approx(0.05, abs=1e-6)
    assert candidates.choose().margin == pytest.approx(0.01, abs=1e-6)  # of edges alone
