"""Approaches to the client's ring through the real pipeline, kept as files; see fusion-approach.

A folder holds one run: ``truth.jsonl`` (camera_from_target every half second), and a log of each
sensor as the commands write it: ``appearance.jsonl`` (`rendezview track --log`), ``ring.jsonl``
(`rendezview ring -o`), ``laser.jsonl``.
"""

from __future__ import annotations

import math
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from experiments.frame import CLIENT, nees
from rendezview.fusion import Fusion, Measurement, PoseMeasurement, RingMeasurement
from rendezview.fusion.logs import LogContext, merged, read_log
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose
from rendezview.io.results import JsonLinesWriter, read_json_lines
from rendezview.io.sequences import Frame, open_sequence
from rendezview.io.target import DockingRing, Target
from rendezview.sensors.appearance import ViewModel
from rendezview.sensors.appearance.following import follow, record
from rendezview.sensors.observation import Status
from rendezview.sensors.ring import RingPrior
from rendezview.sensors.ring.prior_log import prior_of_pose
from rendezview.sensors.ring.run import follow as follow_ring
from rendezview.sensors.ring.run import record as ring_record
from rendezview_ground.fly.dynamics import wander
from rendezview_ground.mesh.mesh import load_mesh
from rendezview_ground.simulate import SceneOptions, render_frame, sun_at_phase
from rendezview_ground.simulate.bop_writer import BopSceneWriter
from rendezview_ground.simulate.ranger import Ranger, write_echoes
from rendezview_ground.simulate.shading import ShadingOptions
from rendezview_ground.simulate.trajectories import looking_at

CAMERA = Camera(1024, 1024, 800.0, 800.0, 511.5, 511.5)
FRAME_EVERY = 4  # of the true poses: 2 s
RANGER = Ranger((0.3, 0.0, 0.0), 0.02)  # beside the camera, along its boresight
SUN_PHASE_DEG = (10.0, 40.0)
PRIOR_ERROR_DEG = 8.0  # of the attitude that the recognizer is given at the start
SILENT_FRAMES = 5  # without a pose, where the body overflows: then the recognizer is switched off

DURATION_S, STEP_S = 240.0, 0.5
START_M, END_M = 60.0, 1.0  # camera to ring plane
POWER = 1.5  # distance − end ∝ (1 − t/T)^power
# σ of the camera off the axis, of the target's attitude and of the camera's, each axis
LATERAL_M, TARGET_RAD, POINTING_RAD = 0.06, math.radians(1.0), math.radians(0.3)
PERIOD_S = 200.0  # of all three


def approach(ring: DockingRing, rng: np.random.Generator) -> list[tuple[float, Pose]]:
    """Times with the true camera_from_target, along the ring's axis at a random roll.

    Without disturbances, the camera looks at the ring's centre along its axis.
    """
    times_s = STEP_S * np.arange(round(DURATION_S / STEP_S) + 1)
    left = np.maximum(1.0 - times_s / DURATION_S, 0.0)
    along_m = END_M + (START_M - END_M) * left**POWER
    lateral, turned, pointing = (
        wander(STEP_S, PERIOD_S, len(times_s), sigma, rng)
        for sigma in (np.full(2, LATERAL_M), np.full(3, TARGET_RAD), np.full(3, POINTING_RAD))
    )
    axis = ring.axis / np.linalg.norm(ring.axis)
    up = np.eye(3)[int(np.argmin(np.abs(axis)))]
    straight = looking_at(ring.centre_m + START_M * axis, ring.centre_m, up).rotation
    roll = Rotation.from_rotvec([0.0, 0.0, rng.uniform(0.0, 2.0 * math.pi)]).as_matrix()
    poses = []
    for k, time_s in enumerate(times_s):
        # Near contact the corridor narrows with the range.
        narrowed = min(1.0, along_m[k] / 10.0)
        place = np.array([*(narrowed * lateral[k]), along_m[k]])
        # The target rotates about its origin, together with the ring.
        origin = place - roll @ straight @ ring.centre_m
        facing = Pose(Rotation.from_rotvec(turned[k]).as_matrix() @ roll @ straight, origin)
        swung = Rotation.from_rotvec(narrowed * pointing[k]).as_matrix()
        poses.append((float(time_s), Pose(swung, np.zeros(3)) @ facing))
    return poses


