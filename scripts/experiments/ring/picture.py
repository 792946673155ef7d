"""The picture of docs/ring.md: the client's ring in a simulated frame, as the sensor reads it.

python -m experiments ring-picture docs/pictures/ring.png
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import cv2
import numpy as np

from experiments.frame import MODELS_CAD
from rendezview.geometry.camera import Camera
from rendezview.io.target import Target
from rendezview.sensors.ring import RingPrior, RingSensor
from rendezview.sensors.ring.overlay import draw_reading
from rendezview.simulation import SceneOptions, TrajectoryOptions, render_frame, trajectory
from rendezview.training.mesh import load_mesh

CLIENT = MODELS_CAD / "client"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("output", type=Path)
    parser.add_argument("--seed", type=int, default=3)
    arguments = parser.parse_args()
    target = Target.load(CLIENT)
    ring = target.docking_ring
    assert ring is not None
    camera = Camera.from_fov(480, 400, math.radians(50.0))
    axis = np.array([-1.0, 0.3, 0.22])
    options = TrajectoryOptions(
        frames=1, start_range_m=4.3, approach_axis=tuple(axis / np.linalg.norm(axis)), hops=0
    )
    ((_, pose),) = trajectory("vbar", options)
    mesh = load_mesh(target.mesh_path, target.unit)
    sun = np.array([0.3, -0.35, -0.9])
    rng = np.random.default_rng(arguments.seed)
    image = render_frame(mesh, camera, pose, sun / np.linalg.norm(sun), SceneOptions(), rng)
    prior = RingPrior(centre_m=pose.apply(ring.centre_m), axis=pose.rotation @ ring.axis)
    reading = RingSensor(camera, ring.radius_m).update(0.0, image, prior)
    cv2.imwrite(str(arguments.output), draw_reading(image, reading, camera))
    if reading.circle is not None:
        far = np.linalg.norm(prior.centre_m)
        off = 100.0 * np.linalg.norm(reading.circle.centre_m - prior.centre_m) / far
        angle = math.degrees(math.acos(min(1.0, float(reading.circle.axis @ prior.axis))))
        print(f"centre off by {off:.3f} % of range, axis by {angle:.2f} degrees")
