"""The challenges' scores, by their definitions, and several results side by side."""

from __future__ import annotations

import io
import json
import math
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from scipy.spatial.transform import Rotation
from tests.ground.evaluate.rows import RANGE_M, row, sequence

from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Pose
from rendezview.geometry.symmetry import Symmetry
from rendezview_ground.evaluate import evaluate
from rendezview_ground.evaluate.comparison import (
    common_frames,
    comparison_dict,
    comparison_table,
    score_table,
)
from rendezview_ground.evaluate.nees import nees_text, normalised_errors
from rendezview_ground.evaluate.scores import scores
from rendezview_ground.evaluate.surface import ModelPoints


def speed_score(angle_deg: float, off_m: float, threshold: bool) -> float:
    """As the data set's authors score a pose of SPEED+: degrees, and the part of the range."""
    e_t = off_m / RANGE_M
    e_q = math.radians(angle_deg)
    if threshold and angle_deg < 0.169:
        e_q = 0.0
    if threshold and e_t < 2.173e-3:
        e_t = 0.0
    return e_t + e_q


def test_speed_is_the_mean_over_the_poses_and_speed_plus_forgives_the_small() -> None:
    errors = [(0.1, 0.01), (0.1, 0.03), (3.0, 0.02), (0.168, 0.0217), (0.17, 0.0218), (40.0, 2.0)]
    found = scores(evaluate(sequence(8), [row(k, *e) for k, e in enumerate(errors)]))
    assert found.speed == pytest.approx(np.mean([speed_score(*e, False) for e in errors]))
    assert found.speed_plus == pytest.approx(np.mean([speed_score(*e, True) for e in errors]))


def test_the_scores_do_not_depend_on_how_each_frame_is_told() -> None:
    rows = [row(0, 0.1, 0.01), row(1, 1.0, 0.1)]
    plain, plus = (scores(evaluate(sequence(2), rows, speed_plus=p)) for p in (False, True))
    assert plain == plus


def test_within_5_cm_and_5_degrees_counts_the_frames_without_a_pose_as_failed() -> None:
    rows = [row(0), row(1, 4.9, 0.049), row(2, 5.1, 0.0), row(3, 0.0, 0.051)]
    assert scores(evaluate(sequence(5), rows)).rbot_share == pytest.approx(2.0 / 5.0)
    assert scores(evaluate(sequence(5), [])).rbot_share == 0.0


def test_recall_is_the_mean_over_the_thresholds_of_bop() -> None:
    rod = ModelPoints.of([[0.5, 0.0, 0.0], [-0.5, 0.0, 0.0], [0.0, 0.1, 0.0]])  # 1 m
    # 0.12 of the diameter: within eight of the ten thresholds; 0.6: within none.
    rows = [row(0), row(1, 0.0, 0.12), row(2, 0.0, 0.6), row(3, 0.0, 0.08)]
    found = scores(evaluate(sequence(5), rows, surface=rod))
    assert found.mssd_recall == pytest.approx((10 + 8 + 0 + 9 + 0) / 50)
    f = sequence(1).frames[0].camera.fx
    px = [f * off / RANGE_M for off in (0.0, 0.12, 0.6, 0.08)]
    within = [sum(value < limit for limit in range(5, 51, 5)) for value in px]
    assert 0 < within[2] < within[1] < 10
    assert found.mspd_recall == pytest.approx(sum(within) / 50)
    assert found.add_share == pytest.approx(2 / 5)
    assert scores(evaluate(sequence(2), rows[:1])).mssd_recall is None


def shown(table: object) -> dict[str, list[str]]:
    console = Console(width=160, record=True, file=io.StringIO())
    console.print(table)
    lines = [line.split("│")[1:-1] for line in console.export_text().splitlines() if "│" in line]
    return {cells[0].strip(): [cell.strip() for cell in cells[1:]] for cells in lines}


