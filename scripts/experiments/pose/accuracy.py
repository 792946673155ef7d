"""First poses and tracked poses on frames: those of `pose-frames`, and of cut targets."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from rendezview.evaluation.campaign import pose_error, second_earlier
from rendezview.sensors.appearance.edges.confidence import Found
from rendezview.simulation import SceneOptions, render_frame, sun_at_phase
from rendezview.training.open_executor import open_executor
from scipy.spatial.transform import Rotation

from experiments.frame import Dask, Log, mesh_of, show, table_of, two, write_log
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose
from rendezview.geometry.symmetry import angle_between
from rendezview.io.sequences import open_sequence
from rendezview.sensors.appearance import AppearanceObservation, Recognizer, ViewModel
from rendezview.sensors.appearance.sky import Sky

WRONG_DEG = 5.0
PRIOR_RAD = np.deg2rad(6.0)  # the prior's error that is given to the recognizer
SINGLE_PRIORS = 3  # more priors of each frame, for the log
HALF_FIELD_RAD = np.deg2rad(15.0)
VISIBLE = ((0.0, 0.3), (0.3, 0.5), (0.5, 0.7), (0.7, 0.9), (0.9, 1.01))  # share of the outline

Record = dict[str, Any]


def compared(observation: AppearanceObservation, truth: Pose, model: ViewModel) -> Record:
    """One answer beside the truth, with all features that may separate right from wrong."""
    record: Record = {
        "status": str(observation.status),
        "confidence": observation.confidence,
        "trees": float(observation.weights.sum()),
        "ms": sum(observation.stage_ms.values()),
    }
    if observation.found is not None:
        record |= features_of(observation.found, truth, model)
    error = pose_error(observation, truth, model)
    if error is not None:
        record |= {
            "rotation_deg": float(np.rad2deg(error.rotation_rad)),
            "translation": error.translation,
            "nees": error.nees,
        }
    return record


def features_of(found: Found, truth: Pose, model: ViewModel) -> Record:
    """What confidence is computed from, and how far off the best pose is."""
    return {
        "features": found.features.tolist(),
        "looked": found.shading is not None,
        "best_deg": float(np.rad2deg(angle_between(found.best.pose, truth, model.symmetries))),
    }


def both_looks(
    recognizer: Recognizer, image: Array, truth: Pose, prior: Pose, sun: Array | None = None
) -> list[Record]:
    """The first pose without a prior, and the tracked one."""
    light = {} if sun is None else {"sun_camera": sun}
    first = recognizer.recognize(image, **light)
    tracked = recognizer.recognize(image, prior, PRIOR_RAD, **light)
    return [
        {"mode": mode} | compared(observation, truth, recognizer.model)
        for mode, observation in (("first", first), ("tracked", tracked))
    ]


def single_looks(
    recognizer: Recognizer, image: Array, truth: Pose, prior: Pose, sun: Array | None
) -> list[Record]:
    """The pose next to a prior if nothing else is tried, without a look at the surface and with."""
    assert recognizer.search is not None
    refiner, sky = recognizer.search.refiner, Sky.of(image, sun)
    refined = refiner.refine(image, sky, prior)
    if refined is None:
        return []
    shading = refiner.shading(image, sky, refined.pose)
    looks = [
        Found(refined, 0.0, 1.0, sky.dark, True),
        Found(refined, 0.0, 1.0, sky.dark, True, shading=shading),
    ]
    return [{"mode": "lone"} | features_of(look, truth, recognizer.model) for look in looks]


def on_scene(
    frames: Path, models: Path, target: str, condition: str, seed: int, sun: bool, log: bool
) -> list[Record]:
    """Both looks at every frame of one scene."""
    model = ViewModel.load(models / f"{target}.rvm")
    folder = frames / target / condition
    suns = json.loads((folder / "sun.json").read_text()) if sun else None
    records = []
    recognizer = None
    for k, frame in enumerate(open_sequence(folder)):
        truth = frame.camera_from_target
        assert truth is not None
        recognizer = recognizer or Recognizer(model, frame.camera)
        image = frame.read()
        light = None if suns is None else np.array(suns[k])

        def prior(
            *seeds: int, truth: Pose = truth, centre_m: Array = model.centre_m, k: int = k
        ) -> Pose:
            return second_earlier(truth, centre_m, np.random.default_rng([seed, k, *seeds]))

        looks = both_looks(recognizer, image, truth, prior(), light)
        for other in range(SINGLE_PRIORS if log else 0):
            looks += single_looks(recognizer, image, truth, prior(other), light)
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
    sun: Annotated[bool, "give the direction to the Sun"] = False, log: Log = None,
    jobs: int = 2, dask: Dask = None,
) -> None:  # fmt: skip
    """First poses and tracked poses on the frames of pose-frames.

    MODELS is a folder with a model <target>.rvm for every folder of FRAMES. Every frame is read
    twice: without a prior, and from the true pose of a second earlier: off by up to 5° about a
    random axis, 3 % of range and 1 % of range across. An answer more than 5° off (the least over
    the target's symmetries) is wrong. The normalised error squared is that of the right answers.
    The log also has, as "lone", the poses next to three more priors of each frame.
    """
    scenes = sorted((p.parent.parent.name, p.parent.name) for p in frames.glob("*/*/scene_gt.json"))
    started = time.perf_counter()
    with open_executor(jobs, dask, processes=True) as workers:
        tasks = [(*scene, seed, sun, log is not None) for scene in scenes]
        parts = dict(workers.results(on_scene, (frames.resolve(), models.resolve()), tasks))
    records = [record for k in sorted(parts) for record in parts[k]]
    write_log(log, records)
    columns = (
        "frames", "n", "right %", "best right %", "wrong %", "rotation ° median / 95 %",
        "translation % of range", "NEES mean / median", "ms",
    )  # fmt: skip
    rows = table_of("poses", columns, left=0)
    for mode in ("first", "tracked"):
        for condition in ("low", "high", "earth"):
            chosen = [r for r in records if r["mode"] == mode and r["condition"] == condition]
            for target in sorted({r["target"] for r in chosen}):
                part = [r for r in chosen if r["target"] == target]
                rows.add_row(*row(f"{mode} {condition} {target}", part))
            if chosen:
                rows.add_row(*row(f"{mode} {condition} all", chosen), style="bold")
    show(rows, width=170)
    print(f"{time.perf_counter() - started:.0f} s")


def cut_place(close: bool, radius_m: float, rng: np.random.Generator) -> Array:
    """(3,) the view centre in the camera frame: close by, or across the image border."""
    if close:
        range_m = rng.uniform(1.3, 3.2) * radius_m
        off = rng.uniform(-0.1, 0.1, 2)
    else:
        range_m = rng.uniform(4.0, 10.0) * radius_m
        angle = rng.uniform(0.0, 2.0 * np.pi)
        off = np.array([np.cos(angle), np.sin(angle)])
        off /= np.abs(off).max()  # on a square
        off *= np.tan(HALF_FIELD_RAD) + rng.uniform(-0.9, 0.5) * radius_m / range_m
    return np.array([*(off * range_m), range_m])


def on_cut_target(target: str, models: Path, count: int, seed: int) -> list[Record]:
    """Both looks at frames of one target."""
    _, mesh = mesh_of(target)
    model = ViewModel.load(models / f"{Path(target).stem}.rvm")
    camera = Camera.from_fov(1024, 1024, 2.0 * HALF_FIELD_RAD)
    recognizer = Recognizer(model, camera)
    rng = np.random.default_rng(seed)
    records = []
    for k in range(count):
        rotation = Rotation.random(random_state=int(rng.integers(1 << 30))).as_matrix()
        centre = cut_place(k % 2 == 0, model.target_radius_m, rng)
        truth = Pose(rotation, centre - rotation @ model.centre_m)
        sun = sun_at_phase(centre, np.deg2rad(rng.uniform(0.0, 60.0)), rng.uniform(0.0, 6.28))
        image = render_frame(mesh, camera, truth, sun, SceneOptions(), rng, 0.0)
        prior = second_earlier(truth, model.centre_m, rng)
        about = {"target": model.name, "condition": "off" if k % 2 else "close", "frame": k}
        records += [about | look for look in both_looks(recognizer, image, truth, prior)]
    return records


def cut(
    models: Path, targets: list[str], *, count: Annotated[int, "frames of each target"] = 60,
    seed: int = 77, log: Log = None,
) -> None:  # fmt: skip
    """Poses of targets that the image border cuts, close by or off to a side.

    MODELS is a folder with a model <target>.rvm of each target. Frames of our own simulator,
    1024 × 1024, Sun 0–60° from behind the camera, any attitude. Half of them are close, the view
    centre 1.3 to 3.2 target radii away; the others are off to a side, 4 to 10 radii away and about
    on the border. Each is read as in pose-accuracy.
    """
    records = [r for target in targets for r in on_cut_target(target, models, count, seed)]
    write_log(log, records)
    columns = ("frames", "of the outline in the picture", "n", "right", "wrong", "no pose")
    rows = table_of(f"cut by the border, seed {seed}", columns, left=0)
    for mode in ("first", "tracked"):
        for condition in ("close", "off"):
            chosen = [r for r in records if (r["mode"], r["condition"]) == (mode, condition)]
            for low, high in VISIBLE:
                share = [r["features"][6] if "features" in r else 0.0 for r in chosen]
                part = [r for r, s in zip(chosen, share, strict=True) if low <= s < high]
                right = sum(r.get("rotation_deg", 180.0) < WRONG_DEG for r in part)
                given = sum("rotation_deg" in r for r in part)
                counts = (len(part), right, given - right, len(part) - given)
                between = f"{low:.1f}–{min(high, 1.0):.1f}"
                rows.add_row(f"{mode} {condition}", between, *map(str, counts))
    show(rows)
