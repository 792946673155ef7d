"""The echoes of a laser ranger beside the camera, as `fuse` and `calibrate ring` read them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rendezview.geometry.pose import Pose
from rendezview.geometry.ray_cast import first_hits
from rendezview.io.files import StrPath
from rendezview.io.results import JsonLinesWriter
from rendezview.sensors.beam import BeamMesh
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.simulate.trajectories import TimedPose, Triple

_STREAM = 2  # random numbers of the ranger, beside those of frames and mesh


@dataclass(frozen=True, slots=True)
class Ranger:
    """A beam fixed to the camera."""

    origin_m: Triple  # camera frame
    sigma_m: float  # noise of a range
    direction: Triple = (0.0, 0.0, 1.0)  # camera frame


def write_echoes(
    path: StrPath, mesh: Mesh, poses: Sequence[TimedPose], ranger: Ranger, seed: int
) -> None:
    """One line a frame: the range to the surface that the beam meets, null where it meets none."""
    rng = np.random.default_rng([seed, _STREAM])
    with JsonLinesWriter(path) as writer:
        for k, (time_s, pose) in enumerate(poses):
            noise = ranger.sigma_m * float(rng.standard_normal())
            distance = echo(mesh, pose, ranger.origin_m, ranger.direction)
            writer.write(
                {
                    "im_id": k,
                    "time_s": time_s,
                    "range_m": None if distance is None else distance + noise,
                    "sigma_m": ranger.sigma_m,
                    "origin_m": ranger.origin_m,
                    "direction": ranger.direction,
                }
            )


def echo(
    mesh: Mesh, camera_from_target: Pose, origin_m: npt.ArrayLike, direction: npt.ArrayLike
) -> float | None:
    """Distance along a beam of the camera frame to the mesh, metres; ``None`` if it misses."""
    target_from_camera = camera_from_target.inverse()
    start = target_from_camera.apply(np.asarray(origin_m, dtype=np.float64))
    way = target_from_camera.rotation @ np.asarray(direction, dtype=np.float64)
    body = BeamMesh(mesh.vertices_m, mesh.faces)
    far, face = first_hits(
        body.corners, body.centres, body.radii, start[None], way / np.linalg.norm(way)
    )
    return float(far[0]) if face[0] >= 0 else None
