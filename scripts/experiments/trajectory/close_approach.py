"""Straight approaches until the target overflows the image."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
from rendezview.simulation import SceneOptions, render_frame, sun_at_phase
from rendezview.simulation.command import default_camera
from rendezview.simulation.trajectories import looking_at
from rendezview.training.mesh import Mesh, load_mesh
from scipy.spatial.transform import Rotation

from rendezview.geometry.pose import Pose
from rendezview.io.bundled import find_target
from rendezview.sensors.appearance import Recognizer, Tracker, ViewModel

FAR_RADII, NEAR_RADII, CLOSE_RADII = 3.0, 1.15, 1.6
WRONG_DEG = 5.0


def fly(model: ViewModel, mesh: Mesh, seed: int, frames: int) -> tuple[np.ndarray, np.ndarray]:
    """(N,) distances in target radii and (N,) errors in degrees, NaN where there is no pose."""
    rng = np.random.default_rng([77, seed])
    away = rng.normal(size=3)
    away /= np.linalg.norm(away)
    up = np.eye(3)[int(np.argmin(np.abs(away)))]
    camera = default_camera()
    radii = np.linspace(FAR_RADII, NEAR_RADII, frames)
    off_deg = np.full(frames, np.nan)
    tracker: Tracker | None = None
    for k, distance in enumerate(radii):
        place = model.centre_m + distance * model.target_radius_m * away
        truth = looking_at(place, model.centre_m, up)
        sun = sun_at_phase(truth.apply(model.centre_m), np.deg2rad(20.0), 1.0)
        image = render_frame(mesh, camera, truth, sun, SceneOptions(), rng)
        if tracker is None:
            tilt = Rotation.from_rotvec([0.03, -0.03, 0.02]).as_matrix()
            prior = Pose(tilt @ truth.rotation, truth.translation_m)
            tracker = Tracker(Recognizer(model, camera), prior)
        pose = tracker.update(float(k), image).pose
        if pose is not None:
            off_deg[k] = np.rad2deg(pose.angle_to(truth))
    return radii, off_deg


def run(
    model: Path, target: Annotated[str, "mesh, target.toml, or hubble, client, scole"], *,
    seeds: tuple[int, int] = (0, 6), frames: int = 60,
) -> None:  # fmt: skip
    """Straight approaches until the target overflows the image.

    From 3 to 1.15 target radii, each seed from another direction, 640 × 480 pixels, 53° across,
    drawn by our own simulator, the Sun 20° from behind the camera; the first prior is 3° off.
    Printed: frames with a pose within 5°, frames without a pose, wrong ones, and the median
    attitude error of all frames and of those nearer than 1.6 radii.
    """
    views = ViewModel.load(model)
    craft = find_target(target)
    mesh = load_mesh(craft.mesh_path, craft.unit)
    for seed in range(*seeds):
        radii, off_deg = fly(views, mesh, seed, frames)
        print(
            f"seed {seed}: {np.count_nonzero(off_deg < WRONG_DEG)} of {frames} held, "
            f"{np.count_nonzero(np.isnan(off_deg))} without a pose, "
            f"{np.count_nonzero(off_deg >= WRONG_DEG)} wrong; {np.nanmedian(off_deg):.3f}°, "
            f"{np.nanmedian(off_deg[radii < CLOSE_RADII]):.3f}° nearer than {CLOSE_RADII:g} radii"
        )
