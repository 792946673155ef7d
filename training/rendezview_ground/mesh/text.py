"""Text of mesh files, as programs of all countries write it."""

from __future__ import annotations

import codecs
import re

_MARKS = (
    (codecs.BOM_UTF8, "utf-8"),
    (codecs.BOM_UTF16_LE, "utf-16-le"),
    (codecs.BOM_UTF16_BE, "utf-16-be"),
)
_DECIMAL_COMMA = re.compile(r"(?<=\d),(?=\d)")
COMMA_NOTE = "Decimal commas read as points."


def decoded(data: bytes) -> str:
    """The text after its byte order mark; without one UTF-8, else Latin-1."""
    for mark, encoding in _MARKS:
        if data.startswith(mark):
            return data[len(mark) :].decode(encoding, errors="replace")
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def is_text(data: bytes) -> bool:
    """Whether the start of a file is text: a byte order mark, or no zero byte."""
    return any(data.startswith(mark) for mark, _ in _MARKS) or b"\0" not in data


def with_points(text: str, key: str) -> tuple[str, bool]:
    """Decimal commas of the lines of a key as points, and whether there were any."""
    if "," not in text:
        return text, False
    line = re.compile(rf"^[ \t]*{key}[ \t].*$", re.MULTILINE | re.IGNORECASE)
    changed = line.sub(lambda found: _DECIMAL_COMMA.sub(".", found[0]), text)
    return changed, changed != text
