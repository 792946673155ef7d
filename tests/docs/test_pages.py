"""The pages of docs/: their length, their place on the site, and the commands that they print."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path
from typing import Any

import pytest
import typer

import rendezview
from rendezview.cli.main import make_app

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PAGES = sorted(DOCS.glob("*.md"))
MOST_WORDS = 1200
_BLOCK = re.compile(r"^```.*?^```$", re.DOTALL | re.MULTILINE)
_COMMAND = re.compile(r"^rendezview ([a-z]+)( .*)$", re.MULTILINE)


def words(text: str) -> int:
    """Words of a page without its code blocks, links' targets and plain numbers."""
    text = re.sub(r"\]\([^)]*\)", "]", _BLOCK.sub("", text))
    return sum(bool(re.search(r"[^\W\d_]", word)) for word in text.split())


def test_no_page_is_longer_than_a_sitting():
    assert words("One `two` 3 | [four](five six)\n```\nseven\n```\n") == 3
    long = {p.name: n for p in PAGES if (n := words(p.read_text(encoding="utf-8"))) > MOST_WORDS}
    assert long == {}


def test_the_sidebar_has_every_page_but_the_notes():
    index = (DOCS / "index.md").read_text(encoding="utf-8")
    listed = set(re.findall(r"^[\w/-]+$", "\n".join(_BLOCK.findall(index)), re.MULTILINE))
    there = {
        str(path.relative_to(DOCS).with_suffix(""))
        for pattern in ("*.md", "*.ipynb")
        for path in DOCS.glob(pattern)
    }
    assert listed == there - {"index"}


def test_every_note_is_linked():
    text = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    notes = {f"notes/{path.name}" for path in DOCS.glob("notes/*.md")}
    assert {note for note in notes if f"({note}" not in text} == set()


def test_the_reference_has_every_public_name():
    text = "".join((DOCS / f"{p}.md").read_text() for p in ("api", "api-sensors", "api-ground"))
    named = re.findall(r"auto\w+:: rendezview\.(\w+)", text)
    assert sorted(named) == sorted(rendezview.__all__)


def test_the_notebook_is_kept_without_results():
    cells = json.loads((DOCS / "notebook.ipynb").read_text(encoding="utf-8"))["cells"]
    assert all(not cell.get("outputs") for cell in cells)
    assert len({cell["id"] for cell in cells}) == len(cells)


def test_every_picture_of_the_tutorial_is_there_and_has_words():
    for words_, place in re.findall(
        r"!\[([^\]]*)\]\(([^)]+)\)", (DOCS / "tutorial.md").read_text(encoding="utf-8")
    ):
        assert (DOCS / place).is_file()
        assert len(words_) > 20


def _commands(page: Path) -> list[tuple[str, str]]:
    text = page.read_text(encoding="utf-8").replace("\\\n", " ")
    return [match for block in _BLOCK.findall(text) for match in _COMMAND.findall(block)]


@pytest.mark.parametrize(
    "page", [p for p in (ROOT / "README.md", *PAGES) if _commands(p)], ids=lambda page: page.name
)
def test_printed_commands_have_options_that_exist(page: Path):
    commands = _commands(page)
    if page.name == "tutorial.md":
        assert len(commands) >= 7
    for name, rest in commands:
        command: Any = typer.main.get_command(make_app(name))
        parts = [name, *shlex.split(rest, comments=True)]
        while hasattr(command, "commands"):  # `ring` has a command without a name
            command = command.commands.get(parts.pop(0)) or command.commands["find"]
        known = {option for p in command.params for option in (*p.opts, *p.secondary_opts)}
        used = {part for part in parts if re.fullmatch(r"--?[a-z][a-z-]*", part)}
        assert used <= known, f"{page.name}: {name} {rest}"
