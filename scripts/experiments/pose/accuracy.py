"""Poses on the frames of ``pose-frames``: the table of docs/refinement.md.

    python -m experiments pose-accuracy FRAMES MODELS [--seed 5] [--sun] [--log LOG.jsonl]

MODELS is a folder with a model ``<target>.rvm`` for every folder of FRAMES. Every frame is looked
at twice: on its own without a prior, and from the true pose of a second earlier: off by up to 5°
about a random axis, 3 % of range and 1 % of range across. A frame without a pose counts as not
found; an answer more than 5° off (the least over the target's symmetries) is wrong. The normalised
error squared is that of the answers that are right; wrong ones are counted beside it. The log has
besides, as ``lone``, the poses next to three more such priors of each frame, nothing else tried.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from rendezview.evaluation.campaign import pose_error, second_earlier
from rendezview.geometry.pose import Array, Pose
from rendezview.geometry.symmetry import angle_between
from rendezview.io.sequences import open_sequence
from rendezview.sensors.appearance import AppearanceObservation, Recognizer, ViewModel
from rendezview.sensors.appearance.edges.confidence import Found
from rendezview.sensors.appearance.sky import Sky
from rendezview.training.open_executor import open_executor

WRONG_DEG = 5.0
_LONE_PRIORS = 3  # of a frame


def compared(observation: AppearanceObservation, truth: Pose, model: ViewModel) -> dict[str, Any]:
    """One answer beside the truth; everything that may tell right from wrong."""
    record: dict[str, Any] = {
        "status": str(observation.status),
        "confidence": observation.confidence,
        "trees": float(observation.weights.sum()),
        "ms": sum(observation.stage_ms.values()),
    }
    found = observation.found
    if found is not None:
        best = found.best
        record |= {
            "features": found.features.tolist(),
            "looked": found.shading is not None,
            "best_deg": float(np.rad2deg(angle_between(best.pose, truth, model.symmetries))),
        }
    error = pose_error(observation, truth, model)
    if error is not None:
        record |= {
            "rotation_deg": float(np.rad2deg(error.rotation_rad)),
            "translation": error.translation,
            "nees": error.nees,
        }
    return record


def lone(
    recognizer: Recognizer, image: np.ndarray, prior: Pose, truth: Pose, sun_camera: Array | None
) -> list[dict[str, Any]]:
    """What the pose next to a prior looks like if nothing else is tried: for ``pose_confidence``.

    Without a look at the surface, and with one.
    """
    assert recognizer.search is not None
    refiner, sky = recognizer.search.refiner, Sky.of(image, sun_camera)
    refined = refiner.refine(image, sky, prior)
    if refined is None:
        return []
    error = angle_between(refined.pose, truth, recognizer.model.symmetries)
    looks = [
        Found(refined, 0.0, 1.0, sky.dark, True),
        Found(refined, 0.0, 1.0, sky.dark, True, shading=refiner.shading(image, sky, refined.pose)),
    ]
    return [
        {
            "mode": "lone",
            "features": found.features.tolist(),
            "looked": found.shading is not None,
            "best_deg": float(np.rad2deg(error)),
        }
        for found in looks
    ]


def run(
    frames: Path, models: Path, target: str, condition: str, seed: int, sun: bool, log: bool
) -> list[dict[str, Any]]:
    """Both looks at every frame of one scene."""
    model = ViewModel.load(models / f"{target}.rvm")
    suns = json.loads((frames / target / condition / "sun.json").read_text()) if sun else None
    records = []
    recognizer = None
    for k, frame in enumerate(open_sequence(frames / target / condition)):
        truth = frame.camera_from_target
        assert truth is not None
        if recognizer is None:
            recognizer = Recognizer(model, frame.camera)
        image = frame.read()
        rng = np.random.default_rng([seed, k])
        prior = second_earlier(truth, model.centre_m, rng)
        light = {} if suns is None else {"sun_camera": np.array(suns[k])}
        for mode, observation in (
            ("first", recognizer.recognize(image, **light)),
            ("tracked", recognizer.recognize(image, prior, np.deg2rad(6.0), **light)),
        ):
            records.append(
                {"target": target, "condition": condition, "frame": k, "mode": mode}
                | compared(observation, truth, model)
            )
        for other in range(_LONE_PRIORS if log else 0):
            prior = second_earlier(truth, model.centre_m, np.random.default_rng([seed, k, other]))
            records += [
                {"target": target, "condition": condition, "frame": k} | record
                for record in lone(recognizer, image, prior, truth, light.get("sun_camera"))
            ]
    return records


def row(name: str, records: list[dict[str, Any]]) -> list[str]:
    """One line of the table."""
    answers = [r for r in records if "rotation_deg" in r]
    right = [r for r in answers if r["rotation_deg"] < WRONG_DEG]
    wrong = len(answers) - len(right)
    rotation = np.array([r["rotation_deg"] for r in right] or [np.nan])
    translation = np.array([r["translation"] for r in right] or [np.nan])
    nees = np.array([r["nees"] for r in right] or [np.nan])
    closest = sum(r.get("best_deg", 180.0) < WRONG_DEG for r in records)
    return [
        name,
        f"{len(records)}",
        f"{100 * len(right) / len(records):.1f}",
        f"{100 * closest / len(records):.1f}",
        f"{100 * wrong / len(records):.1f}",
        f"{np.median(rotation):.3f} / {np.percentile(rotation, 95):.2f}",
        f"{100 * np.median(translation):.3f}",
        f"{np.mean(nees):.1f} / {np.median(nees):.1f}",
        f"{np.median([r['ms'] for r in records]):.1f}",
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("frames", type=Path)
    parser.add_argument("models", type=Path)
    parser.add_argument("--seed", type=int, default=5, help="of the priors")
    parser.add_argument("--sun", action="store_true", help="tell the direction to the Sun")
    parser.add_argument("--log", type=Path, help="every answer, JSON lines")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--dask", help="scheduler of a cluster that has the folders too")
    arguments = parser.parse_args()
    scenes = sorted(
        (p.parent.parent.name, p.parent.name) for p in arguments.frames.glob("*/*/scene_gt.json")
    )
    started = time.perf_counter()
    folders = arguments.frames.resolve(), arguments.models.resolve()
    with open_executor(arguments.jobs, arguments.dask, processes=True) as workers:
        tasks = [
            (*scene, arguments.seed, arguments.sun, arguments.log is not None) for scene in scenes
        ]
        parts = dict(workers.results(run, folders, tasks))
    records = [record for k in sorted(parts) for record in parts[k]]
    if arguments.log:
        arguments.log.write_text("".join(json.dumps(r) + "\n" for r in records))
    table = Table(title="poses")
    for head in (
        "frames", "n", "right %", "best right %", "wrong %", "rotation ° median / 95 %",
        "translation % of range", "NEES mean / median", "ms",
    ):  # fmt: skip
        table.add_column(head, justify="right")
    for mode in ("first", "tracked"):
        for condition in ("low", "high", "earth"):
            chosen = [r for r in records if r["mode"] == mode and r["condition"] == condition]
            for target in sorted({r["target"] for r in chosen}):
                part = [r for r in chosen if r["target"] == target]
                table.add_row(*row(f"{mode} {condition} {target}", part))
            if chosen:
                table.add_row(*row(f"{mode} {condition} all", chosen), style="bold")
    Console(width=170).print(table)
    print(f"{time.perf_counter() - started:.0f} s")
