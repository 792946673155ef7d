"""The answers of a run as records that lose no bit, and two such runs compared."""

from __future__ import annotations

import gzip
import hashlib
import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from experiments.frame import show, table_of
from rendezview import Pose, Target, TrainingOptions, ViewModel, load_mesh
from rendezview.export.c_code import write_c
from rendezview.geometry.symmetry import Symmetry, angle_between
from rendezview.io.results import json_line
from rendezview.sensors.appearance.model.container import read_container
from rendezview_ground.learn.target_job import train_target
from rendezview_ground.mesh.mesh import Mesh

Record = dict[str, Any]
Run = dict[tuple[str, int], Record]  # by group and index

RIGHT_RAD, RIGHT_SHARE = float(np.deg2rad(5.0)), 0.05  # an answer within both is right
_FEWER_RIGHT, _LARGER_ERRORS = 0.99, 1.02  # what `no_worse` allows
_TIMES, _IDS = ("_ms", "_unix_s"), ("session", "id", "model_sha256", "recorded")  # of lines
_WORDS = ("group", "index", "status", "line", "right")  # of records; all others are numbers
_LISTED = 20  # records that differ


class Answers:
    """Collects the records of a run."""

    def __init__(self) -> None:
        self.records: list[Record] = []
        self._count: Counter[str] = Counter()

    def add(
        self, group: str, status: str, *, line: Any = None, right: bool | None = None,
        errors: tuple[float, float] | None = None, limits: tuple[float, float] | None = None,
        **numbers: npt.ArrayLike | None,
    ) -> None:  # fmt: skip
        """One answer: its numbers, and a digest of everything else.

        Args:
            group: of the answer, with its index.
            status: in words.
            line: anything with a JSON form that is the same in two runs, apart from times.
            right: of an answer without errors; ``None``: none is given.
            errors: rotation in radians and translation as a share of the range, of an answer given.
            limits: below both it is right; the usual ones where left out.
            numbers: float64 of any shape.
        """
        if not self._count[group]:
            print(f"{len(self.records)} records, now {group}", flush=True)
        record: Record = {"group": group, "index": self._count[group], "status": status}
        if line is not None:
            content = json_line({"line": steady(line)}).encode()
            record["line"] = hashlib.sha256(content).hexdigest()[:16]
        if errors is not None:
            numbers |= {"rotation": errors[0], "translation": errors[1]}
            right = all(np.array(errors) < (limits or (RIGHT_RAD, RIGHT_SHARE)))
        if right is not None:
            record["right"] = bool(right)
        # 16 hexadecimal digits a number, most significant first.
        given = {name: value for name, value in numbers.items() if value is not None}
        record |= {n: np.asarray(v, dtype=">f8").tobytes().hex() for n, v in given.items()}
        self.records.append(record)
        self._count[group] += 1

    def pose(
        self, group: str, status: object, pose: Pose | None, truth: Pose | None, *,
        middle_m: npt.ArrayLike = (0.0, 0.0, 0.0), symmetries: tuple[Symmetry, ...] = (),
        **more: Any,
    ) -> None:  # fmt: skip
        """A pose, judged by its attitude and the place of a point of the target.

        ``truth``: ``None`` where there is no target, and any pose is wrong.
        """
        errors = None
        if pose is not None and truth is not None:
            place, there = pose.apply(middle_m), truth.apply(middle_m)
            share = float(np.linalg.norm(place - there) / np.linalg.norm(there))
            errors = (angle_between(pose, truth, symmetries), share)
        whole = None if pose is None else np.append(pose.rotation, pose.translation_m)
        right = None if pose is None else False
        self.add(group, str(status), errors=errors, right=right, pose=whole, **more)

    def seen(self, group: str, seen: Any, truth: Pose | None, **more: Any) -> None:
        """An observation that has a pose, beside the true one."""
        self.pose(group, seen.status, seen.pose, truth, line=seen.record(), **more,
                  covariance=seen.covariance, confidence=seen.confidence)  # fmt: skip

    def write(self, path: Path) -> None:
        """All records; same answers give the same bytes."""
        text = "".join(json.dumps(r, separators=(",", ":")) + "\n" for r in self.records)
        path.write_bytes(gzip.compress(text.encode(), 9, mtime=0))


def steady(line: Any) -> Any:
    """A line without times of computing, times of day, and identifiers."""
    if isinstance(line, Mapping):
        return {k: steady(v) for k, v in line.items() if k not in _IDS and not k.endswith(_TIMES)}
    return [steady(item) for item in line] if isinstance(line, list | tuple) else line


def read(path: Path) -> Run:
    """The records of a file."""
    lines = [json.loads(line) for line in gzip.decompress(path.read_bytes()).splitlines()]
    return {(r["group"], r["index"]): r for r in lines}


