"""Trajectories in the formats of TUM and KITTI, which evo and others read.

Both hold the path of the camera about the target: target_from_camera, metres.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Pose
from rendezview.io.pose_log import read_poses

TimedPose = tuple[float | None, Pose]


def poses_of_log(path: Path) -> tuple[list[TimedPose], int]:
    """Time and camera_from_target of each line with a pose, and how many lines have none.

    Raises:
        RendezviewError: missing, no line of poses, or a line that is none.
    """

    def of_line(line: dict[str, Any]) -> TimedPose | None:
        given, time_s = line["pose"], line["time_s"]
        if given is None:
            return None
        pose = Pose.from_quat_wxyz(given["quat_wxyz"], given["translation_m"])
        return None if time_s is None else float(time_s), pose

    lines = read_poses(path, of_line)
    found = [timed for timed in lines if timed is not None]
    if not found:
        raise RendezviewError(f"{path}: none of its {len(lines)} lines has a pose")
    return found, len(lines) - len(found)


def tum_text(timed: Iterable[TimedPose]) -> str:
    """Lines ``time x y z qx qy qz qw``.

    Raises:
        RendezviewError: a pose has no time.
    """
    lines = []
    for time_s, pose in timed:
        if time_s is None:
            raise RendezviewError("TUM files need times, and a frame has none: write --kitti")
        place = pose.inverse()
        w, x, y, z = place.quat_wxyz.tolist()
        numbers = [*place.translation_m.tolist(), x, y, z, w]
        lines.append(f"{time_s:.9f} " + " ".join(f"{number:.12g}" for number in numbers))
    return "\n".join(lines) + "\n"


def kitti_text(timed: Iterable[TimedPose]) -> str:
    """Lines of the twelve numbers of [R t], row by row."""
    rows = (pose.inverse().as_matrix()[:3].ravel().tolist() for _, pose in timed)
    return "\n".join(" ".join(f"{number:.12g}" for number in row) for row in rows) + "\n"
