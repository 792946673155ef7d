"""Reading and writing whole files, with clear errors and no half-written files.

Every writer of this package uses :func:`atomic_write`: it writes to a temporary name beside
the destination and renames the file when it is complete.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import secrets
import stat
import tomllib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

from pydantic import TypeAdapter, ValidationError

from rendezview.errors import RendezviewError, explained

StrPath = str | os.PathLike[str]
Checked = TypeVar("Checked")


def write_error(path: Path, error: OSError) -> RendezviewError:
    """The error to raise when writing ``path`` failed with ``error``."""
    reason = error.strerror or str(error)
    if isinstance(error, FileNotFoundError) and not path.parent.is_dir():
        return RendezviewError(
            f"{path}: cannot be written, its folder {path.parent} does not exist: create it first"
        )
    return RendezviewError(
        f"{path}: cannot be written ({reason}): check the free space and your permissions there, "
        f"or choose another place"
    )


@contextlib.contextmanager
def atomic_write(path: StrPath, *, durable: bool = True) -> Iterator[BinaryIO]:
    """A binary file object; its content appears at ``path`` only when all of it is written.

    The content goes to a temporary name in the same folder and replaces ``path``
    on success. On any exception (Ctrl-C too) the temporary file is removed and ``path`` does not
    change. A symbolic link is followed. An existing file that is not regular (``/dev/stdout``, a
    named pipe) is written directly.

    Args:
        path: the destination.
        durable: force the content to the disk before the rename. Use False if another file,
            written last, marks this one as complete.

    Raises:
        RendezviewError: the folder is missing, the disk full, permission denied …
    """
    given = Path(path)
    destination = Path(os.path.realpath(given))
    try:
        special = not stat.S_ISREG(os.stat(destination).st_mode)
    except OSError:
        special = False
    if destination.is_dir():
        raise RendezviewError(f"{given}: is a folder: give the name of a file to write")
    if special:
        temporary, flags = destination, os.O_WRONLY
    else:
        # The name is cut, so that a long destination name leaves room.
        temporary = destination.with_name(f".{destination.name[:40]}.{secrets.token_hex(6)}.tmp")
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL
    done = False
    try:
        with open(temporary, "wb", opener=lambda name, _: os.open(name, flags, 0o666)) as file:
            yield file
            file.flush()
            if durable and not special:
                os.fsync(file.fileno())
        if not special:
            os.replace(temporary, destination)
        done = True
    except OSError as error:
        # An error of another file, opened in the caller's block, is not explained here.
        if error.filename is not None and os.fspath(error.filename) != str(temporary):
            raise
        raise write_error(given, error) from error
    finally:
        if not done and not special:
            with contextlib.suppress(OSError):
                temporary.unlink()


def atomic_write_text(path: StrPath, text: str, *, durable: bool = True) -> None:
    """Write ``text`` as UTF-8, all or nothing; arguments and errors as in `atomic_write`."""
    with atomic_write(path, durable=durable) as file:
        file.write(text.encode("utf-8"))


def check_place(path: StrPath | None, what: str) -> None:
    """Refuse a file name (None: no file) that cannot be written later, when ``what`` is ready.

    Raises:
        RendezviewError: it is a folder, or its folder does not exist.
    """
    if path is not None and (Path(path).is_dir() or not Path(path).parent.is_dir()):
        raise RendezviewError(f"{path}: give a file name in an existing folder for {what}")


def make_folder(path: StrPath) -> None:
    """Create a folder and its parents if they do not exist.

    Raises:
        RendezviewError: a file has that name, or permission is denied.
    """
    try:
        Path(path).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RendezviewError(
            f"{path}: this folder cannot be created ({error.strerror}): choose another place"
        ) from error


def check_regular(path: StrPath, what: str) -> None:
    """Refuse a device or a named pipe, where ``what`` is expected: reading may never end.

    Pipes of a shell (``/dev/stdin``, ``<(…)``) are read.

    Raises:
        RendezviewError: it is one.
    """
    file = Path(os.path.realpath(path))
    if file.is_fifo() or file.is_char_device() or file.is_block_device() or file.is_socket():
        raise RendezviewError(f"{path}: is no regular file; expected {what}: name a file")


def read_bytes(path: StrPath, what: str, *, limit_bytes: int | None = None) -> bytes:
    """The content of a file that is ``what`` (for the message: ``"a camera file"``).

    Raises:
        RendezviewError: missing, unreadable, no file, or longer than ``limit_bytes``.
    """
    check_regular(path, what)
    try:
        with open(path, "rb") as file:
            content = file.read() if limit_bytes is None else file.read(limit_bytes + 1)
    except FileNotFoundError as error:
        raise RendezviewError(f"{path}: no such file; expected {what}: check the path") from error
    except IsADirectoryError as error:
        raise RendezviewError(f"{path}: is a folder; expected {what}: name the file") from error
    except OSError as error:
        raise RendezviewError(
            f"{path}: cannot be read ({error.strerror}); expected {what}: check its permissions"
        ) from error
    if limit_bytes is not None and len(content) > limit_bytes:
        raise RendezviewError(
            f"{path}: longer than {limit_bytes} bytes, so not {what}: name another file"
        )
    return content


def read_text(path: StrPath, what: str, *, limit_bytes: int | None = None) -> str:
    """Like `read_bytes`, decoded as UTF-8 (a leading byte order mark is dropped)."""
    try:
        return read_bytes(path, what, limit_bytes=limit_bytes).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise RendezviewError(
            f"{path}: not text in UTF-8 (byte {error.start}); expected {what}: name another file"
        ) from error


def read_toml(path: StrPath, what: str) -> dict[str, Any]:
    """The content of a TOML file.

    Raises:
        RendezviewError: as `read_text`, or not TOML.
    """
    faults = (ValueError, RecursionError)  # a ValueError, too: a number of over 4300 digits
    with explained(f"{path}: not valid TOML (", "): correct the file", faults):
        return tomllib.loads(read_text(path, f"{what} (TOML)"))


def _refused(constant: str) -> Any:
    raise ValueError(f"{constant} is not a JSON number")


def _float(text: str) -> float:
    value = float(text)
    if math.isinf(value):
        raise ValueError(f"a number of {len(text)} characters, {text[:20]}, is too large")
    return value


def _int(text: str) -> int:
    _float(text)
    return int(text)


def _with_single_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        twice = next(key for key, n in Counter(key for key, _ in pairs).items() if n > 1)
        raise ValueError(f"the key {twice!r} is there twice")
    return found


def parse_json(text: str | bytes, where: str) -> Any:
    """A JSON document; ``where`` (path, line) starts the message of an error.

    Raises:
        RendezviewError: bad JSON, a key twice in an object, the numbers NaN and Infinity, which
            JSON does not have, or one that no float holds.
    """
    try:
        return json.loads(
            text, parse_constant=_refused, parse_float=_float, parse_int=_int,
            object_pairs_hook=_with_single_keys,
        )  # fmt: skip
    except json.JSONDecodeError as error:
        raise RendezviewError(
            f"{where}: not valid JSON ({error.msg} at line {error.lineno}, column {error.colno}): "
            f"correct or replace the file"
        ) from error
    except (ValueError, RecursionError) as error:
        raise RendezviewError(
            f"{where}: not valid JSON ({error}): correct or replace the file"
        ) from error


def read_json(path: StrPath, what: str) -> Any:
    """The content of a JSON file; errors of `read_text` and `parse_json`."""
    return parse_json(read_text(path, what), str(path))


_EXACT = 2.0**53  # below, a float that is whole is an integer. Source: of 64 bits


def _whole(data: Any) -> Any:
    """Content of a file with floats that are whole numbers as integers."""
    if isinstance(data, float) and data.is_integer() and abs(data) < _EXACT:
        return int(data)
    if isinstance(data, list | tuple):
        return [_whole(one) for one in data]
    if isinstance(data, dict):
        return {key: _whole(one) for key, one in data.items()}
    return data


def checked(adapter: TypeAdapter[Checked], data: Any, where: str) -> Checked:
    """``data`` as the type of a pydantic adapter; ``where`` starts the message.

    A number is a number: none is read from a string, true or false. 3.0 is a whole one, as in JSON
    Schema.

    Raises:
        RendezviewError: names the first wrong keys (at most three) and the fault of each.
    """
    try:  # as JSON, where a list can be a tuple and a string a path, in strict mode, too
        return adapter.validate_json(json.dumps(_whole(data), default=str), strict=True)
    except ValidationError as error:
        raise RendezviewError(f"{where}: {describe(error)}") from error


def describe(error: ValidationError) -> str:
    """The first three faults of a pydantic error in one line, each with its dotted key."""
    faults = []
    for fault in error.errors(include_url=False, include_context=False)[:3]:
        key = ".".join(str(part) for part in fault["loc"]) or "the file"
        if fault["type"] == "extra_forbidden":
            faults.append(f"{key}: unknown key, remove it or correct its spelling")
        elif fault["type"] == "missing":
            faults.append(f"{key}: missing, add it")
        else:
            message = fault["msg"].removeprefix("Value error, ")
            faults.append(f"{key}: {message[:1].lower()}{message[1:]}")
    more = error.error_count() - len(faults)
    return "; ".join(faults) + (f"; and {more} more" if more > 0 else "")
