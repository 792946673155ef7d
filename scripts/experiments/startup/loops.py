"""Lists the loops that commands compile, for ``rendezview.cli.compiling``."""

from __future__ import annotations

import itertools
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import numpy as np

import rendezview as rv
from experiments.frame import ROOT, mesh_of
from experiments.startup import session
from experiments.startup.recorded import recorded
from experiments.stereo.accuracy import leds_of, spots_of
from rendezview.calibration.laboratory import calibrate_laboratory
from rendezview.cli.compiling import COMMANDS
from rendezview.sensors.appearance import AppearanceObservation
from rendezview.sensors.appearance.following import follow, result_row
from rendezview.sensors.beacons import MotionOptions, SixNumbers, TrackerOptions, pose_of
from rendezview.sensors.beacons.run import Mode, pair_up, record
from rendezview.sensors.beacons.run import follow as read
from rendezview_ground.evaluate.pictures.contact import fuse_to_contact
from rendezview_ground.learn import job
from rendezview_ground.simulate.command import default_camera
from rendezview_ground.simulate.led_laboratory import Laboratory, LaboratoryOptions
from rendezview_ground.simulate.ranger import Ranger, write_echoes
from rendezview_ground.simulate.reflector_scene import simulate_reflectors, without_mesh
from rendezview_ground.simulate.scene import SceneOptions
from rendezview_ground.simulate.trajectories import TrajectoryOptions, trajectory

# Few nodes, but views enough that lists of shown faces are made. Source: by construction
_SMALL = rv.TrainingOptions(order=1, perturbed_views=6000, held_out_views=100, contour_radii=(1.0,))
LIST = ROOT / "runtime/rendezview/cli/loops.json"


def track(model: Path, scene: Path) -> list[dict[str, Any]]:
    """The loops of a first pose, and of the frame after it."""
    loaded, sequence = rv.ViewModel.load(model), rv.open_sequence(scene)

    def work() -> None:
        for frame, observation in itertools.islice(follow(loaded, sequence), 2):
            result_row(sequence.scene_id, frame, observation)

    return recorded(work)


def hard(model: Path, scene: Path) -> list[dict[str, Any]]:
    """The loops of ``rendezview track``, without a prior and with one."""
    loaded, sequence = rv.ViewModel.load(model), rv.open_sequence(scene)

    def work() -> None:
        for prior in (None, sequence.frames[0].camera_from_target):
            for frame, observation in follow(loaded, sequence, prior=prior):
                result_row(sequence.scene_id, frame, observation)

    return recorded(work)


def train(model: Path, scene: Path) -> list[dict[str, Any]]:
    """The loops of ``rendezview train``; the model and the scene are not used."""
    name, mesh = mesh_of("hubble")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "hubble.rvm"
        return recorded(lambda: job.train(mesh, path, name=name, options=_SMALL, jobs=1))


def demo(model: Path, scene: Path) -> list[dict[str, Any]]:
    """The loops of simulation, ring and fusion; the model and the scene are not used."""
    ring, (_, mesh) = rv.find_target("client").docking_ring, mesh_of("client")
    assert ring is not None
    straight = TrajectoryOptions(
        frames=8, start_range_m=40.0, end_range_m=2.0, centre_m=tuple(ring.centre_m),
        approach_axis=tuple(ring.axis), hops=0,
    )  # fmt: skip
    path = trajectory("vbar", straight)

    def work() -> None:
        with tempfile.TemporaryDirectory() as name:
            folder, spread = Path(name), 1e-4 * np.eye(6)
            rv.simulate(mesh, default_camera(), path, SceneOptions(), folder / "scene", 0)
            laser = folder / "laser.jsonl"
            write_echoes(laser, mesh, path, Ranger((0.1, 0.0, 0.0), 0.01), 0)
            frames = rv.open_sequence(folder / "scene").frames
            poses = [
                AppearanceObservation(
                    time_s=f.time_s,
                    status=rv.Status.OK,
                    pose=f.camera_from_target,
                    covariance=spread,
                )
                for f in frames
            ]
            log, video = folder / "state.jsonl", folder / "ring.webm"
            wall = rv.BeamMesh(mesh.vertices_m, mesh.faces)
            fuse_to_contact(frames, poses, ring, laser, mesh=wall, log=log, video=video)

    return recorded(work)


