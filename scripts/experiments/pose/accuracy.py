"""First poses and tracked poses on the frames of `pose-frames`."""

from __future__ import annotations

import json
import time
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from experiments.frame import show, table_of, two
from rendezview import Pose, Recognizer, ViewModel, open_sequence
from rendezview.geometry.pose import Array
from rendezview.geometry.symmetry import angle_between
from rendezview.sensors.appearance import AppearanceObservation
from rendezview_ground.evaluate.assessment import pose_error, second_earlier
from rendezview_ground.learn.jobs.open_executor import open_executor

WRONG_DEG = 5.0
PRIOR_RAD = np.deg2rad(6.0)  # the prior's error that is given to the recognizer
JOBS = 2

Record = dict[str, Any]


def compared(observation: AppearanceObservation, truth: Pose, model: ViewModel) -> Record:
    """One answer beside the truth."""
    record: Record = {"ms": sum(observation.stage_ms.values())}
    if observation.found is not None:
        best = observation.found.best.pose
        record["best_deg"] = float(np.rad2deg(angle_between(best, truth, model.symmetries)))
    error = pose_error(observation, truth, model)
    if error is not None:
        record |= {
            "rotation_deg": float(np.rad2deg(error.rotation_rad)),
            "translation": error.translation,
            "nees": error.nees,
        }
    return record


def both_searches(recognizer: Recognizer, image: Array, truth: Pose, prior: Pose) -> list[Record]:
    """The first pose without a prior, and the tracked one."""
    first = recognizer.recognize(image)
    tracked = recognizer.recognize(image, prior, PRIOR_RAD)
    modes = {"first": first, "tracked": tracked}
    return [{"mode": mode} | compared(o, truth, recognizer.model) for mode, o in modes.items()]


def on_scene(frames: Path, models: Path, target: str, condition: str, seed: int) -> list[Record]:
    """Both looks at every frame of one scene."""
    model = ViewModel.load(models / f"{target}.rvm")
    records, recognizer = [], None
    for k, frame in enumerate(open_sequence(frames / target / condition)):
        truth = frame.camera_from_target
        assert truth is not None
        recognizer = recognizer or Recognizer(model, frame.camera)
        image = frame.read()
        prior = second_earlier(truth, model.centre_m, np.random.default_rng([seed, k]))
        looks = both_searches(recognizer, image, truth, prior)
        about = {"target": target, "condition": condition, "frame": k}
        records += [about | look for look in looks]
    return records


def row(name: str, records: list[Record]) -> list[str]:
    """One line of the table."""
    answers = [r for r in records if "rotation_deg" in r]
    right = [r for r in answers if r["rotation_deg"] < WRONG_DEG]
    percent = 100 / len(records)
    closest = sum(r.get("best_deg", 180.0) < WRONG_DEG for r in records)

    def values(key: str) -> Array:
        return np.array([r[key] for r in right] or [np.nan])

    return [
        name, f"{len(records)}", f"{percent * len(right):.1f}", f"{percent * closest:.1f}",
        f"{percent * (len(answers) - len(right)):.1f}",
        two(values("rotation_deg"), form="{:.3f} / {:.2f}"),
        f"{100 * np.median(values('translation')):.3f}",
        f"{np.mean(values('nees')):.1f} / {np.median(values('nees')):.1f}",
        f"{np.median([r['ms'] for r in records]):.1f}",
    ]  # fmt: skip


def run(
    frames: Path, models: Path, *, seed: Annotated[int, "of the priors"] = 5,
    log: Annotated[Path | None, "every answer, JSON lines"] = None,
) -> None:  # fmt: skip
    """First poses and tracked poses on the frames of pose-frames.

    MODELS is a folder with a model <target>.rvm for every folder of FRAMES. Every frame is read
    twice: without a prior, and from the true pose of a second earlier: off by up to 5° about a
    random axis, 3 % of range and 1 % of range across. An answer more than 5° off (the least over
    the target's symmetries) is wrong. The normalised error squared is that of the right answers.
    """
    scenes = sorted((p.parent.parent.name, p.parent.name) for p in frames.glob("*/*/scene_gt.json"))
    started = time.perf_counter()
    with open_executor(JOBS, None, processes=True) as workers:
        tasks = [(*scene, seed) for scene in scenes]
        parts = dict(workers.results(on_scene, (frames.resolve(), models.resolve()), tasks))
    records = [record for k in sorted(parts) for record in parts[k]]
    if log is not None:
        log.write_text("".join(json.dumps(record) + "\n" for record in records))
    columns = "frames | n | right % | best right % | wrong % | rotation ° median / 95 % "
    columns += "| translation % of range | NEES mean / median | ms"
    rows = table_of("poses", columns, left=0)
    for mode, condition in product(("first", "tracked"), ("low", "high", "earth")):
        chosen = [r for r in records if (r["mode"], r["condition"]) == (mode, condition)]
        for target in sorted({r["target"] for r in chosen}):
            part = [r for r in chosen if r["target"] == target]
            rows.add_row(*row(f"{mode} {condition} {target}", part))
        if chosen:
            rows.add_row(*row(f"{mode} {condition} all", chosen), style="bold")
    show(rows, width=170)
    print(f"{time.perf_counter() - started:.0f} s")
