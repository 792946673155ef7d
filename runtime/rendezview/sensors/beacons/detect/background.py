"""The background between the lit and the dark picture: whether it moves, and what noise it leaves.

A camera that turns between the two pictures leaves the background's texture in their difference.
The dark picture is then moved onto the lit one's, if the data say that this leaves less.
"""

from __future__ import annotations

import math

from rendezview.geometry.pose import Array
from rendezview.sensors.beacons.detect.difference import LitDark, ThresholdOptions
from rendezview.sensors.beacons.detect.hidden_noise import HiddenNoise
from rendezview.sensors.beacons.detect.registration import register
from rendezview.sensors.beacons.detect.spots import SpotTable, find_spots

# Of the smooth noise of the difference as it is: the dark picture is moved where less is left.
# Source: by construction, a quarter of the variance is half of the error
_LESS = 0.25
_AGAIN_S = 1.0  # s after which it is measured again. Source: by construction, 1 % of the time


class Background:
    """Chooses by the pictures whether the dark one is moved, and remembers it until measured again.

    ``hidden`` is the noise that is left, of the last measured pictures.
    """

    def __init__(self) -> None:
        self.hidden, self.moves, self._measured_s = HiddenNoise.none(), False, -math.inf

    def spots(
        self, time_s: float, frames: LitDark, threshold: ThresholdOptions, faint: bool = False
    ) -> SpotTable:
        """The spots of whole pictures; the noise that pixels do not show is in their errors."""
        spots = find_spots(frames, threshold, faint=faint)
        if frames.dark is not None or (len(spots) >= 3 and not spots.overfull):
            used = self.measured(frames, spots.table, time_s)
            if used is not frames:
                spots = find_spots(used, threshold, faint=faint)
            self.hidden.widen(spots.table)
        return spots

    def measured(self, frames: LitDark, table: Array, time_s: float) -> LitDark:
        """The pictures to use, measured as a whole.

        Args:
            frames: one reading.
            table: of the spots in their difference, whose light is no noise.
            time_s: of the reading.
        """
        self.hidden, self.moves = HiddenNoise.of(frames, table), False
        self._measured_s = time_s
        if frames.dark is None or not self.hidden.of_cells.any():
            return frames
        moved = register(frames)
        left = self.hidden if moved is frames else HiddenNoise.of(moved, table)
        if not left.of_cells.max() < _LESS * self.hidden.of_cells.max():
            return frames
        self.hidden, self.moves = left, True
        return moved

    def followed(self, frames: LitDark, table: Array, time_s: float) -> LitDark:
        """The pictures to use while spots are followed; measured again once a second."""
        if frames.dark is not None and time_s - self._measured_s >= _AGAIN_S:
            return self.measured(frames, table, time_s)
        return register(frames) if self.moves else frames
