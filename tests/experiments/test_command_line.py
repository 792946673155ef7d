"""The command line of the experiments: one name for each, arguments from the signature."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Annotated, Literal

import pytest

from experiments.__main__ import EXPERIMENTS, listing
from experiments.frame import ROOT, nees, run, table_of, two

ENTRIES = {name: entry for group in EXPERIMENTS.values() for name, (entry, _) in group.items()}


def recorded(
    model: Path, targets: list[str], *, seed: int = 7, part: Literal["one", "two"] = "one",
    span: tuple[int, int] = (0, 20), log: Annotated[Path | None, "JSON lines"] = None,
    from_: float = 12.0, sun: bool = False,
) -> dict[str, object]:  # fmt: skip
    """What was asked for."""
    return locals()


def test_every_name_has_a_module_that_defines_run_and_there_are_at_most_thirty() -> None:
    for name, module in ENTRIES.items():
        path = ROOT / "scripts" / "experiments" / Path(*module.split(".")).with_suffix(".py")
        assert "\ndef run(" in path.read_text(encoding="utf-8"), name
    assert len(ENTRIES) <= 30


def test_the_list_has_a_line_for_every_experiment_and_imports_none_of_them() -> None:
    program = (
        "import sys; from experiments.__main__ import main; sys.argv = ['experiments']; main(); "
        "assert not {'numpy', 'cv2', 'rendezview'} & set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.rstrip() == listing()
    assert all(f"\n  {name} " in done.stdout for name in ENTRIES)


def test_an_unknown_name_is_refused() -> None:
    words = [sys.executable, "-m", "experiments", "no-such"]
    done = subprocess.run(words, capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stderr == "no experiment 'no-such'; python -m experiments lists them\n"


def test_arguments_come_from_the_signature() -> None:
    asked = run("name", recorded, ["m.rvm", "a", "b", "--seed", "3", "--sun", "--from", "2"])
    assert asked == {
        "model": Path("m.rvm"), "targets": ["a", "b"], "seed": 3, "part": "one", "span": (0, 20),
        "log": None, "from_": 2.0, "sun": True,
    }  # fmt: skip
    words = ["m", "a", "--part", "two", "--span", "1", "4", "--log", "x"]
    asked = run("name", recorded, words)
    assert isinstance(asked, dict)
    assert (asked["part"], asked["span"], asked["log"]) == ("two", [1, 4], Path("x"))


@pytest.mark.parametrize("words", [[], ["m"], ["m", "a", "--part", "x"], ["m", "a", "--seed", "x"]])
def test_wrong_arguments_are_refused(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        run("name", recorded, words)
    assert ended.value.code == 2
    assert "python -m experiments name" in capsys.readouterr().err


def test_tables_and_statistics() -> None:
    made = table_of("title", "what | n | NEES", left=1)
    assert [column.header for column in made.columns] == ["what", "n", "NEES"]
    assert [column.justify for column in made.columns] == ["left", "right", "right"]
    assert two([1.0, 2.0, 3.0], 50) == "2.000 / 2.000"
    assert nees([1.0, 2.0], [[1.0, 0.0], [0.0, 4.0]]) == 2.0
