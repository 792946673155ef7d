"""The forest: their score against plain Python, what they decide, and files that hold none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rendezview.geometry.geodesic import angle_between
from rendezview.geometry.pose import Pose
from rendezview.sensors.appearance import Recognizer, ViewModel
from rendezview.sensors.appearance.edges.refinement import Refiner
from rendezview.sensors.appearance.model.forest import (
    BINS,
    LEAF,
    ODDS_UNIT,
    ForestScores,
    ScoreForest,
)
from rendezview.sensors.appearance.model.signature import (
    Signature,
    rebinning,
    roll_readings,
    twist,
)
from rendezview.sensors.appearance.outline.voted import VotedPose
from rendezview.sensors.appearance.outline.votes import Matcher

SILENT = -35  # the share of a node's views among its samples, in ODDS_UNIT


def scores_of(model: ViewModel) -> ForestScores:
    forest_scores = model.forest_scores()
    assert forest_scores is not None
    return forest_scores


def silenced(model: ViewModel, odds: int = SILENT) -> ViewModel:
    odds = np.where(model.score_forest.component == LEAF, odds, 0).astype(np.int8)
    return replace(model, score_forest=replace(model.score_forest, odds=odds))


def score_twin(model: ViewModel, readings: np.ndarray, attitude: np.ndarray) -> float:
    """Mean log odds, tree by tree."""
    forest, sphere = model.score_forest, model.geodesic
    odds = []
    for node, direction in enumerate(sphere.nodes):
        if angle_between(-attitude[2], direction) > sphere.mean_edge_rad:
            continue
        roll = float(twist(attitude, model.views.centred_from_target[node]))
        place = np.arange(BINS) - roll * BINS / (2.0 * np.pi)
        rolled = np.interp(place, np.arange(BINS), readings, period=BINS)
        for root in forest.roots[node]:
            entry = int(root)
            while forest.component[entry] != LEAF:
                left = rolled[forest.component[entry]] <= forest.threshold[entry]
                entry += 1 if left else int(forest.right[entry])
            odds.append(float(forest.odds[entry]))
    return float(np.mean(odds)) * ODDS_UNIT


def test_scores_are_those_of_every_tree_in_turn(refining_model):
    rng = np.random.default_rng(0)
    forest_scores = scores_of(refining_model)
    for _ in range(5):
        view = int(rng.integers(len(refining_model.lattice.nodes)))
        readings = refining_model.views.readings[view].astype(np.float32)
        centred = Rotation.random(random_state=rng).as_matrix()
        attitude = refining_model.views.centred_from_target[view]
        near = Rotation.from_rotvec(0.1 * rng.normal(size=(4, 3))).as_matrix() @ attitude
        signature = Signature(readings, 1.0, centred)
        found = forest_scores.scores(signature, centred.T @ near)
        coarse = np.minimum(readings @ rebinning(len(readings), BINS) / 16.0, 255.0)
        wanted = [score_twin(refining_model, coarse, a) for a in near]
        np.testing.assert_allclose(found, wanted, atol=0.3)  # a reading may lie at a threshold
        assert np.median(np.abs(found - wanted)) < 1e-6


def test_the_odds_of_a_node_are_those_of_its_own_trees(refining_model):
    """A node is active by its forest: the view of a node turns it on, that of another one off."""
    forest_scores, matcher = scores_of(refining_model), Matcher(refining_model)
    count, views = len(refining_model.geodesic.nodes), refining_model.views
    nodes, rolls = np.arange(count), np.zeros(count)
    for view in (0, count // 2):
        readings = views.readings[view].astype(np.float32)
        odds = forest_scores.node_odds(readings, nodes, rolls)
        # The score at a node's own attitude is the mean over it and its neighbours.
        sphere = refining_model.geodesic
        near = sphere.within(-views.centred_from_target[view][2], sphere.mean_edge_rad)
        turns = twist(views.centred_from_target[view], views.centred_from_target[near])
        signature = Signature(readings, 1.0, np.eye(3))
        score = forest_scores.scores(signature, views.centred_from_target[view][None])[0]
        assert np.mean(forest_scores.node_odds(readings, near, turns)) == pytest.approx(
            score, abs=1e-9
        )
        trust = matcher.decided(nodes, readings, rolls)
        assert trust[view] > 0.5
        assert np.array_equal(trust > 0.0, odds > -2.0)
        assert np.mean(trust > 0.0) < 0.5
    quiet = Matcher(silenced(refining_model))
    assert not quiet.decided(nodes, readings, rolls).any()


def test_readings_roll_as_interpolation_does():
    rng = np.random.default_rng(1)
    readings = rng.uniform(0.0, 255.0, BINS).astype(np.float32)
    for roll in (0.0, 0.3, -2.0, 7.0):
        out = np.empty(BINS, np.float32)
        roll_readings(readings, roll, out)
        place = np.arange(BINS) - roll * BINS / (2.0 * np.pi)
        twin = np.interp(place, np.arange(BINS), readings, period=BINS)
        np.testing.assert_allclose(out, twin, atol=1e-2)


def test_the_forest_of_a_view_prefers_its_own_attitude(refining_model):
    forest_scores, right = scores_of(refining_model), []
    for view in range(0, len(refining_model.lattice.nodes), 7):
        attitude = refining_model.views.centred_from_target[view]
        readings = refining_model.views.readings[view].astype(np.float32)
        turned = Rotation.from_rotvec(np.deg2rad([[0, 0, 0], [60, 0, 0], [0, 120, 0]])).as_matrix()
        scores = forest_scores.scores(Signature(readings, 1.0, np.eye(3)), attitude @ turned)
        right.append(np.argmax(scores) == 0)
    assert np.mean(right) > 0.9


def test_silencing_the_forest_costs_work(refining_model, bumpy_mesh, camera, draw, monkeypatch):
    """What the forest says decides how many poses are aligned, and in which order."""
    aligned: list[int] = []
    first: list[np.ndarray] = []
    best = Refiner.best

    def counted(self, image, sky, rotations, centres, *args, **options):
        aligned.append(len(rotations))
        first.append(rotations[0].copy())
        return best(self, image, sky, rotations, centres, *args, **options)

    monkeypatch.setattr(Refiner, "best", counted)
    work, orders = {}, {}
    for name, model in (("learned", refining_model), ("silenced", silenced(refining_model))):
        recognizer = Recognizer(model, camera, sketch=False)
        aligned.clear()
        starts = []
        for k in range(8):
            rng = np.random.default_rng([3, k])
            rotation = Rotation.random(random_state=rng).as_matrix()
            centre = np.array([0.0, 0.0, 8.0])
            pose = Pose(rotation, centre - rotation @ refining_model.centre_m)
            first.clear()
            recognizer.recognize(draw(bumpy_mesh, pose, camera, rng))
            starts.append(first[0])
        work[name], orders[name] = sum(aligned), np.array(starts)
    assert work["learned"] < 0.8 * work["silenced"]
    assert not np.allclose(orders["learned"], orders["silenced"])


def test_a_model_without_a_forest_works(refining_model, tmp_path, camera, draw, bumpy_mesh):
    path = tmp_path / "old.rvm"
    replace(refining_model, score_forest=None).save(path)
    old = ViewModel.load(path)
    assert old.score_forest is None
    pose = Pose(np.eye(3), np.array([0.0, 0.0, 8.0]))
    observation = Recognizer(old, camera).recognize(draw(bumpy_mesh, pose, camera))
    assert observation.found is not None
    assert observation.found.votes is None


def test_alone_a_pose_that_the_forest_doubts_is_not_given(refining_model, bumpy_mesh, camera, draw):
    given = {}
    models = {
        "learned": refining_model,
        "silenced": silenced(refining_model),
        "unsure": silenced(refining_model, SILENT // 2),
    }
    for name, model in models.items():
        recognizer = Recognizer(model, camera, refine=False)
        answers = []
        for k in range(12):
            rng = np.random.default_rng([5, k])
            rotation = Rotation.random(random_state=rng).as_matrix()
            centre = np.array([0.0, 0.0, 8.0])
            pose = Pose(rotation, centre - rotation @ refining_model.centre_m)
            answers.append(recognizer.recognize(draw(bumpy_mesh, pose, camera, rng), pose))
        given[name] = sum(answer.pose is not None for answer in answers)
    assert given["learned"] >= 4
    assert given["silenced"] == given["unsure"] == 0
    assert any("log odds" in (answer.reason or "") for answer in answers)


def test_votes_find_the_attitude_of_a_sunlit_part(refining_model):
    lit, finder = refining_model.lit, VotedPose(refining_model, scores_of(refining_model))
    weights = rebinning(BINS, refining_model.bins)
    off = []
    for entry in range(0, len(lit.sun), len(lit.sun) // 60):
        readings = np.rint(lit.readings[entry].astype(np.float32) * np.float32(16.0) @ weights)
        signature = Signature(readings, float(lit.area_m2[entry]) / 64.0, np.eye(3))
        found = finder.find(signature)
        if found is not None:
            true = Rotation.from_quat(lit.quat_wxyz[entry][[1, 2, 3, 0]])
            turn = Rotation.from_matrix(found[0].rotation) * true.inv()
            off.append(np.rad2deg(turn.magnitude()))
            assert np.all(np.linalg.eigvalsh(found[1]) > 0.0)
    assert len(off) >= 10
    assert np.mean(np.array(off) < 20.0) > 0.9


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"roots": np.zeros((3, 2), np.int32)}, "roots has shape"),
        ({"component": np.full(3, 95, np.uint8)}, "beyond the signature"),
        ({"right": np.full(3, 9, np.uint16)}, "after its parent"),
        ({"odds": np.zeros(2, np.int8)}, "another length"),
        ({"roots": np.full((1, 1), 7, np.int32)}, "outside"),
    ],
)
def test_a_forest_that_does_not_belong_together_is_refused(change, words):
    sound = {
        "roots": np.zeros((1, 1), np.int32),
        "component": np.array([4, LEAF, LEAF], np.uint8),
        "threshold": np.array([30, 0, 0], np.uint8),
        "right": np.array([2, 0, 0], np.uint16),
        "odds": np.array([0, -20, 20], np.int8),
    }
    ScoreForest(**sound).check(1)
    with pytest.raises(ValueError, match=words):
        ScoreForest(**(sound | change)).check(1)
