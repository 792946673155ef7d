"""An approach through the service beside the same approach through the commands."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from experiments.service.serving import Served
from rendezview.client import Client, pose_of_state
from rendezview.geometry.pose import Pose
from rendezview.io.bundled import find_target
from rendezview.io.results import read_json_lines
from rendezview.io.sequences import open_sequence
from rendezview.io.sequences.frame import Frame
from rendezview.io.target import DockingRing
from rendezview.sensors.ring import RingPrior
from rendezview.sensors.ring.prior_log import prior_of_pose
from rendezview.sensors.ring.run import follow, record

Json = dict[str, Any]
_EDGES_M = (60.0, 30.0, 15.0, 7.5, 3.0, 0.0)  # camera to ring. Source: chosen, about halves


@dataclass
class Outcome:
    """What one way gives, by the time of the frame."""

    tracked: dict[float, Json] = field(default_factory=dict)  # lines of `track`, or states
    rings: dict[float, Json] = field(default_factory=dict)  # lines of `ring`
    fused: dict[float, Json] = field(default_factory=dict)  # the last state at that time


def command(folder: Path, *words: object) -> None:
    start = [sys.executable, "-c", "from rendezview.cli.main import main; main()"]
    done = subprocess.run([*start, *map(str, words)], cwd=folder, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{words[0]}: {done.stderr}")


def by_commands(folder: Path, model: Path) -> Outcome:
    """The commands of the whole approach in docs/fusion.md."""
    command(folder, "track", model, "scene", "-o", "poses.csv", "--log", "track.jsonl",
            "--prior", "scene")  # fmt: skip
    fuse = ("--target", "client", "-o")
    command(folder, "fuse", "track.jsonl", "laser.jsonl", *fuse, "far.jsonl")
    command(folder, "ring", "scene", "--track", "far.jsonl", *fuse, "ring.jsonl")
    command(folder, "fuse", "track.jsonl", "ring.jsonl", "laser.jsonl", *fuse, "state.jsonl")
    logs = [read_json_lines(folder / f"{n}.jsonl") for n in ("track", "ring", "state")]
    return Outcome(*({line["time_s"]: line for line in log} for log in logs))


def by_service(folder: Path, model: Path, ring: DockingRing) -> Outcome:
    """Frames, ring readings and ranges into one session; its state is the ring's prior."""
    sequence = open_sequence(folder / "scene")
    echoes = {line["time_s"]: line for line in read_json_lines(folder / "laser.jsonl")}
    first, outcome = sequence.frames[0], Outcome()
    served = Served(model, "--workers", "1")
    try:
        served.await_ready()
        with Client(served.url, timeout_s=120.0) as client:
            session = client.open(
                first.camera, prior=first.camera_from_target, fusion={"ring": ring}, idle_s=600.0
            )

            def prior(frame: Frame) -> RingPrior | None:
                assert frame.time_s is not None
                state = session.track(frame.read(), frame.time_s)
                outcome.tracked[frame.time_s] = state
                known = state.get("fused") or state  # the first frame has no fused state
                pose = pose_of_state(known)
                if pose is None or known["covariance"] is None:
                    return None
                return prior_of_pose(pose, np.array(known["covariance"])[:6, :6], ring)

            readings = follow(sequence, ring.radius_m, prior=prior, circles=ring.circles)
            for frame, _, reading in readings:
                assert frame.time_s is not None
                line = record(frame, reading)
                outcome.rings[frame.time_s] = line
                told = session.measure("ring", line)
                told = session.measure("laser", echoes[frame.time_s])
                if told["fused"] is not None:
                    outcome.fused[frame.time_s] = told["fused"]
            session.close()
    finally:
        served.stop()
    return outcome


def fused_pose(state: Json | None) -> Pose | None:
    """Of a state that is tracking."""
    if state is None or state["status"] != "tracking":
        return None
    return pose_of_state(state)


