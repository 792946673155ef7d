"""First poses with and without the search on sketches, in frames of our own simulator."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
from rendezview.simulation.background import Earth
from rendezview.simulation.scene import SceneOptions, render_frame, sun_at_phase
from rendezview.training.mesh import load_mesh
from scipy.spatial.transform import Rotation

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.geometry.symmetry import angle_between
from rendezview.sensors.appearance import Recognizer, ViewModel

RIGHT_DEG = 5.0
RANGE_RADII = (3.0, 7.0)
# Name, least and greatest angle Sun–target–camera in degrees, Earth behind.
LIGHTS = (
    ("low Sun", 0.0, 30.0, False),
    ("high Sun", 30.0, 75.0, False),
    ("Earth", 0.0, 60.0, True),
)


def run(model: Path, mesh: Path, *, frames: int = 200, seed: int = 902) -> None:
    """FRAMES of each light, random attitudes, 640 × 480 px and 53°; the MESH is in metres."""
    views, shape = ViewModel.load(model), load_mesh(mesh, "m")
    camera = Camera.from_fov(640, 480, np.deg2rad(53.0))
    recognizers = {kind: Recognizer(views, camera, sketch=kind) for kind in (True, False)}
    for name, least, most, earth in LIGHTS:
        errors: dict[bool, list[float]] = {True: [], False: []}
        times: dict[bool, list[float]] = {True: [], False: []}
        for k in range(frames):
            rng = np.random.default_rng([seed, k])
            rotation = Rotation.random(random_state=rng).as_matrix()
            line = np.array([*rng.uniform(-0.15, 0.15, 2), 1.0])
            centre = line * rng.uniform(*RANGE_RADII) * views.target_radius_m
            pose = Pose(rotation, centre - rotation @ views.centre_m)
            options = SceneOptions(earth=Earth(seed=k) if earth else None, sky_frame="camera")
            phase, azimuth = np.deg2rad(rng.uniform(least, most)), rng.uniform(0.0, 2.0 * np.pi)
            sun = sun_at_phase(centre, phase, azimuth)
            frame = render_frame(shape, camera, pose, sun, options, rng)
            for kind, recognizer in recognizers.items():
                began_s = time.perf_counter()
                found = recognizer.recognize(frame).pose
                times[kind].append(time.perf_counter() - began_s)
                errors[kind].append(
                    np.nan
                    if found is None
                    else np.rad2deg(angle_between(found, pose, views.symmetries))
                )
        for kind, some in errors.items():
            error = np.array(some)
            right = error < RIGHT_DEG
            way = "with" if kind else "without"
            print(
                f"{name}, {way} sketch: right {100 * right.mean():.1f} %, "
                f"wrong {100 * (error >= RIGHT_DEG).mean():.1f} %, "
                f"median {np.median(error[right]):.3f}°, {1e3 * np.median(times[kind]):.0f} ms"
            )
