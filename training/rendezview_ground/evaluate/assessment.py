"""How accurate a model is on its own craft: results on random simulated frames."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
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
_NUMBERS = ("confidence", "rotation_rad", "translation", "nees", "sigma_rad")  # of an answer
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

    @classmethod
    def of(cls, records: Sequence[dict[str, Any]]) -> Conditions:
        """From one line of each frame."""
        return cls(**{f.name: np.array([r[f.name] for r in records]) for f in fields(cls)})


@dataclass(frozen=True, slots=True, eq=False)
class Answers:
    """Results of K frames at one look. Errors of frames without a pose are NaN."""

    status: Sequence[Status]  # (K,)
    confidence: Array  # (K,)
    rotation_rad: Array  # (K,) to the nearest equivalent pose
    translation: Array  # (K,) of the view centre, as a share of its distance
    nees: Array  # (K,) normalised squared error; its mean is 6 if the covariance is right
    sigma_rad: Array  # (K,) of the attitude, that the pose claims: root of the trace

    @classmethod
    def of(cls, records: Sequence[dict[str, Any]]) -> Answers:
        """From the lines of one look."""
        numbers = {name: np.array([r[name] for r in records], dtype=float) for name in _NUMBERS}
        return cls(status=[Status(r["status"]) for r in records], **numbers)

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
    parts = [(p,) for p in shares(options.frames, FRAMES_PER_SHARD)]
    shared = (model, mesh, camera, options)
    with Shards(path, _inputs(model, mesh, camera, options)) as shards:
        done = shards.run("frames", _look_at, shared, parts, executor, progress)
        lines = [str(line) for shard in done for line in shard["lines"]]
        atomic_write_text(path, "".join(line + "\n" for line in lines))
        shards.remove()
    records = [json.loads(line) for line in lines]
    answers = {
        look: Answers.of([record for record in records if record["look"] == look]) for look in LOOKS
    }
    return Conditions.of(records[:: len(LOOKS)]), answers


def _look_at(
    model: ViewModel, mesh: Mesh, camera: Camera, options: AssessmentOptions, frames: range
) -> Arrays:
    recognizer = Recognizer(model, camera)
    lines = []
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
        shown = scene.conditions(model)
        for name, observation in zip(LOOKS, looks, strict=True):
            record = {"frame": k, "look": name, "status": str(observation.status)} | shown
            lines.append(json.dumps(record | _answer(observation, scene.pose, model)))
    return {"lines": np.array(lines)}


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

    def conditions(self, model: ViewModel) -> dict[str, Any]:
        """The values of `Conditions`."""
        centre = self.pose.apply(model.centre_m)
        range_m = float(np.linalg.norm(centre))
        return {
            "direction": (-self.pose.rotation.T @ centre / range_m).tolist(),
            "range_m": range_m,
            "sun_phase_rad": self.phase_rad,
            "earth": self.options.earth is not None,
        }


def _answer(
    observation: AppearanceObservation, truth: Pose, model: ViewModel
) -> dict[str, float | None]:
    """The values of `Answers` without the status; None where there are none."""
    error = pose_error(observation, truth, model)
    if error is None or observation.covariance is None:
        return dict.fromkeys(_NUMBERS) | {"confidence": observation.confidence}
    sigma_rad = math.sqrt(float(np.trace(observation.covariance[:3, :3])))
    return {"confidence": observation.confidence, **dataclasses.asdict(error),
            "sigma_rad": sigma_rad}  # fmt: skip


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
        "shards": "lines",
    }
