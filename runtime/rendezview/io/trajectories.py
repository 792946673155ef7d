"""Trajectories in the formats of TUM and KITTI, which evo and others read.

Both hold the path of the camera about the target: target_from_camera, metres.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Pose
from rendezview.io.results import read_json_lines

TimedPose = tuple[float | None, Pose]


def poses_of_log(path: Path) -> tuple[list[TimedPose], int]:
    """Time and camera_from_target of each line with a pose, and how many lines have none.

    Raises:
        RendezviewError: missing, no line of poses, or a line that is none.
    """
    found: list[TimedPose] = []
    empty = 0
    for number, line in enumerate(read_json_lines(path), start=1):
        try:
            given, time_s = line["pose"], line["time_s"]
            if given is None:
                empty += 1
                continue
            pose = Pose.from_quat_wxyz(given["quat_wxyz"], given["translation_m"])
            found.append((None if time_s is None else float(time_s), pose))
        except (KeyError, TypeError, ValueError) as error:
            raise RendezviewError(
                f"{path}: record {number}: no line of a log of poses ({error}): give that of "
                "`rendezview track` or `fuse`"
            ) from error
    if not found:
        raise RendezviewError(f"{path}: none of its {empty} lines has a pose")
    return found, empty


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
