"""The ring detector: a grey frame in, ellipses with their covariance out, the ring's first."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.camera import Camera
from rendezview.grey_frame import check_frame
from rendezview.lens import lens_vector
from rendezview.ring.arcs import find_arcs, group_arcs
from rendezview.ring.edges import find_edges, link
from rendezview.ring.ellipse import Ellipse, axes_of_shape, shape_of_axes
from rendezview.ring.families import families
from rendezview.ring.support import (
    ARC,
    COLUMNS,
    CONTRAST,
    OFFSET,
    PX,
    PY,
    WEIGHT,
    correlation_factor,
    distance,
    gradient_support,
    step_basis,
    step_filters,
    step_support,
    update_shape,
    waviness_factor,
)

Array = npt.NDArray[np.float64]
Grey = npt.NDArray[np.uint8]

_MOST_ARCS = 120
_SUPPORT_SAMPLES = 120
_MOST_SAMPLES = 640  # of the step fit, along one ellipse


@dataclass(frozen=True, slots=True, kw_only=True)
class RingOptions:
    """What counts as a ring's edge."""

    least_contrast_grey: float = 8.0
    edge_sigmas: float = 5.0  # of the smoothed gradient's noise
    fit_tolerance_px: float = 1.2  # of arcs from their common conic
    least_semi_axis_px: float = 8.0  # the short one
    least_ratio: float = 0.2  # short over long: a tilt of 78°
    least_arc_rad: float = math.radians(75.0)  # that edges must bear out, all pieces together
    least_share: float = 0.5  # of the longest piece's neighbourhood; see `_verify`
    blur_px: float = 0.9  # σ of an edge in the picture: optics, pixel and interpolation
    sample_px: float = 1.5  # between samples of the final fit
    floor_px: float = 0.03  # σ that an ellipse's numbers have besides: what the edges' model lacks
    most: int = 12  # ellipses kept


@dataclass(frozen=True, slots=True, eq=False)
class RingEdge:
    """An ellipse that the picture bears out."""

    ellipse: Ellipse
    arc_rad: float  # of the circle's full turn, what edges bear out
    score: float  # 0 … 1, how much it is a ring's: see `families`
    contrast_grey: float  # outside minus inside
    family: int  # number of the set of concentric circles it belongs to
    rms_px: float  # of the edge places about the ellipse

    @property
    def arc_deg(self) -> float:
        """`arc_rad` in degrees, as the log has it."""
        return math.degrees(self.arc_rad)


@dataclass(frozen=True, slots=True, eq=False)
class Detection:
    """What a frame shows."""

    edges: tuple[RingEdge, ...]  # best first
    noise_grey: float
    reason: str | None  # why there is none
    stage_ms: dict[str, float] = field(default_factory=dict)


