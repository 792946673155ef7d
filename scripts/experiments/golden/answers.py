"""The answers of a run as records that lose no bit, and two such runs compared."""

from __future__ import annotations

import gzip
import hashlib
import json
import time
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from experiments.frame import show, table_of
from rendezview.geometry.pose import Pose
from rendezview.geometry.symmetry import Symmetry, angle_between
from rendezview.io.results import json_line

Record = dict[str, Any]
T = TypeVar("T")

RIGHT_RAD, RIGHT_SHARE = np.deg2rad(5.0), 0.05  # a pose within both is right
_FEWER_RIGHT, _LARGER_ERRORS = 0.99, 1.02  # what `statistics` allows
_TIMES = ("_ms", "_unix_s")  # ends of the keys of a line that no two runs share
_IDS = ("session", "id", "model_sha256", "recorded")
_LISTED = 20  # records that differ


class Answers:
    """Collects the records of a run, and the processor time of each group."""

    def __init__(self) -> None:
        self.records: list[Record] = []
        self._count: Counter[str] = Counter()
        self._ms: dict[str, list[float]] = {}

    def timed(self, group: str, answer: Callable[..., T], *arguments: Any) -> T:
        """Call, and count its processor time for a group."""
        began_s = time.process_time()
        found = answer(*arguments)
        self._ms.setdefault(group, []).append(1e3 * (time.process_time() - began_s))
        return found

    def add(
        self,
        group: str,
        status: str,
        numbers: Mapping[str, npt.ArrayLike | None],
        *,
        line: Any = None,
        errors: tuple[float, float] | None = None,
        right: bool | None = None,
    ) -> None:
        """One answer: its numbers; its line of JSON, as a digest; where known, its errors.

        Args:
            group: of the answer; its index follows.
            status: in words.
            numbers: float64, of any shape; ``None`` is left out.
            line: everything else that is the same in two runs.
            errors: rotation in radians, translation as a share of the range.
            right: whether the answer is right; ``None``: there is no answer.
        """
        kept = {name: of(value) for name, value in numbers.items() if value is not None}
        record: Record = {"group": group, "index": self._count[group], "status": status} | kept
        if line is not None:
            record["line"] = digest(json_line({"line": steady(line)}).encode())
        if errors is not None:
            record |= {"rotation_rad": of(errors[0]), "translation": of(errors[1])}
        if right is not None:
            record["right"] = bool(right)
        self.records.append(record)
        self._count[group] += 1

    def pose(
        self,
        group: str,
        seen: Any,
        truth: Pose | None,
        *,
        middle_m: npt.ArrayLike = (0.0, 0.0, 0.0),
        symmetries: tuple[Symmetry, ...] = (),
        limit_rad: float = RIGHT_RAD,
        line: Any = None,
    ) -> None:
        """An observation with ``status``, ``pose`` and ``covariance``, beside the true pose."""
        errors, right = None, None
        if seen.pose is not None and truth is not None:
            place, there = (pose.apply(np.asarray(middle_m)) for pose in (seen.pose, truth))
            share = float(np.linalg.norm(place - there) / np.linalg.norm(there))
            errors = (angle_between(seen.pose, truth, symmetries), share)
            right = errors[0] < limit_rad and share < RIGHT_SHARE
        elif seen.pose is not None:
            right = False  # there is nothing to see
        numbers = {
            "pose": pose_numbers(seen.pose),
            "covariance": seen.covariance,
            "confidence": getattr(seen, "confidence", None),
        }
        line = seen.record() if line is None and hasattr(seen, "record") else line
        self.add(group, str(seen.status), numbers, line=line, errors=errors, right=right)

    def write(self, path: Path) -> None:
        """All records, then the median time of each group; the same bytes for the same answers."""
        times = [{"group": g, "ms": round(float(np.median(v)), 3)} for g, v in self._ms.items()]
        text = "".join(json.dumps(r, separators=(",", ":")) + "\n" for r in self.records + times)
        path.write_bytes(gzip.compress(text.encode(), 9, mtime=0))


def pose_numbers(pose: Pose | None) -> npt.NDArray[np.float64] | None:
    """(12,) rotation by rows, translation."""
    return None if pose is None else np.append(pose.rotation, pose.translation_m)


def of(value: npt.ArrayLike) -> str:
    """Float64 numbers as hexadecimal digits: 16 a number, most significant first."""
    return np.asarray(value, dtype=">f8").tobytes().hex()


def numbers_of(text: str) -> npt.NDArray[np.float64]:
    """The inverse of `of`, flat."""
    return np.frombuffer(bytes.fromhex(text), dtype=">f8").astype(np.float64)


