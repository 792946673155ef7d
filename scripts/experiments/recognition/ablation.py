"""What the trees decide: first poses with learned, silenced and random trees, same frames."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Any

import numpy as np
from rendezview.sensors.appearance.outline.voters import LEAF, ODDS_UNIT
from rendezview.simulation.scene import SceneOptions, render_frame, sun_at_phase
from rendezview.simulation.shading import ShadingOptions
from rendezview.training.mesh import Mesh
from scipy.spatial.transform import Rotation

from experiments.frame import Log, mesh_of, show, table_of, write_log
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose
from rendezview.geometry.symmetry import angle_between
from rendezview.sensors.appearance import Recognizer, ViewModel

RIGHT_DEG = 5.0
ALONE_RIGHT_DEG = 8.0  # the trees alone do not refine
RANGE_RADII = (3.0, 7.0)
PRIOR_RAD = np.deg2rad(3.0)
CAMERA = Camera.from_fov(640, 480, float(np.deg2rad(53.0)))
KINDS = ("learned", "silenced", "random")
SILENT = round(np.log(0.1 / 0.9) / ODDS_UNIT)  # the share of a node's views among its samples

Record = dict[str, Any]


def with_trees(model: ViewModel, kind: str, rng: np.random.Generator) -> ViewModel:
    """The model with its own leaves, with leaves that say nothing, or with shuffled ones."""
    if kind == "learned":
        return model
    forest, voters = model.forest, model.voters
    if voters is not None:
        leaf = voters.component == LEAF
        odds = voters.odds.copy()
        said = voters.odds[leaf]
        odds[leaf] = SILENT if kind == "silenced" else rng.permutation(said)
        model = replace(model, voters=replace(voters, odds=odds))
    if kind == "silenced":
        none = np.zeros_like(model.leaf_on)
        silent = replace(forest, category=np.zeros_like(forest.category))
        return replace(model, forest=silent, leaf_on=none, leaf_off=none)
    leaves = np.flatnonzero(forest.component < 0)
    order = rng.permutation(leaves)
    category, on, off = forest.category.copy(), model.leaf_on.copy(), model.leaf_off.copy()
    category[leaves], on[leaves], off[leaves] = category[order], on[order], off[order]
    return replace(model, forest=replace(forest, category=category), leaf_on=on, leaf_off=off)


def frame_of(
    mesh: Mesh, model: ViewModel, most_phase_deg: float, seed: Sequence[int]
) -> tuple[Array, Pose, Array, float]:
    """A frame, its true pose, the direction to the Sun, and the angle Sun–target–camera."""
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(random_state=rng).as_matrix()
    line = np.array([*rng.uniform(-0.15, 0.15, 2), 1.0])
    centre = line * rng.uniform(*RANGE_RADII) * model.target_radius_m
    pose = Pose(rotation, centre - rotation @ model.centre_m)
    phase = float(np.deg2rad(rng.uniform(0.0, most_phase_deg)))
    sun = sun_at_phase(centre, phase, rng.uniform(0.0, 2.0 * np.pi))
    options = SceneOptions(sky_frame="camera", shading=ShadingOptions(samples=2))
    return render_frame(mesh, CAMERA, pose, sun, options, rng), pose, sun, phase


def looked(
    recognizer: Recognizer, frame: Array, truth: Pose, prior: Pose | None, sun: Array | None
) -> Record:
    """One answer: its error if there is one, its confidence, and its processor time."""
    began = time.process_time()
    observation = recognizer.recognize(frame, prior, sun_camera=sun)
    spent_ms = 1e3 * (time.process_time() - began)
    off = None
    if observation.pose is not None:
        symmetries = recognizer.model.symmetries
        off = float(np.rad2deg(angle_between(observation.pose, truth, symmetries)))
    began = time.process_time()
    active = len(observation.active_nodes)  # asks the trees, where the edges gave the pose
    asked_ms = 1e3 * (time.process_time() - began)
    record = {"off_deg": off, "ms": spent_ms, "asked_ms": asked_ms, "active": active}
    found = observation.found
    if found is not None:
        best = angle_between(found.best.pose, truth, recognizer.model.symmetries)
        record |= {"best_deg": float(np.rad2deg(best)), "votes": found.votes}
    return record | {"confidence": observation.confidence}


def row(name: str, records: list[Record], right_deg: float) -> list[str]:
    """Shares and times of some records."""
    off = np.array([np.nan if r["off_deg"] is None else r["off_deg"] for r in records])
    given = np.isfinite(off)
    percent = 100.0 / len(records)
    times = [r["ms"] for r in records]
    return [
        name,
        f"{percent * given.sum():.1f}",
        f"{percent * np.sum(off[given] < right_deg):.1f}",
        f"{percent * np.sum(off[given] >= right_deg):.2f}",
        f"{np.mean(times):.1f}",
        f"{np.median(times):.1f}",
        f"{np.median([r['asked_ms'] for r in records]):.1f}",
        f"{np.mean([r['active'] for r in records]):.1f}",
    ]


def run(
    model: Annotated[str, "model file"],
    target: Annotated[str, "mesh, target.toml, or hubble, client, scole"],
    *, frames: int = 300, seed: int = 4201,
    sun_phase: Annotated[float, "largest angle Sun–target–camera, degrees"] = 60.0,
    sun: Annotated[bool, "give the direction to the Sun"] = False,
    log: Log = None,
) -> None:  # fmt: skip
    """What the trees decide: learned, silenced and random trees on the same frames, in one run.

    Random attitudes, 640 × 480, 53° across, 3 to 7 target radii away, hard shadows, black sky.
    "silenced": every leaf says nothing. "random": the leaves of all trees are shuffled. "first
    pose": no prior; right within 5°. "alone": the trees without refinement (track --no-refine),
    no prior; right within 8°. "tracked": refinement from a prior 3° off, with the trees and
    without them. Times are processor time; "asked" is that of the active nodes after the pose.
    """
    name, mesh = mesh_of(target)
    views = ViewModel.load(model)
    rng = np.random.default_rng([seed, 10**9])
    kinds = {kind: with_trees(views, kind, rng) for kind in KINDS}
    ways: dict[str, tuple[Recognizer, bool]] = {}
    for kind, own in kinds.items():
        ways[f"first pose, {kind}"] = Recognizer(own, CAMERA, sketch=False), False
    for kind, own in kinds.items():
        ways[f"alone, {kind}"] = Recognizer(own, CAMERA, refine=False), False
    for trees, words in ((True, "with"), (False, "without")):
        own_way = Recognizer(views, CAMERA, sketch=False, trees=trees)
        ways[f"tracked, {words} trees"] = own_way, True
    records: list[Record] = []
    for k in range(-2, frames):  # the first two compile
        frame, truth, light, phase = frame_of(mesh, views, sun_phase, [seed, k + 2])
        turn = np.random.default_rng([seed, k + 2, 1]).normal(size=3)
        turn *= PRIOR_RAD / np.linalg.norm(turn)
        centre = truth.apply(views.centre_m)
        near = Rotation.from_rotvec(turn).as_matrix() @ truth.rotation
        prior = Pose(near, centre - near @ views.centre_m)
        for way, (recognizer, tracked) in ways.items():
            found = looked(
                recognizer, frame, truth, prior if tracked else None, light if sun else None
            )
            if k >= 0:
                records.append({"way": way, "frame": k, "phase": phase} | found)
    write_log(log, records)
    columns = "way | given % | right % | wrong % | mean ms | median ms | asked ms | active nodes"
    rows = table_of(f"{name}: {frames} frames, Sun 0–{sun_phase:g}°, seed {seed}", columns)
    for way in ways:
        limit = ALONE_RIGHT_DEG if way.startswith("alone") else RIGHT_DEG
        rows.add_row(*row(way, [r for r in records if r["way"] == way], limit))
    show(rows, width=110)