def reflectors(model: Path, scene: Path) -> list[dict[str, Any]]:
    """The loops of ``rendezview reflectors``; the model and the scene are not used."""
    target, camera = rv.find_target("client"), rv.Camera(512, 384, 651.975, 651.975, 255.5, 191.5)
    patterns, options = rv.patterns_of(target), SceneOptions()
    steps = (SixNumbers(4.0 - 0.1 * k, 0.02, 0.04, 0.02 * k, 0.1, 0.1) for k in range(6))
    poses = [(0.5 * k, pose_of(six, patterns[0])) for k, six in enumerate(steps)]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        simulate_reflectors(without_mesh(target), target, camera, poses, options, folder, 0)
        taken = [rv.open_sequence(folder / picture) for picture in ("lit", "dark")]

        def work() -> None:
            for sequences, mode in ((taken, Mode.SPLITTER), (taken[:1], Mode.SINGLE)):
                for independent in (False, True):
                    pairs = pair_up(sequences, mode)
                    for pair, frames, seen in read(pairs, patterns, independent=independent):
                        record(pair, seen, patterns, None, frames)

        return recorded(work)


def stereo(model: Path, scene: Path) -> list[dict[str, Any]]:
    """The loops of ``rendezview stereo track``; the model and the scene are not used."""
    target = rv.find_target("scole")
    made = Laboratory(leds_of(target), LaboratoryOptions(signal_to_noise=1000.0), seed=71)
    rng = np.random.default_rng(1)
    rig = calibrate_laboratory(made.calibration(rng, scans=4)).rig
    currents = made.currents(made.stage(np.deg2rad(np.arange(0.0, 20.0, 2.0))), rng)
    currents[4] = np.nan

    def work() -> None:
        for motion in (None, MotionOptions(angular_acceleration=0.02, linear_acceleration=0.02)):
            options = TrackerOptions(motion=motion)
            tracker = rv.StereoTracker.of_target(rig, target, options)
            for k, seen in enumerate(currents):
                tracker.update(0.1 * k, spots_of(rig, seen)).record()

    return recorded(work)


def sensors(model: Path, scene: Path) -> list[dict[str, Any]]:
    """The loops of a session of the service beside those of `track`; nothing given is used."""

    def work() -> None:
        session.fuse()
        session.sense()

    return recorded(work)


GROUPS: dict[str, Callable[[Path, Path], list[dict[str, Any]]]] = {
    "train": train, "track": track, "hard": hard, "demo": demo, "reflectors": reflectors,
    "stereo": stereo,
    "sensors": sensors,
}  # fmt: skip


def run(
    model: Path, scene: Path, *, add: Annotated[bool, "keep the loops that are listed"] = False
) -> None:
    """Write the list of the loops that commands compile, with the seconds that each takes.

    MODEL is tracked through SCENE in a process with an empty cache, and so is a small training.
    Two frames of it, which should be easy, give what a first pose needs. Easy frames and hard
    ones, models with a forest and without, need different loops: --add.
    """
    found = json.loads(LIST.read_text()) if LIST.exists() else {}
    for name in GROUPS:
        known = found.get(name, []) if add else []
        before = [set(of[: of.index(name)]) for of in COMMANDS.values() if name in of]
        earlier = set.intersection(*before)  # for every command that calls this group
        listed = {_key(e) for group in earlier for e in found[group]} | set(map(_key, known))
        found[name] = known + [e for e in _called(name, model, scene) if _key(e) not in listed]
        seconds = sum(entry["seconds"] for entry in found[name])
        print(f"{name}: {len(found[name])} loops, {seconds:.0f} s")
    groups = [
        f' "{name}": [\n' + ",\n".join(f"  {json.dumps(entry)}" for entry in found[name]) + "\n ]"
        for name in sorted(found)
    ]
    LIST.write_text("{\n" + ",\n".join(groups) + "\n}\n")


def _called(group: str, model: Path, scene: Path) -> list[dict[str, Any]]:
    """The loops that a group calls, and the seconds of each; 0 if another loop contains it.

    The first run compiles. The second finds all loops in the cache: only then numba has to ask for
    a loop that was compiled as a part of another.
    """
    command = [sys.executable, "-m", "experiments.startup.loops", group, model, scene]
    with tempfile.TemporaryDirectory() as cache:
        environment = os.environ | {"NUMBA_CACHE_DIR": cache}
        runs = [subprocess.check_output(command, env=environment, text=True) for _ in range(2)]
    compiled, called = (json.loads(said.splitlines()[-1]) for said in runs)
    seconds = {_key(entry): max(entry["seconds"], 0.1) for entry in compiled}
    return [entry | {"seconds": seconds.get(_key(entry), 0.0)} for entry in called]


def _key(entry: dict[str, Any]) -> str:
    return json.dumps([entry["loop"], entry["arguments"]])


if __name__ == "__main__":
    print(json.dumps(GROUPS[sys.argv[1]](Path(sys.argv[2]), Path(sys.argv[3]))))
