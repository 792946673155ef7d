"""What the benchmark keeps and refuses, and that its turns measure what they say."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

from experiments.benchmark.check import Row, Way, best, race, times, worse, write
from experiments.benchmark.history import history_table, kept_ratios


def row(ours: float, peer: float = 2.0, name: str = "tracking") -> Row:
    return Row(name, ours, "floor", peer, "ms", "pose_speed.py")


def test_a_ratio_within_half_as_much_again_passes(tmp_path: Path) -> None:
    kept = tmp_path / "kept.json"
    write([row(4.0)], kept)
    assert worse([row(5.9)], kept) == {}
    assert worse([row(1.0)], kept) == {}


def test_a_ratio_that_is_worse_is_named_with_both_numbers(tmp_path: Path) -> None:
    kept = tmp_path / "kept.json"
    write([row(4.0), row(1.0, name="ring")], kept)
    (line,) = worse([row(6.1), row(1.0, name="ring")], kept).values()
    assert "tracking / floor" in line
    assert "3.05" in line
    assert "kept 2" in line


def test_a_slower_machine_does_not_count(tmp_path: Path) -> None:
    kept = tmp_path / "kept.json"
    write([row(4.0, 2.0)], kept)
    assert worse([row(40.0, 20.0)], kept) == {}


def test_rows_that_vanish_or_are_new_are_named(tmp_path: Path) -> None:
    kept = tmp_path / "kept.json"
    write([row(4.0)], kept)
    missing, new = worse([row(4.0, name="ring")], kept).values()
    assert "tracking / floor: kept, but not measured" in missing
    assert "ring / floor: measured, but not kept" in new


def test_the_best_of_several_passes_is_that_of_ours_and_of_the_peer() -> None:
    found = best([row(4.0, 3.0), row(5.0, 2.0), row(1.0, 1.0, "ring")])
    assert found["tracking / floor"].ratio == 2.0
    assert found["ring / floor"].ratio == 1.0


def test_passes_on_both_sides_of_a_millisecond_are_compared_in_one_unit() -> None:
    timed = [
        next(
            iter(
                times("pose_speed.py", {"tracking": ours, "floor": 4e-4}, {"tracking": ("floor",)})
            )
        )
        for ours in (1.3e-3, 0.8e-3)
    ]
    (found,) = best(timed).values()
    assert found.ratio == pytest.approx(2.0)
    assert found.shown() == (pytest.approx(800.0), pytest.approx(400.0), "µs")


def test_kept_times_are_in_the_unit_that_is_shown(tmp_path: Path) -> None:
    write([Row("tracking", 1.3e-3, "floor", 4e-4, "s", "pose_speed.py")], tmp_path / "kept.json")
    (entry,) = json.loads((tmp_path / "kept.json").read_text(encoding="utf-8")).values()
    assert entry == {"ratio": 3.25, "ours": 1.3, "peer": 0.4, "unit": "ms"}


def test_a_failure_where_there_was_none_is_worse(tmp_path: Path) -> None:
    kept = tmp_path / "kept.json"
    write([row(0.0, 3.0)], kept)
    assert worse([row(0.0, 3.0)], kept) == {}
    assert len(worse([row(1.0, 3.0)], kept)) == 1


def test_what_cannot_be_a_number_is_worse(tmp_path: Path) -> None:
    kept = tmp_path / "kept.json"
    write([row(1.0)], kept)
    assert len(worse([row(float("nan"))], kept)) == 1
    assert len(worse([row(float("inf"))], kept)) == 1


@pytest.mark.parametrize("text", ["", "[1]", "{", '{"a": 1}', '{"a": {"ratio": "x"}}'])
def test_a_file_that_is_none_is_told(tmp_path: Path, text: str) -> None:
    kept = tmp_path / "kept.json"
    kept.write_text(text, encoding="utf-8")
    (line,) = worse([row(1.0)], kept).values()
    assert "not a file of kept ratios" in line


def test_the_kept_file_of_the_repository_has_positive_ratios() -> None:
    path = Path(__file__).resolve().parents[2] / "benchmark.json"
    kept = json.loads(path.read_text(encoding="utf-8"))
    assert len(kept) >= 30
    assert all(entry["ratio"] >= 0.0 for entry in kept.values())


@pytest.fixture
def clocks(monkeypatch: pytest.MonkeyPatch) -> Callable[[float, float], None]:
    """Moves the wall clock and the clock of the process, s; nothing else does."""
    wall_s, process_s = [0.0], [0.0]

    def move(wall: float, process: float) -> None:
        wall_s[0] += wall
        process_s[0] += process

    clocks = SimpleNamespace(process_time=lambda: process_s[0], perf_counter=lambda: wall_s[0])
    monkeypatch.setattr("experiments.benchmark.check.time", clocks)
    return move


@pytest.fixture
def work(clocks: Callable[[float, float], None]) -> Callable[[int], object]:
    """Work that moves both clocks by a millisecond a piece."""
    return lambda count: clocks(1e-3 * count, 1e-3 * count)


def test_turns_tell_twice_the_work_from_once(work: Callable[[int], object]) -> None:
    spent = race({"once": Way(lambda: work(10)), "twice": Way(lambda: work(20))}, 0.3)
    assert spent["once"] == pytest.approx(0.01)
    assert spent["twice"] == pytest.approx(0.02)


def test_turns_divide_by_the_answers_of_a_call(work: Callable[[int], object]) -> None:
    ways = {"call": Way(lambda: work(20)), "each": Way(lambda: work(20), answers=20)}
    spent = race(ways, 0.3)
    assert spent["call"] == pytest.approx(0.02)
    assert spent["each"] == pytest.approx(0.001)


def test_waiting_for_a_core_does_not_count(clocks: Callable[[float, float], None]) -> None:
    spent = race({"waits": Way(lambda: clocks(0.01, 0.001))}, 0.1, rounds=3)
    assert spent["waits"] == pytest.approx(0.001)


def test_a_way_with_a_clock_of_its_own_is_believed() -> None:
    spent = race({"elsewhere": Way(lambda: 0.25, own_clock=True)}, 0.01, rounds=2)
    assert spent["elsewhere"] == 0.25


def test_history_has_the_last_ratios_of_each_day(tmp_path: Path) -> None:
    def git(*arguments: str) -> None:
        own = ["-c", "user.name=a", "-c", "user.email=a@b", *arguments]
        subprocess.run(["git", "-C", str(tmp_path), *own], check=True, capture_output=True)

    kept = tmp_path / "kept.json"
    with pytest.raises(SystemExit, match=r"not a git repository|no commit"):
        kept_ratios(kept)
    git("init")
    for day, rows in (("03", [row(8.0)]), ("03", [row(4.0)]), ("05", [row(2.0), row(1, 1, "new")])):
        write(rows, kept)
        git("add", "kept.json")
        git("commit", "-m", "kept", f"--date=2026-10-{day}T12:00:00Z")
    days = kept_ratios(kept)
    assert days == {
        "2026-10-03": {"tracking / floor": 2.0},
        "2026-10-05": {"tracking / floor": 1.0, "new / floor": 1.0},
    }
    table = history_table(days)
    assert [column.header for column in table.columns][1:] == [*days]
    assert [list(column.cells) for column in table.columns[1:]] == [["2", "–"], ["1", "1"]]
