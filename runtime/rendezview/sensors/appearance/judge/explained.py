"""How much of a sketch a pose explains: the compiled loop.

Alignment and ``sketch_agreement`` ask whether the model's edges are in the sketch. This asks the
other way round: a pose that is wrong leaves lines of the sketch without an edge of the model.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.geometry.pose import Array
from rendezview.sensors.appearance.edges.predicted import COLUMNS, NX, NY, OUTSIDE, STATE, U, V
from rendezview.sensors.appearance.edges.sketch import predict_view
from rendezview.sensors.appearance.model.sketches import Float32s
from rendezview.sensors.appearance.model.view_tables import Lens, ViewTables

# Half a strip along the edge at a contour point, in steps: half the spacing of the points of a
# craft with many edges. Source: by construction
_ALONG = 7
# … and across it, 1 % of the target's size: of 1.5, 2.5 and 4 px the narrower tells more on drawn
# frames, the wider on photographs. Source: frames of sketch-confidence, photo-accuracy
_ACROSS = 3
# Sketch px of a first pass; no pixel of the strip is stepped over. Source: half a diagonal
_STEP_PX = 0.7


@njit(cache=True, nogil=True, error_model="numpy")
def explained_share(
    lines: Float32s, lens: Lens, views: ViewTables, rotation: Array, centre: Array,
    seen: npt.NDArray[np.uint8],
) -> float:  # fmt: skip
    """Sum of a sketch's lines next to the contour points of the view nearest to a pose.

    Args:
        lines: (h, w) how much of a line there is, as a share of the sum; as fine as a first pass.
        lens: of a camera whose picture they are.
        rotation: (3, 3), and ``centre``: (3,) of the view centre, camera frame.
        seen: (h, w) scratch.
    """
    height, width = lines.shape
    edges = np.empty((views.point.shape[2], COLUMNS))
    one = int(np.int64(1))  # as a literal, numba would compile a copy of what is called for it
    _, _, count = predict_view(lens, views, rotation, centre, one, edges)
    seen[:] = 0
    share = 0.0
    for k in range(count):
        row = edges[k]
        if row[STATE] == OUTSIDE:
            continue
        step_x, step_y = _STEP_PX * row[NX], _STEP_PX * row[NY]
        for along in range(-_ALONG, _ALONG + 1):
            for across in range(-_ACROSS, _ACROSS + 1):
                x = row[U] - along * step_y + across * step_x + 0.5
                y = row[V] + along * step_x + across * step_y + 0.5
                if x >= 0.0 and y >= 0.0 and x < width and y < height:
                    column, line = int(x), int(y)
                    if seen[line, column] == 0:
                        seen[line, column] = 1
                        share += lines[line, column]
    return share
