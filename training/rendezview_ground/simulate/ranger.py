"""The echoes of a laser ranger beside the camera, as `fuse` and `calibrate ring` read them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rendezview.io.files import StrPath
from rendezview.io.results import JsonLinesWriter
from rendezview_ground.mesh.mesh import Mesh
from rendezview_ground.simulate.approach import echo
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
