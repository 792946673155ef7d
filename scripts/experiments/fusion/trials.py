"""Approaches to the client's ring through the real pipeline, kept as files; see fusion-approach.

A folder holds one run: ``scene/`` (BOP frames with truth), ``truth.jsonl`` (camera_from_target
every half second), and a log of each sensor as the commands write it: ``appearance.jsonl``
(`rendezview track --log`), ``ring.jsonl`` (`rendezview ring -o`), ``laser.jsonl``.
"""

from __future__ import annotations

import math
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rendezview.simulation import SceneOptions, render_frame, sun_at_phase
from rendezview.simulation.approach import ApproachOptions, approach, echo
from rendezview.simulation.shading import ShadingOptions
from rendezview.training.mesh import load_mesh
from scipy.spatial.transform import Rotation

from experiments.frame import MODELS_CAD
from rendezview.errors import RendezviewError
from rendezview.fusion import (
    BeamSurface,
    Fusion,
    FusionOptions,
    Measurement,
    MotionOptions,
    PoseMeasurement,
    RingMeasurement,
    SensorOptions,
)
from rendezview.fusion.logs import LogContext, merged, read_log
from rendezview.geometry import so3
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose
from rendezview.io.results import JsonLinesWriter, read_json_lines
from rendezview.io.sequences import BopSceneWriter, Frame, Sequence, open_sequence
from rendezview.io.target import DockingRing, Target
from rendezview.sensors.appearance import ViewModel
from rendezview.sensors.appearance.following import follow, record
from rendezview.sensors.observation import Status
from rendezview.sensors.ring import RingPrior
from rendezview.sensors.ring.run import follow as follow_ring
from rendezview.sensors.ring.run import record as ring_record

CLIENT = MODELS_CAD / "client"
CAMERA = Camera(1024, 1024, 800.0, 800.0, 511.5, 511.5)
FRAME_EVERY = 4  # of the true poses: 2 s
LASER_SIGMA_M = 0.02
LASER_ORIGIN_M = (0.3, 0.0, 0.0)  # beside the camera, along its boresight
SUN_PHASE_DEG = (10.0, 40.0)
PRIOR_ERROR_DEG = 8.0  # of the attitude that the recognizer is given at the start
# Surfaces the beam can hit, as given to the filter: the heat shield between nozzle and adapter, the
# bus's face around the adapter, and, where neither is certain, something near them.
SURFACES = (
    BeamSurface(np.array([-1.43, 0.0, 0.0]), np.array([-1.0, 0.0, 0.0]), 0.02, 0.17, 0.43),
    BeamSurface(np.array([-1.40, 0.0, 0.0]), np.array([-1.0, 0.0, 0.0]), 0.04, 0.73, 1.05),
    BeamSurface(np.array([-1.50, 0.0, 0.0]), np.array([-1.0, 0.0, 0.0]), 0.15),
)
SILENT_FRAMES = 5  # without a pose, where the body overflows: then the recognizer is switched off


def render_run(folder: Path, seed: int) -> None:
    """The frames, the truth and the ranger's echoes of one seed, unless they are there."""
    if (folder / "truth.jsonl").exists():
        return
    folder.mkdir(parents=True, exist_ok=True)
    target = Target.load(CLIENT)
    assert target.docking_ring is not None
    mesh = load_mesh(target.mesh_path, target.unit)
    rng = np.random.default_rng([5, seed])
    poses = approach(target.docking_ring, ApproachOptions(), rng)
    phase = math.radians(rng.uniform(*SUN_PHASE_DEG))
    first = poses[0][1]
    sun = sun_at_phase(first.apply(mesh.bounding_sphere[0]), phase, rng.uniform(0.0, 2 * math.pi))
    sun_target = first.rotation.T @ sun
    options = SceneOptions(shading=ShadingOptions(samples=2))
    with JsonLinesWriter(folder / "laser.jsonl") as writer:
        for time_s, pose in poses:
            distance = echo(mesh, pose, LASER_ORIGIN_M, (0.0, 0.0, 1.0))
            noise = LASER_SIGMA_M * rng.standard_normal()
            writer.write(
                {
                    "time_s": time_s,
                    "range_m": None if distance is None else distance + noise,
                    "sigma_m": LASER_SIGMA_M,
                    "origin_m": LASER_ORIGIN_M,
                    "direction": (0.0, 0.0, 1.0),
                }
            )
    with BopSceneWriter(folder / "scene", CAMERA, overwrite=True) as scene:
        for k, (time_s, pose) in enumerate(poses[::FRAME_EVERY]):
            image = render_frame(mesh, CAMERA, pose, pose.rotation @ sun_target, options, rng)
            scene.add(k, image, pose, time_s)
    with JsonLinesWriter(folder / "truth.jsonl") as writer:
        for time_s, pose in poses:
            writer.write({"time_s": time_s, "pose": pose})


