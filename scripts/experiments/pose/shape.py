"""The shape of a craft that is not its CAD model, calibrated from frames of unknown pose."""

from __future__ import annotations

import dataclasses
import tempfile
from pathlib import Path
from typing import Annotated

import numpy as np
from joblib import Parallel, delayed
from rendezview.sensors.appearance.as_built import ShapeEstimator, strained
from rendezview.simulation import Earth, SceneOptions, ShadingOptions, render_frame, sun_at_phase
from rendezview.simulation.command import default_camera
from rendezview.training.job import train
from rendezview.training.mesh import Mesh, load_mesh
from rendezview.training.options import TrainingOptions
from scipy.spatial.transform import Rotation

from experiments.frame import mesh_of
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.sensors.appearance import Recognizer, ViewModel

PHASE_DEG = 30.0  # of the Sun, at most
RANGE_RADII = (3.0, 6.0)
PRIOR_RAD = 0.03  # error of the priors, each axis
SEARCH_DEG = 6.0
LENGTH_ERROR = 1e-3  # of the known length, one σ
# Name, least and greatest angle Sun–target–camera in degrees, Earth behind.
LIGHTS = (
    ("low Sun", 0.0, 30.0, False),
    ("high Sun", 30.0, 75.0, False),
    ("Earth", 0.0, 60.0, True),
)


def frame(mesh: Mesh, seed: int, k: int) -> tuple[np.ndarray, Pose]:
    """One frame of our own simulator with its pose."""
    rng = np.random.default_rng([seed, k])
    centre_m, radius_m = mesh.bounding_sphere
    rotation = Rotation.random(random_state=rng).as_matrix()
    ahead = np.array([0.0, 0.0, radius_m * rng.uniform(*RANGE_RADII)])
    phase, azimuth = np.deg2rad(rng.uniform(0.0, PHASE_DEG)), rng.uniform(0.0, 2.0 * np.pi)
    sun = sun_at_phase([0.0, 0.0, 1.0], phase, azimuth)
    scene = SceneOptions(sky_frame="camera", shading=ShadingOptions(samples=4))
    pose = Pose(rotation, ahead - rotation @ centre_m)
    return render_frame(mesh, default_camera(), pose, sun, scene, rng), pose


def judge(what: str, model: ViewModel, frames: list[tuple[np.ndarray, Pose]]) -> None:
    """Errors of poses from near the truth, and their covariance."""
    recognizer = Recognizer(model, default_camera())
    turns, shares, nees = [], [], []
    for k, (image, truth) in enumerate(frames):
        rng = np.random.default_rng(k)
        start = Rotation.from_rotvec(rng.normal(size=3) * PRIOR_RAD).as_matrix() @ truth.rotation
        prior = Pose(start, truth.translation_m)
        seen = recognizer.recognize(image, prior, np.deg2rad(SEARCH_DEG))
        if seen.pose is None or seen.covariance is None:
            continue
        turn = Rotation.from_matrix(truth.rotation @ seen.pose.rotation.T).as_rotvec()
        error = np.concatenate([turn, truth.translation_m - seen.pose.translation_m])
        turns.append(np.rad2deg(np.linalg.norm(turn)))
        shares.append(np.linalg.norm(error[3:]) / np.linalg.norm(truth.translation_m))
        nees.append(error @ np.linalg.solve(seen.covariance, error))
    print(
        f"{what}: given {len(turns)} of {len(frames)}, rotation {np.median(turns):.3f}° median, "
        f"{np.percentile(turns, 95):.2f}° 95 %, translation {100 * np.median(shares):.3f} % of "
        f"range, NEES median {np.median(nees):.1f}, mean {np.mean(nees):.1f}",
        flush=True,
    )


