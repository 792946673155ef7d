"""The size of a ring from a sequence of frames and a ranger's log (Zhai et al.'s task).

Each frame gives a panel's corners, ellipses and a range. Which ellipse is the ring's is decided by
the pass: a circle has the same radius and place in every frame, a chance ellipse has not.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array
from rendezview.io.sequences.frame import Frame, Sequence
from rendezview.sensors.observation import Status
from rendezview.sensors.ring.detector import RingDetector, RingEdge, RingOptions
from rendezview.sensors.ring.edge_sides import EdgeSides
from rendezview.sensors.ring.ellipse import Ellipse
from rendezview.sensors.ring.panel import Panel, find_panel
from rendezview.sensors.ring.rectangle import Beam
from rendezview.sensors.ring.ring_pass import LEAST_FRAMES, PassSize, ring_size_of_pass
from rendezview.sensors.ring.ring_size import RingSight, ring_size
from rendezview.sensors.ring.size_choice import which_is_the_ring
from rendezview.sensors.ring.size_circles import Ellipses, PassCircle, circles_of_pass

_MOST_GAP_S = 1.0  # between two echoes that a range is interpolated from. Source: by construction
_SAME_S = 1e-3  # an echo of the frame's own time. Source: by construction, a time in ms


@dataclass(frozen=True, slots=True, eq=False)
class Echo:
    """One range of a laser."""

    range_m: float
    sigma_m: float
    beam: Beam


@dataclass(frozen=True, slots=True, eq=False)
class SizeFrame:
    """One frame of the pass."""

    frame: Frame
    reason: str | None = None  # why it says nothing
    panel: Panel | None = None
    echo: Echo | None = None
    edges: tuple[RingEdge, ...] = ()
    sights: tuple[RingSight, ...] = ()  # of the edges beside the beam
    sides: tuple[EdgeSides, ...] = ()  # of the same edges

    def record(self) -> dict[str, Any]:
        """Its line of the log; each frame's circles as if their axis met the panel's middle."""
        camera = self.frame.camera.pinhole
        sizes = filter(None, (ring_size(camera, sight) for sight in self.sights))
        return {
            "im_id": self.frame.im_id,
            "image": self.frame.name,
            "time_s": self.frame.time_s,
            "reason": self.reason,
            "corners_px": None if self.panel is None else self.panel.corners_px,
            "corner_sigma_px": None if self.panel is None else self.panel.sigma_px,
            "range_m": None if self.echo is None else self.echo.range_m,
            "circles": [
                {"radius_m": s.radius_m, "distance_m": s.distance_m, "covariance": s.covariance}
                for s in sizes
            ],
        }


@dataclass(frozen=True, slots=True, eq=False)
class SizeResult:
    """The ring of a pass, or why there is none."""

    size: PassSize | None
    reason: str | None
    frames: int
    measured: int  # frames with a panel, a range and an ellipse
    circles: tuple[PassCircle, ...] = ()  # the likeliest one first
    ambiguous: bool = False

    @property
    def status(self) -> Status:
        """OK, AMBIGUOUS or NOT_FOUND."""
        if self.size is not None:
            return Status.OK
        return Status.AMBIGUOUS if self.ambiguous else Status.NOT_FOUND

    def record(self) -> dict[str, Any]:
        """One line of JSON: metres; σ are one standard deviation."""
        record: dict[str, Any] = {
            "status": str(self.status),
            "reason": self.reason,
            "frames": self.frames,
            "measured": self.measured,
        }
        if self.size is not None:
            size = self.size
            sigma = np.sqrt(np.diag(size.covariance))
            record |= {
                "used": len(size.used),
                "radius_m": size.radius_m,
                "radius_sigma_m": sigma[0],
                "diameter_m": 2.0 * size.radius_m,
                "diameter_sigma_m": 2.0 * sigma[0],
                "distance_m": size.distance_m,
                "distance_sigma_m": sigma[1],
                "offset_m": size.offset_m,
                "offset_sigma_m": sigma[2:],
                "panel_m": size.sides_m,
                "covariance": size.covariance,
                "chi2": size.chi2,
                "freedom": size.freedom,
            }
        record["circles"] = [
            {"radius_m": c.radius_m, "distance_m": c.distance_m, "frames": len(c.members)}
            for c in self.circles
        ]
        return record


def read_echoes(records: Iterable[dict[str, Any]], where: str) -> Callable[[Frame], Echo | None]:
    """The ranges of a laser ranger's log, by frame.

    Lines with ``im_id`` belong to that frame. Others belong to the frame of their time; between two
    echoes at most 1 s apart the range is interpolated.

    Args:
        records: lines with ``range_m`` (None: no echo), ``sigma_m``, ``time_s`` or ``im_id``;
            optional ``origin_m`` and ``direction`` of the beam in the camera frame.
        where: the file, for messages.

    Raises:
        RendezviewError: a line is wrong.
    """
    of_frame: dict[int, Echo] = {}
    timed: list[tuple[float, Echo]] = []
    for number, record in enumerate(records, start=1):
        try:
            if record["range_m"] is None:
                continue
            echo = _echo(record)
            if record.get("im_id") is not None:
                of_frame[int(record["im_id"])] = echo
            else:
                timed.append((float(record["time_s"]), echo))
        except (KeyError, TypeError, ValueError) as error:
            said = f"no key {error}" if isinstance(error, KeyError) else str(error)
            raise RendezviewError(
                f"{where}: record {number}: no line of a ranger's log ({said}): needs range_m, "
                "sigma_m, and time_s or im_id"
            ) from error
    timed.sort(key=lambda line: line[0])
    times = np.array([time_s for time_s, _ in timed])

    def at(frame: Frame) -> Echo | None:
        if frame.im_id in of_frame or frame.time_s is None or not timed:
            return of_frame.get(frame.im_id)
        near = int(np.argmin(np.abs(times - frame.time_s)))
        if abs(times[near] - frame.time_s) <= _SAME_S:
            return timed[near][1]
        after = int(np.searchsorted(times, frame.time_s))
        if not 0 < after < len(timed) or times[after] - times[after - 1] > _MOST_GAP_S:
            return None
        (t0, one), (t1, other) = timed[after - 1], timed[after]
        share = (frame.time_s - t0) / (t1 - t0)
        range_m = (1.0 - share) * one.range_m + share * other.range_m
        return Echo(range_m, max(one.sigma_m, other.sigma_m), one.beam)

    return at


def _echo(record: dict[str, Any]) -> Echo:
    range_m, sigma_m = float(record["range_m"]), float(record["sigma_m"])
    if not (0.0 < range_m < np.inf and 0.0 < sigma_m < np.inf):
        raise ValueError(f"range_m and sigma_m must be positive: {range_m}, {sigma_m}")
    origin = np.array(record.get("origin_m", (0.0, 0.0, 0.0)), dtype=np.float64)
    direction = np.array(record.get("direction", (0.0, 0.0, 1.0)), dtype=np.float64)
    length = float(np.linalg.norm(direction))
    if origin.shape != (3,) or direction.shape != (3,) or not 0.0 < length < np.inf:
        raise ValueError("origin_m and direction must be three numbers")
    return Echo(range_m, sigma_m, Beam(origin, direction / length))


class SizeSensor:
    """Panel, ellipses and range of each frame of a pass; remembers the panel's attitude."""

    def __init__(self, options: RingOptions | None = None) -> None:
        self.options = options or RingOptions()
        self._detectors: dict[Camera, RingDetector] = {}
        self._attitude: Array | None = None

    def measure(self, frame: Frame, echo: Echo | None) -> SizeFrame:
        """What a frame says of the ring's size; never raises for a picture that says nothing."""
        try:
            image = frame.read()
        except RendezviewError as error:
            return SizeFrame(frame, str(error))
        if echo is None:
            return SizeFrame(frame, "no range at this time")
        camera = frame.camera.pinhole
        panel = find_panel(image, frame.camera, self.options.blur_px)
        if panel is None:
            return SizeFrame(frame, "no panel: no quadrilateral with four sharp sides", echo=echo)
        ordered = panel.ordered(camera, self._attitude)
        if ordered is None:
            return SizeFrame(frame, "the four corners are of no rectangle", panel, echo)
        corners, self._attitude = ordered
        spot = camera.project(echo.beam.end(echo.range_m)[None])[0]
        if not (np.isfinite(spot).all() and panel.holds(spot)):
            return SizeFrame(frame, "the ranger's beam misses the panel", panel, echo)
        if frame.camera not in self._detectors:
            self._detectors[frame.camera] = RingDetector(frame.camera, self.options)
        edges = self._detectors[frame.camera].detect(image).edges
        sights, sides = [], []
        for edge in edges:
            spread = edge.ellipse.shape_covariance
            # What the beam meets within an ellipse is not known to be the panel.
            if edge.ellipse.holds(spot) or spread is None or not np.isfinite(spread).all():
                continue
            side = EdgeSides.of(image, frame.camera, edge, self.options.blur_px)
            spread = spread + (edge.systematic_px**2 + side.cut_px**2) * np.eye(5)
            ellipse = Ellipse.from_shape(edge.ellipse.shape, spread)
            sides.append(side)
            sights.append(
                RingSight(corners, ellipse, echo.range_m, panel.sigma_px, echo.sigma_m, echo.beam)
            )
        reason = None if sights else "no ellipse beside the beam"
        return SizeFrame(frame, reason, panel, echo, edges, tuple(sights), tuple(sides))


