"""Monte-Carlo accuracy: a model's results on random frames of its target."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose
from rendezview.geometry.symmetry import nearest_alike
from rendezview.io.files import atomic_write_text, check_place
from rendezview.sensors.appearance import AppearanceObservation, Recognizer, ViewModel
from rendezview.sensors.observation import Status
from rendezview_ground.learn.jobs.shard_executor import ShardExecutor
from rendezview_ground.learn.jobs.stages import Arrays, Progress, Shards, shares
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.simulate import SceneOptions, ShadingOptions, render_frame, sun_at_phase

FRAMES_PER_SHARD = 16  # about a second of work
LOOKS = ("first", "tracked")
WRONG_RAD = math.radians(5.0)  # attitude error above which a pose is wrong
_STATUSES = list(Status)
_MARGIN = 1.08  # factor on the bounding sphere, so that it stays off the border
_PRIOR_RAD = math.radians(5.0)  # largest attitude error of a prior
_PRIOR_RANGE, _PRIOR_BEARING = 0.03, 0.01  # of the range; largest errors of a prior
_SEARCH_FACTOR = 1.2  # allowance on the prior's error that the recognizer is given


@dataclass(frozen=True, kw_only=True)
class CampaignOptions:
    """Distribution of the frames of a campaign."""

    frames: int = 1000
    sun_phase_rad: tuple[float, float] = (0.0, math.radians(30.0))  # Sun, target, camera
    range_radii: tuple[float, float] = (
        1.0,
        2.0,
    )  # of the range at which the target fills the picture
    samples: int = 2  # of shading, per pixel and axis
    seed: int = 0

    def __post_init__(self) -> None:
        checks = {
            "frames": 1 <= self.frames <= 10_000_000,
            "sun_phase_rad": 0.0 <= self.sun_phase_rad[0] <= self.sun_phase_rad[1] <= math.pi,
            "range_radii": 1.0 <= self.range_radii[0] <= self.range_radii[1] < math.inf,
            "samples": 1 <= self.samples <= 16,
            "seed": self.seed >= 0,
        }
        for name, right in checks.items():
            if not right:
                raise RendezviewError(
                    f"campaign option {name} = {getattr(self, name)} is out of range"
                )


@dataclass(frozen=True, slots=True, eq=False)
class Answers:
    """Results of K frames at one look. Errors of frames without a pose are NaN."""

    status: Sequence[Status]  # (K,)
    confidence: Array  # (K,)
    rotation_rad: Array  # (K,) to the nearest equivalent pose
    translation: Array  # (K,) of the view centre, as a share of its distance
    nees: Array  # (K,) normalised squared error; its mean is 6 if the covariance is right

    @property
    def given(self) -> npt.NDArray[np.bool_]:
        """(K,) whether there is a pose."""
        return ~np.isnan(self.rotation_rad)

    @property
    def right(self) -> npt.NDArray[np.bool_]:
        """(K,) whether there is a pose with an attitude error below 5°."""
        return np.asarray(self.rotation_rad < WRONG_RAD)  # NaN compares as false


@dataclass(frozen=True, slots=True)
class PoseError:
    """Errors of one pose."""

    rotation_rad: float  # to the nearest equivalent pose
    translation: float  # of the view centre, as a share of its distance
    nees: float  # normalised squared error; its mean is 6 if the covariance is right


def pose_error(
    observation: AppearanceObservation, truth: Pose, model: ViewModel
) -> PoseError | None:
    """Errors of an observation; ``None`` if it has no pose."""
    if observation.pose is None or observation.covariance is None:
        return None
    pose = observation.pose
    truth = nearest_alike(truth, pose, model.symmetries)  # the covariance is that of the pose
    turn = Rotation.from_matrix(truth.rotation @ pose.rotation.T).as_rotvec()
    error = np.concatenate([turn, truth.translation_m - pose.translation_m])
    centre = truth.apply(model.centre_m)
    off = float(np.linalg.norm(pose.apply(model.centre_m) - centre) / np.linalg.norm(centre))
    nees = float(error @ np.linalg.solve(observation.covariance, error))
    return PoseError(float(np.linalg.norm(turn)), off, nees)


def second_earlier(truth: Pose, centre_m: Array, rng: np.random.Generator) -> Pose:
    """A prior off by at most 5°, and by 3 % of the range along and 1 % across the line of sight."""
    axis = rng.normal(size=3)
    turn = axis / np.linalg.norm(axis) * rng.uniform(0.0, _PRIOR_RAD)
    rotation = Rotation.from_rotvec(turn).as_matrix() @ truth.rotation
    centre = truth.apply(centre_m)
    range_m = float(np.linalg.norm(centre))
    centre = centre * (1.0 + rng.uniform(-_PRIOR_RANGE, _PRIOR_RANGE))
    centre[:2] += rng.uniform(-_PRIOR_BEARING, _PRIOR_BEARING, 2) * range_m
    return Pose(rotation, centre - rotation @ centre_m)


def campaign(
    model: ViewModel,
    mesh: Mesh,
    camera: Camera,
    path: Path,
    executor: ShardExecutor,
    options: CampaignOptions | None = None,
    progress: Progress | None = None,
) -> dict[str, Answers]:
    """Recognise random frames, each twice, and write every result to ``path`` (JSON lines).

    A frame shows the whole target at any attitude, anywhere in the picture. The first pass has no
    prior. The tracked look has a prior with an error of up to 5° about a random axis, 3 % of the
    range along the line of sight and 1 % across. Each frame has its own random numbers (seed,
    frame), so the bytes of the file depend on the inputs only. Finished shards are kept in
    ``path`` + ``.partial`` until the file is written.

    Returns:
        The results by look, in the order of the frames.

    Raises:
        RendezviewError: the file cannot be written; or an error of the executor.
    """
    options = options or CampaignOptions()
    check_place(path, "the answers")
    shards = Shards(path.with_name(path.name + ".partial"), _inputs(model, mesh, camera, options))
    parts = [(p,) for p in shares(options.frames, FRAMES_PER_SHARD)]
    shared = (model, mesh, camera, options)
    done = shards.run("frames", _look_at, shared, parts, executor, progress)
    table = {name: np.concatenate([a[name] for a in done], axis=1) for name in done[0]}
    answers = {}
    for k, look in enumerate(LOOKS):
        columns = {name: column[k] for name, column in table.items()}
        status = [_STATUSES[i] for i in columns.pop("status")]
        answers[look] = Answers(status=status, **columns)
    atomic_write_text(path, "".join(_lines(answers, options.frames)))
    shards.remove()
    return answers


def _look_at(
    model: ViewModel, mesh: Mesh, camera: Camera, options: CampaignOptions, frames: range
) -> Arrays:
    recognizer = _recognizer(model, camera)
    records = []
    for k in frames:
        rng = np.random.default_rng([options.seed, k])
        truth, image = _frame(model, mesh, camera, options, rng)
        prior = second_earlier(truth, model.centre_m, rng)
        records.append(
            [
                _answer(recognizer.recognize(image), truth, model),
                _answer(
                    recognizer.recognize(image, prior, _SEARCH_FACTOR * _PRIOR_RAD), truth, model
                ),
            ]
        )
    table = np.array(records).transpose(2, 1, 0)  # value, look, frame
    names = ("status", "confidence", "rotation_rad", "translation", "nees")
    arrays: Arrays = dict(zip(names, table, strict=True))
    return arrays | {"status": table[0].astype(np.uint8)}


class _Kept(threading.local):
    """The last recognizer of a thread: creating one takes as long as a frame."""

    recognizer: Recognizer | None = None


_kept = _Kept()


def _recognizer(model: ViewModel, camera: Camera) -> Recognizer:
    last = _kept.recognizer
    if last is None or last.model is not model or last.camera != camera:
        last = _kept.recognizer = Recognizer(model, camera)
    return last


def _frame(
    model: ViewModel,
    mesh: Mesh,
    camera: Camera,
    options: CampaignOptions,
    rng: np.random.Generator,
) -> tuple[Pose, npt.NDArray[np.uint8]]:
    """A random pose and its picture."""
    radius_m = model.target_radius_m
    near_m = radius_m * _MARGIN / math.sin(camera.half_fov_rad)
    depth_m = near_m * rng.uniform(*options.range_radii)
    # An upper bound on the width of the sphere's picture, so that the target is whole.
    half = np.array([camera.width / camera.fx, camera.height / camera.fy]) / 2.0
    room = np.maximum(half - math.tan(math.asin(radius_m * _MARGIN / depth_m)), 0.0)
    middle = (np.array([camera.width, camera.height]) - 1.0) / 2.0
    offset = (middle - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    bearing = offset + 0.9 * room * rng.uniform(-1.0, 1.0, 2)
    rotation = Rotation.random(random_state=rng).as_matrix()
    centre = np.array([*bearing, 1.0]) * depth_m
    pose = Pose(rotation, centre - rotation @ model.centre_m)
    phase, azimuth = rng.uniform(*options.sun_phase_rad), rng.uniform(0.0, 2.0 * math.pi)
    sun = sun_at_phase(centre, phase, azimuth)
    scene = SceneOptions(sky_frame="camera", shading=ShadingOptions(samples=options.samples))
    return pose, render_frame(mesh, camera, pose, sun, scene, rng)


def _answer(observation: AppearanceObservation, truth: Pose, model: ViewModel) -> list[float]:
    """Status, confidence, errors of rotation and translation, normalised error squared."""
    status = float(_STATUSES.index(observation.status))
    confidence = math.nan if observation.confidence is None else observation.confidence
    error = pose_error(observation, truth, model)
    if error is None:
        return [status, confidence, math.nan, math.nan, math.nan]
    return [status, confidence, error.rotation_rad, error.translation, error.nees]


def _lines(answers: dict[str, Answers], frames: int) -> list[str]:
    lines = []
    for k in range(frames):
        for look, answer in answers.items():
            record: dict[str, Any] = {"frame": k, "look": look, "status": str(answer.status[k])}
            for name in ("confidence", "rotation_rad", "translation", "nees"):
                value = float(getattr(answer, name)[k])
                record[name] = None if math.isnan(value) else value
            lines.append(json.dumps(record) + "\n")
    return lines


def _inputs(
    model: ViewModel, mesh: Mesh, camera: Camera, options: CampaignOptions
) -> dict[str, Any]:
    """The inputs that decide the results, except the code."""
    digest = hashlib.sha256()
    for array in (model.views.readings, model.forest.threshold, mesh.vertices_m, mesh.faces):
        digest.update(np.ascontiguousarray(array).tobytes())
    return {
        "model": model.provenance,
        "data": digest.hexdigest(),
        "camera": dataclasses.asdict(camera),
        "options": {k: v for k, v in dataclasses.asdict(options).items() if k != "frames"},
        "frames": options.frames,
    }