def test_results_stand_side_by_side_and_compare_over_the_frames_all_have() -> None:
    ours = evaluate(sequence(4), [row(0, 1.0), row(1, 2.0), row(2, 3.0), row(3, 9.0)])
    theirs = evaluate(sequence(4), [row(1, 0.5), row(2, 1.5)])
    table = shown(comparison_table({"ours": ours, "theirs": theirs}))
    assert table["frames with a pose"] == ["", "4", "2"]
    assert table["wrong by more than 5°"] == ["", "1", "0"]
    assert table["rotation, median"] == ["°", "2.500", "1.000"]
    assert table["rotation, median of the 2 frames all have"] == ["°", "2.500", "1.000"]
    assert table["within 5 cm and 5° (RBOT)"] == ["%", "75.0", "50.0"]
    assert "BOP recall by MSSD" not in table
    again = json.loads(json.dumps(comparison_dict({"ours": ours, "theirs": theirs})))
    assert [part["file"] for part in again["results"]] == ["ours", "theirs"]
    assert again["results"][1]["scores"]["rbot_share"] == 0.5
    assert again["common_frames"] == 2
    assert again["common_medians"]["ours"]["rotation_rad"] == pytest.approx(math.radians(2.5))
    assert shown(score_table(theirs))["within 5 cm and 5° (RBOT)"] == ["50.0", "%"]


def test_results_without_a_frame_in_common_have_no_common_median() -> None:
    parts = {"a": evaluate(sequence(2), [row(0)]), "b": evaluate(sequence(2), [row(1)])}
    assert common_frames(parts).frames == 0
    assert comparison_dict(parts)["common_medians"]["a"]["rotation_rad"] is None
    assert "–" in shown(comparison_table(parts))["rotation, median of the 0 frames all have"]
    with pytest.raises(ValueError, match="comparable over one sequence only"):
        common_frames({"a": parts["a"], "b": evaluate(sequence(3), [row(1)])})


def test_a_frame_without_a_pose_counts_half_a_turn_and_the_whole_range() -> None:
    found = scores(evaluate(sequence(4), [row(0), row(1, 3.0), row(2, 40.0)]))
    assert found.speed_plus_all == pytest.approx(
        (speed_score(3.0, 0.0, True) + speed_score(40.0, 0.0, True) + math.pi + 1.0) / 4.0
    )
    assert found.right_share == 0.5
    assert found.wrong_share == 0.25
    assert scores(evaluate(sequence(2), [])).speed_plus_all == pytest.approx(math.pi + 1.0)


def logged(im_id: int, pose: Pose | None, sigma: float = 0.01) -> str:
    place = None
    if pose is not None:
        quat = np.roll(Rotation.from_matrix(pose.rotation).as_quat(), 1)
        place = {"quat_wxyz": quat.tolist(), "translation_m": pose.translation_m.tolist()}
    covariance = (sigma**2 * np.eye(6)).tolist()
    return json.dumps({"im_id": im_id, "pose": place, "covariance": covariance})


def test_normalised_errors_are_those_of_the_right_poses_of_the_log(tmp_path: Path) -> None:
    log = tmp_path / "log.jsonl"
    poses = [row(0, 1.0, 0.02).camera_from_target, row(1, 90.0).camera_from_target, None]
    log.write_text("\n".join(logged(k, pose) for k, pose in enumerate(poses)) + "\n")
    expected = (np.deg2rad(1.0) ** 2 + 0.02**2) / 0.01**2
    assert normalised_errors(sequence(3), log) == pytest.approx([expected])
    quarter = Symmetry("discrete", np.array([0.0, 0.0, 1.0]), np.pi / 2.0)
    assert normalised_errors(sequence(3), log, [quarter]) == pytest.approx(
        [expected, 0.0], abs=1e-9
    )
    # About an axis beside the origin: the covariance is that of the pose's own origin.
    aside = Symmetry("discrete", np.array([0.0, 0.0, 1.0]), np.pi, np.array([0.5, 0.0, 0.0]))
    truth = sequence(1).frames[0].camera_from_target
    assert truth is not None
    there = truth @ Pose(np.diag([-1.0, -1.0, 1.0]), np.array([1.0, 0.0, 0.0]))
    tilt = Rotation.from_rotvec([0.0, np.deg2rad(1.0), 0.0]).as_matrix()
    log.write_text(logged(0, Pose(tilt @ there.rotation, there.translation_m)) + "\n")
    assert normalised_errors(sequence(1), log, [aside]) == pytest.approx(
        [np.deg2rad(1.0) ** 2 / 0.01**2]
    )
    assert "median" in nees_text(np.array([expected]))
    log.write_text("no log\n")
    with pytest.raises(RendezviewError, match="line 1"):
        normalised_errors(sequence(3), log)
