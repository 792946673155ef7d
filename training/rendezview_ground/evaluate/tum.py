"""Results from a trajectory in the format of TUM, as evo and others write it."""

from __future__ import annotations

import numpy as np

from rendezview.errors import RendezviewError, explained
from rendezview.geometry.pose import Pose
from rendezview.io.files import StrPath, read_text
from rendezview.io.results import ResultRow
from rendezview.io.sequences.frame import Sequence

# s; as evo's default for stamps of one frame in two files. Source: its option --t_max_diff
_SAME_TIME_S = 0.01


def results_of_tum(path: StrPath, sequence: Sequence) -> list[ResultRow]:
    """The poses of a TUM file, for the frames of a sequence that have their times.

    Raises:
        RendezviewError: missing, a line that is none (its number is given), or no frame's time.
    """
    timed: list[tuple[float, Pose]] = []
    for number, line in enumerate(read_text(path, "a TUM trajectory").splitlines(), start=1):
        cells = line.split("#")[0].replace(",", " ").split()
        if not cells:
            continue
        where = f"{path}: line {number}: not `time x y z qx qy qz qw` ("
        with explained(where, "): correct or remove the line", (ValueError, TypeError)):
            time_s, *place_m, x, y, z, w = (float(cell) for cell in cells)
            timed.append((time_s, Pose.from_quat_wxyz([w, x, y, z], place_m).inverse()))
    times = np.array([time_s for time_s, _ in timed])
    rows = []
    for frame in sequence:
        if frame.time_s is None or not timed:
            continue
        k = int(np.argmin(np.abs(times - frame.time_s)))
        if abs(times[k] - frame.time_s) <= _SAME_TIME_S:
            rows.append(ResultRow(sequence.scene_id, frame.im_id, frame.obj_id, 1.0, timed[k][1]))
    if not rows:
        raise RendezviewError(
            f"{path}: none of its {len(timed)} poses has the time of a frame of {sequence.source}"
        )
    return rows
