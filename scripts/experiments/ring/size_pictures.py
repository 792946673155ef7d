"""`ring size` on a drawn fly-around: pictures, a beam on the mesh, R and D_f from them."""

from __future__ import annotations

import math
import tempfile
from pathlib import Path
from typing import Annotated

import numpy as np
import trimesh
from rendezview.simulation.ranger import Ranger, write_echoes
from rendezview.simulation.scene import SceneOptions, render_frame
from rendezview.simulation.trajectories import looking_at
from rendezview.training.mesh import Mesh
from scipy.spatial.transform import Rotation

from experiments.frame import nees, show, table_of
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Pose
from rendezview.io.results import read_json_lines
from rendezview.io.sequences import BopSceneWriter, open_sequence
from rendezview.sensors.ring.size_run import SizeResult, measure_pass, read_echoes

RADIUS_M, WIDTH_M, DISTANCE_M = 0.597, 0.12, 1.68
SIDES = 360  # of the drawn ring: a polygon within 0.003 % of a circle
PANEL_M = (8.0, 2.4)  # the method does not know it
RANGE_M = 12.0
CAMERA = Camera.from_fov(1024, 1024, math.radians(42.0))
RANGER = Ranger((0.15, 0.1, 0.0), 0.005)
ARCS_DEG = ((-50.0, -25.0), (25.0, 50.0))  # the pass begins again on the other side of the ring
POINTING_RAD = math.radians(0.4)


def run(
    *,
    seed: int = 62,
    passes: int = 4,
    frames: Annotated[int, "of a pass"] = 20,
    keep: Annotated[Path | None, "a folder for the pictures of the passes"] = None,
) -> None:
    """R and D_f of a ring before a panel, from drawn pictures and a beam that meets the mesh.

    1024 × 1024 px over 42°, 12 m, two arcs of a fly-around in the panel's long plane, Sun 20 to 40°
    off the camera. The ring's axis is up to 8 cm off the panel's middle, which is estimated too.
    """
    title = f"drawn fly-around, {passes} passes of {frames} frames, seed {seed}"
    rows = table_of(
        title,
        "pass | used of measured | R, % | D_f, % | offset, mm (truth) | σ R, % | σ D_f, %"
        " | NEES of R and D_f",
    )
    found = []
    for number in range(passes):
        rng = np.random.default_rng([seed, number])
        offset = rng.uniform(-0.08, 0.08, 2)
        with tempfile.TemporaryDirectory() as scratch:
            folder = Path(scratch) if keep is None else keep / f"{number:02d}"
            result = _pass(folder, offset, frames, rng, [seed, number])
        size = result.size
        if size is None:
            rows.add_row(str(number), f"– of {result.measured}", result.reason, *["–"] * 5)
            continue
        error = np.array([size.radius_m - RADIUS_M, size.distance_m - DISTANCE_M])
        spread = nees(error, size.covariance[:2, :2])
        found.append((*np.abs(error) / (RADIUS_M, DISTANCE_M), spread))
        sigma = np.sqrt(np.diag(size.covariance))
        places = ", ".join(
            f"{1e3 * a:.0f} ({1e3 * b:.0f})" for a, b in zip(size.offset_m, offset, strict=True)
        )
        rows.add_row(
            str(number),
            f"{len(size.used)} of {result.measured}",
            f"{100.0 * error[0] / RADIUS_M:+.3f}",
            f"{100.0 * error[1] / DISTANCE_M:+.3f}",
            places,
            f"{100.0 * sigma[0] / RADIUS_M:.3f}",
            f"{100.0 * sigma[1] / DISTANCE_M:.3f}",
            f"{spread:.1f}",
        )
    show(rows, width=140)
    if found:
        radius, distance, spread = np.transpose(found)
        print(
            f"worst R {100.0 * radius.max():.3f} %, worst D_f {100.0 * distance.max():.3f} %, "
            f"mean NEES of two {spread.mean():.2f}; {len(found)} of {passes} passes answered"
        )


def _pass(
    folder: Path, offset: np.ndarray, frames: int, rng: np.random.Generator, seed: list[int]
) -> SizeResult:
    mesh = craft(offset)
    half = frames // 2
    angles = np.radians(
        np.concatenate(
            [np.linspace(*arc, n) for arc, n in zip(ARCS_DEG, (half, frames - half), strict=True)]
        )
    )
    poses = [(4.0 * k, _pose(angle, rng)) for k, angle in enumerate(angles)]
    phase, azimuth = math.radians(rng.uniform(20.0, 40.0)), rng.uniform(0.0, math.tau)
    sun = np.array(
        [
            math.sin(phase) * math.cos(azimuth),
            math.sin(phase) * math.sin(azimuth),
            -math.cos(phase),
        ]
    )
    with BopSceneWriter(folder / "scene", CAMERA, overwrite=True) as scene:
        for k, (time_s, pose) in enumerate(poses):
            image = render_frame(mesh, CAMERA, pose, sun, SceneOptions(), rng)
            scene.add(k, image, pose, time_s)
    laser = folder / "laser.jsonl"
    write_echoes(laser, mesh, poses, RANGER, seed[0] * 1000 + seed[1])
    echo_of = read_echoes(read_json_lines(laser), str(laser))
    return measure_pass(open_sequence(folder / "scene"), echo_of)


def craft(offset: np.ndarray) -> Mesh:
    """A panel in the plane x = 0, and a ring parallel to it at x = D_f."""
    panel = trimesh.creation.box((0.002, *PANEL_M))
    panel.apply_translation([-0.001, 0.0, 0.0])
    ring = trimesh.creation.annulus(RADIUS_M - WIDTH_M, RADIUS_M, 0.002, sections=SIDES)
    ring.apply_transform(trimesh.geometry.align_vectors([0.0, 0.0, 1.0], [1.0, 0.0, 0.0]))
    ring.apply_translation([DISTANCE_M - 0.001, *offset])
    vertices = np.vstack([panel.vertices, ring.vertices])
    faces = np.vstack([panel.faces, ring.faces + len(panel.vertices)]).astype(np.int32)
    grey = np.full((len(faces), 3), 0.6, dtype=np.float32)
    grey[len(panel.faces) :] = 0.25  # a brighter one is overexposed, and its edges move
    return Mesh(vertices, faces, grey, ())


def _pose(angle: float, rng: np.random.Generator) -> Pose:
    """A camera at an angle off the panel's normal that looks at its middle, nearly."""
    out = np.array([math.cos(angle), math.sin(angle), 0.05 * rng.standard_normal()])
    out *= RANGE_M / np.linalg.norm(out)
    shaken = np.array([*rng.normal(0.0, POINTING_RAD, 2), rng.normal(0.0, math.radians(2.0))])
    turned = Pose(Rotation.from_rotvec(shaken).as_matrix(), np.zeros(3))
    return turned @ looking_at(out, np.zeros(3), [0.0, 0.0, 1.0])
