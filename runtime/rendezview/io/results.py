"""Results files: BOP's CSV, and JSON lines with everything.

CSV: ``scene_id,im_id,obj_id,score,R,t,time``; R row-wise, t in mm, both separated by
spaces; time in seconds, -1 where it is not known.
"""

from __future__ import annotations

import contextlib
import csv
import dataclasses
import json
import math
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, BinaryIO, Self

import numpy as np

from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Pose, nearest_rotation
from rendezview.io.file_lock import give_name, opened_alone
from rendezview.io.files import StrPath, atomic_write_text, parse_json, read_text, write_error

HEADER = ("scene_id", "im_id", "obj_id", "score", "R", "t", "time")


@dataclasses.dataclass(frozen=True, slots=True)
class ResultRow:
    """One estimated pose.

    Raises:
        ValueError: a score or time is not finite, or a time negative.
    """

    scene_id: int
    im_id: int
    obj_id: int
    score: float  # higher is more confident
    camera_from_target: Pose
    time_s: float | None = None  # computing time of the image; None: not measured

    def __post_init__(self) -> None:
        if not math.isfinite(self.score):
            raise ValueError(f"score must be finite, not {self.score}")
        if self.time_s is not None and not 0.0 <= self.time_s < math.inf:
            raise ValueError(f"time_s must be finite and not negative, or None: {self.time_s}")


def write_results(path: StrPath, rows: Iterable[ResultRow]) -> None:
    """Write a BOP results CSV, atomically, with numbers in full precision.

    Raises:
        RendezviewError: it cannot be written.
    """
    lines = [",".join(HEADER)]
    for row in rows:
        pose = row.camera_from_target
        cells = (
            str(int(row.scene_id)),
            str(int(row.im_id)),
            str(int(row.obj_id)),
            repr(float(row.score)),
            " ".join(map(repr, pose.rotation.ravel().tolist())),
            " ".join(map(repr, (pose.translation_m * 1000.0).tolist())),
            "-1" if row.time_s is None else repr(float(row.time_s)),
        )
        lines.append(",".join(cells))
    atomic_write_text(path, "\n".join(lines) + "\n")


def partial(path: Path) -> Path:
    """Where a file is until it is complete."""
    return path.with_name(f"{path.name}.partial")


def read_results(path: StrPath) -> list[ResultRow]:
    """Read a BOP results CSV, of this package or another.

    Rotations rounded to a few digits are replaced by the nearest rotation.

    Raises:
        RendezviewError: missing, another header, or a wrong row (its line is named).
    """
    reader = csv.reader(read_text(path, "BOP results (CSV)").splitlines())
    rows: list[ResultRow] = []
    try:
        first = next(reader, [])
        header = tuple(cell.strip() for cell in first)
        if len(first) == len(HEADER) and all(cell.isdigit() for cell in header[:3]):
            rows.append(_row(first))  # BOP's files have a header, some peers' have none
        elif header != HEADER:
            raise RendezviewError(
                f"{path}: line 1: the header must be {','.join(HEADER)}, not "
                f"{','.join(header)[:80]!r}: these are not BOP results"
            )
        for cells in reader:
            if cells:
                rows.append(_row(cells))
    except (ValueError, csv.Error) as error:
        raise RendezviewError(
            f"{path}: line {reader.line_num}: {error}: correct or remove the line"
        ) from error
    return rows


def _row(cells: list[str]) -> ResultRow:
    if len(cells) != len(HEADER):
        raise ValueError(f"{len(cells)} values, expected {len(HEADER)}")
    named = dict(zip(HEADER, cells, strict=True))
    whole = []
    for name in HEADER[:3]:
        try:
            whole.append(int(named[name]))
        except ValueError:
            raise ValueError(f"{name}: {named[name]!r} is not a whole number") from None
    rotation, translation_mm = _numbers(named, "R", 9), _numbers(named, "t", 3)
    score, time_s = _numbers(named, "score", 1)[0], _numbers(named, "time", 1)[0]
    try:
        nearest = nearest_rotation(np.reshape(rotation, (3, 3)))
    except ValueError as error:
        raise ValueError(f"R: {error}") from error
    pose = Pose(nearest, np.asarray(translation_mm) / 1000.0)
    scene_id, im_id, obj_id = whole
    return ResultRow(scene_id, im_id, obj_id, score, pose, None if time_s < 0.0 else time_s)


