"""What an edge of a ring shows of it, and how the grey levels beside it spoil its measurement."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rendezview.geometry.camera import Camera
from rendezview.sensors.ring.detector import Grey, RingEdge
from rendezview.sensors.ring.ellipse import Ellipse

# σ of an error of the ring's size, and of its place along its axis, that all pictures share: a
# rim's wall, of another grey, is next to its edge. Over the edge's contrast it gives px. Source:
# ring-size, seed 77: of 76 passes 4.5 (R) and 4.2 (D), at contrasts from 15 to 146
_COMMON_PX_GREY = 5.0
# Level within an edge over that outside, of no light. Source: ring-size, seed 77: shadows 0.04 to
# 0.09, rings from 0.23 on
_UNLIT = 0.14
_WHITE = 250  # grey level of a pixel that may be more. Source: by construction, 8 bits less noise
_ASIDE_PX = 3.0  # from an edge to its sides. Source: by construction, 3 σ of the blur


@dataclass(frozen=True, slots=True)
class EdgeSides:
    """What the grey levels beside an edge say."""

    near_px: float  # σ of an error by what is next to the edge, the same in all frames
    cut_px: float  # the same by levels cut at white: the edge is measured too far on the dark side
    unlit: bool  # no light comes from within
    shown: float  # visible share of the circle

    @classmethod
    def of(cls, image: Grey, camera: Camera, edge: RingEdge, blur_px: float) -> EdgeSides:
        """Of an edge of a picture."""
        x, y, a11, a12, a22 = edge.ellipse.shape
        levels = []
        for move in (-_ASIDE_PX, _ASIDE_PX):
            side = Ellipse.from_shape(np.array([x, y, a11 + move, a12, a22 + move]))
            places = np.rint(camera.project(camera.pinhole.rays(side.points())))
            within = ((places >= 0) & (places < (camera.width, camera.height))).all(axis=1)
            column, row = places[within].astype(np.int64).T
            levels.append(image[row, column] if len(row) else np.zeros(1))
        inside, outside = levels
        white = float(np.mean((outside if edge.contrast_grey > 0.0 else inside) >= _WHITE))
        unlit = bool(np.median(inside) < _UNLIT * np.median(outside))
        near_px = _COMMON_PX_GREY / max(abs(edge.contrast_grey), 1.0)
        shown = min(edge.arc_rad / math.tau, 1.0)
        return cls(near_px, white * blur_px, unlit, shown)
