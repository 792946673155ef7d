"""An approach through the service beside the same approach through the commands."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rendezview.cli.main import main
from rendezview.geometry.pose import Pose
from rendezview.io.results import read_json_lines
from rendezview_service.client import pose_of_state

Json = dict[str, Any]


@dataclass
class Outcome:
    """What one way gives, by the time of the frame."""

    tracked: dict[float, Json] = field(default_factory=dict)  # lines of `track`, or states
    rings: dict[float, Json] = field(default_factory=dict)  # lines of `ring`, or readings
    fused: dict[float, Json] = field(default_factory=dict)  # the last state at that time
    paths: dict[float, Json] = field(default_factory=dict)  # `trajectory` of `guide`, or of states


def command(folder: Path, *words: object) -> None:
    """Run a command in this process, in a folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(sys, "argv", ["rendezview", *map(str, words)])
        with pytest.raises(SystemExit) as ended:
            main()
        assert not ended.value.code, words


def by_commands(folder: Path, model: Path) -> Outcome:
    """The commands of the whole approach in docs/fusion.md; at one time the range comes first."""
    command(folder, "track", model, "scene", "-o", "poses.csv", "--log", "track.jsonl",
            "--prior", "scene")  # fmt: skip
    fuse = ("--target", "client", "-o")
    beam = ("--model", model)
    command(folder, "fuse", "laser.jsonl", "track.jsonl", *beam, *fuse, "far.jsonl")
    command(folder, "ring", "scene", "--track", "far.jsonl", *fuse, "ring.jsonl")
    command(folder, "fuse", "laser.jsonl", "track.jsonl", "ring.jsonl", *beam, *fuse,
            "state.jsonl")  # fmt: skip
    command(folder, "guide", "state.jsonl", "--shape", "vbar", *fuse, "guide.jsonl")
    logs = [read_json_lines(folder / f"{n}.jsonl") for n in ("track", "ring", "state", "guide")]
    told = Outcome(*({line["time_s"]: line for line in log} for log in logs))
    told.paths = {time_s: line["trajectory"] for time_s, line in told.paths.items()}
    return told


def note(outcome: Outcome, state: Json) -> None:
    """Keep a state of the service."""
    time_s = state["time_s"]
    outcome.tracked[time_s], outcome.fused[time_s] = state, state["fused"]
    outcome.rings[time_s], outcome.paths[time_s] = state["ring"], state["trajectory"]


def compare(commands: Outcome, service: Outcome) -> dict[str, tuple[int, int, float]]:
    """How many results each way has, and the largest difference where both have one."""
    told = {}
    for name, ours, theirs in (
        ("poses, mm", commands.tracked, service.tracked),
        ("fused states, mm", commands.fused, service.fused),
    ):
        told[name] = _apart(
            [(_pose(ours[t]), _pose(theirs[t])) for t in ours],
            lambda a, b: 1e3 * float(np.linalg.norm(a.translation_m - b.translation_m)),
        )
        told[name.replace("mm", "°")] = _apart(
            [(_pose(ours[t]), _pose(theirs[t])) for t in ours],
            lambda a, b: float(np.rad2deg(a.angle_to(b))),
        )
    told["ring readings, mm"] = _apart(
        [(line["poses"], service.rings[t]["poses"]) for t, line in commands.rings.items()],
        lambda a, b: 1e3 * _farthest(a, b, "centre_m"),
    )
    told["open rings, mm"] = _apart(
        [
            (line["candidates"], service.rings[t]["candidates"])
            for t, line in commands.rings.items()
        ],
        lambda a, b: 1e3 * _farthest(a[0]["poses"], b[0]["poses"], "centre_m"),
    )
    told["paths, predicted place, mm"] = _apart(
        [(line["segment"], service.paths[t]["segment"]) for t, line in commands.paths.items()],
        lambda a, b: 1e3 * float(np.abs(_array(a["predicted_m"]) - b["predicted_m"]).max()),
    )
    return told


def _pose(state: Json) -> Pose | None:
    return pose_of_state(state)


def _array(values: Any) -> np.ndarray:
    return np.asarray(values, dtype=np.float64)


def _farthest(ours: list[Json], theirs: list[Json], key: str) -> float:
    """Of poses of circles in the same order; infinite if one way has more."""
    if len(ours) != len(theirs):
        return float("inf")
    pairs = zip(ours, theirs, strict=True)
    return max(float(np.linalg.norm(_array(a[key]) - b[key])) for a, b in pairs)


def _apart(
    pairs: list[tuple[Any, Any]], difference: Callable[[Any, Any], float]
) -> tuple[int, int, float]:
    """Counts of both ways, and the largest difference; infinite if only one has a result."""
    both = [bool(a) == bool(b) for a, b in pairs]
    found = [difference(a, b) for a, b in pairs if a and b]
    counts = [sum(bool(pair[k]) for pair in pairs) for k in (0, 1)]
    return counts[0], counts[1], max(found, default=0.0) if all(both) else float("inf")


def draw(place: Path, *, frames: int, seed: int, start_m: float = 60.0, end_m: float = 1.0) -> None:
    """A straight approach to the client's ring, with ranges."""
    command(place, "simulate", "client", "-o", "scene", "--trajectory", "vbar",
            "--axis", "ring", "--start-range", start_m, "--end-range", end_m,
            "--frames", frames, "--dt", 4, "--jitter", 0.05, "--sun-phase", 25, "--seed", seed,
            "--laser", "laser.jsonl", "--jobs", 1)  # fmt: skip
