"""Assessments: every frame counts, and the answers depend on the seed alone."""

from __future__ import annotations

import json

import numpy as np
import pytest

from rendezview.errors import RendezviewError
from rendezview_ground.evaluate.assessment import LOOKS, AssessmentOptions, assess
from rendezview_ground.learn.jobs.cores import Cores

OPTIONS = AssessmentOptions(frames=20, samples=1, seed=4, earth=0.3)


@pytest.fixture(scope="module")
def reference(tmp_path_factory, refining_model, bumpy_mesh, camera):
    path = tmp_path_factory.mktemp("assessment") / "answers.jsonl"
    seen, answers = assess(refining_model, bumpy_mesh, camera, path, Cores(1), OPTIONS)
    assert [p.name for p in path.parent.iterdir()] == ["answers.jsonl"]  # no shards stay
    return answers, path.read_bytes(), seen


def test_every_frame_has_a_line_for_each_look_that_says_what_the_answers_say(reference):
    answers, content, seen = reference
    lines = [json.loads(line) for line in content.splitlines()]
    assert [(r["frame"], r["look"]) for r in lines] == [(k, x) for k in range(20) for x in LOOKS]
    for record in lines:
        said = answers[record["look"]]
        k = record["frame"]
        assert record["status"] == str(said.status[k])
        assert (record["rotation_rad"] is None) == (not said.given[k])
        assert (record["status"] == "ok") == bool(said.given[k])
        assert record["direction"] == seen.direction[k].tolist()
        assert record["earth"] == bool(seen.earth[k])
        if said.given[k]:
            assert record["rotation_rad"] == said.rotation_rad[k]


def test_poses_from_a_prior_are_right_and_their_errors_small(reference):
    tracked = reference[0]["tracked"]
    assert np.mean(tracked.right) >= 0.8
    assert np.median(tracked.rotation_rad[tracked.right]) < np.deg2rad(1.0)
    assert np.median(tracked.translation[tracked.right]) < 0.01


def test_threads_and_an_interruption_do_not_change_a_byte(
    tmp_path, refining_model, bumpy_mesh, camera, reference
):
    path, shared = tmp_path / "answers.jsonl", (refining_model, bumpy_mesh, camera)

    def stop(stage: str, done: int, of: int) -> None:
        if done == 1:
            raise InterruptedError

    with pytest.raises(InterruptedError):
        assess(*shared, path, Cores(1), OPTIONS, stop)
    assert not path.exists()
    reported: list[tuple[str, int, int]] = []
    assess(*shared, path, Cores(2), OPTIONS, lambda *step: reported.append(step))
    assert reported == [("frames", k, 5) for k in range(1, 6)]
    assert path.read_bytes() == reference[1]


def test_another_seed_gives_other_answers(tmp_path, refining_model, bumpy_mesh, camera, reference):
    options = AssessmentOptions(frames=4, samples=1, seed=5)
    path = tmp_path / "a"
    assess(refining_model, bumpy_mesh, camera, path, Cores(1), options)
    assert not reference[1].startswith(path.read_bytes())


def test_a_place_where_no_answers_can_be_written_is_refused_before_the_work(
    tmp_path, refining_model, bumpy_mesh, camera
):
    for path in (tmp_path, tmp_path / "none" / "a"):
        with pytest.raises(RendezviewError, match="folder"):
            assess(refining_model, bumpy_mesh, camera, path, Cores(1), OPTIONS)


def test_what_frames_show_is_as_asked(reference, refining_model):
    seen = reference[2]
    assert 2 <= seen.earth.sum() <= 12
    assert np.linalg.norm(seen.direction, axis=1) == pytest.approx(np.ones(20))
    assert seen.sun_phase_rad.max() <= OPTIONS.sun_phase_rad[1]
    assert seen.range_m.min() > refining_model.target_radius_m


def test_what_is_known_beside_the_frame_helps(reference):
    given = {look: answer.given.sum() for look, answer in reference[0].items()}
    assert given["tracked"] >= given["first"]
    assert given["second"] >= given["first"] - 1
    for answer in reference[0].values():
        assert np.isfinite(answer.sigma_rad[answer.given]).all()
        assert not (answer.given & answer.ambiguous).any()