def run(
    mesh: Annotated[Path, "mesh of the craft, in metres"],
    *,
    stretch: Annotated[str, "of the model along its axes, over the craft's"] = "1.04,1,1",
    frames: Annotated[int, "for calibration; as many others judge"] = 100,
    seed: int = 77,
) -> None:
    """Train on a stretched mesh, calibrate on frames of the craft, judge on others.

    The poses of the calibration's frames are not known. Three models are judged: the stretched one,
    the calibrated one, and one calibrated with a known length along x (σ 0.1 %).
    """
    name, craft = mesh_of(str(mesh))
    factors = np.array([float(part) for part in stretch.split(",")])
    cad = dataclasses.replace(craft, vertices_m=craft.vertices_m * factors)
    drawn = Parallel(n_jobs=-1)(delayed(frame)(craft, seed, k) for k in range(2 * frames))
    seen, others = drawn[:frames], drawn[frames:]
    # The trees do not matter here.
    options = TrainingOptions(perturbed_views=1000, held_out_views=100, shadowed_silhouettes=False)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.rvm"
        train(cad, path, name=name, options=options)
        model = ViewModel.load(path)
    judge("as modelled", model, others)
    estimator = ShapeEstimator(model, default_camera())
    length = {0: (1.0 / factors[0] - 1.0, LENGTH_ERROR)}
    for what, known in (("calibrated", {}), ("calibrated, length along x known", length)):
        found = estimator.estimate([image for image, _ in seen], None, known)
        sigma = 100.0 * np.sqrt(np.diag(found.covariance))
        print(
            f"strain xx yy zz xy xz yz, %: {np.round(100.0 * found.components, 3)}, "
            f"σ {np.round(sigma, 3)}; {found.used} of {frames} frames"
        )
        judge(what, strained(model, found.strain, found.covariance), others)


def misfit(
    model: Annotated[Path, "trained on the mesh"],
    mesh: Annotated[Path, "of the craft, in metres"],
    *,
    frames: Annotated[int, "of each light and strain"] = 60,
    seed: int = 6,
) -> None:
    """How honest covariances are where nobody says that the mesh is wrong.

    The model is stretched along x by 0, 1 and 4 %, the frames show the craft itself.
    """
    craft = load_mesh(mesh, "m")
    exact = ViewModel.load(model)
    camera = Camera.from_fov(640, 480, np.deg2rad(53.0))
    for light, least, most, earth in LIGHTS:
        for stretch in (0.0, 0.01, 0.04):
            recognizer = Recognizer(strained(exact, np.diag([stretch, 0.0, 0.0])), camera)
            residuals, nees = [], []
            for k in range(frames):
                rng = np.random.default_rng([seed, k])
                image, truth = _lit_frame(craft, exact, camera, rng, least, most, earth)
                off = Rotation.from_rotvec(rng.normal(size=3) * PRIOR_RAD).as_matrix()
                start = off @ truth.rotation
                place = truth.apply(exact.centre_m) - start @ exact.centre_m
                seen = recognizer.recognize(image, Pose(start, place), np.deg2rad(SEARCH_DEG))
                if seen.pose is None or seen.found is None or seen.covariance is None:
                    continue
                turn = Rotation.from_matrix(truth.rotation @ seen.pose.rotation.T).as_rotvec()
                if np.linalg.norm(turn) > np.deg2rad(SEARCH_DEG):
                    continue  # a wrong pose, not an inaccurate one
                error = np.concatenate([turn, truth.translation_m - seen.pose.translation_m])
                nees.append(error @ np.linalg.solve(seen.covariance, error))
                residuals.append(seen.found.best.residual_px)
            print(
                f"{light}, model {100 * stretch:.0f} % longer: {len(nees)} poses, residual "
                f"{np.median(residuals):.3f} px median, NEES median {np.median(nees):.1f}, "
                f"mean {np.mean(nees):.1f}",
                flush=True,
            )


def _lit_frame(
    craft: Mesh, model: ViewModel, camera: Camera, rng: np.random.Generator,
    least_deg: float, most_deg: float, earth: bool,
) -> tuple[np.ndarray, Pose]:  # fmt: skip
    rotation = Rotation.random(random_state=rng).as_matrix()
    line = np.array([*rng.uniform(-0.15, 0.15, 2), 1.0])
    centre = line * model.target_radius_m * rng.uniform(*RANGE_RADII)
    phase, azimuth = np.deg2rad(rng.uniform(least_deg, most_deg)), rng.uniform(0.0, 2.0 * np.pi)
    pose = Pose(rotation, centre - rotation @ model.centre_m)
    scene = SceneOptions(earth=Earth() if earth else None)
    return render_frame(craft, camera, pose, sun_at_phase(centre, phase, azimuth), scene, rng), pose
