"""Spots of a rolling shutter, whose rows are exposed one after the other, at one time."""

from __future__ import annotations

import numpy as np

from rendezview.geometry.pose import Array
from rendezview.sensors.beacons.detect.spot_columns import SIGMA, X, Y

# Of a spot's shift, by which its speed may have changed. Source: by construction, 1 s of motion
# that doubles its speed, at 20 readings a second
_SPEED_SHARE = 0.05


def at_middle_row(
    table: Array, before: Array, step_s: float, readout_s: float, height: int,
    before_is_raw: bool = False,
) -> None:  # fmt: skip
    """Move spots (N, COLUMNS) to where they were when the middle row was exposed; in place.

    A spot moves on as it did since the reading before; one that was not visible then, as the others
    on average. Nothing moves where that is not known.

    Args:
        table: NaN where a reflector is not visible.
        before: (N, 2) places of the reading before.
        step_s: between both.
        readout_s: from the first row to the last.
        height: rows of the picture.
        before_is_raw: whether ``before`` has places of their own rows, too.
    """
    late = readout_s * (table[:, Y] / (height - 1) - 0.5)
    since = step_s + late
    if before_is_raw:
        since = since - readout_s * (before[:, 1] / (height - 1) - 0.5)
    speed = (table[:, [X, Y]] - before) / since[:, None]
    known = np.isfinite(speed).all(axis=1)
    if not known.any():
        return
    speed[~known] = speed[known].mean(axis=0)
    shift = late[:, None] * speed
    table[:, [X, Y]] -= shift
    table[:, SIGMA] = np.hypot(table[:, SIGMA], _SPEED_SHARE * np.linalg.norm(shift, axis=1))
