"""Tracking and the service need no loop, of any types of arguments, that is not in the list."""

from __future__ import annotations

import json
import subprocess
import sys

import cv2
from tests.sensors.appearance.sketch.test_search import hard_frame
from tests.waiting import MOST_S

from rendezview.cli import compiling
from rendezview_ground.simulate.scene import SceneOptions, simulate
from rendezview_ground.simulate.trajectories import TrajectoryOptions, trajectory

_TRACK = """
import json, sys
from experiments.startup import session
from experiments.startup.recorded import recorded
from rendezview.io.sequences import open_sequence
from rendezview.sensors.appearance import ViewModel
from rendezview.sensors.appearance.following import follow

model, sequence = ViewModel.load(sys.argv[1]), open_sequence(sys.argv[2])

def work():
    for prior in (None, sequence.frames[0].camera_from_target):
        for frame, observation in follow(model, sequence, prior=prior):
            print(observation.status, observation.reason, file=sys.stderr)

serve = recorded(lambda: (session.track(model), session.fuse(), session.sense()))
print(json.dumps({"track": recorded(work), "serve": serve}))
"""


def test_every_loop_of_tracking_and_of_the_service_is_listed(
    tmp_path, bumpy_mesh, camera, refining_model
):
    model, scene = tmp_path / "bumpy.rvm", tmp_path / "scene"
    refining_model.save(model)
    start_m = 2.0 * refining_model.sphere_radius_m
    path = trajectory(
        "spiral", TrajectoryOptions(frames=5, start_range_m=start_m, end_range_m=0.8 * start_m)
    )
    simulate(bumpy_mesh, camera, path, SceneOptions(), scene, 0)
    first, *_, last = sorted(p for p in scene.rglob("*.png") if "mask" not in p.parent.name)
    assert cv2.imread(str(first), cv2.IMREAD_GRAYSCALE).shape == (camera.height, camera.width)
    hard, _ = hard_frame(bumpy_mesh, refining_model, camera, 3)
    cv2.imwrite(str(last), hard)
    command = [sys.executable, "-c", _TRACK, str(model), str(scene)]
    run = subprocess.run(command, capture_output=True, text=True, check=True, timeout=MOST_S)
    called = {
        command: [(e["loop"], e["arguments"]) for e in entries]
        for command, entries in json.loads(run.stdout.splitlines()[-1]).items()
    }
    names = {name.rpartition(":")[2] for loops in called.values() for name, _ in loops}
    assert {"align", "shading", "mean_shift", "align_to_sketch"} <= names, run.stderr
    assert {"fit_steps", "judge", "normal_equations", "first_hits"} <= names, run.stderr
    for command, loops in called.items():
        groups = map(compiling.load_loops, compiling.COMMANDS[command])
        listed = [(e["loop"], e["arguments"]) for group in groups for e in group]
        assert [each for each in loops if each not in listed] == [], command
