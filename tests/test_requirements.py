"""Requirements, their tests, and the matrix of results."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from tests.evidence import Requirement, matrix, requirements

ROOT = Path(__file__).resolve().parents[1]
_MARK = re.compile(r'^\s*@pytest\.mark\.requirement\("([^"]+)"\)', re.MULTILINE)


def report(*names: str) -> SimpleNamespace:
    return SimpleNamespace(user_properties=[("requirement", name) for name in names])


REPORTS = {
    "passed": [report("RV-A"), report("RV-B"), report("RV-X"), report()],
    "failed": [report("RV-B")],
    "skipped": [report("RV-C")],
}


def test_every_requirement_has_a_test_and_every_mark_a_requirement():
    marked = {
        name
        for path in (ROOT / "tests").rglob("test_*.py")
        for name in _MARK.findall(path.read_text(encoding="utf-8"))
    }
    assert marked == set(requirements())


def test_a_requirement_holds_where_a_test_passed_and_none_failed():
    known = {f"RV-{c}": Requirement(id=f"RV-{c}", text=c, verified="test") for c in "ABCD"}
    lines, faults = matrix(REPORTS, known)
    assert [name for name, one in known.items() if one.holds] == ["RV-A"]
    assert known["RV-B"].results == {"failed": 1, "passed": 1}
    assert known["RV-C"].results == {"skipped": 1}
    assert [line.partition(" (")[0] for line in lines] == [
        "RV-A: holds", "RV-B: NOT VERIFIED", "RV-C: NOT VERIFIED", "RV-D: NOT VERIFIED",
    ]  # fmt: skip
    assert faults[0] == "RV-X is not in requirements.toml"
    assert faults[1:] == [f"RV-{c} has no passing test" for c in "BCD"]


def test_a_requirement_without_a_passing_test_fails_the_run(tmp_path: Path):
    path = tmp_path / "test_one.py"
    path.write_text(
        'import pytest\n\n@pytest.mark.requirement("RV-POSE-1")\ndef test_one(): pass\n'
    )
    words = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--evidence",
             "-c", str(ROOT / "pyproject.toml"), "-p", "tests.conftest", str(path)]  # fmt: skip
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    assert "RV-POSE-1: holds (1 passed, 0 failed, 0 skipped)" in done.stdout
    assert "NOT VERIFIED" in done.stdout
    assert done.returncode == 1, done.stderr


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('[[requirement]]\nid = "RV-1"\ntext = "a"\n', "missing"),
        ('[[requirement]]\nid = "RV-1"\ntext = "a"\nverified = "hope"\n', "wrong"),
        ('[[requirement]]\nid = "RV-1"\ntext = "a"\nverified = "test"\nby = "me"\n', "by"),
        (2 * '[[requirement]]\nid = "RV-1"\ntext = "a"\nverified = "test"\n', "twice"),
    ],
)
def test_an_entry_that_is_not_complete_is_refused(tmp_path: Path, text: str, message: str):
    path = tmp_path / "requirements.toml"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        requirements(path)