def _numbers(named: dict[str, str], name: str, count: int) -> list[float]:
    words = named[name].split()
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        raise ValueError(
            f"{name}: {named[name][:60]!r} has something that is not a number"
        ) from None
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise ValueError(f"{name}: needs {count} finite numbers, has {named[name][:60]!r}")
    return numbers


class JsonLinesWriter:
    """Writes JSON lines, one mapping per line, flushed after each.

    Lines go to ``<path>.partial``, which `close` renames to ``path``. After an exception or a
    kill, the partial file stays with every line so far, and ``path`` does not change. A later
    writer of the same ``path`` starts the partial file again.

    Arrays become lists; a `Pose` ``{"quat_wxyz": [...], "translation_m": [...]}``; paths
    text; dataclasses mappings; NaN and infinity, which JSON lacks, null.

    Raises:
        RendezviewError: the file cannot be written.
    """

    def __init__(self, path: StrPath) -> None:
        self.path = Path(path)
        self.partial_path = partial(self.path)
        if self.path.exists() and not self.path.is_file():
            raise RendezviewError(f"{self.path}: is no regular file: give the name of a file")
        try:
            self._file: BinaryIO = opened_alone(self.partial_path, self.path)
        except OSError as error:
            raise write_error(self.path, error) from error
        self._written = False

    def write(self, record: Mapping[str, Any]) -> None:
        """Append one line.

        Raises:
            RendezviewError: disk full …
            ValueError: already closed.
            TypeError: a value has no JSON form.
        """
        if self._file.closed:
            raise ValueError(f"{self.path}: this writer is closed")
        line = json_line(record)
        try:
            self._file.write(line.encode("utf-8") + b"\n")
            self._file.flush()
            self._written = True
        except OSError as error:
            raise write_error(self.path, error) from error

    def close(self) -> None:
        """Give the file its name. Closing again does nothing."""
        if self._file.closed:
            return
        try:
            self._file.flush()
            os.fsync(self._file.fileno())
            give_name(self._file, self.partial_path, self.path)
        except OSError as error:
            with contextlib.suppress(OSError):
                self._file.close()
            raise write_error(self.path, error) from error

    def keep(self, ended: bool = True) -> None:
        """`close` if a line was written, else leave no file.

        Work that has not ``ended`` keeps its partial name.
        """
        if self._written and ended:
            self.close()
            return
        with contextlib.suppress(OSError):
            self._file.close()
        if not self._written:
            self.partial_path.unlink(missing_ok=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if kind is None:
            self.close()
            return
        with contextlib.suppress(OSError):  # the current exception is more informative
            self._file.close()


def read_json_lines(path: StrPath) -> list[dict[str, Any]]:
    """The mappings of a JSON-lines file; blank lines are skipped.

    Raises:
        RendezviewError: missing, or a line (named) is not a JSON object.
    """
    records = []
    # Not splitlines(): it breaks at characters that JSON strings may hold, such as U+2028.
    for number, line in enumerate(read_text(path, "JSON lines").split("\n"), start=1):
        if not line.strip():
            continue
        where = f"{path}: line {number}"
        record = parse_json(line, where)
        if not isinstance(record, dict):
            raise RendezviewError(f"{where}: not a JSON object: correct or remove the line")
        records.append(record)
    return records


def json_line(record: Mapping[str, Any]) -> str:
    """A record as one line of JSON: arrays as lists, poses as quaternion and translation.

    Raises:
        TypeError: a value has no JSON form.
    """
    return json.dumps(json_value(record), allow_nan=False)


def json_value(value: Any) -> Any:
    """The value in the types that JSON has; NaN and infinity become None."""
    if isinstance(value, Pose):
        return value.as_dict()
    if isinstance(value, np.ndarray | np.generic):
        return json_value(value.tolist())
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, Mapping):
        return {str(key): json_value(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [json_value(item) for item in value]
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: json_value(getattr(value, f.name)) for f in dataclasses.fields(value)}
    raise TypeError(f"{type(value).__name__} has no JSON form: {value!r}")
