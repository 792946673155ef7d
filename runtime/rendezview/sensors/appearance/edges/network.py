"""The sketch of a frame: where the target is, its edges and facets, as a network draws them.

A photograph in hard light shows what no mesh has: a face burnt out, another black, cells, foil,
shadows, clouds. The network turns it into what the mesh does have: cover, outer edges and creases.
It is a U-Net (Ronneberger et al. 2015) that has seen random spacecraft only
(experiment sketch-network), so it is specific to no target.
"""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import numpy.typing as npt

from rendezview.geometry.pose import Array
from rendezview.io.grey_frame import Picture
from rendezview.sensors.appearance.model.sketches import COVER, Float32s

if TYPE_CHECKING:
    from onnxruntime import InferenceSession

NETWORK = Path(__file__).with_name("sketch.onnx")
SIDE_PX = 256  # sketch px; the network is trained at this size. Source: experiment sketch-network
# Px a side: the pixels of a square become channels. Source: experiment sketch-network
SQUARE_PX = 4
_MULTIPLE_PX = 64  # px; a side must allow four halvings of the squares. Source: by construction
FAINT_GREY = 8.0  # grey levels; the second channel saturates there. Source: as trained
_GLANCE_PX = (320, 240)  # sketch px; at most, of the pass over the whole frame. Source: as trained
_MARGIN = 1.4  # of the box of the target: side of the square that is sketched. Source: as trained
# Source: its cost; no other is better in experiment photo-accuracy (docs/notes/photographs.md)
_CLOSER_MARGIN = 0.1  # of the box's longer side, around it in closer passes
_LEAST_SIDE = 0.75  # of SIDE_PX: a smaller square would be magnified. Source: as trained
COVERED = 0.5  # probability. Source: by construction
_SUREST = 1e-6  # of the sky or the target; log odds stay finite. Source: by construction
_LOOKS = 3  # at a body whose box changes. Source: by construction, a bound of time
FINER = 2  # times a first pass: closer ones. Source: experiment photo-accuracy
_PIECE_SHARE = (
    0.03  # of the largest piece; smaller ones are specks. Source: experiment photo-accuracy
)
# Source: experiment photo-accuracy
_PIECE_GAP = 0.4  # of the largest piece's size; pieces this near belong to it

Bools = npt.NDArray[np.bool_]
Box = tuple[float, float, float, float]  # left, top, right, bottom; frame px
Part = tuple[int, int, int, int]  # the same in whole pixels, right and bottom beyond the last