def numbers_of(text: str) -> npt.NDArray[np.float64]:
    """The numbers of a record, flat."""
    return np.frombuffer(bytes.fromhex(text), dtype=">f8").astype(np.float64)


def same(old: Run, new: Run) -> bool:
    """Whether every record is the same bit for bit; the first that differ are printed."""
    keys = list(dict.fromkeys([*old, *new]))
    off = [key for key in keys if old.get(key) != new.get(key)]
    for group, index in off[:_LISTED]:
        one, other = old.get((group, index), {}), new.get((group, index), {})
        names = [n for n in dict.fromkeys([*one, *other]) if one.get(n) != other.get(n)]
        print(f"{group} {index}: {'; '.join(_change(n, one.get(n), other.get(n)) for n in names)}")
    for group, number in Counter(key[0] for key in off).items():
        print(f"{group}: {number} of {sum(key[0] == group for key in keys)} records differ")
    print(f"{len(keys)} records, {len(off)} differ")
    return not off


def _change(name: str, old: Any, new: Any) -> str:
    """The first number that differs, or words."""
    if name in _WORDS or old is None or new is None or len(old) != len(new):
        return f"{name} {old} → {new}" if name in _WORDS else f"{name} of another size"
    was, now = numbers_of(old), numbers_of(new)
    k = int(np.flatnonzero(was.view(np.int64) != now.view(np.int64))[0])
    return f"{name}[{k}] {float(was[k])!r} → {float(now[k])!r}"


def no_worse(old: Run, new: Run) -> bool:
    """Whether no group has become worse; prints a table of all groups, old / new.

    Worse: more than 1 % fewer right answers, more wrong ones, or a median error of the right
    answers that is more than 2 % larger. A group that one run lacks is shown and not judged.
    """
    columns = "group | records | given | right | wrong | rotation, ° | translation, % | worse"
    rows, fine = table_of("old / new", columns), True
    for group in dict.fromkeys(key[0] for key in [*old, *new]):
        was, now = _figures(old, group), _figures(new, group)
        worse = {
            "right": now[2] < _FEWER_RIGHT * was[2], "wrong": now[3] > was[3],
            "rotation": now[4] > _LARGER_ERRORS * was[4],
            "translation": now[5] > _LARGER_ERRORS * was[5],
        }  # fmt: skip
        found = [name for name, is_so in worse.items() if is_so and was[0] and now[0]]
        cells = [f"{a:.4g} / {b:.4g}" for a, b in zip(was, now, strict=True)]
        rows.add_row(group, *cells, ", ".join(found))
        fine = fine and not found
    show(rows, width=150)
    return fine


def _figures(run: Run, group: str) -> tuple[int, int, int, int, float, float]:
    """Records, answers, right, wrong; median errors of the right ones, ° and %."""
    own = [r for r in run.values() if r["group"] == group]
    right, wrong = ([r for r in own if r.get("right") is kind] for kind in (True, False))
    errors = [
        float(np.median([numbers_of(r[n])[0] for r in right if n in r] or [np.nan]))
        for n in ("rotation", "translation")
    ]
    answers = len(right) + len(wrong)
    return len(own), answers, len(right), len(wrong), np.rad2deg(errors[0]), 100.0 * errors[1]


QUICK = TrainingOptions(
    order=2, bins=120, smooth_bins=3, resolution_px=160, perturbed_views=1500, held_out_views=100,
    contour_radii=(1.0, 2.0), contour_resolution_px=256, surface_points=2048,
)  # fmt: skip
SMALLEST = replace(QUICK, order=1, perturbed_views=400)  # of each angle of a target with joints
_STEP_RAD = float(np.deg2rad(90.0))  # between these angles


def trained(path: Path, source: Path, unit: str | None = None) -> tuple[Mesh, ViewModel]:
    """Mesh and model of a target; the model is trained where its file is not there."""
    target = Target.load(source)
    mesh = load_mesh(target.mesh_path, unit or target.unit)
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        more = {"step_rad": _STEP_RAD, "options": SMALLEST} if target.joints else {"options": QUICK}
        train_target(target, mesh, path, unit, jobs=1, **more)
    return mesh, ViewModel.load(path)


def digests(answers: Answers, path: Path, model: ViewModel, code: Path) -> None:
    """Of a model's file, of its arrays without the versions of the header, and of its C code."""
    hashes = {name: hashlib.sha256() for name in ("file", "arrays", "flight code")}
    hashes["file"].update(path.read_bytes())
    for key, array in sorted(read_container(path)[1].items()):
        hashes["arrays"].update(f"{key} {array.dtype.str} {array.shape}".encode() + array.tobytes())
    for written in sorted(write_c(model, code)):
        hashes["flight code"].update(written.name.encode() + written.read_bytes())
    for name, sha256 in hashes.items():
        answers.add(f"model/{name}", f"{path.stem} {sha256.hexdigest()}")
