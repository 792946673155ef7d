"""Requirements, their tests, and the matrix of results."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from experiments.evidence import Requirement, count_results, requirements, run

ROOT = Path(__file__).resolve().parents[1]
_MARK = re.compile(r'^\s*@pytest\.mark\.requirement\("([^"]+)"\)', re.MULTILINE)

JUNIT = """<testsuites><testsuite>
<testcase name="a"><properties><property name="requirement" value="RV-A"/></properties></testcase>
<testcase name="b"><properties><property name="requirement" value="RV-B"/></properties>
<failure message="no"/></testcase>
<testcase name="c"><properties><property name="requirement" value="RV-B"/></properties></testcase>
<testcase name="d"><properties><property name="requirement" value="RV-C"/></properties>
<skipped message="no data"/></testcase>
<testcase name="e"><properties><property name="requirement" value="RV-X"/></properties></testcase>
<testcase name="f"/>
</testsuite></testsuites>"""


def test_every_requirement_has_a_test_and_every_mark_a_requirement():
    marked = {
        name
        for path in (ROOT / "tests").rglob("test_*.py")
        for name in _MARK.findall(path.read_text(encoding="utf-8"))
    }
    assert marked == set(requirements())


def test_a_requirement_holds_where_a_test_passed_and_none_failed(tmp_path: Path):
    junit = tmp_path / "junit.xml"
    junit.write_text(JUNIT)
    known = {f"RV-{c}": Requirement(id=f"RV-{c}", text=c, verified="test") for c in "ABCD"}
    assert count_results(junit, known) == ["RV-X"]
    assert [name for name, one in known.items() if one.holds] == ["RV-A"]
    assert known["RV-B"].results == {"failed": 1, "passed": 1}
    assert known["RV-C"].results == {"skipped": 1}


def test_a_requirement_without_a_passing_test_fails_the_run(tmp_path: Path, capsys):
    junit = tmp_path / "junit.xml"
    junit.write_text(JUNIT.replace("RV-X", "RV-POSE-1"))
    with pytest.raises(SystemExit, match="RV-A"):  # not among the requirements
        run(junit)
    assert "NOT VERIFIED" in capsys.readouterr().out


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
