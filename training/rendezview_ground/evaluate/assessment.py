"""How accurate a model is on its own craft: results on random simulated frames."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from rendezview.estimation.motion import extrapolate
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose
from rendezview.geometry.symmetry import nearest_alike
from rendezview.io.files import atomic_write_text, check_place
from rendezview.sensors.appearance import AppearanceObservation, Recognizer, Tracker, ViewModel
from rendezview.sensors.observation import Status
from rendezview_ground.learn.jobs.shard_executor import ShardExecutor
from rendezview_ground.learn.jobs.stages import Arrays, Progress, Shards, shares
from rendezview_ground.limits import check, check_rising
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.simulate import SceneOptions, ShadingOptions, render_frame, sun_at_phase
from rendezview_ground.simulate.background import Earth

FRAMES_PER_SHARD = 16  # about a second of work
# What is known beside the frame: nothing; a pose to 5°; the Sun; a frame a few degrees before.
LOOKS = ("first", "tracked", "sun", "second")
WRONG_RAD = math.radians(5.0)  # attitude error above which a pose is wrong
_STATUSES = list(Status)
_MARGIN = 1.08  # factor on the bounding sphere, so that it stays off the border
_PRIOR_RAD = math.radians(5.0)  # largest attitude error of a prior
_PRIOR_RANGE, _PRIOR_BEARING = 0.03, 0.01  # of the range; largest errors of a prior
_SEARCH_FACTOR = 1.2  # allowance on the prior's error that the recognizer is given
_STEP_RAD = math.radians(5.0)  # turn from the frame before to the second
_STEP_RANGE = 0.02  # by which it was farther away, of the range
# Of the Earth's centre from the boresight, at most: its limb crosses half of the frames.
_EARTH_RAD = math.radians(70.0)


@dataclass(frozen=True, kw_only=True)
class AssessmentOptions:
    """Distribution of the frames."""

    frames: int = 1000
    sun_phase_rad: tuple[float, float] = (0.0, math.radians(30.0))  # Sun, target, camera
    range_radii: tuple[float, float] = (
        1.0,
        2.0,
    )  # of the range at which the target fills the picture
    earth: float = 0.0  # share of the frames with the Earth behind the target
    samples: int = 2  # of shading, per pixel and axis
    seed: int = 0

    def __post_init__(self) -> None:
        check(self, 1, 10_000_000, "frames")
        check(self, 0.0, math.pi, "sun_phase_rad")
        check(self, 1.0, math.inf, "range_radii")
        check(self, 0.0, 1.0, "earth")
        check(self, 1, 16, "samples")
        check(self, 0, math.inf, "seed")
        check_rising(self, "sun_phase_rad", "range_radii")


@dataclass(frozen=True, slots=True, eq=False)
class Conditions:
    """What K frames show."""

    direction: Array  # (K, 3) unit, from the view centre to the camera, target frame
    range_m: Array  # (K,) of the view centre
    sun_phase_rad: Array  # (K,) angle Sun, target, camera
    earth: npt.NDArray[np.bool_]  # (K,) whether the Earth is behind


@dataclass(frozen=True, slots=True, eq=False)
class Answers:
    """Results of K frames at one look. Errors of frames without a pose are NaN."""

    status: Sequence[Status]  # (K,)
    confidence: Array  # (K,)
    rotation_rad: Array  # (K,) to the nearest equivalent pose
    translation: Array  # (K,) of the view centre, as a share of its distance
    nees: Array  # (K,) normalised squared error; its mean is 6 if the covariance is right
    sigma_rad: Array  # (K,) of the attitude, that the pose claims: root of the trace

    @property
    def given(self) -> npt.NDArray[np.bool_]:
        """(K,) whether there is a pose."""
        return ~np.isnan(self.rotation_rad)

    @property
    def right(self) -> npt.NDArray[np.bool_]:
        """(K,) whether there is a pose with an attitude error below 5°."""
        return np.asarray(self.rotation_rad < WRONG_RAD)  # NaN compares as false

    @property
    def ambiguous(self) -> npt.NDArray[np.bool_]:
        """(K,) whether several poses show the same."""
        return np.array([one is Status.AMBIGUOUS for one in self.status])


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
    error = truth.delta_from(pose)
    centre = truth.apply(model.centre_m)
    off = float(np.linalg.norm(pose.apply(model.centre_m) - centre) / np.linalg.norm(centre))
    nees = float(error @ np.linalg.solve(observation.covariance, error))
    return PoseError(float(np.linalg.norm(error[:3])), off, nees)


def second_earlier(truth: Pose, centre_m: Array, rng: np.random.Generator) -> Pose:
    """A prior off by at most 5°, and by 3 % of the range along and 1 % across the line of sight."""
    axis = rng.normal(size=3)
    turn = axis / np.linalg.norm(axis) * rng.uniform(0.0, _PRIOR_RAD)
    centre = truth.apply(centre_m)
    move = centre * rng.uniform(-_PRIOR_RANGE, _PRIOR_RANGE)
    move[:2] += rng.uniform(-_PRIOR_BEARING, _PRIOR_BEARING, 2) * np.linalg.norm(centre)
    return extrapolate(truth, np.append(turn, move), 1.0, centre_m)


def assess(
    model: ViewModel,
    mesh: Mesh,
    camera: Camera,
    path: Path,
    executor: ShardExecutor,
    options: AssessmentOptions | None = None,
    progress: Progress | None = None,
) -> tuple[Conditions, dict[str, Answers]]:
    """Recognise random frames, each in four ways, and write every result to ``path`` (JSON lines).

    A frame shows the whole target at any attitude, anywhere in the picture. ``first`` knows nothing
    else. ``tracked`` has a prior with an error of up to 5° about a random axis, 3 % of the range
    along the line of sight and 1 % across. ``sun`` has the direction to the Sun, ``second`` a frame
    before, from 5° beside. Each frame has its own random numbers (seed, frame), so the bytes of the
    file depend on the inputs only. Finished shards are kept in ``path`` + ``.partial`` until the
    file is written.

    Returns:
        What the frames show, and the results by look, in the order of the frames.

    Raises:
        RendezviewError: the file cannot be written; or an error of the executor.
    """
    options = options or AssessmentOptions()
    check_place(path, "the answers")
    shards = Shards(path.with_name(path.name + ".partial"), _inputs(model, mesh, camera, options))
    parts = [(p,) for p in shares(options.frames, FRAMES_PER_SHARD)]
    shared = (model, mesh, camera, options)
    done = shards.run("frames", _look_at, shared, parts, executor, progress)
    table = {name: np.concatenate([a[name] for a in done], axis=1) for name in done[0]}
    seen = table.pop("seen")
    conditions = Conditions(seen[:3].T, seen[3], seen[4], seen[5] > 0.0)
    answers = {}
    for k, look in enumerate(LOOKS):
        columns = {name: column[k] for name, column in table.items()}
        status = [_STATUSES[i] for i in columns.pop("status")]
        answers[look] = Answers(status=status, **columns)
    atomic_write_text(path, "".join(_lines(conditions, answers)))
    shards.remove()
    return conditions, answers


def _look_at(
    model: ViewModel, mesh: Mesh, camera: Camera, options: AssessmentOptions, frames: range
) -> Arrays:
    recognizer = Recognizer(model, camera)
    records, seen = [], []
    for k in frames:
        rng = np.random.default_rng([options.seed, k])
        scene = _Scene.drawn(model, camera, options, rng)
        image = scene.render(mesh, camera, scene.pose, rng)
        prior = second_earlier(scene.pose, model.centre_m, rng)
        tracker = Tracker(recognizer)
        tracker.update(0.0, scene.render(mesh, camera, scene.before(model, rng), rng))
        looks = (
            recognizer.recognize(image),
            recognizer.recognize(image, prior, _SEARCH_FACTOR * _PRIOR_RAD),
            recognizer.recognize(image, sun_camera=scene.sun),
            tracker.update(1.0, image),
        )
        records.append([_answer(look, scene.pose, model) for look in looks])
        seen.append(scene.conditions(model))
    table = np.array(records).transpose(2, 1, 0)  # value, look, frame
    names = ("status", "confidence", "rotation_rad", "translation", "nees", "sigma_rad")
    arrays: Arrays = dict(zip(names, table, strict=True))
    return arrays | {"status": table[0].astype(np.uint8), "seen": np.transpose(seen)}


@dataclass(frozen=True, slots=True, eq=False)
class _Scene:
    """A random pose, and the light and sky of its picture."""

    pose: Pose
    sun: Array  # (3,) towards it, camera frame
    phase_rad: float
    options: SceneOptions

    @classmethod
    def drawn(
        cls, model: ViewModel, camera: Camera, options: AssessmentOptions, rng: np.random.Generator
    ) -> _Scene:
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
        phase, azimuth = rng.uniform(*options.sun_phase_rad), rng.uniform(0.0, 2.0 * math.pi)
        sun = sun_at_phase(centre, phase, azimuth)
        earth, off = None, rng.uniform(0.0, _EARTH_RAD)
        around = rng.uniform(0.0, 2.0 * math.pi)
        below = (math.sin(off) * math.cos(around), math.sin(off) * math.sin(around), math.cos(off))
        if rng.random() < options.earth:
            earth = Earth(seed=int(rng.integers(2**31)))
        scene = SceneOptions(
            sky_frame="camera", earth=earth, earth_direction_sky=below,
            shading=ShadingOptions(samples=options.samples),
        )  # fmt: skip
        return cls(Pose(rotation, centre - rotation @ model.centre_m), sun, phase, scene)

    def render(
        self, mesh: Mesh, camera: Camera, pose: Pose, rng: np.random.Generator
    ) -> npt.NDArray[np.uint8]:
        return render_frame(mesh, camera, pose, self.sun, self.options, rng)

    def before(self, model: ViewModel, rng: np.random.Generator) -> Pose:
        """The pose of the frame before: turned by 5° about a random axis, and farther away."""
        axis = rng.normal(size=3)
        turn = _STEP_RAD * axis / np.linalg.norm(axis)
        move = _STEP_RANGE * self.pose.apply(model.centre_m)
        return extrapolate(self.pose, np.append(turn, move), 1.0, model.centre_m)

    def conditions(self, model: ViewModel) -> list[float]:
        """Direction, range, phase, Earth: a column of `Conditions`."""
        centre = self.pose.apply(model.centre_m)
        range_m = float(np.linalg.norm(centre))
        direction = -self.pose.rotation.T @ centre / range_m
        return [*direction, range_m, self.phase_rad, float(self.options.earth is not None)]


def _answer(observation: AppearanceObservation, truth: Pose, model: ViewModel) -> list[float]:
    """Status, confidence, errors of rotation and translation, normalised error squared, σ."""
    status = float(_STATUSES.index(observation.status))
    confidence = math.nan if observation.confidence is None else observation.confidence
    error = pose_error(observation, truth, model)
    if error is None or observation.covariance is None:
        return [status, confidence, math.nan, math.nan, math.nan, math.nan]
    sigma_rad = math.sqrt(float(np.trace(observation.covariance[:3, :3])))
    return [status, confidence, error.rotation_rad, error.translation, error.nees, sigma_rad]


def _lines(seen: Conditions, answers: dict[str, Answers]) -> list[str]:
    lines = []
    for k in range(len(seen.range_m)):
        shown = {
            "direction": seen.direction[k].tolist(),
            "range_m": float(seen.range_m[k]),
            "sun_phase_rad": float(seen.sun_phase_rad[k]),
            "earth": bool(seen.earth[k]),
        }
        for look, answer in answers.items():
            record: dict[str, Any] = {"frame": k, "look": look, "status": str(answer.status[k])}
            record |= shown
            for name in ("confidence", "rotation_rad", "translation", "nees", "sigma_rad"):
                value = float(getattr(answer, name)[k])
                record[name] = None if math.isnan(value) else value
            lines.append(json.dumps(record) + "\n")
    return lines


def _inputs(
    model: ViewModel, mesh: Mesh, camera: Camera, options: AssessmentOptions
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
