"""Poses of targets that the border of the picture cuts, from near by or off to a side.

    python -m experiments pose-cut MODELS HST.obj hubble … [--count 60] [--seed 77] [--log LOG]

MODELS is a folder with a model ``<target>.rvm`` of each. Frames of our own simulator, 1024 × 1024,
Sun 0–60° from behind the camera, any attitude. Half of them are ``close``, the view centre 1.3 to
3.2 target radii away; the others ``off``, 4 to 10 radii away and about on the border. Each is
looked at as in ``pose-accuracy``: on its own, and from the true pose of a second earlier.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.spatial.transform import Rotation

from experiments.pose.accuracy import WRONG_DEG, compared
from rendezview.evaluation.campaign import second_earlier
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose
from rendezview.sensors.appearance import Recognizer, ViewModel
from rendezview.simulation import SceneOptions, render_frame, sun_at_phase
from rendezview.training.bundled import find_target
from rendezview.training.mesh import load_mesh

HALF_FIELD_RAD = np.deg2rad(15.0)
SEEN = ((0.0, 0.3), (0.3, 0.5), (0.5, 0.7), (0.7, 0.9), (0.9, 1.01))


def place(close: bool, radius_m: float, rng: np.random.Generator) -> Array:
    """(3,) the view centre in the camera frame."""
    if close:
        range_m = rng.uniform(1.3, 3.2) * radius_m
        off = rng.uniform(-0.1, 0.1, 2)
    else:
        range_m = rng.uniform(4.0, 10.0) * radius_m
        angle = rng.uniform(0.0, 2.0 * np.pi)
        off = np.array([np.cos(angle), np.sin(angle)])
        off /= np.abs(off).max()  # on a square
        off *= np.tan(HALF_FIELD_RAD) + rng.uniform(-0.9, 0.5) * radius_m / range_m
    return np.array([*(off * range_m), range_m])


def run(target: str, models: Path, count: int, seed: int) -> list[dict[str, Any]]:
    found = find_target(target)
    mesh = load_mesh(found.mesh_path, found.unit)
    model = ViewModel.load(models / f"{Path(target).stem}.rvm")
    camera = Camera.from_fov(1024, 1024, 2.0 * HALF_FIELD_RAD)
    recognizer = Recognizer(model, camera)
    rng = np.random.default_rng(seed)
    records = []
    for k in range(count):
        rotation = Rotation.random(random_state=int(rng.integers(1 << 30))).as_matrix()
        centre = place(k % 2 == 0, model.target_radius_m, rng)
        truth = Pose(rotation, centre - rotation @ model.centre_m)
        sun = sun_at_phase(centre, np.deg2rad(rng.uniform(0.0, 60.0)), rng.uniform(0.0, 6.28))
        image = render_frame(mesh, camera, truth, sun, SceneOptions(), rng, 0.0)
        prior = second_earlier(truth, model.centre_m, rng)
        for mode, observation in (
            ("first", recognizer.recognize(image)),
            ("tracked", recognizer.recognize(image, prior, np.deg2rad(6.0))),
        ):
            what = {"target": model.name, "condition": "off" if k % 2 else "close", "frame": k}
            records.append(what | {"mode": mode} | compared(observation, truth, model))
    return records


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("models", type=Path)
    parser.add_argument("targets", nargs="+")
    parser.add_argument("--count", type=int, default=60, help="frames of each target")
    parser.add_argument("--seed", type=int, default=77)
    parser.add_argument("--log", type=Path, help="every answer, JSON lines")
    arguments = parser.parse_args()
    records = [
        record
        for target in arguments.targets
        for record in run(target, arguments.models, arguments.count, arguments.seed)
    ]
    if arguments.log:
        arguments.log.write_text("".join(json.dumps(r) + "\n" for r in records))
    table = Table(title=f"cut by the border, seed {arguments.seed}")
    for head in ("frames", "of the outline in the picture", "n", "right", "wrong", "no pose"):
        table.add_column(head, justify="right")
    for mode in ("first", "tracked"):
        for condition in ("close", "off"):
            for low, high in SEEN:
                part = [
                    r
                    for r in records
                    if (r["mode"], r["condition"]) == (mode, condition)
                    and low <= (r["features"][6] if "features" in r else 0.0) < high
                ]
                right = sum(r.get("rotation_deg", 180.0) < WRONG_DEG for r in part)
                given = sum("rotation_deg" in r for r in part)
                counts = (len(part), right, given - right, len(part) - given)
                share = f"{low:.1f}–{min(high, 1.0):.1f}"
                table.add_row(f"{mode} {condition}", share, *map(str, counts))
    Console().print(table)
