"""The plain part of YAML that calibration tools write, read without a YAML library.

Mappings and lists, in blocks or in brackets (over several lines too), numbers,
strings, comments, tags (ignored) and document marks. OpenCV's own reader refuses
much of what ROS tools write: block lists that are not indented, ``-.5``, a second
document mark. Anchors and folded text are outside; they are read as strings.
"""

from __future__ import annotations

import re
from typing import Any

_INTEGER = re.compile(r"[-+]?\d+")
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")
_ENTRY = re.compile(r"""("[^"]*"|'[^']*'|[^\s\[\]{}"'#,][^:]*?)\s*:(?:\s+(.*))?""")
_TAG = re.compile(r"^!\S*\s*")
_TOKEN = re.compile(
    r"""\s*([\[\]{},]|:(?=\s)|"[^"]*"|'[^']*'|[^\[\]{},\s](?:[^\[\]{},:]|:(?!\s))*)"""
)
_CONSTANTS = {
    "true": True, "false": False, "null": None, "~": None, "": None,
    ".nan": float("nan"), ".inf": float("inf"), "+.inf": float("inf"), "-.inf": float("-inf"),
}  # fmt: skip

_Line = tuple[int, int, str]  # number from 1, indentation, content


def parse_yaml(text: str) -> Any:
    """The first document of ``text`` as dicts, lists, numbers, strings, booleans, None.

    Raises:
        ValueError: outside the subset; the message gives the line.
    """
    lines = _logical_lines(text)
    if not lines:
        return None
    value, used = _block(lines, 0)
    if used < len(lines):
        raise ValueError(f"line {lines[used][0]}: the indentation fits nothing above it")
    return value


def _logical_lines(text: str) -> list[_Line]:
    """Lines without comments, marks and blanks; what is open in brackets is one line."""
    lines: list[_Line] = []
    depth = 0
    for number, raw in enumerate(text.splitlines(), start=1):
        if depth == 0 and raw.startswith("%"):
            continue
        if depth == 0 and raw.rstrip() in ("---", "..."):
            if lines:
                break
            continue
        line, opened = _without_comment(raw.replace("\t", "    "))
        if not line.strip():
            continue
        if depth > 0:
            first, indent, content = lines[-1]
            lines[-1] = (first, indent, f"{content} {line.strip()}")
        else:
            lines.append((number, len(line) - len(line.lstrip()), line.strip()))
        depth += opened
    if depth > 0:
        raise ValueError(f"line {lines[-1][0]}: a bracket is not closed")
    return lines


def _without_comment(line: str) -> tuple[str, int]:
    """The line up to its comment, and how many more brackets it opens than it closes."""
    quote, depth = "", 0
    for index, char in enumerate(line):
        before = line[index - 1] if index else " "
        if quote:
            quote = "" if char == quote else quote
        elif char in "\"'" and before in " [{,:":
            quote = char
        elif char == "#" and before == " ":
            return line[:index].rstrip(), depth
        else:
            depth += (char in "[{") - (char in "]}")
    return line.rstrip(), depth


def _block(lines: list[_Line], start: int) -> tuple[Any, int]:
    """The mapping, list or scalar whose first line is ``start``, and the line after it."""
    number, indent, content = lines[start]
    if content == "-" or content.startswith("- "):
        return _block_list(lines, start)
    if _ENTRY.fullmatch(content) is None:
        return _inline(content, number), start + 1
    mapping: dict[str, Any] = {}
    index = start
    while index < len(lines) and lines[index][1] == indent:
        number, _, content = lines[index]
        entry = _ENTRY.fullmatch(content)
        if entry is None:
            raise ValueError(f"line {number}: expected 'key: value', not {content[:40]!r}")
        key, rest = entry[1].strip("\"'"), _TAG.sub("", entry[2] or "", count=1)
        if key in mapping:
            raise ValueError(f"line {number}: the key {key!r} is there twice")
        index += 1
        if rest:
            mapping[key] = _inline(rest, number)
            continue
        mapping[key] = None
        if index < len(lines):
            dashed = lines[index][2] == "-" or lines[index][2].startswith("- ")
            if lines[index][1] > indent or (lines[index][1] == indent and dashed):
                mapping[key], index = _block(lines, index)
    return mapping, index


def _block_list(lines: list[_Line], start: int) -> tuple[list[Any], int]:
    indent, index, items = lines[start][1], start, list[Any]()
    while index < len(lines) and lines[index][1] == indent and lines[index][2].startswith("-"):
        number, _, content = lines[index]
        rest = content[1:].strip()
        if rest:
            # '- key: value' opens a mapping whose indentation is that of the key.
            lines[index] = (number, indent + len(content) - len(rest), rest)
            item, index = _block(lines, index)
        elif index + 1 < len(lines) and lines[index + 1][1] > indent:
            item, index = _block(lines, index + 1)
        else:
            item, index = None, index + 1
        items.append(item)
    return items, index


def _inline(text: str, number: int) -> Any:
    """A scalar or a bracketed list or mapping, all on one (logical) line."""
    if text[0] not in "[{":
        return _scalar(text)
    tokens = _TOKEN.findall(text)
    value, used = _flow(tokens, 0, number)
    if used != len(tokens):
        raise ValueError(f"line {number}: {tokens[used]!r} after the closing bracket")
    return value


def _flow(tokens: list[str], index: int, number: int) -> tuple[Any, int]:
    if index >= len(tokens):
        raise ValueError(f"line {number}: a bracket is not closed")
    if tokens[index] not in ("[", "{"):
        return _scalar(tokens[index].strip()), index + 1
    closing = "]" if tokens[index] == "[" else "}"
    items: list[Any] = []
    mapping: dict[str, Any] = {}
    index += 1
    while index < len(tokens) and tokens[index] != closing:
        value, index = _flow(tokens, index, number)
        if closing == "}":
            if tokens[index : index + 1] != [":"]:
                raise ValueError(f"line {number}: expected 'key: value' in the braces")
            mapping[str(value)], index = _flow(tokens, index + 1, number)
        else:
            items.append(value)
        if tokens[index : index + 1] == [","]:
            index += 1
        elif tokens[index : index + 1] != [closing]:
            raise ValueError(f"line {number}: expected ',' or '{closing}' in the brackets")
    if index >= len(tokens):
        raise ValueError(f"line {number}: a bracket is not closed")
    return (items if closing == "]" else mapping), index + 1


def _scalar(text: str) -> Any:
    if len(text) >= 2 and text[0] == text[-1] and text[0] in "\"'":
        return text[1:-1]
    if text.lower() in _CONSTANTS:
        return _CONSTANTS[text.lower()]
    if _INTEGER.fullmatch(text):
        return int(text)
    if _NUMBER.fullmatch(text):
        return float(text)
    return text
