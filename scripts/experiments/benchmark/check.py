"""Rows of the benchmark, what all groups share, and the check for rows that have become worse."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from rendezview import ViewModel
from rendezview_ground.mesh.mesh import Mesh


@dataclass(frozen=True, slots=True)
class Way:
    """A call, and how many answers it gives; ``own_clock``: it returns seconds an answer."""

    call: Callable[[], Any]
    answers: int = 1
    own_clock: bool = False


def race(ways: dict[str, Way], seconds: float, rounds: int = 15) -> dict[str, float]:
    """Seconds an answer: least of the medians of ``rounds`` turns; ``seconds``: for all of it."""
    other_process = any(way.own_clock for way in ways.values())
    now = time.perf_counter if other_process else time.process_time
    for way in ways.values():
        way.call()
    best = dict.fromkeys(ways, np.inf)
    for k in range(rounds):
        for name in list(ways) if k % 2 else list(reversed(ways)):
            way, spent = ways[name], list[float]()
            until = time.perf_counter() + seconds / (rounds * len(ways))
            while not spent or time.perf_counter() < until:
                start = now()
                returned = way.call()
                took = now() - start
                spent.append(float(returned) if way.own_clock else took / way.answers)
            best[name] = min(best[name], float(np.median(spent)))
    return best


ALLOWED = 1.5


@dataclass(frozen=True)
class Bench:
    """Data of all groups. ``frames``, ``problems``: of each kind; ``seconds``: of each race."""

    mesh: Mesh
    model_path: Path
    frames: int
    problems: int
    seconds: float
    seed: int

    @cached_property
    def model(self) -> ViewModel:
        return ViewModel.load(self.model_path)

    def race(self, ways: dict[str, Callable[[], object] | Way]) -> dict[str, float]:
        """Seconds an answer of each way."""
        entered = {n: w if isinstance(w, Way) else Way(w) for n, w in ways.items()}
        return race(entered, self.seconds)


@dataclass(frozen=True, slots=True)
class Row:
    """One comparison: less is better, of ``ours`` and of the ratio."""

    name: str  # of the row, unique
    ours: float
    beside: str  # the peer or floor
    peer: float
    unit: str  # times: "s"; else the unit of the count
    command: str  # the experiment that has more of it

    @property
    def ratio(self) -> float:
        """Ours over the peer's; 1 where both are nothing."""
        if self.peer == 0.0:
            return 1.0 if self.ours == 0.0 else float("inf")
        return self.ours / self.peer

    @property
    def key(self) -> str:
        return f"{self.name} / {self.beside}"

    def shown(self) -> tuple[float, float, str]:
        """Ours, the peer's and their unit, for readers: a time in ms or µs."""
        if self.unit != "s":
            return self.ours, self.peer, self.unit
        unit, scale = ("ms", 1e3) if self.ours >= 1e-3 else ("µs", 1e6)
        return scale * self.ours, scale * self.peer, unit


def times(
    command: str, spent_s: dict[str, float], rows: dict[str, tuple[str, ...]]
) -> Iterator[Row]:
    """A row for every way of ours beside each of its peers."""
    for ours, beside in rows.items():
        for peer in beside:
            yield Row(ours, spent_s[ours], peer, spent_s[peer], "s", command)


def best(rows: Iterable[Row]) -> dict[str, Row]:
    """One row a key: the least of ours and the least of the peer's; a key has one unit."""
    found: dict[str, Row] = {}
    for row in rows:
        other = found.get(row.key, row)
        least = min(row.ours, other.ours), min(row.peer, other.peer)
        found[row.key] = replace(row, ours=least[0], peer=least[1])
    return found


def write(rows: Iterable[Row], path: Path) -> None:
    """Ratios to be kept, and the numbers they came of, for readers."""
    kept: dict[str, dict[str, object]] = {}
    for row in rows:
        ours, peer, unit = row.shown()
        numbers = {"ratio": row.ratio, "ours": ours, "peer": peer}
        kept[row.key] = {name: float(f"{value:.4g}") for name, value in numbers.items()}
        kept[row.key]["unit"] = unit
    path.write_text(json.dumps(kept, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def worse(rows: Iterable[Row], path: Path, allowed: float = ALLOWED) -> dict[str, str]:
    """The faults, a line for each key: ratios above ``allowed`` × the kept ones, other rows."""
    try:
        kept = json.loads(path.read_text(encoding="utf-8"))
        limits = {key: allowed * float(entry["ratio"]) for key, entry in kept.items()}
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        return {"": f"{path} is not a file of kept ratios ({error!r})"}
    measured = {row.key: row.ratio for row in rows}
    wrong = {key: f"{key}: kept, but not measured" for key in limits if key not in measured}
    for key, ratio in measured.items():
        if key not in limits:
            wrong[key] = f"{key}: measured, but not kept; --write"
        elif not ratio <= limits[key]:
            was = limits[key] / allowed
            times = f"{ratio / was:.2f} × as much" if was > 0.0 else "was nothing"
            wrong[key] = f"{key}: ratio {ratio:.3g}, kept {was:.3g} ({times})"
    return wrong
