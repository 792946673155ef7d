"""A suggestion for the next integration time: the brightest reflector shall not saturate.

Book et al. let the integration time follow the range. Here it follows the spots. The sensor drives
no camera: each reading says by which factor its owner should change the exposure.
"""

from __future__ import annotations

import numpy as np

from rendezview.sensors.beacons.detect.difference import LitDark
from rendezview.sensors.beacons.detect.spot_columns import PEAK, SATURATED
from rendezview.sensors.beacons.observation import ReflectorObservation
from rendezview.sensors.observation import Status

_WANTED_GREY = 180.0  # of the brightest reflector. Source: by construction, 70 % of 8 bits
_STEP = 4.0  # factor, at most. Source: by construction, two stops
_STILL = 1.25  # factor below which nothing changes. Source: by construction, beam and tilt
_BRIGHT_GREY = 200.0  # of half of the pixels: too long. Source: by construction


def suggest_exposure(reading: ReflectorObservation, frames: LitDark | None = None) -> float | None:
    """Factor for the next integration time; 1: keep it, ``None``: nothing to go by.

    Args:
        reading: whose reflectors count; all spots where none has a name.
        frames: its pictures, which tell a dark picture from an overexposed one without spots.
    """
    if frames is not None and float(np.median(frames.lit[::8, ::8])) > _BRIGHT_GREY:
        return 0.5
    named = [k for k, name in enumerate(reading.reflectors) if name is not None]
    rows = reading.spots.table[named] if named else reading.spots.table
    if not len(rows):
        return 2.0 if reading.status in (Status.NO_SPOTS, Status.LOST) else None
    if (rows[:, SATURATED] > 1).any():
        return 0.5  # how much too bright they are is not visible
    factor = float(np.clip(_WANTED_GREY / max(rows[:, PEAK].max(), 1.0), 1.0 / _STEP, _STEP))
    return 1.0 if 1.0 / _STILL < factor < _STILL else factor