def digest(content: bytes) -> str:
    """The first 16 digits of SHA-256."""
    return hashlib.sha256(content).hexdigest()[:16]


def steady(line: Any) -> Any:
    """A line without times of computing, times of day, and identifiers."""
    if isinstance(line, Mapping):
        return {k: steady(v) for k, v in line.items() if k not in _IDS and not k.endswith(_TIMES)}
    return [steady(item) for item in line] if isinstance(line, list | tuple) else line


def read(path: Path) -> tuple[dict[tuple[str, int], Record], dict[str, float]]:
    """Records by group and index, and times by group."""
    lines = [json.loads(line) for line in gzip.decompress(path.read_bytes()).splitlines()]
    records = {(r["group"], r["index"]): r for r in lines if "index" in r}
    return records, {r["group"]: r["ms"] for r in lines if "ms" in r}


def same(old: dict[tuple[str, int], Record], new: dict[tuple[str, int], Record]) -> bool:
    """Whether every record is the same bit for bit; the first that differ are printed."""
    keys = [*old, *(key for key in new if key not in old)]
    off = [key for key in keys if old.get(key) != new.get(key)]
    for key in off[:_LISTED]:
        one, other = old.get(key, {}), new.get(key, {})
        parts = []
        for name in sorted(one.keys() | other.keys()):
            a, b = one.get(name), other.get(name)
            if a == b:
                continue
            if name in ("status", "line", "right", "sha256") or a is None or b is None:
                parts.append(f"{name} {_short(name, a)} → {_short(name, b)}")
                continue
            u, v = numbers_of(a), numbers_of(b)
            if len(u) != len(v):
                parts.append(f"{name} {len(u)} → {len(v)} numbers")
                continue
            k = int(np.argmax(np.abs(u - v)))
            parts.append(f"{name}[{k}] {float(u[k])!r} → {float(v[k])!r}")
        print(f"{key[0]} {key[1]}: {'; '.join(parts)}")
    count = Counter(key[0] for key in off)
    for group, number in count.items():
        print(f"{group}: {number} of {sum(key[0] == group for key in keys)} records differ")
    print(f"{len(keys)} records, {len(off)} differ")
    return not off


def _short(name: str, value: Any) -> str:
    if value is None:
        return "none"
    known = name in ("status", "line", "right", "sha256")
    return str(value) if known else f"{len(numbers_of(value))} numbers"


def no_worse(
    old: dict[tuple[str, int], Record], new: dict[tuple[str, int], Record],
    old_ms: dict[str, float], new_ms: dict[str, float],
) -> bool:  # fmt: skip
    """Whether no group has become worse; prints a table of all groups, old / new.

    Worse: more than 1 % fewer right answers, more wrong ones, or a median error that is more than
    2 % larger. Groups without truth or without a counterpart are shown and not judged.
    """
    columns = "group | records | given | right | wrong | rotation, ° | translation, % | ms | worse"
    rows, fine = table_of("old / new", columns), True
    for group in dict.fromkeys(key[0] for key in [*old, *new]):
        a, b = _figures(old, group), _figures(new, group)
        worse = []
        if a["records"] and b["records"]:
            if b["right"] < _FEWER_RIGHT * a["right"]:
                worse.append("right")
            if b["wrong"] > a["wrong"]:
                worse.append("wrong")
            pairs = (("rotation", b["rotation"], a["rotation"]), ("translation", b["translation"],
                                                                  a["translation"]))  # fmt: skip
            worse += [name for name, now, was in pairs if now > _LARGER_ERRORS * was]
        fine = fine and not worse
        cells = [f"{a[n]} / {b[n]}" for n in ("records", "given", "right", "wrong")]
        cells += [f"{a[n]:.4f} / {b[n]:.4f}" for n in ("rotation", "translation")]
        times = [f"{ms[group]:.2f}" if group in ms else "–" for ms in (old_ms, new_ms)]
        rows.add_row(group, *cells, " / ".join(times), ", ".join(worse))
    show(rows, width=150)
    return fine


def _figures(records: dict[tuple[str, int], Record], group: str) -> dict[str, Any]:
    """Counts, and medians of the errors of the right answers; NaN where none has any."""
    own = [r for r in records.values() if r["group"] == group]
    right = [r for r in own if r.get("right")]
    known = [r for r in right if "rotation_rad" in r]
    turn, move = (
        float(np.median([numbers_of(r[n])[0] for r in known])) if known else np.nan
        for n in ("rotation_rad", "translation")
    )
    return {
        "records": len(own), "given": sum("right" in r for r in own), "right": len(right),
        "wrong": sum(r.get("right") is False for r in own), "rotation": np.rad2deg(turn),
        "translation": 100.0 * move,
    }  # fmt: skip