class RingDetector:
    """Finds the ellipses of rings in frames of one camera."""

    def __init__(self, camera: Camera, options: RingOptions | None = None) -> None:
        self.camera = camera
        self.options = options or RingOptions()
        self._lens = np.append(lens_vector(camera), float(camera.is_distorted))
        self._filters = step_filters(self.options.blur_px)
        self._number = np.zeros((camera.height, camera.width), dtype=np.int32)
        self._power = np.empty((camera.height, camera.width), dtype=np.float32)
        self._basis = step_basis(self.options.blur_px)

    def detect(self, image: npt.ArrayLike) -> Detection:
        """Ellipses of a frame, (H, W) uint8 of the camera's size.

        Raises:
            RendezviewError: another size or type than the camera's pictures.
        """
        grey = check_frame(image, self.camera.width, self.camera.height)
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
        points, starts, closed = link(
            found.dx, found.dy, found.low, found.high, self._number, self._power
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
        shapes = _verify(
            found.dx, found.dy, found.low, self._lens, rough, o.least_arc_rad, o.least_share,
            limits, o.most,
        )  # fmt: skip
        lap("support")
        if len(shapes) == 0:
            return Detection((), found.noise_grey, "no ellipse that edges bear out", stage_ms)
        edges = self._refined(grey, shapes, max(found.noise_grey, 0.3))
        lap("fit")
        reason = None if edges else "no ellipse with a sharp edge"
        return Detection(edges, found.noise_grey, reason, stage_ms)

    def _refined(self, grey: Grey, shapes: Array, noise: float) -> tuple[RingEdge, ...]:
        o = self.options
        fitted, covariances, facts = _fit_steps(
            grey, self._lens, shapes, o.sample_px, noise, self._filters, self._basis, o.blur_px,
            o.least_arc_rad, o.floor_px,
        )  # fmt: skip
        if len(fitted) == 0:
            return ()
        family, score, order = families(self.camera, fitted, facts[:, 0])
        return tuple(
            RingEdge(
                Ellipse.from_shape(fitted[k], covariances[k]),
                float(facts[k, 0]),
                float(score[k]),
                float(facts[k, 1]),
                int(family[k]),
                float(facts[k, 2]),
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


@njit(cache=True, nogil=True)
def _verify(dx, dy, low, lens, rough, least_arc, least_share, limits, most):  # type: ignore[no-untyped-def]
    """Rough ellipses (K, 5) that the gradients bear out, settled on them: shapes (M, 5)."""
    kept = np.empty((most, 5))
    value = np.empty(most)
    count = 0
    samples = np.zeros((_SUPPORT_SAMPLES, COLUMNS))
    normal = np.empty((5, 5))
    n = _SUPPORT_SAMPLES
    for k in range(rough.shape[0]):
        shape = shape_of_axes(rough[k])
        good = True
        twin = False
        for step in range(4):
            band = 4.0 if step == 0 else (3.0 if step == 1 else 2.0)
            n = _SUPPORT_SAMPLES // 2
            found = gradient_support(dx, dy, low, lens, shape, n, band, samples)
            if found * 2.0 * np.pi / n < 0.7 * least_arc:
                good = False
                break
            _one_sense(samples, n)
            moved = update_shape(samples, n, band + 1.0, shape, normal)
            row = axes_of_shape(shape)
            if (
                moved < 0.0
                or row[3] < limits[0]
                or row[2] > limits[1]
                or row[3] < limits[2] * row[2]
            ):
                good = False
                break
            for j in range(count):
                if _twins(kept[j], shape, 1.5):
                    twin = True
            if twin or moved < 0.1:
                break
        if not good or twin:
            continue
        n = _SUPPORT_SAMPLES
        gradient_support(dx, dy, low, lens, shape, n, 1.5, samples)
        _one_sense(samples, n)
        found, longest = _runs(samples, n)
        share = found / n
        if share * 2.0 * np.pi < least_arc or longest < least_share * found / 3.0:
            continue
        at = count
        if count == most:
            at = int(np.argmin(value))
            if value[at] >= share:
                continue
        else:
            count += 1
        kept[at] = shape
        value[at] = share
    return _exclusive(dx, dy, low, lens, kept[np.argsort(-value[:count])], least_arc)


@njit(cache=True, nogil=True)
def _exclusive(dx, dy, low, lens, shapes, least_arc):  # type: ignore[no-untyped-def]
    """Shapes (M, 5), best first, less those that live on the edges of better ones."""
    n = _SUPPORT_SAMPLES
    samples = np.zeros((n, COLUMNS))
    kept = np.empty_like(shapes)
    count = 0
    for k in range(shapes.shape[0]):
        gradient_support(dx, dy, low, lens, shapes[k], n, 1.5, samples)
        _one_sense(samples, n)
        own = 0
        for i in range(n):
            if samples[i, WEIGHT] > 0.0:
                free = True
                for j in range(count):
                    if abs(distance(kept[j], samples[i, PX], samples[i, PY])) < 2.0:
                        free = False
                        break
                own += free
        if own * 2.0 * np.pi / n >= 0.8 * least_arc:
            kept[count] = shapes[k]
            count += 1
    return kept[:count]


@njit(cache=True, nogil=True)
def _one_sense(samples, n):  # type: ignore[no-untyped-def]
    """Leave out edges against the sense of their neighbourhood: a ring's edge keeps it for long."""
    half = n // 20
    keep = np.ones(n, dtype=np.bool_)
    for i in range(n):
        if samples[i, WEIGHT] <= 0.0:
            continue
        same, other = 0, 0
        for k in range(-half, half + 1):
            j = (i + k) % n
            if samples[j, WEIGHT] > 0.0:
                if samples[j, CONTRAST] * samples[i, CONTRAST] > 0.0:
                    same += 1
                else:
                    other += 1
        keep[i] = same > other and 3 * same > half + half // 2
    for i in range(n):
        if not keep[i]:
            samples[i, WEIGHT] = 0.0


@njit(cache=True, nogil=True)
def _runs(samples, n):  # type: ignore[no-untyped-def]
    """How many samples found an edge, and the longest run of them (gaps of two allowed)."""
    found, longest, run, gap = 0, 0, 0, 9
    for i in range(2 * n):
        s = samples[i % n, WEIGHT] > 0.0
        if s and i < n:
            found += 1
        if s:
            run += 1
            gap = 0
        else:
            gap += 1
            if gap > 2:
                run = 0
        longest = max(longest, run)
    return found, min(longest, n)


@njit(cache=True, nogil=True)
def _twins(a, b, near):  # type: ignore[no-untyped-def]
    """Whether two shapes are one ellipse, to ``near`` px."""
    return bool(np.max(np.abs(a - b)) <= near)


@njit(cache=True, nogil=True)
def _fit_steps(  # type: ignore[no-untyped-def]
    image, lens, shapes, spacing, noise, filters, basis, blur, least_arc, floor
):
    """Blurred-step fits: shapes (M, 5), covariances (M, 5, 5), (M, 3) arc, contrast, rms."""
    total = shapes.shape[0]
    current = shapes.copy()
    fitted = np.empty((total, 5))
    covariances = np.empty((total, 5, 5))
    facts = np.empty((total, 3))
    samples = np.zeros((_MOST_SAMPLES, COLUMNS))
    others = np.empty((total, 5))
    normal = np.empty((5, 5))
    count = 0
    for k in range(total):
        shape = current[k].copy()
        beside = 0
        for j in range(total):
            if j != k and not _twins(current[j], shape, 2.5) and _meet(current[j], shape, 14.0):
                others[beside] = current[j]
                beside += 1
        row = axes_of_shape(shape)
        around = np.pi * (3.0 * (row[2] + row[3])
                          - np.sqrt((3.0 * row[2] + row[3]) * (row[2] + 3.0 * row[3])))  # fmt: skip
        step_px = max(spacing, around / (0.8 * _MOST_SAMPLES))
        good = True
        n = 0
        sense = 0.0
        for step in range(4):
            # The first look is a sparse one: it brings the ellipse onto the edge.
            n = step_support(
                image, lens, shape, 4.0 * step_px if step == 0 else step_px, sense, noise,
                filters, basis, blur, others[:beside], samples,
            )  # fmt: skip
            if step == 0:
                _one_sense(samples, n)
            scale = 2.0 if step == 0 else _scale(samples, n)
            moved = update_shape(samples, n, scale, shape, normal)
            if moved < 0.0 or _covered(samples, n, scale) < 0.5 * least_arc:
                good = False
                break
            if step > 0 and moved < 0.01:
                break
        if not good:
            continue
        twin = False
        for j in range(count):
            if _twins(fitted[j], shape, 1.0):
                twin = True
        if twin:
            continue
        scale = _scale(samples, n)
        chi, used, contrast, weight, square = 0.0, 0, 0.0, 0.0, 0.0
        for i in range(n):
            if samples[i, WEIGHT] > 0.0:
                if abs(samples[i, OFFSET]) > scale:
                    samples[i, WEIGHT] = 0.0
                    continue
                w = samples[i, WEIGHT]
                chi += w * samples[i, OFFSET] ** 2
                square += samples[i, OFFSET] ** 2
                used += 1
                weight += 1.0
                contrast += samples[i, CONTRAST]
        arc = _covered(samples, n, scale)
        if used < 20 or arc < 0.8 * least_arc:
            continue
        update = shape.copy()
        if update_shape(samples, n, 3.0 * scale, update, normal) < 0.0:
            continue
        trace = np.trace(normal)
        for j in range(5):
            normal[j, j] += 1e-12 * trace
        spread = max(chi / max(used - 5, 1), 0.5) * correlation_factor(samples, n)
        spread = max(spread, waviness_factor(samples, n))
        fitted[count] = update
        covariances[count] = np.linalg.inv(normal) * spread
        for j in range(5):
            covariances[count, j, j] += floor * floor
        facts[count, 0], facts[count, 1] = arc, contrast / weight
        facts[count, 2] = np.sqrt(square / used)
        current[k] = update
        count += 1
    return fitted[:count], covariances[:count], facts[:count]


@njit(cache=True, nogil=True)
def _meet(a, b, near):  # type: ignore[no-untyped-def]
    """Whether ellipse a comes within ``near`` px of some of 24 points of ellipse b."""
    for k in range(24):
        u0, u1 = np.cos(np.pi * k / 12.0), np.sin(np.pi * k / 12.0)
        x, y = b[0] + b[2] * u0 + b[3] * u1, b[1] + b[3] * u0 + b[4] * u1
        if abs(distance(a, x, y)) < near:
            return True
    return False


@njit(cache=True, nogil=True)
def _scale(samples, n):  # type: ignore[no-untyped-def]
    """Where offsets stop counting, px: five σ of them, from their median size."""
    size = np.empty(n)
    count = 0
    for i in range(n):
        if samples[i, WEIGHT] > 0.0:
            size[count] = abs(samples[i, OFFSET])
            count += 1
    if count == 0:
        return 1.0
    return min(max(5.0 * 1.483 * float(np.median(size[:count])), 0.15), 2.0)


@njit(cache=True, nogil=True)
def _covered(samples, n, scale):  # type: ignore[no-untyped-def]
    """Angle of the circle that samples within ``scale`` px bear out, rad."""
    total = 0.0
    for i in range(n):
        if samples[i, WEIGHT] > 0.0 and abs(samples[i, OFFSET]) < scale:
            total += samples[i, ARC]
    return total
