"""How well the maps of a sketch agree with a view of the model at a pose."""

from __future__ import annotations

import cv2
import numpy as np

from rendezview.geometry.pose import Array
from rendezview.sensors.appearance.sketch.network import COVER, CREASE, EDGE, SIDE_PX, Float32s
from rendezview.sensors.appearance.sketch.retrieval import nearest_view, towards
from rendezview.sensors.appearance.sketch.views import GRID, REACH, ViewSketches

_COMPARED_PX = SIDE_PX // 2  # at most, a side: a view's maps are no finer. Source: by construction
# Source: experiment photo-accuracy
_LINE_SIGMA_CELLS = 1.2  # σ, cells: lines of the nearest view lie a little aside


class SketchAgreement:
    """Compares one sketch with poses."""

    def __init__(self, views: ViewSketches, maps: Float32s) -> None:
        """
        Args:
            views: of the model.
            maps: (MAPS, h, w) of the sketch.
        """
        self._views = views
        height, width = maps.shape[1:]
        self._coarser = max(2, -(-max(width, height) // _COMPARED_PX))  # times than the sketch
        self._size = max(1, width // self._coarser), max(1, height // self._coarser)
        self._maps = np.stack(
            [np.asarray(cv2.resize(m, self._size, interpolation=cv2.INTER_AREA)) for m in maps]
        )
        self._lines = {k: _line(self._maps[k]) for k in (EDGE, CREASE)}

    def of(
        self, rotation: Array, centre: Array, centre_px: Array, radius_px: float
    ) -> tuple[float, float, float]:
        """Overlap of covers (intersection over union), correlations of edges and of creases.

        Args:
            rotation: (3, 3), and ``centre``: (3,) of the view centre, camera frame.
            centre_px: (2,) of the view centre in the sketch.
            radius_px: a target radius there, sketch px.
        """
        ahead = towards(centre / np.linalg.norm(centre)).T @ rotation
        view, turn = nearest_view(self._views, ahead)
        c, s = np.cos(turn), np.sin(turn)
        spin = np.array([[c, -s], [s, c]])
        middle_px = centre_px + radius_px * spin @ self._views.centre_radii[view]
        cell = 2.0 * REACH * float(self._views.size_radii[view]) * radius_px / GRID
        linear = cell / self._coarser * spin
        shift = (middle_px + 0.5) / self._coarser - 0.5 - linear @ np.full(2, 0.5 * (GRID - 1))
        warp = np.column_stack([linear, shift])
        drawn = np.stack(
            [np.asarray(cv2.warpAffine(m, warp, self._size)) for m in self._views.decoded(view)]
        )
        cover, shown = drawn[COVER], self._maps[COVER]
        both = float((cover * shown).sum())
        union = float((cover + shown).sum()) - both
        return (
            both / (union + 1e-6),
            float((_line(drawn[EDGE]) * self._lines[EDGE]).sum()),
            float((_line(drawn[CREASE]) * self._lines[CREASE]).sum()),
        )


def _line(plane: Float32s) -> Float32s:
    """A map of lines, softened, without its mean, of unit norm: products are correlations."""
    soft = np.asarray(cv2.GaussianBlur(plane, (0, 0), _LINE_SIGMA_CELLS))
    soft = soft - soft.mean()
    return np.asarray(soft / (np.linalg.norm(soft) + 1e-6), dtype=np.float32)