def render_run(folder: Path, seed: int) -> None:
    """The frames, the ranger's echoes and the truth of one seed."""
    target = Target.load(CLIENT)
    assert target.docking_ring is not None
    mesh = load_mesh(target.mesh_path, target.unit)
    rng = np.random.default_rng([5, seed])
    poses = approach(target.docking_ring, rng)
    phase = math.radians(rng.uniform(*SUN_PHASE_DEG))
    first = poses[0][1]
    sun = sun_at_phase(first.apply(mesh.bounding_sphere[0]), phase, rng.uniform(0.0, 2 * math.pi))
    sun_target = first.rotation.T @ sun
    options = SceneOptions(shading=ShadingOptions(samples=2))
    write_echoes(folder / "laser.jsonl", mesh, poses, RANGER, seed)
    with BopSceneWriter(folder / "scene", CAMERA, overwrite=True) as scene:
        for k, (time_s, pose) in enumerate(poses[::FRAME_EVERY]):
            image = render_frame(mesh, CAMERA, pose, pose.rotation @ sun_target, options, rng)
            scene.add(k, image, pose, time_s)
    with JsonLinesWriter(folder / "truth.jsonl") as writer:
        for time_s, pose in poses:
            writer.write({"time_s": time_s, "pose": pose})


def track_run(folder: Path, seed: int, model: ViewModel) -> None:
    """The recognizer's log, as `rendezview track --log` writes it."""
    sequence = open_sequence(folder / "scene")
    truth = sequence.frames[0].camera_from_target
    assert truth is not None
    rng = np.random.default_rng([6, seed])
    tilt = rng.standard_normal(3)
    tilt *= math.radians(PRIOR_ERROR_DEG) / np.linalg.norm(tilt)
    prior = Pose(Rotation.from_rotvec(tilt).as_matrix() @ truth.rotation, truth.translation_m)
    half_field, silent = 0.5 * CAMERA.width / CAMERA.fx, 0
    with JsonLinesWriter(folder / "appearance.jsonl") as writer:
        for frame, observation in follow(model, sequence, prior=prior):
            writer.write(record(frame, observation))
            silent = 0 if observation.status is Status.OK else silent + 1
            depth_m = frame.camera_from_target.apply(model.centre_m)[2]
            if silent >= SILENT_FRAMES and model.target_radius_m / depth_m > half_field:
                break


def ring_run(folder: Path, model: ViewModel) -> None:
    """The ring detector's log, as `rendezview ring -o` writes it.

    Its prior of a frame is the forecast of the filter, as on board: the filter runs along, with the
    recognizer, the ranger, and the rings found so far.
    """
    ring, fusion = ring_of_client(), Fusion()
    pending = measurements_of(folder, ("appearance", "laser"), model)

    def prior(frame: Frame) -> RingPrior | None:
        while pending and pending[0].time_s <= frame.time_s:
            fusion.add(pending.pop(0))
        state = fusion.state_at(frame.time_s)
        if state.pose is None:
            return None
        return prior_of_pose(state.pose, state.covariance[:6, :6], ring)

    scene = open_sequence(folder / "scene")
    with JsonLinesWriter(folder / "ring.jsonl") as writer:
        readings = follow_ring(scene, ring.radius_m, prior=prior, circles=ring.circles)
        for frame, _, reading in readings:
            writer.write(ring_record(frame, reading))
            measurement = reading.measurement("ring", ring=ring)
            if measurement is not None:
                fusion.add(measurement)


def make_run(folder: Path, seed: int, model: ViewModel) -> None:
    """Makes a run that is not there: frames, recognizer, ring detector, ranger."""
    if (folder / "ring.jsonl").exists():
        return
    folder.mkdir(parents=True, exist_ok=True)
    render_run(folder, seed)
    track_run(folder, seed, model)
    ring_run(folder, model)
    shutil.rmtree(folder / "scene")


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


