"""Where in a picture full of other things the target may be: bodies in windows of many sizes.

The network draws what stands out in its window. A window that is little larger than the target
shows it whole even where the frame shows a desk, a room or clouds. Bodies that look like views of
the model come first.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np

from rendezview.geometry.boxes import overlap
from rendezview.geometry.pose import Array
from rendezview.io.grey_frame import Picture
from rendezview.sensors.appearance.edges.network import (
    COVERED,
    Bools,
    Box,
    Part,
    Sketch,
    Sketcher,
    around,
)
from rendezview.sensors.appearance.model.sketches import COVER
from rendezview.sensors.appearance.search.by_sketch import SketchRetrieval

# Sides of the windows, of the frame's shorter side: a target of any size between a tenth and
# two thirds of it has one that is 1.2 to 2.5 times larger. Source: by construction
_SIDES = (1.0, 0.62, 0.38)
# Sketch px a side: it shows where bodies are, and roughly which are like the target.
# Source: Mitsuba rooms, photographs of everyday objects
_WINDOW_PX = 128, 128
_CLOSER = 4  # of the likeliest bodies, sketched again as fine as others. Source: the same
_STEP = 0.5  # of a window, to the next one. Source: by construction, a body is whole in one
# Of a window: a smaller body has a smaller window of its own. Source: by construction
_LEAST_SIDE = 0.25
# Of the longer side of what a window shows of a body: so much more lies beyond. Source: drawn rooms
_BEYOND = 0.3
SAME_BODY = 0.5  # intersection over union of boxes of the same body. Source: as in detection


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """Something that stands out whole in a window."""

    box_px: Array  # (4,) left, top, right, bottom, frame px
    likeness: float  # correlation with the likeliest view of the model


def bodies_in_windows(
    sketcher: Sketcher, retrieval: SketchRetrieval, frame: Picture, most: int,
    may_be: Callable[[Array], bool] | None = None,
) -> list[Body]:  # fmt: skip
    """Bodies of a frame (H, W), those most like the target first, ``most`` at most.

    ``may_be``: whether a body with a box (4,), px, may be the target.
    """
    found, cut = list[Body](), list[Box]()
    for window in _windows(*frame.shape):
        sketch = sketcher.look(frame, window, _WINDOW_PX)
        found += _whole(sketch, retrieval)
        for box in _cut(sketch, frame.shape):
            if all(overlap(box, other) < SAME_BODY for other in cut):
                cut.append(box)
    for box in cut:
        found += _whole(sketcher.look(frame, around(box), _WINDOW_PX), retrieval)
    closer = list[Body]()
    for body in _likeliest(found, _CLOSER, may_be):
        left, top, right, bottom = body.box_px.tolist()
        shown = _whole(sketcher.look(frame, around((left, top, right, bottom))), retrieval)
        same = [one for one in shown if overlap(one.box_px, body.box_px) >= SAME_BODY]
        closer += same or [body]
    return _likeliest(closer, most, may_be)


def _likeliest(bodies: list[Body], most: int, may_be: Callable[[Array], bool] | None) -> list[Body]:
    """Of some bodies those most like the target that are not the same, ``most`` at most."""
    kept: list[Body] = []
    for body in sorted(bodies, key=lambda b: -b.likeness):
        if len(kept) == most:
            break
        told = may_be is None or may_be(body.box_px)
        if told and all(overlap(body.box_px, other.box_px) < SAME_BODY for other in kept):
            kept.append(body)
    return kept


def _windows(height: int, width: int) -> Iterator[Box]:
    """Squares all over a frame."""
    for share in _SIDES:
        side = share * min(height, width)
        lefts, tops = (_starts(whole, side) for whole in (width, height))
        for top in tops:
            for left in lefts:
                yield left - 0.5, top - 0.5, left + side - 0.5, top + side - 0.5


def _starts(whole: int, side: float) -> Array:
    """Where windows begin that cover a length evenly."""
    room = max(whole - side, 0.0)
    return np.linspace(0.0, room, 1 + int(np.ceil(room / (_STEP * side))))


def _whole(sketch: Sketch, retrieval: SketchRetrieval) -> Iterator[Body]:
    """Each body that lies whole within a sketch."""
    for inside, box, crossed in _bodies(sketch):
        if not crossed.any():
            alone = replace(sketch, maps=sketch.maps * inside)
            yield Body(np.array(sketch.box_in_frame(box)), retrieval.likeness(alone))


def _cut(sketch: Sketch, shape: tuple[int, int]) -> Iterator[Box]:
    """Where the rest of each body may be that leaves the window, but not a frame (H, W)."""
    for _, box, crossed in _bodies(sketch):
        left, top, right, bottom = sketch.box_in_frame(box)
        more = _BEYOND * max(right - left, bottom - top)
        at_border = left < 0.0 or top < 0.0 or right > shape[1] - 1.0 or bottom > shape[0] - 1.0
        if crossed.any() and not crossed.all(1).any() and not at_border:
            (to_left, to_right), (above, below) = more * crossed
            yield left - to_left, top - above, right + to_right, bottom + below


def _bodies(sketch: Sketch) -> Iterator[tuple[Bools, Part, Bools]]:
    """Each body of a sketch that is not small in it.

    Yields:
        Where it is (h, w), its box, sketch px, and which sides it crosses (2, 2): the left, the
        right; the upper, the lower.
    """
    covered = (sketch.maps[COVER] > COVERED).astype(np.uint8)
    height, width = covered.shape
    count, labels, boxes, _ = cv2.connectedComponentsWithStats(covered, connectivity=8)
    for k in range(1, count):
        left, top, across, down = (int(side) for side in boxes[k, :4])
        right, bottom = left + across, top + down
        crossed = np.array([[left == 0, right == width], [top == 0, bottom == height]])
        if max(across, down) >= _LEAST_SIDE * max(height, width):
            yield labels == k, (left, top, right, bottom), crossed
