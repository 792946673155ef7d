"""Sequences for the integrity of poses: each condition that tempts a tracker to mislead."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.simulate import (
    Earth,
    SceneOptions,
    ShadingOptions,
    render_frame,
    sun_at_phase,
)
from rendezview_ground.simulate.sensor import SensorOptions

CAMERA = Camera.from_fov(320, 240, math.radians(53.0))  # small pictures: many frames
RANGE_RADII = (3.0, 5.5)
TURN_DEG = (0.3, 3.0)  # a frame
CLOSING = (-0.006, 0.012)  # of the range, a frame
ASIDE = 0.12  # of the range, at most
LONG_BLUR_PX, PLAIN_BLUR_PX = (1.5, 3.0), 0.7
OVEREXPOSED = (3.0, 10.0)
CUT_RADII = (0.2, 0.8)  # of the target radius beyond the border


@dataclass(frozen=True, slots=True, kw_only=True)
class Condition:
    """Light and faults of the sequences of one condition."""

    sun_deg: tuple[float, float] = (0.0, 60.0)  # angle Sun–target–camera
    frames: int = 30  # of a sequence, a second apart
    earth: bool = False
    other: bool = False  # the frames show another target
    stretch: float = 0.0  # of the craft against its model, along a random axis
    cut: bool = False
    blurred: bool = False
    saturated: bool = False


CONDITIONS = {
    "low Sun": Condition(sun_deg=(0.0, 30.0)),
    "high Sun": Condition(sun_deg=(30.0, 60.0)),
    "side Sun": Condition(sun_deg=(60.0, 110.0)),
    "Earth": Condition(earth=True),
    "wrong target": Condition(other=True, frames=8),
    "mesh 2 %": Condition(stretch=0.02),
    "mesh 4 %": Condition(stretch=0.04),
    "cut": Condition(cut=True),
    "blurred": Condition(blurred=True),
    "saturated": Condition(saturated=True),
}


def stretched(mesh: Mesh, share: float, rng: np.random.Generator) -> Mesh:
    """The mesh longer by a share along a random axis through its centre."""
    centre_m, _ = mesh.bounding_sphere
    axis = _unit(rng)
    offset = mesh.vertices_m - centre_m
    vertices_m = mesh.vertices_m + share * np.outer(offset @ axis, axis)
    return dataclasses.replace(mesh, vertices_m=vertices_m)


def sequence(
    mesh: Mesh, centre_m: Array, radius_m: float, condition: Condition, rng: np.random.Generator
) -> Iterator[tuple[np.ndarray, Pose]]:
    """The pictures of a sequence with their poses.

    Args:
        mesh: that the frames show.
        centre_m, radius_m: of the target that is looked for, target frame.
        condition: of the sequence.
        rng: of everything.
    """
    if condition.stretch:
        mesh = stretched(mesh, condition.stretch, rng)
    depth_m = radius_m * rng.uniform(*RANGE_RADII)
    rotation = Rotation.random(random_state=rng)
    turn = Rotation.from_rotvec(math.radians(rng.uniform(*TURN_DEG)) * _unit(rng))
    bearing = rng.uniform(-ASIDE, ASIDE, 2)
    if condition.cut:
        bearing = _beyond(depth_m / radius_m, rng)
    closing = rng.uniform(*CLOSING)
    phase, azimuth = np.deg2rad(rng.uniform(*condition.sun_deg)), rng.uniform(0.0, 2.0 * math.pi)
    blur_px = rng.uniform(*LONG_BLUR_PX) if condition.blurred else PLAIN_BLUR_PX
    over = rng.uniform(*OVEREXPOSED) if condition.saturated else 1.0
    scene = SceneOptions(
        sky_frame="camera",
        earth=Earth(seed=int(rng.integers(2**31))) if condition.earth else None,
        shading=ShadingOptions(samples=2),
        sensor=SensorOptions(blur_sigma_px=blur_px, overexposure=over),
    )
    for k in range(condition.frames):
        centre = np.array([*bearing, 1.0]) * depth_m * (1.0 - closing) ** k
        pose = Pose(rotation.as_matrix(), centre - rotation.as_matrix() @ centre_m)
        sun = sun_at_phase(centre, phase, azimuth)
        yield render_frame(mesh, CAMERA, pose, sun, scene, rng, float(k)), pose
        rotation = turn * rotation


def _beyond(depth_radii: float, rng: np.random.Generator) -> Array:
    """Bearing of a target that the border of the picture cuts."""
    half = np.array([CAMERA.width / CAMERA.fx, CAMERA.height / CAMERA.fy]) / 2.0
    side = int(rng.integers(2))
    bearing = rng.uniform(-ASIDE, ASIDE, 2)
    bearing[side] = half[side] - (1.0 - rng.uniform(*CUT_RADII)) / depth_radii
    bearing[side] *= rng.choice([-1.0, 1.0])
    return bearing


def _unit(rng: np.random.Generator) -> Array:
    axis = rng.normal(size=3)
    return axis / np.linalg.norm(axis)
