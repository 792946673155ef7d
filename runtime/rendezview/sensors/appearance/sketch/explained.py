"""How much of a sketch a pose explains: the compiled loop.

Alignment and ``sketch_agreement`` ask whether the model's edges are in the sketch. This asks the
other way round: a pose that is wrong leaves lines of the sketch without an edge of the model.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.geometry.pose import Array
from rendezview.sensors.appearance.edges.alignment import nearest_views
from rendezview.sensors.appearance.edges.contours import NO_POINT, POINT_UNIT
from rendezview.sensors.appearance.edges.edge_search import COLUMNS, NX, NY, U, V
from rendezview.sensors.appearance.edges.view_tables import Lens, ViewTables
from rendezview.sensors.appearance.sketch.alignment import predict_edge
from rendezview.sensors.appearance.sketch.network import Float32s

# Sketch px of a first look, to either side of a contour point along its edge: half the spacing of
# the points of a craft with many edges. Source: by construction
_ALONG_PX = 5.0
# … and across it, 1 % of the target's size: of 1.5, 2.5 and 4 px the narrower tells more on drawn
# frames, the wider on photographs. Source: frames of sketch-confidence, photo-accuracy
_ACROSS_PX = 2.0
# Sketch px; no pixel of the strip is stepped over. The last step ends up to as much before the far
# side, so that a strip of a first look reaches 2.0 px against the normal and 1.5 px along it. The
# trees are fitted to it. Source: half a diagonal
_STEP_PX = 0.7


@njit(cache=True, nogil=True, error_model="numpy")
def explained_share(
    lines: Float32s, place: Array, fineness: float, lens: Lens, views: ViewTables,
    rotation: Array, centre: Array, seen: npt.NDArray[np.uint8],
) -> float:  # fmt: skip
    """Sum of a sketch's lines next to the contour points of the view nearest to a pose.

    Args:
        lines: (h, w) how much of a line there is, as a share of the sum.
        place: (3,) of ``Sketch.place``.
        fineness: of the sketch.
        rotation: (3, 3), and ``centre``: (3,) of the view centre, camera frame.
        seen: (h, w) scratch.
    """
    height, width = lines.shape
    nearest = np.zeros(1, dtype=np.int64)
    shell = nearest_views(views.directions, views.shells_m, rotation, centre, nearest)
    view = nearest[0]
    row = np.empty(COLUMNS)
    along, across = _ALONG_PX * fineness, _ACROSS_PX * fineness
    seen[:] = 0
    share = 0.0
    for j in range(views.point.shape[2]):
        if views.kind[shell, view, j] == NO_POINT:
            break
        if not predict_edge(
            views.point[shell, view, j], views.tangent[shell, view, j], lens, place,
            views.radius_m * POINT_UNIT, rotation, centre, row,
        ):  # fmt: skip
            continue
        a = -along
        while a <= along:
            b = -across
            while b <= across:
                x = row[U] - a * row[NY] + b * row[NX] + 0.5
                y = row[V] + a * row[NX] + b * row[NY] + 0.5
                if x >= 0.0 and y >= 0.0 and x < width and y < height:
                    column, line = int(x), int(y)
                    if seen[line, column] == 0:
                        seen[line, column] = 1
                        share += lines[line, column]
                b += _STEP_PX
            a += _STEP_PX
    return share
