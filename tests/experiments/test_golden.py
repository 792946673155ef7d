"""The golden file: what counts as the same, and what as worse."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from experiments.golden.answers import Answers, no_worse, read, same
from rendezview.geometry.pose import Pose

TRUTH = Pose(np.eye(3), np.array([0.1, 0.2, 5.0]))


def stored(folder: Path, change: Callable[[int, np.ndarray], None] | None = None) -> Path:
    """A run of forty poses, 3 to 43 mm off; ``change`` moves their translations."""
    answers = Answers()
    for k in range(40):
        place = TRUTH.translation_m + np.array([0.003 + 0.001 * k, 0.0, 0.0])
        if change is not None:
            change(k, place)
        answers.pose("group", "ok", Pose(np.eye(3), place), TRUTH, line={"n": k, "track_ms": id(k)})
    folder.mkdir(exist_ok=True)
    answers.write(folder / "golden.jsonl.gz")
    return folder / "golden.jsonl.gz"


def test_a_run_that_is_repeated_is_the_same(tmp_path: Path) -> None:
    old, new = read(stored(tmp_path / "a")), read(stored(tmp_path / "b"))
    assert len(old) == 40
    assert same(old, new)
    assert no_worse(old, new)


def test_one_last_bit_is_a_difference_and_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def nudge(k: int, place: np.ndarray) -> None:
        place[1] = np.nextafter(place[1], 1.0) if k == 7 else place[1]

    old, new = read(stored(tmp_path / "a")), read(stored(tmp_path / "b", nudge))
    assert not same(old, new)
    said = capsys.readouterr().out
    assert "group 7: pose[10] 0.2 → 0.20000000000000004" in said
    assert "group: 1 of 40 records differ" in said
    assert no_worse(old, new)


def test_a_record_that_is_missing_is_a_difference(tmp_path: Path) -> None:
    old = read(stored(tmp_path / "a"))
    new = {key: record for key, record in old.items() if key[1] != 3}
    assert not same(old, new)
    assert not same(new, old)


@pytest.mark.parametrize(
    ("word", "moved_m", "which"), [("wrong", 1.0, {3}), ("translation", 0.002, set(range(40)))]
)
def test_a_wrong_answer_and_larger_errors_are_worse(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], word: str, moved_m: float, which: set[int]
) -> None:
    def move(k: int, place: np.ndarray) -> None:
        place[0] += moved_m if k in which else 0.0

    old, new = read(stored(tmp_path / "a")), read(stored(tmp_path / "b", move))
    assert not no_worse(old, new)
    assert word in capsys.readouterr().out.splitlines()[-2]
    assert no_worse(new, old)


def test_answers_without_truth_are_counted_and_not_judged(tmp_path: Path) -> None:
    answers = Answers()
    answers.add("nothing", "lost")
    answers.pose("black", "ok", TRUTH, None)  # there is nothing to see
    answers.write(tmp_path / "golden.jsonl.gz")
    run = read(tmp_path / "golden.jsonl.gz")
    assert "right" not in run["nothing", 0]
    assert run["black", 0]["right"] is False
