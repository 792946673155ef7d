"""A final approach along V-bar to a docking ring: the motion and a laser ranger's echoes.

The camera starts tens of metres from the ring and ends at contact. Both spacecraft wander: each
disturbance is a damped oscillator driven by white acceleration, whose spectral density a filter
needs. The ranger's beam is intersected with the mesh, so the echo comes from the rim, the nozzle,
the heat shield, or is missing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from rendezview.geometry.pose import Array, Pose
from rendezview.io.target import DockingRing
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.simulate.trajectories import looking_at


@dataclass(frozen=True, slots=True, kw_only=True)
class ApproachOptions:
    """Motion of the chaser, and disturbances of both spacecraft."""

    start_m: float = 60.0  # camera to ring plane
    end_m: float = 1.0
    duration_s: float = 240.0
    dt_s: float = 0.5
    power: float = 1.5  # distance − end ∝ (1 − t/T)^power
    lateral_sigma_m: float = 0.06  # of the camera off the approach axis
    pointing_sigma_rad: float = math.radians(0.3)  # of the camera, each axis
    target_sigma_rad: float = math.radians(1.0)  # of the target's attitude, each axis
    period_s: float = 200.0  # of all three
    damping: float = 0.7

    def density(self, sigma: float) -> float:
        """White acceleration (unit/s² √s) that gives an oscillator the σ ``sigma``."""
        omega = 2.0 * math.pi / self.period_s
        return sigma * math.sqrt(4.0 * self.damping * omega**3)


def approach(
    ring: DockingRing, options: ApproachOptions, rng: np.random.Generator
) -> list[tuple[float, Pose]]:
    """Times from 0 in steps of ``dt_s`` with the true camera_from_target.

    Without disturbances, the camera looks at the ring's centre along its axis, at a random roll.
    """
    count = round(options.duration_s / options.dt_s) + 1
    times_s = options.dt_s * np.arange(count)
    left = 1.0 - times_s / options.duration_s
    along_m = options.end_m + (options.start_m - options.end_m) * np.maximum(left, 0.0) ** (
        options.power
    )
    lateral = wander(options, count, options.lateral_sigma_m, 2, rng)
    turned = wander(options, count, options.target_sigma_rad, 3, rng)
    pointing = wander(options, count, options.pointing_sigma_rad, 3, rng)
    axis = ring.axis / np.linalg.norm(ring.axis)
    up = np.eye(3)[int(np.argmin(np.abs(axis)))]
    straight = looking_at(ring.centre_m + options.start_m * axis, ring.centre_m, up).rotation
    roll = Rotation.from_rotvec([0.0, 0.0, rng.uniform(0.0, 2.0 * math.pi)]).as_matrix()
    poses = []
    for k in range(count):
        # Near contact the corridor narrows with the range.
        narrowed = min(1.0, along_m[k] / 10.0)
        place = np.array([*(narrowed * lateral[k]), along_m[k]])
        # The target rotates about its origin, together with the ring.
        origin = place - roll @ straight @ ring.centre_m
        facing = Pose(Rotation.from_rotvec(turned[k]).as_matrix() @ roll @ straight, origin)
        poses.append((float(times_s[k]), _turned(narrowed * pointing[k]) @ facing))
    return poses


def _turned(vector: Array) -> Pose:
    return Pose(Rotation.from_rotvec(vector).as_matrix(), np.zeros(3))


def wander(
    options: ApproachOptions, count: int, sigma: float, axes: int, rng: np.random.Generator
) -> Array:
    """(count, axes) of a damped oscillator driven by white noise, stationary from the start."""
    omega = 2.0 * math.pi / options.period_s
    rate = np.array([[0.0, 1.0], [-(omega**2), -2.0 * options.damping * omega]])
    # Van Loan: transition and noise of one step from one matrix exponential.
    noise = np.zeros((2, 2))
    noise[1, 1] = options.density(sigma) ** 2
    block = np.block([[-rate, noise], [np.zeros((2, 2)), rate.T]]) * options.dt_s
    whole = expm(block)
    step = whole[2:, 2:].T
    root = np.linalg.cholesky(step @ whole[:2, 2:] + 1e-24 * np.eye(2))
    state = rng.standard_normal((2, axes)) * np.array([[sigma], [sigma * omega]])
    out = np.empty((count, axes))
    for k in range(count):
        out[k] = state[0]
        state = step @ state + root @ rng.standard_normal((2, axes))
    return out


def echo(
    mesh: Mesh, camera_from_target: Pose, origin_m: npt.ArrayLike, direction: npt.ArrayLike
) -> float | None:
    """Distance along a beam of the camera frame to the mesh, metres; ``None`` if it misses.

    Möller & Trumbore over all triangles at once.
    """
    target_from_camera = camera_from_target.inverse()
    start = target_from_camera.apply(np.asarray(origin_m, dtype=np.float64))
    beam = target_from_camera.rotation @ np.asarray(direction, dtype=np.float64)
    beam = beam / np.linalg.norm(beam)
    corners = mesh.vertices_m[mesh.faces]
    one, two = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    across = np.cross(beam, two)
    volume = np.einsum("ij,ij->i", one, across)
    with np.errstate(divide="ignore", invalid="ignore"):
        away = start - corners[:, 0]
        u = np.einsum("ij,ij->i", away, across) / volume
        lifted = np.cross(away, one)
        v = lifted @ beam / volume
        distance = np.einsum("ij,ij->i", two, lifted) / volume
        hit = (np.abs(volume) > 1e-15) & (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (distance > 0.0)
    return float(distance[hit].min()) if hit.any() else None
