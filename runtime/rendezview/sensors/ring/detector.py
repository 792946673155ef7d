"""The ring detector: a grey frame in, ellipses with their covariance out, the ring's first."""

from __future__ import annotations

import math
import threading
import time
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from rendezview.estimation.edge_profile import step_basis, step_filters
from rendezview.geometry.camera import Camera
from rendezview.geometry.lens import lens_vector
from rendezview.io.grey_frame import check_frame
from rendezview.sensors.ring.arcs import find_arcs, group_arcs
from rendezview.sensors.ring.concentric_groups import concentric_groups
from rendezview.sensors.ring.edges import find_edges, link
from rendezview.sensors.ring.ellipse import Ellipse
from rendezview.sensors.ring.step_fit import fit_steps
from rendezview.sensors.ring.verify import verify

Array = npt.NDArray[np.float64]
Grey = npt.NDArray[np.uint8]

_MOST_ARCS = 120  # Source: by construction, a bound of time
# σ of an ellipse's numbers times its size, px²: parts next to an edge disturb it where they come
# within its blur. Source: pictures of tests/plain_rings.py and of Mitsuba; 0.5 px at 15 px, 0.2 px
# at 40 px, 0.07 px at 80 px
_CROWDED_PX2 = 7.5


@dataclass(frozen=True, slots=True, kw_only=True)
class RingOptions:
    """What counts as a ring's edge."""

    least_contrast_grey: float = 8.0  # grey levels. Source: a chosen limit
    # Of the smoothed gradient's noise. Source: normal distribution, 6·10⁻⁷
    edge_sigmas: float = 5.0
    # Of arcs from their common conic. Source: by hand; see ring-accuracy
    fit_tolerance_px: float = 1.2
    least_semi_axis_px: float = 8.0  # the short one. Source: a chosen limit
    least_ratio: float = 0.2  # short over long: a tilt of 78°. Source: a chosen limit
    # Of the circle with edges, all pieces together. Source: a chosen limit
    least_arc_rad: float = math.radians(75.0)
    # σ of an edge in the picture: optics, pixel and interpolation. Source: by hand; see
    # ring-accuracy
    blur_px: float = 0.9
    # Between samples of the final fit. Source: by construction, 1.7 σ of the blur
    sample_px: float = 1.5
    # σ added to an ellipse's numbers: errors of the edge model. Source: docs/notes/ring.md, meant
    # for real frames
    floor_px: float = 0.03
    most: int = 12  # ellipses kept. Source: by construction, a bound of time


@dataclass(frozen=True, slots=True, eq=False)
class RingEdge:
    """An ellipse that edges of the picture confirm."""

    ellipse: Ellipse
    arc_rad: float  # visible part of the circle
    score: float  # 0 … 1, how much it is a ring's: see `concentric_groups`
    contrast_grey: float  # outside minus inside
    group: int  # number of the set of concentric circles it belongs to
    rms_px: float  # of the edge places about the ellipse
    pair: int = -1  # number of the lip whose two edges were fitted as one; -1: of none
    # σ of what neighbouring places of the edge have in common and the ellipse has not: the rear
    # edge of a lip, a shadow, a part beside a small ring. The ellipse's covariance is without it.
    systematic_px: float = 0.0

    @property
    def arc_deg(self) -> float:
        """`arc_rad` in degrees, as the log has it."""
        return math.degrees(self.arc_rad)


@dataclass(frozen=True, slots=True, eq=False)
class Detection:
    """The ellipses of a frame."""

    edges: tuple[RingEdge, ...]  # best first
    noise_grey: float
    reason: str | None  # why there is none
    stage_ms: dict[str, float] = field(default_factory=dict)


class RingDetector:
    """Finds the ellipses of rings in frames of one camera. Threads may share an instance."""

    def __init__(self, camera: Camera, options: RingOptions | None = None) -> None:
        self.camera = camera
        self.options = options or RingOptions()
        self._lens = np.append(lens_vector(camera), float(camera.is_distorted))
        self._filters = step_filters(self.options.blur_px)
        self._number = np.zeros((camera.height, camera.width), dtype=np.int32)
        self._power = np.empty((camera.height, camera.width), dtype=np.float32)
        self._basis = step_basis(self.options.blur_px)
        self._lock = threading.Lock()  # of the scratch arrays

    def detect(self, image: npt.ArrayLike) -> Detection:
        """Ellipses of a frame, (H, W) uint8 of the camera's size.

        Raises:
            RendezviewError: another size or type than the camera's pictures.
        """
        grey = check_frame(image, self.camera)
        o = self.options
        clock = time.perf_counter()
        stage_ms: dict[str, float] = {}

        def lap(stage: str) -> None:
            nonlocal clock
            now = time.perf_counter()
            stage_ms[stage] = 1e3 * (now - clock)
            clock = now

        found = find_edges(grey, o.least_contrast_grey, o.edge_sigmas)
        lap("edges")
        with self._lock:
            points, starts, closed = link(
                found.dx, found.dy, found.least, self._number, self._power
            )
        lap("chains")
        if len(points) == 0:
            return Detection((), found.noise_grey, "no edges in the picture", stage_ms)
        if self.camera.is_distorted:
            points = self._straightened(points)
        arcs = find_arcs(points, starts, closed)
        if len(arcs) == 0:
            return Detection((), found.noise_grey, "no curved edges in the picture", stage_ms)
        size = 0.5 * max(grey.shape)
        limits = np.array([o.least_semi_axis_px, 4.0 * size, o.least_ratio])
        rough, _ = group_arcs(
            points, arcs, size, 0.5 * grey.shape[1], 0.5 * grey.shape[0],
            o.fit_tolerance_px, _MOST_ARCS, limits,
        )  # fmt: skip
        lap("arcs")
        shapes = verify(
            found.dx, found.dy, found.least, self._lens, rough, o.least_arc_rad, limits, o.most,
        )  # fmt: skip
        lap("support")
        if len(shapes) == 0:
            return Detection((), found.noise_grey, "no ellipse that edges confirm", stage_ms)
        edges = self._refined(grey, shapes, max(found.noise_grey, 0.3))
        lap("fit")
        reason = None if edges else "no ellipse with a sharp edge"
        return Detection(edges, found.noise_grey, reason, stage_ms)

    def _refined(self, grey: Grey, shapes: Array, noise: float) -> tuple[RingEdge, ...]:
        o = self.options
        fitted, covariances, facts, pairs = fit_steps(
            grey, self._lens, shapes, o.sample_px, noise, self._filters, self._basis, o.blur_px,
            o.least_arc_rad, o.floor_px,
        )  # fmt: skip
        if len(fitted) == 0:
            return ()
        group, score, order = concentric_groups(self.camera, fitted, facts[:, 0])
        return tuple(
            RingEdge(
                Ellipse.from_shape(fitted[k], covariances[k]),
                float(facts[k, 0]),
                float(score[k]),
                float(facts[k, 1]),
                int(group[k]),
                float(facts[k, 2]),
                int(pairs[k]),
                math.hypot(facts[k, 3], 2.0 * _CROWDED_PX2 / (fitted[k, 2] + fitted[k, 4])),
            )
            for k in order
        )

    def _straightened(self, points: Array) -> Array:
        """Chains without the lens distortion; their directions are taken as they are."""
        rays = self.camera.rays(points[:, :2])
        out = points.copy()
        out[:, 0] = self.camera.fx * rays[:, 0] + self.camera.cx
        out[:, 1] = self.camera.fy * rays[:, 1] + self.camera.cy
        lost = ~np.isfinite(out).all(axis=1)
        out[lost, :2] = points[lost, :2]
        return out
