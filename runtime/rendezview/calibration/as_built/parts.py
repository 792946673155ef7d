"""Parts of a craft that are mounted otherwise than its CAD model has them.

A bent antenna or a wing at another angle moves as a rigid body. A part is all that lies in some
boxes; it turns about their middle and is shifted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from rendezview.calibration.as_built.strain import stored_points, turned_directions
from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Array
from rendezview.geometry.so3 import exp, log
from rendezview.io.parts import TrustedPart
from rendezview.sensors.appearance.model.contours import NO_POINT, POINT_UNIT
from rendezview.sensors.appearance.model.view_model import ViewModel

MARGIN_RADII = 2e-4  # of the target's radius; beyond a box, for rounding. Source: unit of points
_SEED = 0  # of the points that a distrusted part keeps. Source: by construction

Shorts = npt.NDArray[np.int16]
Bytes = npt.NDArray[np.int8]


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """Where a part is in the model, and how it is mounted instead."""

    name: str
    boxes_m: Array  # (K, 2, 3) lowest and highest corner, from the view centre, target axes
    turn: Array  # (3, 3) about the middle of the boxes
    move_m: Array  # (3,)

    @classmethod
    def of(cls, part: TrustedPart, model: ViewModel) -> Part:
        """A part of the target file, mounted as the model has it.

        Raises:
            RendezviewError: it has no boxes, or no contour point of the model lies in them.
        """
        if not part.boxes_m:
            raise RendezviewError(
                f"part {part.name!r} is given by nodes only: calibration needs its boxes_m"
            )
        boxes = np.array(part.boxes_m) - model.centre_m
        made = cls(part.name, boxes, np.eye(3), np.zeros(3))
        if not made.holds(_contour_places(model)).any():
            raise RendezviewError(f"part {part.name!r}: no contour point of the model is in it")
        return made

    @property
    def middle_m(self) -> Array:
        """(3,) of the boxes, from the view centre."""
        lowest, highest = self.boxes_m[:, 0].min(0), self.boxes_m[:, 1].max(0)
        return np.asarray(0.5 * (lowest + highest))

    def holds(self, places_m: Array, margin_m: float = 0.0) -> npt.NDArray[np.bool_]:
        """(…) whether places (…, 3) of the model as it was, from the view centre, are of it."""
        inside = np.zeros(places_m.shape[:-1], dtype=np.bool_)
        for low, high in self.boxes_m:
            inside |= np.all((places_m >= low - margin_m) & (places_m <= high + margin_m), axis=-1)
        return inside

    def after(self, step: Array) -> Part:
        """Turned and moved by a little more: (6,) rad and m."""
        turn = exp(np.ascontiguousarray(step[:3])) @ self.turn
        return replace(self, turn=turn, move_m=self.move_m + step[3:])

    @property
    def motion(self) -> Array:
        """(6,) rotation vector, rad, and shift, m."""
        return np.concatenate([log(self.turn), self.move_m])


def remounted(
    model: ViewModel, original: ViewModel, parts: Sequence[Part], strain: Array
) -> ViewModel:
    """A strained model with its parts turned and shifted.

    What a part hides or leaves free by its motion stays as it was: the motion must be small.

    Args:
        model: with the strain.
        original: without; tells what is of a part.
        parts: their mounting.
        strain: (3, 3).
    """
    contours, surface = model.contours, model.surface
    assert contours is not None
    unit_m = POINT_UNIT * model.target_radius_m
    margin_m = MARGIN_RADII * model.target_radius_m

    def mounted(points: Shorts, directions: Bytes, places: Array) -> tuple[Shorts, Bytes]:
        """Points and directions of the strained model, by their places as they were."""
        moved, turned = points.copy(), directions.copy()
        for part in parts:
            own = part.holds(places, margin_m)
            middle = part.middle_m + strain @ part.middle_m
            at = points[own] * unit_m - middle
            moved[own] = stored_points((at @ part.turn.T + middle + part.move_m) / unit_m)
            turned[own] = turned_directions(directions[own], part.turn)
        return moved, turned

    point, tangent = mounted(contours.point, contours.tangent, _contour_places(original))
    contours = replace(contours, point=point, tangent=tangent)
    if surface is not None and original.surface is not None:
        places = _places(original.surface.point, original)
        point, normal = mounted(surface.point, surface.normal, places)
        surface = replace(surface, point=point, normal=normal)
    return replace(model, contours=contours, surface=surface)


def distrusted(
    model: ViewModel, original: ViewModel, trusts: Sequence[tuple[Part, float]]
) -> ViewModel:
    """A model whose parts keep only a share of their contour points each."""
    contours = model.contours
    assert contours is not None
    kind, places = contours.kind, _contour_places(original)
    drop = np.zeros(kind.shape, dtype=np.bool_)
    rng = np.random.default_rng(_SEED)
    for part, trust in trusts:
        own = part.holds(places, MARGIN_RADII * original.target_radius_m)
        drop |= own & (rng.random(kind.shape) >= trust)
    drop &= kind != NO_POINT
    if not drop.any():
        return model
    gone = drop | (kind == NO_POINT)
    order = np.argsort(gone, axis=-1, kind="stable")  # rows without a point stand last
    kept = {
        name: np.take_along_axis(
            array, order.reshape(order.shape + (1,) * (array.ndim - order.ndim)), axis=2
        )
        for name in ("point", "tangent", "run", "strip", "start", "part")
        if (array := getattr(contours, name)) is not None
    }
    kept["kind"] = np.take_along_axis(np.where(gone, np.uint8(NO_POINT), kind), order, axis=-1)
    return replace(model, contours=replace(contours, **kept))


def _contour_places(model: ViewModel) -> Array:
    """(S, V, N, 3) contour points from the view centre, m."""
    assert model.contours is not None
    return _places(model.contours.point, model)


def _places(points: Shorts, model: ViewModel) -> Array:
    """Stored points (…, 3) from the view centre, m."""
    return np.asarray(points * np.float32(POINT_UNIT * model.target_radius_m))
