"""Draws sequences of every condition, tracks them and keeps what speaks for each pose."""

from __future__ import annotations

import time
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np

from experiments.frame import mesh_of
from experiments.integrity.frames import CAMERA, CONDITIONS, Condition, sequence
from rendezview.geometry import so3
from rendezview.geometry.pose import Pose
from rendezview.geometry.symmetry import nearest_alike
from rendezview.io.files import atomic_write_text
from rendezview.io.results import json_line
from rendezview.sensors.appearance import Recognizer, Tracker, ViewModel
from rendezview.sensors.appearance.integrity.evidence import Evidence
from rendezview_ground.mesh.mesh import Mesh

SECOND_EVERY = 5  # poses of a track; the sketch is asked beside the first of them
OFF = np.deg2rad(20.0)  # a wrong pose is farther than that from the truth
MOST_LOST = 4  # frames in a row without a pose, after which a sequence ends
TARGETS = ("hubble", "client", "scole")
SHARD = 4  # sequences of a file


def error(found: Pose, truth: Pose | None, model: ViewModel) -> list[float] | None:
    """(6,) rotation vector and translation from the pose to the truth; None: there is none."""
    if truth is None:
        return None
    near = nearest_alike(found, truth, model.symmetries)
    turn = so3.between(truth.rotation, near.rotation)
    return [*turn.tolist(), *(truth.translation_m - near.translation_m).tolist()]


def alike(recognizer: Recognizer, picture: np.ndarray, truth: Pose, mesh: Mesh) -> Iterator[Pose]:
    """Wrong poses that may look like the true one: rivals, half turns, depth reversed."""
    model = recognizer.model
    found = recognizer.recognize(picture).found
    if found is not None:
        yield from (one.pose for one in (found.best, found.rival) if one is not None)
    centre = truth.apply(model.centre_m)
    main_axes = np.linalg.svd(mesh.vertices_m - mesh.vertices_m.mean(0), full_matrices=False)[2]
    view = centre / np.linalg.norm(centre)
    turns = [truth.rotation @ so3.exp(np.pi * axis) for axis in main_axes]
    # A nearly flat craft seen along its normal n: turned about n × view by twice the angle between.
    normal = truth.rotation @ main_axes[2]
    across = np.cross(normal, view)
    lean = np.arctan2(np.linalg.norm(across), normal @ view)
    turns.append(so3.exp(2.0 * lean * across / max(np.linalg.norm(across), 1e-9)) @ truth.rotation)
    yield from (Pose(turn, centre - turn @ model.centre_m) for turn in turns)


def is_off(pose: Pose | None, truth: Pose, model: ViewModel) -> bool:
    """Whether a pose is quite another attitude than the truth."""
    return pose is not None and nearest_alike(pose, truth, model.symmetries).angle_to(truth) > OFF


def misled(recognizer: Recognizer, picture: np.ndarray, truth: Pose, mesh: Mesh) -> Tracker | None:
    """A tracker that takes a wrong prior; None where no wrong one is taken."""
    for prior in alike(recognizer, picture, truth, mesh):
        if not is_off(prior, truth, recognizer.model):
            continue
        if is_off(recognizer.recognize(picture, prior).pose, truth, recognizer.model):
            return Tracker(recognizer, prior=prior)
    return None


def looks(
    recognizer: Recognizer, mesh: Mesh, condition: Condition, rng: np.random.Generator,
    mislead: bool = False,
) -> list[dict[str, Any]]:  # fmt: skip
    """Every look at one sequence; every other one has a prior, a misled one a wrong prior."""
    model = recognizer.model
    centre_m, radius_m = model.centre_m, model.target_radius_m
    if condition.other:
        centre_m, radius_m = mesh.bounding_sphere
    tracker: Tracker | None = None
    with_prior = rng.random() < 0.5
    lines: list[dict[str, Any]] = []
    poses = lost = 0
    for k, (picture, shown) in enumerate(sequence(mesh, centre_m, radius_m, condition, rng)):
        truth = None if condition.other else shown
        if tracker is None and mislead:
            tracker = misled(recognizer, picture, shown, mesh)
            if tracker is None:
                break
        elif tracker is None:
            tracker = Tracker(recognizer, prior=truth if with_prior else None)
        predicted = tracker.predicted(float(k)) if k else None
        began_s = time.process_time()
        seen = tracker.update(float(k), picture)
        spent_s = time.process_time() - began_s
        if mislead and not is_off(seen.pose, shown, model):
            break
        evidence, second = Evidence.of(seen, float(k), predicted, model.centre_m), None
        due = poses % SECOND_EVERY == 0
        if due and seen.pose is not None and not (evidence is not None and evidence.sketched):
            second = recognizer.second_look(picture, seen.pose)
        poses += seen.pose is not None
        lost = 0 if seen.pose is not None else lost + 1
        lines.append({
            "frame": k, "status": str(seen.status),
            "error": None if seen.pose is None else error(seen.pose, truth, model),
            "spent_s": round(spent_s, 4), "second": second,
            "evidence": None if evidence is None else evidence.record(),
        })  # fmt: skip
        if lost > MOST_LOST:
            break
    return lines


def run(
    models: Annotated[Path, "folder of hubble.rvm, client.rvm, scole.rvm, or some of them"],
    output: Annotated[Path, "folder of the logs"], *,
    shards: Annotated[tuple[int, int], "of each condition: first, end"] = (0, 10),
    seed: int = 1,
    mislead: Annotated[bool, "begin at wrong poses, end where they are left"] = False,
) -> None:  # fmt: skip
    """Draw and track sequences; each shard of four is a file.

    A sequence ends early where the target is lost for good. A shard that is there is not drawn
    again, so a run can be stopped and continued.
    """
    cv2.setNumThreads(1)
    names = [name for name in TARGETS if (models / f"{name}.rvm").is_file()]
    meshes = {name: mesh_of(name)[1] for name in TARGETS}
    stored = {name: ViewModel.load(models / f"{name}.rvm") for name in names}
    recognizers = {name: Recognizer(model, CAMERA) for name, model in stored.items()}
    output.mkdir(parents=True, exist_ok=True)
    for shard, (c, (name, condition)) in product(range(*shards), enumerate(CONDITIONS.items())):
        kind = name.replace(" ", "_").replace("_%", "") + "-misled" * mislead
        path = output / f"{kind}-{seed}-{shard:03d}.jsonl"
        if path.exists() or (mislead and condition.other):  # no pose of another target is right
            continue
        lines = []
        for k in range(SHARD):
            target = names[k % len(names)]
            others = [name for name in TARGETS if name != target]
            shown = others[k // len(names) % len(others)] if condition.other else target
            place = [seed, c, shard, k]
            head = {"condition": name, "target": target, "sequence": place, "misled": mislead}
            rng = np.random.default_rng(place)
            seen = looks(recognizers[target], meshes[shown], condition, rng, mislead)
            lines += [head | one for one in seen]
        atomic_write_text(path, "".join(json_line(one) + "\n" for one in lines))
        print(f"{path.name}: {len(lines)} frames", flush=True)
