"""One flight of a seed, and many: resumable, the same bytes for the same seeds."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import ks_2samp

from rendezview.io.files import atomic_write_text, check_place
from rendezview.io.video_file import VideoWriter
from rendezview_ground.fly.dynamics import OrbitDynamics
from rendezview_ground.fly.faults import Fault, fault_of_run
from rendezview_ground.fly.guidance import Guidance
from rendezview_ground.fly.loop import Flight, FusedEstimator, Loop
from rendezview_ground.fly.rendered import RenderedSensors
from rendezview_ground.fly.sensors import ModelledSensors
from rendezview_ground.fly.setup import Setup
from rendezview_ground.learn.jobs.shard_executor import ShardExecutor
from rendezview_ground.learn.jobs.stages import Arrays, Progress, Shards, shares

RUNS_PER_SHARD = 4  # some seconds of work


def fly_once(
    setup: Setup, seed: int, fault: Fault | None = None,
    film: VideoWriter | None = None,
) -> Flight:  # fmt: skip
    """The flight of a seed with the project's own parts; ``film`` receives rendered frames."""
    sensors: ModelledSensors | RenderedSensors
    if setup.model is None:
        sensors = ModelledSensors(setup, seed, fault)
    else:
        sensors = RenderedSensors(setup, seed, fault, film)
    dynamics = OrbitDynamics(setup.plan, setup.port, seed, fault)
    return Loop(sensors, FusedEstimator(), Guidance(setup.plan, setup.port), dynamics).run()


def record(flight: Flight, seed: int, fault: Fault | None) -> dict[str, Any]:
    """A flight as one line of JSON."""
    last = flight.moments[-1]
    modes = [moment.mode for moment in flight.moments]
    return {
        "seed": seed,
        "fault": None if fault is None else fault.kind,
        "fault_s": None if fault is None else round(fault.begin_s, 3),
        "end": flight.end,
        "outside": flight.outside,
        "reason": last.reason,
        "time_s": last.time_s,
        "spent_m_s": round(last.spent_m_s, 6),
        "retreats": sum(a != b == "retreat" for a, b in pairwise(modes)),
        "nearest_m": round(min(m.true.range_m for m in flight.moments), 6),
        "steps": flight.known,
        "beyond": flight.beyond,
        "contact": None
        if flight.contact is None
        else {k: round(v, 9) for k, v in dataclasses.asdict(flight.contact).items()},
        "touch_m": None if flight.touch_m is None else [round(float(v), 9) for v in flight.touch_m],
    }


def campaign(
    setup: Setup, path: Path, runs: int, seed: int, faults: tuple[str, ...], every: int,
    executor: ShardExecutor, progress: Progress | None = None,
) -> list[dict[str, Any]]:  # fmt: skip
    """Flights of the seeds ``seed`` … ``seed + runs − 1``; their lines, also written to ``path``.

    Finished shards are kept in ``path`` + ``.partial`` until the file is complete: the same call
    goes on after a kill.

    Args:
        faults: kinds, in turn, in one run of ``every``.
    """
    check_place(path, "the runs")
    inputs = {
        "plan": dataclasses.asdict(setup.plan),
        "mesh": hashlib.sha256(setup.beam.vertices_m.tobytes()).hexdigest(),
        "port": [*setup.port.centre_m, *setup.port.axis],
        "model": None if setup.model is None else setup.model.provenance,
        "runs": [seed, runs, *faults, every],
    }
    parts = [(range(seed + p.start, seed + p.stop),) for p in shares(runs, RUNS_PER_SHARD)]
    with Shards(path, inputs) as shards:
        done = shards.run("flights", _fly, (setup, faults, every), parts, executor, progress)
        lines = [str(line) for shard in done for line in shard["lines"]]
        atomic_write_text(path, "".join(line + "\n" for line in lines))
        shards.remove()
    return [json.loads(line) for line in lines]


def _fly(setup: Setup, faults: tuple[str, ...], every: int, seeds: range) -> Arrays:
    lines = []
    for seed in seeds:
        kind = fault_of_run(faults, every, seed)
        fault = None if kind is None else Fault.drawn(kind, seed)
        lines.append(json.dumps(record(fly_once(setup, seed, fault), seed, fault)))
    return {"lines": np.array(lines)}


def worst(lines: list[dict[str, Any]], setup: Setup) -> list[tuple[float, dict[str, Any]]]:
    """Contacts by the largest share of a limit that they use, worst first."""
    limits, found = setup.plan.envelope, []
    angle, rate = math.radians(limits.angle_deg), math.radians(limits.rate_deg_s)
    slow, fast = limits.closing_m_s
    for line in lines:
        c = line["contact"]
        if c is None:
            continue
        closing = abs(c["closing_m_s"] - 0.5 * (slow + fast)) / (0.5 * (fast - slow))
        used = max(
            c["lateral_m"] / limits.lateral_m, c["tilt_rad"] / angle, c["roll_rad"] / angle,
            closing, c["lateral_m_s"] / limits.lateral_m_s, c["across_rad_s"] / rate,
            c["about_rad_s"] / rate,
        )  # fmt: skip
        found.append((used, line))
    return sorted(found, key=lambda pair: -pair[0])


def agreement(
    lines: list[dict[str, Any]], others: list[dict[str, Any]]
) -> list[tuple[str, int, int, float]]:
    """Whether contacts of faultless flights may be of one distribution, by contact condition.

    Returns:
        Condition, both numbers of flights, and p of the two-sample Kolmogorov–Smirnov test.
    """
    one, two = (
        [line["contact"] for line in some if line["contact"] and line["fault"] is None]
        for some in (lines, others)
    )
    if not one or not two:
        return []
    return [
        (key, len(one), len(two),
         float(ks_2samp([c[key] for c in one], [c[key] for c in two]).pvalue))
        for key in one[0]
    ]  # fmt: skip
