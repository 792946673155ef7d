"""The size in which a frame is looked at: a blurred one shows no more than a smaller one."""

from __future__ import annotations

import math
from typing import NamedTuple

from rendezview.io.grey_frame import Picture, frame_blur, shrunk
from rendezview.sensors.appearance.edges.refinement import RefineOptions
from rendezview.sensors.appearance.search.levels import edge_blur, shrunk_blur

# Px; a frame with more blur is looked at in a smaller size. Source: sharp frames of other authors
# and simulators are measured below 1.1, those of 1.6 px above 1.3
_SHARP_PX = 1.2
# Px; each time smaller takes so much. Source: integrity-draw, blurred, hubble and client, seed 11:
# of 168 poses 100, 101 and 90 are right with 1.4, 1.75 and 2.2, and 4, 1 and 1 wrong
_MOST_PX = 1.75
# Px, radius of the smallest target that is looked at in a smaller size. Source: integrity-draw,
# blurred, hubble and client at 7 to 12 radii, seed 5: of 72 without a prior one was wrong with 22
LEAST_PX = 28.0
_STEP_PX = 0.25  # px; sizes differ by so much in blur. Source: by construction, a bound of space


class Scale(NamedTuple):
    """How many times smaller frames are looked at, and the blur of edges there."""

    times: int
    blur_px: float

    @classmethod
    def of(cls, frame: Picture) -> Scale:
        """That of a frame; whole where it is sharp, or shows too few edges to tell."""
        blur_px = frame_blur(frame)
        if blur_px <= _SHARP_PX:
            return WHOLE
        times = max(2, math.ceil(blur_px / _MOST_PX))
        return cls(times, shrunk_blur(edge_blur(_STEP_PX * round(blur_px / _STEP_PX)), times))

    def shrunk(self, frame: Picture) -> Picture:
        """The frame in that size."""
        return shrunk(frame, self.times)


WHOLE = Scale(1, RefineOptions.blur_px)  # of sharp frames. Source: by construction