def track_run(folder: Path, seed: int, model: ViewModel) -> None:
    """The recognizer's log, as `rendezview track --log` writes it."""
    if (folder / "appearance.jsonl").exists():
        return
    sequence = open_sequence(folder / "scene")
    truth = sequence.frames[0].camera_from_target
    assert truth is not None
    rng = np.random.default_rng([6, seed])
    tilt = rng.standard_normal(3)
    tilt *= math.radians(PRIOR_ERROR_DEG) / np.linalg.norm(tilt)
    prior = Pose(Rotation.from_rotvec(tilt).as_matrix() @ truth.rotation, truth.translation_m)
    with JsonLinesWriter(folder / "appearance.jsonl") as writer:
        silent = 0
        for frame, observation in follow(model, sequence, prior=prior):
            writer.write(record(frame, observation))
            silent = 0 if observation.status is Status.OK else silent + 1
            if silent >= SILENT_FRAMES and _overflows(frame, model):
                break


def _overflows(frame: Frame, model: ViewModel) -> bool:
    truth = frame.camera_from_target
    if truth is None:
        return False
    half = 0.5 * CAMERA.width / CAMERA.fx
    return bool(model.target_radius_m / truth.apply(model.centre_m)[2] > half)


def make_run(folder: Path, seed: int, model: ViewModel | None, *, keep_frames: bool) -> None:
    """Makes the missing files of a run: frames, recognizer, ring detector, ranger."""
    logs = [folder / f"{name}.jsonl" for name in ("truth", "appearance", "ring", "laser")]
    if all(log.exists() for log in logs):
        return
    if model is None:
        raise RendezviewError(f"{folder}: this run is to be made: give --model")
    render_run(folder, seed)
    track_run(folder, seed, model)
    ring_run(folder)
    if not keep_frames:
        shutil.rmtree(folder / "scene")


def ring_run(folder: Path) -> None:
    """The ring detector's log, as `rendezview ring -o` writes it.

    Its prior of a frame is the forecast of the filter, as on board: the filter runs along, with the
    recognizer, the ranger, and the rings found so far.
    """
    if (folder / "ring.jsonl").exists():
        return
    ring = ring_of_client()
    context = LogContext(ring, SURFACES)
    others = [read_log(folder / f"{name}.jsonl", name, context) for name in ("appearance", "laser")]
    pending = merged(others)
    fusion = Fusion(OPTIONS)
    done = 0

    def prior(frame: Frame) -> RingPrior | None:
        nonlocal done
        assert frame.time_s is not None
        while done < len(pending) and pending[done].time_s <= frame.time_s:
            fusion.add(pending[done])
            done += 1
        estimate = fusion.state_at(frame.time_s)
        pose = estimate.pose
        if pose is None:
            return None
        centre = pose.apply(ring.centre_m)
        sight = centre / np.linalg.norm(centre)
        along = np.concatenate([np.cross(pose.rotation @ ring.centre_m, sight), sight])
        variance = float(along @ estimate.covariance[:6, :6] @ along)
        return RingPrior(centre, pose.rotation @ ring.axis, range_sigma_m=np.sqrt(variance))

    with JsonLinesWriter(folder / "ring.jsonl") as writer:
        for frame, _, reading in follow_ring(
            scene_of(folder), ring.radius_m, prior=prior, circles=ring.circles
        ):
            writer.write(ring_record(frame, reading))
            if frame.time_s is not None:
                measurement = reading.measurement("ring", ring=ring)
                if measurement is not None:
                    fusion.add(measurement)


