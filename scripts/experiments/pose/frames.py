"""The frames on which docs/refinement.md judges poses: drawn by Mitsuba, kept as BOP scenes."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from experiments.frame import mesh_of
from rendezview import Camera, Pose
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.simulate import (
    Earth,
    MitsubaOptions,
    SceneOptions,
    render_frame,
    sun_at_phase,
)
from rendezview_ground.simulate.bop_writer import BopSceneWriter
from rendezview_ground.simulate.command import default_camera
from rendezview_ground.simulate.near_symmetric_craft import CRAFT

RADIUS_PX = (100.0, 220.0)
MARGIN_PX = 6.0
PHASE_DEG = {"low": (0.0, 30.0), "high": (30.0, 70.0), "earth": (0.0, 60.0)}  # by condition
MITSUBA = MitsubaOptions()
PATCHES, ALBEDO, FOIL, ROUGHNESS = 12, (0.05, 0.9), (0.0, 0.6), (0.1, 0.5)  # of unknown materials


def random_pose(mesh: Mesh, camera: Camera, rng: np.random.Generator) -> Pose:
    """Any attitude, the bounding sphere anywhere in the picture but whole."""
    centre_m, radius_m = mesh.bounding_sphere
    radius_px = rng.uniform(*RADIUS_PX)
    depth_m = camera.fx * radius_m / radius_px
    room = np.array([camera.width, camera.height]) / 2.0 - radius_px * 1.08 - MARGIN_PX
    shift_px = rng.uniform(-1.0, 1.0, 2) * np.maximum(room, 0.0)
    place = np.array([shift_px[0] / camera.fx, shift_px[1] / camera.fy, 1.0]) * depth_m
    rotation = Rotation.random(random_state=rng).as_matrix()
    return Pose(rotation, place - rotation @ centre_m)


def repainted(mesh: Mesh, rng: np.random.Generator) -> tuple[Mesh, MitsubaOptions]:
    """A craft whose surfaces are not as its mesh has them: patches of any albedo, glinting foil."""
    middles = mesh.vertices_m[mesh.faces].mean(axis=1)
    seeds = middles[rng.choice(len(middles), PATCHES)]
    nearest = np.argmin(np.linalg.norm(middles[:, None] - seeds, axis=2), axis=1)
    albedo = np.exp(rng.uniform(*np.log(ALBEDO), PATCHES)).astype(np.float32)
    rgb = np.repeat(albedo[nearest][:, None], 3, axis=1)
    options = MitsubaOptions(foil=rng.uniform(*FOIL), foil_roughness=rng.uniform(*ROUGHNESS))
    return replace(mesh, face_rgb=rgb), options


def one_frame(
    mesh: Mesh, camera: Camera, condition: str, seed: list[int], *, unknown: bool = False,
    mitsuba: MitsubaOptions | None = MITSUBA,
) -> tuple[np.ndarray, Pose]:  # fmt: skip
    """A picture under a condition, and its pose; ``unknown``: of unknown materials.

    ``mitsuba``: None for our own renderer.
    """
    rng = np.random.default_rng(seed)
    pose = random_pose(mesh, camera, rng)
    phase = math.radians(rng.uniform(*PHASE_DEG[condition]))
    sun = sun_at_phase(pose.apply(mesh.bounding_sphere[0]), phase, rng.uniform(0.0, 2.0 * math.pi))
    earth = Earth(seed=int(rng.integers(2**31))) if condition == "earth" else None
    # The Earth's centre up to 70° off the boresight: its limb crosses the frame in half of them.
    off = math.radians(rng.uniform(0.0, 70.0))
    around = rng.uniform(0.0, 2.0 * math.pi)
    below = (math.sin(off) * math.cos(around), math.sin(off) * math.sin(around), math.cos(off))
    if unknown:
        mesh, foil = repainted(mesh, np.random.default_rng([*seed, 1]))
        mitsuba = mitsuba and replace(foil, samples=mitsuba.samples)
    options = SceneOptions(
        sky_frame="camera", earth=earth, earth_direction_sky=below, mitsuba=mitsuba
    )
    return render_frame(mesh, camera, pose, sun, options, rng), pose


def run(
    frames: Annotated[Path, "folder of the scenes"],
    targets: Annotated[list[str], "meshes, bundled targets, twelve-sides or four-panels"],
    *, count: int = 200, seed: int = 77, materials: Literal["mesh", "random"] = "mesh",
) -> None:  # fmt: skip
    """Draw the frames of pose-accuracy with Mitsuba, as BOP scenes.

    FRAMES/<target>/<condition> has frames of random attitudes: 640 × 480, 53° across, the bounding
    sphere 100–220 px in radius anywhere in the image, each frame with its own exposure and Sun.
    Conditions: low: Sun phase 0–30°, black sky; high: 30–70°, black sky; earth: 0–60°, the Earth
    behind, whose limb crosses some of the frames. An existing scene is kept. With --materials
    random, surfaces are patches of albedo 0.05–0.9 under 0–60 % of foil, unlike the mesh. The
    near-symmetric craft twelve-sides and four-panels are also written, as FRAMES/<target>.stl.
    """
    camera = default_camera()
    for target in targets:
        target_name, mesh = mesh_of(target)
        if target in CRAFT:
            frames.mkdir(parents=True, exist_ok=True)
            trimesh.Trimesh(mesh.vertices_m, mesh.faces).export(frames / f"{target}.stl")
        for stream, name in enumerate(PHASE_DEG):
            folder = frames / target_name / name
            if folder.exists():
                print(f"{folder}: there already", flush=True)
                continue
            with BopSceneWriter(folder, camera) as writer:
                for i in range(count):  # Mitsuba uses all cores by itself
                    image, pose = one_frame(
                        mesh, camera, name, [seed, stream, i], unknown=materials == "random"
                    )
                    writer.add(i, image, pose, float(i))
            print(f"{folder}: {count} frames", flush=True)