@dataclass(frozen=True, slots=True, eq=False)
class Sketch:
    """What the network draws of a part of a frame.

    A place (u, v) of the frame is at (scale u + left, scale v + top) of the sketch.
    """

    maps: Float32s  # (MAPS, h, w), 0 … 1
    grey: Picture  # (h, w) what the network saw
    scale: float  # sketch px a frame px
    left_px: float  # sketch px
    top_px: float  # sketch px
    crossed: Bools  # (2, 2) the target leaves the frame: to the left, the right; above, below
    fineness: float  # how many times as fine as a first pass, whose square is SIDE_PX large

    @property
    def is_cut(self) -> bool:
        """Whether the target leaves the frame."""
        return bool(self.crossed.any())

    @property
    def overflows(self) -> bool:
        """Whether it leaves the frame on two opposite sides."""
        return bool(self.crossed.all(1).any())

    @property
    def rest(self) -> Array:
        """(2,) −1, 0 or 1: where the rest of the target lies, to the right and below."""
        return self.crossed[:, 1].astype(float) - self.crossed[:, 0]

    def box_in_frame(self, box: Part) -> Box:
        """A box of whole pixels of the sketch, right and bottom beyond the last, in the frame."""
        x0, y0, x1, y1 = (side - 0.5 for side in box)
        s, u, v = self.scale, self.left_px, self.top_px
        return float((x0 - u) / s), float((y0 - v) / s), float((x1 - u) / s), float((y1 - v) / s)

    def odds(self, shape: tuple[int, ...], times: int) -> Float32s:
        """(H / n, W / n) log odds of target to sky, a pixel for n × n of a frame (H, W)."""
        share = np.clip(self.maps[COVER], _SUREST, 1.0 - _SUREST)
        scale, shift = self.scale * times, 0.5 * self.scale * (times - 1)
        to_sketch = np.array(
            [[scale, 0.0, self.left_px + shift], [0.0, scale, self.top_px + shift]]
        )
        drawn = cv2.warpAffine(
            np.log(share / (1.0 - share)), to_sketch, (shape[1] // times, shape[0] // times),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderValue=math.log(_SUREST),
        )  # fmt: skip
        return np.asarray(drawn, dtype=np.float32)

    @property
    def place(self) -> Array:
        """(3,) scale, left and top for compiled loops."""
        return np.array([self.scale, self.left_px, self.top_px])


class Sketcher:
    """The network. It is read at its first use, and one thread uses it at a time."""

    def __init__(self) -> None:
        self._session: InferenceSession | None = None
        self._lock = threading.Lock()

    def find(self, frame: Picture, *, turned: bool = False) -> Sketch | None:
        """The sketch of the target, wherever it is in the frame; None where there is none.

        A glance at the whole frame gives the target's box, a look at that a better one.
        ``turned``: as of ``look``.
        """
        height, width = frame.shape
        whole = -0.5, -0.5, width - 0.5, height - 0.5
        glance = self.look(frame, whole, _GLANCE_PX, turned=turned)
        box = _box_of(glance)
        sketch = None if box is None else self.near(frame, box, turned=turned)
        return None if sketch is None or _box_of(sketch) is None else sketch

    def near(
        self, frame: Picture, box: Box, fineness: int = 1, *, turned: bool = False
    ) -> Sketch | None:
        """The sketch of a target whose box is known; None where it is out of the frame.

        ``fineness``: at 1 the box need not be known well, and the square around it is drawn; finer
        looks draw little more than the box.
        """
        height, width = frame.shape
        left, top, right, bottom = box
        if right < 0.0 or bottom < 0.0 or left > width - 1.0 or top > height - 1.0:
            return None
        square = around(box)
        if fineness > 1:
            scale = _scale(_inside(frame, square), (fineness * SIDE_PX, fineness * SIDE_PX))
            part = _inside(frame, _widened(box, _CLOSER_MARGIN))
            return self._drawn(frame, part, scale, float(fineness), turned=turned)
        sketch = self.look(frame, square, turned=turned)
        better = _box_of(sketch)
        if better is not None and _differ(box, better):
            sketch = self.look(frame, around(better), turned=turned)
        return sketch

    def closer(self, frame: Picture, first: Sketch) -> Sketch:
        """A finer sketch of the body that one shows; the same where it shows none.

        What lies near the body is less often taken for it then, so its box is looked at again.
        """
        sketch, box = first, _box_of(first)
        for _ in range(_LOOKS):
            finer = None if box is None else self.near(frame, box, FINER)
            if box is None or finer is None:
                break
            sketch, better = finer, _box_of(finer)
            if better is None or not _differ(box, better):
                break
            box = better
        return sketch

    def look(
        self,
        frame: Picture,
        box: Box,
        most_px: tuple[int, int] = (SIDE_PX, SIDE_PX),
        *,
        turned: bool = False,
    ) -> Sketch:
        """The sketch of a box of the frame, as far as it lies within, at most ``most_px`` large.

        ``turned``: the network sees it upside down, and errs otherwise.
        """
        part, fineness = _inside(frame, box), max(most_px) / SIDE_PX
        return self._drawn(frame, part, _scale(part, most_px), fineness, turned=turned)

    def _drawn(
        self, frame: Picture, part: Part, scale: float, fineness: float, *, turned: bool
    ) -> Sketch:
        """The sketch of a part of the frame, ``scale`` sketch px a frame px large."""
        height, width = frame.shape
        left, top, right, bottom = part
        grey = frame[top:bottom, left:right].astype(np.float32)
        columns = max(1, round(scale * (right - left)))
        rows = max(1, round(scale * (bottom - top)))
        how = cv2.INTER_AREA if scale <= 1.0 else cv2.INTER_LINEAR
        grey = cv2.resize(grey, (columns, rows), interpolation=how).astype(np.float32, copy=False)
        shown = np.asarray(cv2.convertScaleAbs(grey), dtype=np.uint8)
        if turned:
            grey = np.ascontiguousarray(grey[::-1, ::-1])
        maps = _probabilities(self._log_odds(grey))
        if turned:
            maps = np.ascontiguousarray(maps[:, ::-1, ::-1])
        # Rounding makes the scales of the axes differ by less than half a sketch pixel's share.
        scale = 0.5 * (columns / (right - left) + rows / (bottom - top))
        cover = maps[COVER] > COVERED
        across = left == 0 and cover[:, 0].any(), right == width and cover[:, -1].any()
        down = top == 0 and cover[0].any(), bottom == height and cover[-1].any()
        # Pixel k of the frame covers k − 0.5 … k + 0.5, in the sketch likewise.
        shift_x, shift_y = scale * (0.5 - left) - 0.5, scale * (0.5 - top) - 0.5
        return Sketch(maps, shown, scale, shift_x, shift_y, np.array([across, down]), fineness)

    def _log_odds(self, grey: Float32s) -> Float32s:
        """(MAPS, h, w) of a picture (h, w) of grey levels."""
        rows, columns = grey.shape
        below, right = -rows % _MULTIPLE_PX, -columns % _MULTIPLE_PX
        padded = np.pad(channels_of(grey), ((0, 0), (0, below), (0, right)), mode="edge")
        with self._lock:
            if self._session is None:
                self._session = _session()
            drawn = self._session.run(None, {"squares": to_squares(padded)[None]})[0][0]
        return np.ascontiguousarray(from_squares(np.asarray(drawn))[:, :rows, :columns])


def _session() -> InferenceSession:
    import onnxruntime as ort  # half a second, for the frames that need it only

    options = ort.SessionOptions()
    options.intra_op_num_threads = 1  # frames, not the parts of one, are the parallelism
    options.log_severity_level = 3
    return ort.InferenceSession(str(NETWORK), options, providers=["CPUExecutionProvider"])


def _probabilities(odds: Float32s) -> Float32s:
    """1 / (1 + exp(−odds)), in place."""
    np.negative(odds, out=odds)
    np.clip(odds, None, 60.0, out=odds)  # exp stays finite
    np.exp(odds, out=odds)
    odds += np.float32(1.0)
    return np.asarray(np.reciprocal(odds, out=odds))


def channels_of(grey: Float32s) -> Float32s:
    """(2, h, w): the grey levels 0 … 1, and faint differences from the median magnified."""
    channels = np.empty((2, *grey.shape), np.float32)
    np.divide(grey, np.float32(255.0), out=channels[0])
    np.subtract(grey, np.float32(np.median(grey[::4, ::4])), out=channels[1])
    channels[1] /= np.float32(FAINT_GREY)
    np.tanh(channels[1], out=channels[1])
    return channels


def to_squares(planes: Float32s) -> Float32s:
    """(C, H, W) to (C n², H/n, W/n): the pixels of each square of n = SQUARE_PX, row by row."""
    n = SQUARE_PX
    count, height, width = planes.shape
    squares = planes.reshape(count, height // n, n, width // n, n).transpose(0, 2, 4, 1, 3)
    return np.ascontiguousarray(squares.reshape(count * n * n, height // n, width // n))


def from_squares(squares: Float32s) -> Float32s:
    """(C n², H/n, W/n) to (C, H, W): the inverse of ``to_squares``."""
    n = SQUARE_PX
    count, height, width = squares.shape
    planes = squares.reshape(count // (n * n), n, n, height, width).transpose(0, 3, 1, 4, 2)
    return np.ascontiguousarray(planes.reshape(count // (n * n), n * height, n * width))


def _box_of(sketch: Sketch) -> Box | None:
    """The box of the likeliest body and the pieces near it, frame px; None without a body."""
    cover = sketch.maps[COVER]
    mask = (cover > COVERED).astype(np.uint8)
    count, labels, boxes, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    if count < 2:
        return None
    mass = np.bincount(labels.ravel(), cover.ravel(), count)
    mass[0] = 0.0
    main = int(np.argmax(mass))
    left, top, width, height = (int(x) for x in boxes[main, :4])
    reach = _PIECE_GAP * max(width, height)
    apart_x = np.maximum(boxes[:, 0] - (left + width), left - (boxes[:, 0] + boxes[:, 2]))
    apart_y = np.maximum(boxes[:, 1] - (top + height), top - (boxes[:, 1] + boxes[:, 3]))
    near = (mass > _PIECE_SHARE * mass[main]) & (np.maximum(apart_x, apart_y) < reach)
    near[main] = True
    pieces = boxes[near]
    right, bottom = (pieces[:, k] + pieces[:, k + 2] for k in (0, 1))
    box = pieces[:, 0].min(), pieces[:, 1].min(), right.max(), bottom.max()
    return sketch.box_in_frame((int(box[0]), int(box[1]), int(box[2]), int(box[3])))


def around(box: Box) -> Box:
    """The square to sketch around the box of a target."""
    x, y = 0.5 * (box[0] + box[2]), 0.5 * (box[1] + box[3])
    half = 0.5 * max(_MARGIN * max(box[2] - box[0], box[3] - box[1]), _LEAST_SIDE * SIDE_PX)
    return x - half, y - half, x + half, y + half


def _widened(box: Box, share: float) -> Box:
    """The box, wider on each side by a share of its longer side."""
    more = share * max(box[2] - box[0], box[3] - box[1])
    return box[0] - more, box[1] - more, box[2] + more, box[3] + more


def _inside(frame: Picture, box: Box) -> Part:
    """The pixels of a frame in a box, one at least."""
    height, width = frame.shape
    left, top = max(0, round(box[0] + 0.5)), max(0, round(box[1] + 0.5))
    right, bottom = min(width, round(box[2] + 0.5)), min(height, round(box[3] + 0.5))
    left, top = min(left, width - 1), min(top, height - 1)
    return left, top, max(right, left + 1), max(bottom, top + 1)


def _scale(part: Part, most_px: tuple[int, int]) -> float:
    """Sketch px a frame px, so that a part is as large as it may be."""
    return min(most_px[0] / (part[2] - part[0]), most_px[1] / (part[3] - part[1]))


def _differ(a: Box, b: Box) -> bool:
    """Whether two boxes differ so much that another pass pays."""
    size = max(a[2] - a[0], a[3] - a[1])
    return max(abs(p - q) for p, q in zip(a, b, strict=True)) > 0.1 * size