def scene_of(folder: Path) -> Sequence:
    """The frames of a run."""
    return open_sequence(folder / "scene")


# Chosen on seeds 100 to 109; tables are of seeds 0 to 49.
OPTIONS = FusionOptions(
    # The wander of ApproachOptions, its rotation twice: the recognizer knows more of it than steady
    # rates do; along has the braking, which the filter does not know.
    motion=MotionOptions(angular=3.4e-4, linear=6e-4, along=5e-3, pointing=6e-5),
    pose=SensorOptions(
        # As exact as the recognizer is on the fast simulator's frames: seeds 100 to 105.
        inflation=0.4, floor_range=2e-5, bias_share=0.8, bias_s=60.0, bias_range=0.25
    ),
    ring=SensorOptions(
        inflation=4.0, floor_rad=math.radians(0.25), floor_range=5e-4, bias_share=0.8,
        bias_s=60.0, bias_range=0.35, gate=1e-3,
    ),
    range=SensorOptions(bias_s=10.0, bias_range=0.5),
    ring_radius_sigma=1e-3,  # the ring's edge as drawn has 72 corners
)  # fmt: skip


def ring_of_client() -> DockingRing:
    """The docking ring of the target."""
    ring = Target.load(CLIENT).docking_ring
    assert ring is not None
    return ring


@dataclass(frozen=True)
class Run:
    """The sensors' measurements in one approach, and the truth."""

    measurements: list[Measurement]
    truth: dict[float, Pose]  # by time


def load_run(folder: Path) -> Run:
    """The logs of a folder, as `rendezview fuse` reads them."""
    ring = ring_of_client()
    context = LogContext(ring, SURFACES)
    names = [n for n in ("appearance", "ring", "laser") if (folder / f"{n}.jsonl").exists()]
    logs = [read_log(folder / f"{name}.jsonl", name, context) for name in names]
    truth = {
        round(line["time_s"], 6): Pose.from_quat_wxyz(
            line["pose"]["quat_wxyz"], line["pose"]["translation_m"]
        )
        for line in read_json_lines(folder / "truth.jsonl")
    }
    return Run(merged(logs), truth)


def off_by(pose: Pose, truth: Pose) -> Array:
    """(6,) perturbation from truth to an estimate."""
    turn = so3.between(pose.rotation, truth.rotation)
    return np.concatenate([turn, pose.translation_m - truth.translation_m])


@dataclass(frozen=True)
class Sample:
    """Errors at one camera frame; NaN where a sensor said nothing."""

    time_s: float
    range_m: float  # camera to ring plane, true
    status: Status
    fused: Array  # place of the ring's centre (m), its depth (m), axis (rad), attitude (rad)
    single: dict[str, Array]  # the same of each sensor
    nees: float  # of the six of the pose
    sigma_m: float  # of the place, largest


@dataclass(frozen=True)
class Flight:
    """One approach through the filter."""

    samples: list[Sample]
    jumps: dict[str, float]  # largest step of an update over its σ: at hand-overs, and at all
    starts: int
    lockouts: dict[str, int]


def four_errors(pose: Pose, truth: Pose, ring: DockingRing) -> Array:
    """(4,) place of the ring's centre (m), its depth (m), axis (rad), attitude (rad)."""
    off = pose.apply(ring.centre_m) - truth.apply(ring.centre_m)
    axis = _angle(pose.rotation @ ring.axis, truth.rotation @ ring.axis)
    return np.array([np.linalg.norm(off), abs(off[2]), axis, pose.angle_to(truth)])


def _angle(one: Array, other: Array) -> float:
    return float(np.arctan2(np.linalg.norm(np.cross(one, other)), one @ other))


