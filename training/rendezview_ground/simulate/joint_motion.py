"""Joints that move while a scene is simulated."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rendezview.errors import RendezviewError
from rendezview.geometry.joint import Joint, within
from rendezview.geometry.pose import Array
from rendezview.io.files import atomic_write_text
from rendezview_ground.mesh.joints import posed
from rendezview_ground.mesh.mesh import Mesh

JOINTS_FILE = "scene_joints.json"  # beside scene_gt.json: angles by frame and joint, degrees


@dataclass(frozen=True, slots=True, eq=False)
class JointMotion:
    """Constant rates of all joints of a target."""

    joints: tuple[Joint, ...]
    start_rad: Array  # (J,) at the time 0
    rate_rad_s: Array  # (J,)

    def angles_rad(self, time_s: float) -> Array:
        """(J,) angles at a time, in the joints' ranges."""
        return within(self.joints, self.start_rad + time_s * self.rate_rad_s)

    def posed(self, mesh: Mesh, time_s: float) -> Mesh:
        """The mesh of ``with_parts`` at a time."""
        return posed(mesh, self.joints, self.angles_rad(time_s))

    def write(self, folder: Path, times_s: Sequence[float]) -> None:
        """Write the true angles beside a scene."""
        names = [joint.name for joint in self.joints]
        rows = {
            str(k): dict(zip(names, np.rad2deg(self.angles_rad(t)).tolist(), strict=True))
            for k, t in enumerate(times_s)
        }
        atomic_write_text(folder / JOINTS_FILE, json.dumps(rows, indent=1) + "\n")


def joint_motion(joints: Sequence[Joint], settings: Sequence[str]) -> JointMotion:
    """The motion of ``NAME=ANGLE`` or ``NAME=ANGLE,RATE``, degrees and degrees a second.

    A joint that is not named stays at 0, or at the end of its range nearest to it.

    Raises:
        RendezviewError: an unknown joint, no number, or an angle beyond the joint's limits.
    """
    names = [joint.name for joint in joints]
    start, rate = (np.zeros(len(names)) for _ in range(2))
    for k, joint in enumerate(joints):
        start[k] = min(max(0.0, joint.lowest_rad), joint.highest_rad)
    for setting in settings:
        name, _, numbers = setting.partition("=")
        if name not in names:
            known = ", ".join(names) or "none"
            raise RendezviewError(f"--joint {setting}: the target's joints are: {known}")
        k = names.index(name)
        try:
            angle, *rest = (float(part) for part in numbers.split(","))
            (speed,) = rest or [0.0]
        except ValueError:
            raise RendezviewError(
                f"--joint {setting}: give NAME=ANGLE or NAME=ANGLE,RATE, in degrees"
            ) from None
        start[k], rate[k] = np.deg2rad(angle), np.deg2rad(speed)
        outside = not joints[k].lowest_rad <= start[k] <= joints[k].highest_rad
        if not np.isfinite([angle, speed]).all() or (outside and joints[k].period_rad is None):
            raise RendezviewError(f"--joint {setting}: the angle is beyond the joint's limits")
    return JointMotion(tuple(joints), start, rate)
