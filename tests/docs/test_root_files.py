"""The files at the root that other programs read: the hooks, the citation, the change log."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[2]
HEADINGS = {"Added", "Changed", "Deprecated", "Removed", "Fixed", "Security"}


def read(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def version() -> str:
    return str(tomllib.loads(read("pyproject.toml"))["project"]["version"])


def test_hooks_run_what_make_lint_runs():
    rule = re.search(r"^lint:.*\n((?:\t.*\n)+)", read("Makefile"), re.MULTILINE)
    assert rule is not None
    commands = [line.strip().replace("$(BIN)", ".venv/bin") for line in rule[1].splitlines()]
    (repo,) = yaml.safe_load(read(".pre-commit-config.yaml"))["repos"]
    assert [hook["entry"] for hook in repo["hooks"]] == commands
    assert not any(hook["pass_filenames"] for hook in repo["hooks"])


def test_the_citation_is_of_this_version():
    citation = yaml.safe_load(read("CITATION.cff"))
    assert citation["cff-version"] == "1.2.0"
    assert citation["version"] == version()
    assert citation["license"] == tomllib.loads(read("pyproject.toml"))["project"]["license"]


def test_the_change_log_has_this_version_with_its_date():
    releases = re.findall(r"^## (.*)$", read("CHANGELOG.md"), re.MULTILINE)
    assert releases[0] == "[Unreleased]"
    assert re.fullmatch(rf"\[{re.escape(version())}\] - \d{{4}}-\d\d-\d\d", releases[1])
    assert all(re.fullmatch(r"\[[\d.]+\] - \d{4}-\d\d-\d\d", name) for name in releases[1:])


def test_the_change_log_is_a_list_of_single_lines():
    text = read("CHANGELOG.md")
    assert set(re.findall(r"^### (.*)$", text, re.MULTILINE)) <= HEADINGS
    for item in re.findall(r"^- .*(?:\n  .*)*", text, re.MULTILINE):
        assert len(item.split()) <= 40, item


@pytest.mark.parametrize("name", ["CONTRIBUTING.md", "SECURITY.md", "README.md"])
def test_links_between_files_lead_somewhere(name: str):
    places = re.findall(r"\]\(([^):#]+)(?:#[^)]*)?\)", read(name))
    assert [place for place in places if not (ROOT / place).exists()] == []