def fly(run: Run, options: FusionOptions) -> Flight:
    """All measurements through the filter in order of arrival, judged at the camera's frames."""
    ring = ring_of_client()
    fusion = Fusion(options)
    samples: list[Sample] = []
    jumps = {"hand-over": 0.0, "any": 0.0}
    last_s: dict[str, float] = {}
    frame_s = sorted(run.truth)[::FRAME_EVERY]
    pending = list(run.measurements)
    position = 0
    for time_s in frame_s:
        spoke: dict[str, Measurement] = {}
        while position < len(pending) and pending[position].time_s <= time_s:
            measurement = pending[position]
            position += 1
            before = fusion.state_at(measurement.time_s)
            verdict = fusion.add(measurement)
            if measurement.time_s == time_s:
                spoke[measurement.sensor] = measurement
            if not verdict.accepted:
                continue
            after = fusion.state_at(measurement.time_s)
            # The first of a sensor, and the first after another fell silent, are hand-overs.
            last = last_s.get(measurement.sensor)
            handed = last is None or measurement.time_s - last > 2.5 * FRAME_EVERY * 0.5
            last_s[measurement.sensor] = measurement.time_s
            if before.pose is None or after.pose is None or verdict.began:
                continue
            assert before.covariance is not None
            sigma = np.sqrt(np.diag(before.covariance)[:6])
            jump = float((np.abs(off_by(after.pose, before.pose)) / sigma).max())
            jumps["any"] = max(jumps["any"], jump)
            if handed or (
                measurement.sensor == "ring"
                and "appearance" in last_s
                and (
                    last_s["appearance"] < measurement.time_s
                    and last_s["appearance"] >= measurement.time_s - 2.5 * FRAME_EVERY * 0.5
                )
            ):
                jumps["hand-over"] = max(jumps["hand-over"], jump)
        samples.append(_sample(fusion, time_s, run.truth[time_s], spoke, ring))
    lockouts = {name: trust.lockouts for name, trust in fusion.trusts.items()}
    return Flight(samples, jumps, fusion.starts, lockouts)


def _sample(
    fusion: Fusion, time_s: float, truth: Pose, spoke: dict[str, Measurement], ring: DockingRing
) -> Sample:
    estimate = fusion.state_at(time_s)
    fused, nees, sigma_m = np.full(4, np.nan), np.nan, np.nan
    if estimate.pose is not None and estimate.covariance is not None:
        fused = four_errors(estimate.pose, truth, ring)
        off = off_by(estimate.pose, truth)
        covariance = estimate.covariance[:6, :6]
        nees = float(off @ np.linalg.solve(covariance, off))
        sigma_m = float(np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1]))
    single = {}
    for name, measurement in spoke.items():
        if isinstance(measurement, PoseMeasurement):
            single[name] = four_errors(measurement.pose, truth, ring)
        elif isinstance(measurement, RingMeasurement):
            # The better of the two circles: more than a ring on its own could choose.
            axis = truth.rotation @ ring.axis
            centre = truth.apply(ring.centre_m)
            errors = []
            for c in measurement.candidates:
                sign = 1.0 if c.axis @ axis > 0.0 else -1.0
                off = c.centre_m - centre
                errors.append([np.linalg.norm(off), abs(off[2]), _angle(sign * c.axis, axis)])
            best = min(errors, key=lambda e: e[2])
            single[name] = np.array([*best, np.nan])
        else:
            # That ranger's word on the ring: where the beam meets another thing, wrong by that.
            surface = SURFACES[0]
            normal = truth.rotation @ surface.normal
            distance = normal @ (truth.apply(surface.point_m) - measurement.origin_m)
            off_m = abs(measurement.range_m - distance / (normal @ measurement.direction))
            single[name] = np.array([np.nan, off_m, np.nan, np.nan])
    range_m = float(truth.apply(ring.centre_m)[2])
    return Sample(time_s, range_m, estimate.status, fused, single, nees, sigma_m)
