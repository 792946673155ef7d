"""Every frame with a truth counts."""

from __future__ import annotations

import io
import json
import math

import numpy as np
import pytest
from rich.console import Console
from tests.ground.evaluate.rows import row, sequence

from rendezview.errors import RendezviewError
from rendezview.geometry.symmetry import Symmetry
from rendezview_ground.evaluate import evaluate
from rendezview_ground.evaluate.evaluation import Evaluation


def test_frames_without_a_row_have_no_pose_and_stay_in_the_count() -> None:
    found = evaluate(sequence(4), [row(2, 1.0), row(0, 3.0)])
    assert (len(found.frames), found.found, found.missing) == (4, 2, (1, 3))
    assert found.found_share == 0.5
    assert found.statistics("rotation_rad").median == pytest.approx(math.radians(2.0))
    assert found.statistics("rotation_rad").largest == pytest.approx(math.radians(3.0))
    assert np.isnan(found.values("roll_rad")).tolist() == [False, True, False, True]


def test_a_pose_is_wrong_above_five_degrees() -> None:
    found = evaluate(sequence(4), [row(0, 4.9), row(1, 5.1), row(2, 180.0)])
    assert found.wrong == (1, 2)
    assert found.wrong_share == 0.5


def test_statistics_are_those_of_the_frames_found() -> None:
    angles = np.random.default_rng(6).uniform(0.0, 4.0, 40)
    found = evaluate(sequence(50), [row(k, float(a)) for k, a in enumerate(angles)])
    statistics = found.statistics("rotation_rad")
    assert statistics.percentile_95 == pytest.approx(np.deg2rad(np.percentile(angles, 95)))
    assert statistics.mean == pytest.approx(np.deg2rad(angles.mean()))


def test_a_row_of_no_frame_is_an_error_that_names_it() -> None:
    with pytest.raises(RendezviewError, match="im_id 9 of scene 5"):
        evaluate(sequence(), [row(9)])
    with pytest.raises(RendezviewError, match="im_id 1 of scene 6"):
        evaluate(sequence(), [row(1, scene_id=6)])


def test_of_several_rows_the_best_score_counts_and_a_note_says_so() -> None:
    found = evaluate(
        sequence(), [row(0, 1.0, score=0.5), row(0, 2.0, score=0.9), row(0, 3.0, score=0.7)]
    )
    assert found.statistics("rotation_rad").median == pytest.approx(math.radians(2.0))
    assert found.notes == ("2 rows more than one for a frame, the best score counts",)


def test_rows_that_cannot_be_judged_are_left_out_and_noted() -> None:
    found = evaluate(sequence(4, without_truth=(3,)), [row(3), row(1, obj_id=2), row(0)])
    assert (len(found.frames), found.found) == (3, 1)
    assert found.notes == (
        "1 rows of a frame without truth, left out",
        "1 rows of another object, left out",
    )


def test_a_sequence_without_truth_cannot_be_evaluated() -> None:
    with pytest.raises(RendezviewError, match="no frame has a true pose"):
        evaluate(sequence(2, without_truth=(0, 1)), [])


def test_a_symmetric_target_is_judged_by_the_nearest_of_its_poses() -> None:
    twofold = Symmetry("discrete", np.array([0.0, 0.0, 1.0]), math.pi)
    found = evaluate(sequence(1), [row(0, 182.0)], [twofold])
    assert found.statistics("rotation_rad").median == pytest.approx(math.radians(2.0))
    assert not found.wrong


def printed(evaluation: Evaluation) -> str:
    console = Console(width=120, record=True, file=io.StringIO())
    console.print(evaluation.as_table())
    return console.export_text()


def test_the_table_says_counts_errors_and_times() -> None:
    found = evaluate(sequence(4), [row(0, 1.0, time_s=0.004), row(1, 6.0, time_s=0.008)])
    text = printed(found)
    assert "4 frames, 2 with a pose (50.0%)" in text
    assert "2 without a pose, 1 wrong by more than 5° (25.0%)" in text
    (line,) = (line for line in text.splitlines() if "rotation" in line)
    assert [cell.strip() for cell in line.split("│")[2:6]] == ["3.50", "5.75", "6.00", "°"]
    (line,) = (line for line in text.splitlines() if "computing" in line)
    assert line.split("│")[2].strip() == "6.0"


def test_the_dictionary_is_json_and_what_is_unknown_is_none() -> None:
    whole = evaluate(sequence(3), [row(1, 2.0)]).as_dict()
    again = json.loads(json.dumps(whole, allow_nan=False))
    assert again == whole
    assert whole["missing"] == [0, 2]
    assert whole["computing_s"]["median"] is None
    assert whole["errors"]["rotation_rad"]["median"] == pytest.approx(math.radians(2.0))
    assert [frame["status"] for frame in whole["per_frame"]] == ["no pose", "pose", "no pose"]
    nothing = evaluate(sequence(3), []).as_dict()
    assert nothing["found"] == 0
    assert nothing["errors"]["speed_score"]["mean"] is None
    assert "–" in printed(evaluate(sequence(3), []))
