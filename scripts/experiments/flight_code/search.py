"""Direction of view that the C code finds, by the error of the prior attitude."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Annotated

import numpy as np
from rendezview.sensors.appearance.outline.signature import Signature
from rendezview.training.mesh import load_mesh
from rich.table import Table
from scipy.spatial.transform import Rotation

from experiments.flight_code.driver import ActiveNodes, FlightCode, build
from experiments.frame import show
from experiments.recognition.accuracy import WRONG_DEG, flight_camera, frame_of, random_pose
from rendezview.geometry.geodesic import angle_between
from rendezview.geometry.pose import Array
from rendezview.io.target import Target
from rendezview.sensors.appearance import ViewModel
from rendezview.sensors.appearance.outline.votes import Match, Matcher, MatchOptions
from rendezview.sensors.observation import Status

ERRORS_DEG = (0.0, 2.0, 5.0, 10.0, 20.0)
WAYS = ("rdv_search", "rdv_search_around", "the runtime's matcher")


def error_deg(found: ActiveNodes | Match | Status | str | None, truth: Array) -> float:
    """Degrees off the true direction; infinite without one."""
    if not isinstance(found, ActiveNodes | Match):
        return np.inf
    return float(np.rad2deg(angle_between(found.direction, truth)))


def run(
    model: Path, target: Annotated[Path, "target of the model: folder or target.toml"], *,
    frames: int = 400, seed: int = 77,
) -> None:  # fmt: skip
    """Direction of view that the C code finds, by the error of the prior attitude.

    Frames are those of condition (d) of recognition-accuracy: 640 × 480, 1-3 sphere radii, hard
    shadows, blur, noise of 3 grey levels, the Sun up to 30° from behind the camera. The prior
    attitude is off by exactly the error given, about a random axis. rdv_search evaluates each node
    once, at the prior's roll; rdv_search_around tries the rolls that the error allows; the
    runtime's matcher finds the roll in stored signatures, which flight code does not carry. A
    direction more than 8° off is wrong; a frame without a direction counts as not right.
    """
    view_model = ViewModel.load(model)
    craft = Target.load(target)
    mesh = load_mesh(craft.mesh_path, craft.unit)
    camera, matcher = flight_camera(mesh), Matcher(view_model)
    near_rad = (MatchOptions().margin_edges + 2.0) * view_model.geodesic.mean_edge_rad
    rng = np.random.default_rng([seed, 10])
    errors: dict[tuple[float, str], list[float]] = {}
    with (
        tempfile.TemporaryDirectory() as folder,
        FlightCode(build(view_model, Path(folder), ["-O2"]), view_model) as code,
    ):
        for _ in range(frames):
            _, pose = random_pose(view_model, camera, rng)
            image = frame_of(mesh, view_model, camera, pose, (0.0, 30.0), rng)
            visible = code.frame(image, camera)
            signature = visible[1] if isinstance(visible, tuple) else visible
            for prior_deg in ERRORS_DEG:
                axis = rng.normal(size=3)
                turn = np.deg2rad(prior_deg) * axis / np.linalg.norm(axis)
                if not isinstance(signature, Signature):
                    for way in WAYS:
                        errors.setdefault((prior_deg, way), []).append(np.inf)
                    continue
                true = signature.centred_from_camera @ pose.rotation
                prior = Rotation.from_rotvec(turn).as_matrix() @ true
                prior_rad = np.deg2rad(prior_deg)
                reach_rad = max(near_rad, prior_rad + 1.2 * view_model.geodesic.mean_edge_rad)
                answers = (
                    code.search(signature.readings, prior, reach_rad),
                    code.search_around(signature.readings, prior, prior_rad),
                    matcher.match(signature, prior, prior_rad),
                )
                for way, found in zip(WAYS, answers, strict=True):
                    off = error_deg(found, -true[2])
                    errors.setdefault((prior_deg, way), []).append(off)
    table = Table(title=f"{frames} frames of {view_model.name}, seed {seed}: "
                        f"median, within {WRONG_DEG:.0f}°")  # fmt: skip
    table.add_column("prior off by", justify="right")
    for way in WAYS:
        table.add_column(way, justify="right")
    for prior_deg in ERRORS_DEG:
        cells = []
        for way in WAYS:
            off = np.array(errors[prior_deg, way])
            cells.append(f"{np.median(off):.1f}°  {100.0 * np.mean(off < WRONG_DEG):.1f} %")
        table.add_row(f"{prior_deg:.0f}°", *cells)
    show(table, width=100)
