"""Sequences of every condition, tracked; what speaks for each pose is kept, and read again."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from experiments.frame import mesh_of, unit
from rendezview import Camera, Pose, Recognizer, Tracker, ViewModel, read_json_lines
from rendezview.geometry import so3
from rendezview.geometry.pose import Array
from rendezview.geometry.symmetry import nearest_alike
from rendezview.io.files import atomic_write_text
from rendezview.io.results import json_line
from rendezview.sensors.appearance.integrity.evidence import Evidence, Second
from rendezview_ground import simulate
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.simulate.sensor import SensorOptions

CAMERA = Camera.from_fov(320, 240, math.radians(53.0))  # small pictures: many frames
RANGE_RADII = (3.0, 5.5)
TURN_DEG = (0.3, 3.0)  # a frame
CLOSING = (-0.006, 0.012)  # of the range, a frame
ASIDE = 0.12  # of the range, at most
LONG_BLUR_PX, PLAIN_BLUR_PX = (1.5, 3.0), 0.7
OVEREXPOSED = (3.0, 10.0)
CUT_RADII = (0.2, 0.8)  # of the target radius beyond the border
SECOND_EVERY = 5  # poses of a track; the sketch is asked beside the first of them
OFF = np.deg2rad(20.0)  # a wrong pose is farther than that from the truth
MOST_LOST = 4  # frames in a row without a pose, after which a sequence ends
TARGETS = ("hubble", "client", "scole")
SHARD = 4  # sequences of a file
# A pose is another answer than the truth where its error is larger than this and beyond its tails.
WRONG_DEG = 5.0  # of attitude, as in the experiments of poses
WRONG_SHARE = 0.1  # of the range
WRONG_SIGMA = 6.0  # standard deviations along the longest axis of the covariance


@dataclass(frozen=True, slots=True, kw_only=True)
class Condition:
    """Light and faults of the sequences of one condition."""

    sun_deg: tuple[float, float] = (0.0, 60.0)  # angle Sun–target–camera
    frames: int = 30  # of a sequence, a second apart
    earth: bool = False
    other: bool = False  # the frames show another target
    stretch: float = 0.0  # of the craft against its model, along a random axis
    cut: bool = False
    blurred: bool = False
    saturated: bool = False


CONDITIONS = {
    "low Sun": Condition(sun_deg=(0.0, 30.0)),
    "high Sun": Condition(sun_deg=(30.0, 60.0)),
    "side Sun": Condition(sun_deg=(60.0, 110.0)),
    "Earth": Condition(earth=True),
    "wrong target": Condition(other=True, frames=8),
    "mesh 2 %": Condition(stretch=0.02),
    "mesh 4 %": Condition(stretch=0.04),
    "cut": Condition(cut=True),
    "blurred": Condition(blurred=True),
    "saturated": Condition(saturated=True),
}


def sequence(
    mesh: Mesh, centre_m: Array, radius_m: float, condition: Condition, rng: np.random.Generator
) -> Iterator[tuple[np.ndarray, Pose]]:
    """The pictures of a sequence with their poses; the centre is that of the expected target."""
    if condition.stretch:
        axis = unit(rng)
        along = (mesh.vertices_m - mesh.bounding_sphere[0]) @ axis
        longer_m = mesh.vertices_m + condition.stretch * np.outer(along, axis)
        mesh = replace(mesh, vertices_m=longer_m)
    depth_m = radius_m * rng.uniform(*RANGE_RADII)
    rotation = Rotation.random(random_state=rng)
    turn = Rotation.from_rotvec(math.radians(rng.uniform(*TURN_DEG)) * unit(rng))
    bearing = rng.uniform(-ASIDE, ASIDE, 2)
    if condition.cut:
        bearing = _cut(depth_m / radius_m, rng)
    closing = rng.uniform(*CLOSING)
    phase, azimuth = np.deg2rad(rng.uniform(*condition.sun_deg)), rng.uniform(0.0, 2.0 * math.pi)
    blur_px = rng.uniform(*LONG_BLUR_PX) if condition.blurred else PLAIN_BLUR_PX
    over = rng.uniform(*OVEREXPOSED) if condition.saturated else 1.0
    scene = simulate.SceneOptions(
        sky_frame="camera",
        earth=simulate.Earth(seed=int(rng.integers(2**31))) if condition.earth else None,
        shading=simulate.ShadingOptions(samples=2),
        sensor=SensorOptions(blur_sigma_px=blur_px, overexposure=over),
    )
    for k in range(condition.frames):
        centre = np.array([*bearing, 1.0]) * depth_m * (1.0 - closing) ** k
        pose = Pose(rotation.as_matrix(), centre - rotation.as_matrix() @ centre_m)
        sun = simulate.sun_at_phase(centre, phase, azimuth)
        yield simulate.render_frame(mesh, CAMERA, pose, sun, scene, rng, float(k)), pose
        rotation = turn * rotation


def _cut(depth_radii: float, rng: np.random.Generator) -> Array:
    """Bearing of a target that the border of the picture cuts."""
    half = np.array([CAMERA.width / CAMERA.fx, CAMERA.height / CAMERA.fy]) / 2.0
    side = int(rng.integers(2))
    bearing = rng.uniform(-ASIDE, ASIDE, 2)
    bearing[side] = half[side] - (1.0 - rng.uniform(*CUT_RADII)) / depth_radii
    bearing[side] *= rng.choice([-1.0, 1.0])
    return bearing


def error(found: Pose, truth: Pose | None, model: ViewModel) -> list[float] | None:
    """(6,) rotation vector and translation from the pose to the truth; None: there is none."""
    if truth is None:
        return None
    return nearest_alike(truth, found, model.symmetries).delta_from(found).tolist()


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
            second = recognizer.second_estimate(picture, seen.pose)
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


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """One look at one frame."""

    condition: str
    evidence: Evidence | None  # None: no pose
    second: Second | None
    asked: bool  # whether the second estimator was
    error: np.ndarray | None  # (6,) from the pose to the truth; None: another target
    misled: bool  # the track began at a wrong prior on purpose

    @property
    def ask(self) -> Callable[[], Second | None] | None:
        """The second estimator, where it was asked."""
        return (lambda: self.second) if self.asked else None

    @property
    def turn_rad(self) -> float:
        return np.inf if self.error is None else float(np.linalg.norm(self.error[:3]))

    @property
    def move_m(self) -> float:
        return np.inf if self.error is None else float(np.linalg.norm(self.error[3:]))

    @property
    def wrong(self) -> bool:
        """Another answer than the truth."""
        assert self.evidence is not None
        turned = _beyond(self.turn_rad, np.deg2rad(WRONG_DEG), self.evidence.covariance[:3, :3])
        moved = WRONG_SHARE * self.evidence.range_m
        return turned or _beyond(self.move_m, moved, self.evidence.covariance[3:6, 3:6])


def _beyond(length: float, least: float, covariance: np.ndarray) -> bool:
    spread = float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
    return length > max(least, WRONG_SIGMA * spread)


def tracks(folder: Path) -> Iterator[list[Look]]:
    """The looks of each track, in order."""
    for path in sorted(folder.glob("*.jsonl")):
        tracked: dict[tuple[int, ...], list[Look]] = {}
        poses: Counter[tuple[int, ...]] = Counter()
        for line in read_json_lines(path):
            name, evidence, second = tuple(line["sequence"]), line["evidence"], line["second"]
            asked = evidence is not None and poses[name] % SECOND_EVERY == 0
            poses[name] += evidence is not None
            look = Look(
                line["condition"],
                None if evidence is None else Evidence.of_record(evidence),
                None if second is None else Second(**second), asked,
                None if line["error"] is None else np.array(line["error"]), line["misled"],
            )  # fmt: skip
            tracked.setdefault(name, []).append(look)
        yield from tracked.values()


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