def compare_poses(commands: Outcome, service: Outcome) -> None:
    both = [
        (pose_of_state(line), pose_of_state(service.tracked[time_s]))
        for time_s, line in commands.tracked.items()
    ]
    pairs = [(a, b) for a, b in both if a is not None and b is not None]
    apart_m = max(float(np.linalg.norm(a.translation_m - b.translation_m)) for a, b in pairs)
    angle = max(np.rad2deg(a.angle_to(b)) for a, b in pairs)
    counts = [sum(pair[k] is not None for pair in both) for k in (0, 1)]
    print(
        f"poses: commands {counts[0]}, service {counts[1]}, both {len(pairs)}; largest difference "
        f"{1e3 * apart_m:.3g} mm, {angle:.3g}°"
    )


def compare_rings(commands: Outcome, service: Outcome) -> None:
    lines = [(line, service.rings[time_s]) for time_s, line in commands.rings.items()]
    counts = [sum(bool(pair[k]["poses"]) for pair in lines) for k in (0, 1)]
    apart_px, chosen = [0.0], 0
    for ours, theirs in lines:
        if bool(ours["poses"]) != bool(theirs["poses"]) or not ours["poses"]:
            continue
        ends = [_place(line["poses"][0]) for line in (ours, theirs)]
        difference = float(np.linalg.norm(ends[0] - ends[1]))
        chosen += difference > 1e-9
        apart_px.append(difference)
    print(
        f"ring readings: commands {counts[0]}, service {counts[1]}; {chosen} differ, by at most "
        f"{1e3 * max(apart_px):.3g} mm"
    )


def _place(circle: Any) -> np.ndarray:
    return np.asarray(circle["centre_m"], dtype=np.float64)


def compare_fused(commands: Outcome, service: Outcome) -> None:
    """Differences in metres and degrees, and over the commands' σ."""
    rows = []
    for time_s, ours in commands.fused.items():
        a, b = fused_pose(ours), fused_pose(service.fused.get(time_s))
        if a is None or b is None:
            continue
        sigma = np.sqrt(np.diag(np.array(ours["covariance"]))[:6])
        turn = (b.rotation @ a.rotation.T - a.rotation @ b.rotation.T) / 2.0
        vector = np.array([turn[2, 1], turn[0, 2], turn[1, 0]])  # small
        move = b.translation_m - a.translation_m
        rows.append((time_s, np.linalg.norm(move), np.rad2deg(a.angle_to(b)),
                     np.abs(move / sigma[3:]).max(), np.abs(vector / sigma[:3]).max()))  # fmt: skip
    table = np.array(rows)
    for name, part in (("all", table), ("second half", table[len(table) // 2 :])):
        position_m, angle, position_s, angle_s = part[:, 1:].max(axis=0)
        print(
            f"fused states, {name}: {len(part)} of both; largest difference "
            f"{1e3 * position_m:.3g} mm ({position_s:.2g} σ), {angle:.3g}° ({angle_s:.2g} σ)"
        )


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


def run(model: Path, *, frames: int = 60, seed: int = 1, folder: Path | None = None) -> None:
    """An approach from 60 m to 1 m through the service, beside the commands.

    Draws a straight approach to the client's ring, then gives it to the commands of
    docs/fusion.md, and over HTTP to one session of a service of its own: frames, ranges, and
    readings of the ring that the client makes with the session's own state as the prior.

    A --folder keeps all files; a scene that it has is not drawn again.
    """
    with tempfile.TemporaryDirectory() as temporary:
        place = (folder or Path(temporary)).resolve()
        place.mkdir(exist_ok=True)
        if not (place / "scene").exists():
            command(place, "simulate", "client", "-o", "scene", "--trajectory", "vbar",
                    "--axis", "ring", "--start-range", 60, "--end-range", 1, "--frames", frames,
                    "--dt", 4, "--jitter", 0.05, "--sun-phase", 25, "--seed", seed,
                    "--laser", "laser.jsonl", "--jobs", 1)  # fmt: skip
        ring = find_target("client").docking_ring
        assert ring is not None
        commands = by_commands(place, model.resolve())
        service = by_service(place, model.resolve(), ring)
        truth = {}
        for frame in open_sequence(place / "scene").frames:
            assert frame.time_s is not None
            assert frame.camera_from_target is not None
            truth[frame.time_s] = frame.camera_from_target
        compare_poses(commands, service)
        compare_rings(commands, service)
        compare_fused(commands, service)
        errors({"commands": commands, "service": service}, truth, ring)
