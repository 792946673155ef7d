"""An approach through the service beside the same approach through the commands."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from rendezview.client import Client, pose_of_state

from experiments.service.serving import Served
from rendezview.geometry.pose import Pose
from rendezview.io.bundled import find_target
from rendezview.io.results import read_json_lines
from rendezview.io.sequences import open_sequence
from rendezview.io.target import DockingRing

Json = dict[str, Any]
_EDGES_M = (60.0, 30.0, 15.0, 7.5, 3.0, 0.0)  # camera to ring. Source: chosen, about halves


@dataclass
class Outcome:
    """What one way gives, by the time of the frame."""

    tracked: dict[float, Json] = field(default_factory=dict)  # lines of `track`, or states
    rings: dict[float, Json] = field(default_factory=dict)  # lines of `ring`, or readings
    fused: dict[float, Json] = field(default_factory=dict)  # the last state at that time
    paths: dict[float, Json] = field(default_factory=dict)  # `trajectory` of `guide`, or of states


def command(folder: Path, *words: object) -> None:
    start = [sys.executable, "-c", "from rendezview.cli.main import main; main()"]
    done = subprocess.run([*start, *map(str, words)], cwd=folder, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{words[0]}: {done.stderr}")


def by_commands(folder: Path, model: Path) -> Outcome:
    """The commands of the whole approach in docs/fusion.md; at one time the range comes first."""
    command(folder, "track", model, "scene", "-o", "poses.csv", "--log", "track.jsonl",
            "--prior", "scene")  # fmt: skip
    fuse = ("--target", "client", "-o")
    command(folder, "fuse", "laser.jsonl", "track.jsonl", *fuse, "far.jsonl")
    command(folder, "ring", "scene", "--track", "far.jsonl", *fuse, "ring.jsonl")
    command(folder, "fuse", "laser.jsonl", "track.jsonl", "ring.jsonl", *fuse, "state.jsonl")
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


def by_service(folder: Path, model: Path) -> Outcome:
    """Ranges and frames into one session, which does all the rest."""
    sequence = open_sequence(folder / "scene")
    echoes = {line["time_s"]: line for line in read_json_lines(folder / "laser.jsonl")}
    first, outcome = sequence.frames[0], Outcome()
    target = find_target("client").mesh_path.parent
    served = Served(model, "--workers", "1", "--target", str(target))
    try:
        served.await_ready()
        with (
            Client(served.url, timeout_s=120.0) as client,
            client.open(first.camera, prior=first.camera_from_target, idle_s=600.0) as session,
        ):
            for frame in sequence:
                assert frame.time_s is not None
                session.measure("laser", echoes[frame.time_s])
                state = session.track(frame.read(), frame.time_s)
                note(outcome, state)
    finally:
        served.stop()
    return outcome


def fused_pose(state: Json | None) -> Pose | None:
    """Of a state that is tracking."""
    if state is None or state["status"] != "tracking":
        return None
    return pose_of_state(state)


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


def errors(ways: dict[str, Outcome], truth: dict[float, Pose], ring: DockingRing) -> None:
    """Errors against the truth in bins of range."""
    centres = {time_s: pose.apply(ring.centre_m) for time_s, pose in truth.items()}
    print("range, m   frames   " + "   ".join(f"{name:>37}" for name in ways))
    print(" " * 20 + "   poses  rings  fused  centre mm  attitude °" * len(ways))
    for far, near in pairwise(_EDGES_M):
        times = [t for t, c in centres.items() if near < np.linalg.norm(c) - 1e-3 <= far]
        line = f"{far:4g} – {near:3g} {len(times):6}   "
        for outcome in ways.values():
            found = [(t, fused_pose(outcome.fused.get(t))) for t in times]
            good = [(t, pose) for t, pose in found if pose is not None]
            away = [np.linalg.norm(p.apply(ring.centre_m) - centres[t]) for t, p in good]
            turned = [np.rad2deg(p.angle_to(truth[t])) for t, p in good]
            poses = sum(outcome.tracked[t]["pose"] is not None for t in times)
            rings = sum(bool(outcome.rings[t]["poses"]) for t in times)
            line += f"{poses:8} {rings:6} {len(good):6} {1e3 * rms(away):10.2f} {rms(turned):11.3f}"
        print(line)


def rms(values: list[Any]) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if values else float("nan")


def costs(outcome: Outcome) -> str:
    """Computing time of a frame, by stage."""
    states = outcome.tracked.values()
    parts = {"tracker": [state["track_ms"] for state in states]}
    for stage in ("filter", "sensors", "trajectory"):
        parts[stage] = [state["stage_ms"][stage] for state in states]
    return "ms a frame, median; most: " + ", ".join(
        f"{name} {np.median(ms):.1f}; {max(ms):.1f}" for name, ms in parts.items()
    )


def draw(place: Path, *, frames: int, seed: int, start_m: float = 60.0, end_m: float = 1.0) -> None:
    """A straight approach to the client's ring, with ranges."""
    command(place, "simulate", "client", "-o", "scene", "--trajectory", "vbar",
            "--axis", "ring", "--start-range", start_m, "--end-range", end_m,
            "--frames", frames, "--dt", 4, "--jitter", 0.05, "--sun-phase", 25, "--seed", seed,
            "--laser", "laser.jsonl", "--jobs", 1)  # fmt: skip


def run(model: Path, *, frames: int = 60, seed: int = 1, folder: Path | None = None) -> None:
    """An approach from 60 m to 1 m through the service, beside the commands.

    Draws a straight approach to the client's ring, then gives it to the commands of
    docs/fusion.md, and its frames and ranges over HTTP to one session of a service of its own.

    A --folder keeps all files; a scene that it has is not drawn again.
    """
    with tempfile.TemporaryDirectory() as temporary:
        place = (folder or Path(temporary)).resolve()
        place.mkdir(exist_ok=True)
        if not (place / "scene").exists():
            draw(place, frames=frames, seed=seed)
        ring = find_target("client").docking_ring
        assert ring is not None
        commands = by_commands(place, model.resolve())
        service = by_service(place, model.resolve())
        truth = {}
        for frame in open_sequence(place / "scene").frames:
            assert frame.time_s is not None
            assert frame.camera_from_target is not None
            truth[frame.time_s] = frame.camera_from_target
        for name, (ours, theirs, apart) in compare(commands, service).items():
            print(f"{name}: commands {ours}, service {theirs}; largest difference {apart:.3g}")
        errors({"commands": commands, "service": service}, truth, ring)
        print(costs(service))
