"""What the control system knows of the target's acceleration, as a log of JSON lines."""

from __future__ import annotations

import bisect
from dataclasses import dataclass

import numpy as np

from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Array
from rendezview.io.files import StrPath
from rendezview.io.results import read_json_lines

_KEYS = ("angular_rad_s2", "linear_m_s2")


@dataclass(frozen=True, slots=True, eq=False)
class Accelerations:
    """Accelerations of the target in the camera frame; each holds until the next."""

    times_s: list[float]
    values: Array  # (N, 6) angular rad/s², linear m/s²

    @classmethod
    def load(cls, path: StrPath) -> Accelerations:
        """Read JSON lines of ``time_s``, ``angular_rad_s2`` and ``linear_m_s2`` (3 each).

        Raises:
            RendezviewError: missing, a line that does not fit, or times that do not rise.
        """
        times_s: list[float] = []
        values = []
        for number, line in enumerate(read_json_lines(path), start=1):
            where = f"{path}: line {number}"
            try:
                time_s = float(line["time_s"])
                value = np.array([line[key] for key in _KEYS], dtype=np.float64)
                if value.shape != (2, 3) or not np.isfinite([time_s, *value.ravel()]).all():
                    raise ValueError(value)
            except (KeyError, TypeError, ValueError):
                raise RendezviewError(
                    f"{where}: needs time_s, and angular_rad_s2 and linear_m_s2 of three finite "
                    "numbers each"
                ) from None
            if times_s and time_s <= times_s[-1]:
                raise RendezviewError(f"{where}: time_s must rise from line to line")
            times_s.append(time_s)
            values.append(value.ravel())
        if not times_s:
            raise RendezviewError(f"{path}: holds no accelerations")
        return cls(times_s, np.array(values))

    def at(self, time_s: float) -> Array | None:
        """(6,) at a time; ``None`` before the first."""
        k = bisect.bisect_right(self.times_s, time_s) - 1
        return None if k < 0 else np.asarray(self.values[k])