def measure_pass(
    sequence: Sequence,
    echo_of: Callable[[Frame], Echo | None],
    options: RingOptions | None = None,
    each: Callable[[SizeFrame], None] = lambda _: None,
) -> SizeResult:
    """The ring's size from all frames of a sequence.

    Args:
        sequence: of a fly-around, one camera.
        echo_of: the range of a frame.
        options: of the detector.
        each: called with every frame.
    """
    sensor = SizeSensor(options)
    frames: list[SizeFrame] = []
    for frame in sequence:
        measured = sensor.measure(frame, echo_of(frame))
        each(measured)
        if measured.sights:
            frames.append(measured)
    return size_of_frames(frames, len(sequence))


def size_of_frames(frames: list[SizeFrame], total: int) -> SizeResult:
    """The ring's size from the frames with sights; ``total``: frames of the pass."""
    count = len(frames)
    if count < LEAST_FRAMES:
        return SizeResult(
            None, f"{count} frames with a panel, a range and an ellipse: {LEAST_FRAMES} are needed",
            total, count,
        )  # fmt: skip
    camera = frames[0].frame.camera.pinhole
    ellipses = Ellipses(camera, [frame.sights for frame in frames])
    circles = circles_of_pass(ellipses, LEAST_FRAMES)
    sides = [frame.sides for frame in frames]
    answers = which_is_the_ring(circles, sides, ellipses)
    if not answers:
        return SizeResult(None, "no circle has one size in three frames", total, count)
    best = answers[0].circle
    order = (best, *(one for one in circles if one is not best))
    if len(answers) > 1 or answers[0].instead:
        places = " or ".join(answer.words for answer in answers)
        reason = f"the ring's radius is not clear: {places}"
        return SizeResult(None, reason, total, count, order, ambiguous=True)
    near_px = float(np.mean([side.near_px for side in best.of(sides)]))
    cut_px = float(np.mean([side.cut_px for side in best.of(sides)]))
    sights = best.of([frame.sights for frame in frames])
    size = ring_size_of_pass(camera, sights, math.hypot(near_px, cut_px), near_px)
    if size is None:
        return SizeResult(None, "the frames of its circle do not fit", total, count, order)
    return SizeResult(size, None, total, count, order)
