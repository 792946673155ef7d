"""The rules of the documentation's language, page by page.

For one page: `python -m pytest -n 0 -q tests/docs/test_style.py -k ring.md`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
CHANGELOG = ROOT / "CHANGELOG.md"
NOTES = sorted((DOCS / "notes").glob("*.md"))
MAIN_PAGES = sorted(DOCS.glob("*.md"))
PAGES = sorted({*ROOT.glob("*.md"), *DOCS.rglob("*.md")})
MAX_LINE_CHARS = 100
MAX_SENTENCE_WORDS = 35
MAX_PARAGRAPH_NUMBERS = 7
MAX_NOTE_WORDS = 600
MAX_NOTES_WORDS = 8_000  # all notes together
MAX_DOCS_WORDS = 32_000  # main pages and notes together

# The pattern of a word that only this project understands, and the plain word.
PRIVATE_WORDS = {
    r"voters?": "tree, forest",
    r"ballots?": "score",
    r"witness\w*": "second estimator, evidence",
    r"told": "given, known, distinguished",
    r"young(er)?": "new, recent",
    r"(?<!data )(?<!style )sheets?(?! of)": "configuration",
    r"(?:an?|the|one|each|every|its|first|second|last|full|closer|two|three|of|\d+)"
    r" looks?(?! up)(?!-)": "frame, search",
    r"seats?": "worker",
    r"stewards?": "orchestrator",
    r"lifelines?": "heartbeat",
    r"crowd(s|ed)?": "clutter, many spots",
    r"lonely|lone": "single, isolated",
    r"astray": "diverged, wrong",
    r"anew": "again, restarted",
    r"heard": "received",
    r"vouch\w*": "confirmed",
    r"(?<!make )(sure|unsure|surer)": "confident",
    r"rests?(?= (before|when|while|until)\b)": "converges",
    r"begun at": "started at",
    r"bor(e|ne) out": "confirmed",
}
# Words with which a page tells of a version before the present one.
PAST_WORDS = (
    r"the versions? before",
    r"before this version",
    r"(an |the )?earlier versions?",
    r"(it|that|which|they|there|we) used to",
    r"used to be",
    r"previously",
    r"formerly",
    r"no longer(?! than)",
    r"until now",
    r"has been replaced",
)

_MARK = re.compile(r"^\s*(?:[-*+]|\d+[.)])\s+|^:\s+")  # of an item of a list
_END = re.compile(r"[.!?][)\"”*_]*\s+(?=[\"“(*_]*[A-Z0-9Σσ])")  # of a sentence
_UNBREAKABLE = re.compile(r"\S*(?:://|\]\()\S*")
_NUMBER = re.compile(
    r"(?<![\w.])[-−±+~≤≥<>]?\d[\d.,]*(?:[  ]\d{3}\b)*(?:(?: ?× ?| ?… ?|[–:/-])[-−]?\d[\d.,]*)*"
)


@dataclass(frozen=True, slots=True)
class Paragraph:
    """A paragraph or an item of a list; a code span counts as one word."""

    line: int  # the first, from 1
    text: str

    @property
    def sentences(self) -> list[str]:
        return [s for s in _END.split(self.text) if s.strip()]

    @property
    def numbers(self) -> list[str]:
        """Numbers; a range, a size (6 × 6) and a date are one each."""
        return _NUMBER.findall(self.text)


def plain(text: str) -> str:
    """Text as read: a link is its words, a picture its description, a code span one word."""
    text = re.sub(r"(`+)[^`].*?\1", "code", text, flags=re.DOTALL)
    text = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", text)
    return re.sub(r"<!--.*?-->|https?://\S+", "", text, flags=re.DOTALL)


def prose_lines(text: str) -> list[tuple[int, str]]:
    """Numbered lines outside code blocks, front matter and tables; these are left empty."""
    kept: list[tuple[int, str]] = []
    fence = ""
    for number, line in enumerate(text.splitlines(), start=1):
        bare = line.strip()
        if number == 1 and bare == "---":
            fence = "---"
            kept.append((number, ""))
            continue
        mark = re.match(r"`{3,}|~{3,}", bare)
        if fence:
            if bare == fence:
                fence = ""
            kept.append((number, ""))
        elif mark:
            fence = mark[0]
            kept.append((number, ""))
        elif bare.startswith("|") or re.match(r":{3,}|:\w+:", bare):
            kept.append((number, ""))
        else:
            kept.append((number, line))
    return kept


def paragraphs(text: str) -> list[Paragraph]:
    """Paragraphs, items of lists and headings, in order."""
    found: list[Paragraph] = []
    open_: list[str] = []
    start = 0

    def close() -> None:
        if open_:
            found.append(Paragraph(start, plain(" ".join(open_))))
            open_.clear()

    for number, line in prose_lines(text):
        if not line.strip() or _MARK.match(line) or line.startswith("#"):
            close()
        if line.strip():
            if not open_:
                start = number
            open_.append(_MARK.sub("", line).strip("# "))
        if line.startswith("#"):
            close()
    close()
    return found


def long_lines(text: str) -> list[str]:
    """Lines that are too long and could be broken."""
    found = []
    for number, line in prose_lines(text):
        breakable = not (line.lstrip().startswith("![") or _cannot_be_broken(line))
        if len(line) > MAX_LINE_CHARS and breakable:
            found.append(f"line {number}: {len(line)} characters: {line[:60]}…")
    return found


def _cannot_be_broken(line: str) -> bool:
    """A link with nothing before it, and at most a point after it."""
    words = _MARK.sub("", line).split()
    return len(words) == 1 and bool(_UNBREAKABLE.fullmatch(words[0]))


def long_sentences(text: str) -> list[str]:
    found = []
    for paragraph in paragraphs(text):
        for sentence in paragraph.sentences:
            count = sum(bool(re.search(r"\w", word)) for word in sentence.split())
            if count > MAX_SENTENCE_WORDS:
                found.append(f"line {paragraph.line}: {count} words: {sentence[:80]}…")
    return found


def number_heaps(text: str) -> list[str]:
    return [
        f"line {p.line}: {len(p.numbers)} numbers, make a table: {p.text[:80]}…"
        for p in paragraphs(text)
        if len(p.numbers) > MAX_PARAGRAPH_NUMBERS
    ]


def words_found(text: str, patterns: dict[str, str] | tuple[str, ...]) -> list[str]:
    """Where words are that are not to be used; tables are read too, code is not."""
    found = []
    text = re.sub(r"^(`{3,}).*?^\1", lambda m: "\n" * m[0].count("\n"), text, flags=re.M | re.S)
    for pattern in patterns:
        hint = f" (write: {patterns[pattern]})" if isinstance(patterns, dict) else ""
        spaced = pattern.replace(" ", r"\s+") if "(?<" not in pattern else pattern
        for number, line in enumerate(text.splitlines(), start=1):
            for match in re.finditer(rf"\b(?:{spaced})\b", plain(line), re.IGNORECASE):
                found.append(f"line {number}: {match[0]!r}{hint}")
    return found


def name(path: Path) -> str:
    return str(path.relative_to(ROOT))


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_lines_fit_a_screen(page: Path):
    assert long_lines(page.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize("page", [p for p in PAGES if p != CHANGELOG], ids=name)
def test_sentences_are_short(page: Path):
    assert long_sentences(page.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize("page", [p for p in PAGES if p != CHANGELOG], ids=name)
def test_many_numbers_are_a_table(page: Path):
    assert number_heaps(page.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_words_are_those_of_the_field(page: Path):
    assert words_found(page.read_text(encoding="utf-8"), PRIVATE_WORDS) == []


@pytest.mark.parametrize("page", [*MAIN_PAGES, ROOT / "README.md"], ids=name)
def test_main_pages_speak_of_the_present_version(page: Path):
    assert words_found(page.read_text(encoding="utf-8"), PAST_WORDS) == []


@pytest.mark.parametrize("page", NOTES, ids=name)
def test_a_note_is_short(page: Path):
    assert len(page.read_text(encoding="utf-8").split()) <= MAX_NOTE_WORDS


def test_the_documentation_can_be_read():
    notes = sum(len(page.read_text(encoding="utf-8").split()) for page in NOTES)
    pages = sum(len(page.read_text(encoding="utf-8").split()) for page in MAIN_PAGES)
    assert notes <= MAX_NOTES_WORDS
    assert notes + pages <= MAX_DOCS_WORDS


LONG = "Word " * 36

SPOILT = {  # a fault of each kind, and the same without it
    "line": (long_lines, "x " * 51, "x " * 50),
    "line with a link in it": (long_lines, f"see [this]({'a' * 99})", f"- [this]({'a' * 99})"),
    "sentence": (long_sentences, LONG, "Word " * 35),
    "sentence over lines": (long_sentences, LONG.replace(" ", "\n"), LONG[:90] + ". " + LONG[90:]),
    "item": (long_sentences, "- " + LONG, f"- {LONG[:90]}\n- {LONG[90:]}"),
    "after a code block": (long_sentences, f"```\na\n```\n{LONG}", f"```\n{LONG}\n```\na"),
    "after a table": (long_sentences, f"| a |\n\n{LONG}", f"| {LONG} |\n\na"),
    "numbers": (number_heaps, "1, 2, 3, 4, 5, 6, 7 and 8 m", "1, 2, 3, 4, 5, 6 and 7–8 m"),
    "sizes": (number_heaps, "1 2 3 4 5 6 7 a 640 × 480", "2 3 4 5 6 7 a 640 × 480, C99, `8`"),
}  # fmt: skip


@pytest.mark.parametrize("kind", SPOILT)
def test_a_fault_is_found(kind: str):
    find, wrong, right = SPOILT[kind]
    assert len(find(wrong)) == 1
    assert find(right) == []


@pytest.mark.parametrize(("wrong", "right"), [
    ("the voters agree", "the trees agree"),
    ("29 looks outside", "an axis that looks at it, a look-up, a table to look up"),
    ("one of its sheets", "`sheets`, a sheet of frames, a data sheet"),
    ("is not sure", "make sure"),
    ("| told |", "```\ntold\n```\n"),
    ("it rests before it closes", "the rest of the frames"),
])  # fmt: skip
def test_a_private_word_is_found(wrong: str, right: str):
    assert len(words_found(wrong, PRIVATE_WORDS)) == 1
    assert words_found(right, PRIVATE_WORDS) == []


@pytest.mark.parametrize(("wrong", "right"), [
    ("78 % in the version before that", "the row before that"),
    ("it used to fail", "it is used to fit"),
    ("no longer needed", "not needed; no longer than 5 s"),
])  # fmt: skip
def test_a_word_on_the_past_is_found(wrong: str, right: str):
    assert len(words_found(wrong, PAST_WORDS)) == 1
    assert words_found(right, PAST_WORDS) == []