def load_run(folder: Path, model: ViewModel) -> Run:
    """The logs of a folder, as `rendezview fuse` reads them."""
    lines = read_json_lines(folder / "truth.jsonl")
    truth = {round(line["time_s"], 6): Pose.from_quat_wxyz(**line["pose"]) for line in lines}
    return Run(measurements_of(folder, ("appearance", "ring", "laser"), model), truth)


def measurements_of(folder: Path, sensors: tuple[str, ...], model: ViewModel) -> list[Measurement]:
    """The logs of some sensors, in the order of their times."""
    context = LogContext(ring_of_client(), model.beam_mesh() or ())
    return list(merged([read_log(folder / f"{name}.jsonl", name, context) for name in sensors]))


@dataclass(frozen=True)
class Sample:
    """Errors at one camera frame; NaN where a sensor said nothing."""

    time_s: float
    range_m: float  # camera to ring plane, true
    fused: Array  # place of the ring's centre (m), its depth (m), axis (rad), attitude (rad)
    single: dict[str, Array]  # the same of each sensor
    nees: float  # of the six of the pose


@dataclass(frozen=True)
class Flight:
    """One approach through the filter."""

    samples: list[Sample]
    starts: int

    @property
    def without_state(self) -> int:
        """Frames."""
        return sum(bool(np.isnan(s.fused[0])) for s in self.samples)


def four_errors(pose: Pose, truth: Pose, ring: DockingRing) -> Array:
    """(4,) place of the ring's centre (m), its depth (m), axis (rad), attitude (rad)."""
    off = pose.apply(ring.centre_m) - truth.apply(ring.centre_m)
    axis = _angle(pose.rotation @ ring.axis, truth.rotation @ ring.axis)
    return np.array([np.linalg.norm(off), abs(off[2]), axis, pose.angle_to(truth)])


def _angle(one: Array, other: Array) -> float:
    return float(np.arctan2(np.linalg.norm(np.cross(one, other)), one @ other))


def fly(run: Run) -> Flight:
    """All measurements through the filter in order of arrival, judged at the camera's frames."""
    ring, fusion, pending = ring_of_client(), Fusion(), list(run.measurements)
    samples: list[Sample] = []
    for time_s in sorted(run.truth)[::FRAME_EVERY]:
        spoke: dict[str, Measurement] = {}
        while pending and pending[0].time_s <= time_s:
            measurement = pending.pop(0)
            fusion.add(measurement)
            if measurement.time_s == time_s:
                spoke[measurement.sensor] = measurement
        samples.append(_sample(fusion, time_s, run.truth[time_s], spoke, ring))
    return Flight(samples, fusion.starts)


def _sample(
    fusion: Fusion, time_s: float, truth: Pose, spoke: dict[str, Measurement], ring: DockingRing
) -> Sample:
    estimate = fusion.state_at(time_s)
    pose, fused, squared = estimate.pose, np.full(4, np.nan), np.nan
    if pose is not None:
        fused = four_errors(pose, truth, ring)
        squared = nees(pose.delta_from(truth), estimate.covariance[:6, :6])
    single = {}
    for name, measurement in spoke.items():
        if isinstance(measurement, PoseMeasurement):
            single[name] = four_errors(measurement.pose, truth, ring)
        elif isinstance(measurement, RingMeasurement):
            # The better of the two circles: more than a ring on its own could choose.
            axis, centre = truth.rotation @ ring.axis, truth.apply(ring.centre_m)
            angles = [
                _angle(math.copysign(1.0, c.axis @ axis) * c.axis, axis)
                for c in measurement.candidates
            ]
            best = int(np.argmin(angles))
            off = measurement.candidates[best].centre_m - centre
            single[name] = np.array([np.linalg.norm(off), abs(off[2]), angles[best], np.nan])
        else:
            # That ranger's word on the ring: where the beam meets another thing, wrong by that.
            normal = truth.rotation @ ring.axis
            distance = normal @ (truth.apply(ring.centre_m) - measurement.origin_m)
            off_m = abs(measurement.range_m - distance / (normal @ measurement.direction))
            single[name] = np.array([np.nan, off_m, np.nan, np.nan])
    return Sample(time_s, float(truth.apply(ring.centre_m)[2]), fused, single, squared)
