"""Which three spots may be the target: Book et al.'s tests, for any triangle of reflectors.

Base (one side is the single longest), hourglass (where the centre spot may stand over the base
at ±40° of yaw and pitch, figure 2), sizes and brightness alike. Here the tests run on directions
instead of pixels, so that they mean the same at the rim of the picture, and a spot's size says
how long a base it may belong to, which is what keeps hundreds of false spots cheap.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.pose import Array
from rendezview.reflectors.pattern import ReflectorPattern

Table = npt.NDArray[np.float64]

_ALIKE = 0.3
_TIE = 0.02  # sides nearer in length than this share tie


@dataclass(frozen=True, slots=True, kw_only=True)
class Hourglass:
    """Region of the centre spot: x along the base and y across, in base lengths, from its middle.

    ``|x − x0| ≤ x_intercept`` and ``|y − y0| ≤ slope |x − x0| + y_intercept``. x runs from left to
    right, y is a quarter turn clockwise from it on the screen (down, where x is right).
    """

    x0: float = 0.0
    y0: float = 0.0
    slope: float
    x_intercept: float
    y_intercept: float

    def contains(self, x: float, y: float) -> bool:
        """Whether a centre spot may be there."""
        dx = abs(x - self.x0)
        return dx <= self.x_intercept and abs(y - self.y0) <= self.slope * dx + self.y_intercept

    @property
    def longest_side(self) -> float:
        """Square that the other two sides over the base stay below; ∞ where the base may tie."""
        x, y = abs(self.x0) + self.x_intercept, abs(self.y0)
        y += self.slope * self.x_intercept + self.y_intercept
        limit = (1.0 - _TIE) ** 2
        return limit if (x + 0.5) ** 2 + y * y < limit else math.inf

    def as_array(self) -> Array:
        """(5,) for the compiled loops."""
        return np.array([self.x0, self.y0, self.slope, self.x_intercept, self.y_intercept])


# Figure 2, for the target 14.5 in wide with a post of 4 in, ±40° of yaw and pitch.
PAPER_HOURGLASS = Hourglass(slope=0.238, x_intercept=0.22375, y_intercept=0.17141)


def hourglass_of(
    pattern: ReflectorPattern,
    triangle: tuple[int, int, int],
    tilt_rad: float = math.radians(40.0),
    nearest_base: float = 2.5,
) -> Hourglass:
    """The hourglass of any triangle (left, centre, right) of a pattern.

    The centre is projected at every yaw and pitch up to ``tilt_rad``, in weak perspective and
    from ``nearest_base`` base lengths away; the six lines enclose what comes out.
    """
    left, centre, right = pattern.positions_m[list(triangle)]
    face = pattern.target_from_face.rotation
    base = (right - left) @ face
    post = (centre - 0.5 * (left + right)) @ face
    steps = np.linspace(-tilt_rad, tilt_rad, 17)
    yaw, pitch = (angles.ravel() for angles in np.meshgrid(steps, steps))

    def seen(v: Array, depth: Array | float) -> tuple[Array, Array, Array]:
        """Face vector (right, up, out) → right, down, towards the camera."""
        x, y, z = v
        out = z * np.cos(pitch) + y * np.sin(pitch)
        down = z * np.sin(pitch) - y * np.cos(pitch)
        right_ = x * np.cos(yaw) + out * np.sin(yaw)
        near = out * np.cos(yaw) - x * np.sin(yaw)
        return right_ / (1.0 - near * depth), down / (1.0 - near * depth), near

    xs, ys = [], []
    length = float(np.linalg.norm(base))
    for depth in (0.0, 1.0 / (nearest_base * length)):
        lx, ly, _ = seen(-0.5 * base, depth)
        rx, ry, _ = seen(0.5 * base, depth)
        cx, cy, _ = seen(post, depth)
        z = ((cx - 0.5 * (lx + rx)) + 1j * (cy - 0.5 * (ly + ry))) / ((rx - lx) + 1j * (ry - ly))
        xs.append(z.real)
        ys.append(z.imag)
    x, y = np.concatenate(xs), np.concatenate(ys)
    ahead = len(steps) ** 2 // 2  # yaw and pitch 0
    x0, y0 = float(x[ahead]), float(y[ahead])
    dx, dy = np.abs(x - x0), np.abs(y - y0)
    slope = 1.0 - math.cos(tilt_rad)
    return Hourglass(
        x0=x0,
        y0=y0,
        slope=slope,
        x_intercept=1.02 * float(dx.max()),
        y_intercept=1.02 * float(np.max(dy - slope * dx)),
    )


def paper_tests(spots_px: npt.ArrayLike, hourglass: Hourglass = PAPER_HOURGLASS) -> int | None:
    """Book et al.'s tests on three spots (3, 2), in pixels, as printed.

    Returns:
        Which of the three is the centre spot; None where the base ties or the hourglass is missed.

    Raises:
        ValueError: not three spots.
    """
    spots = np.asarray(spots_px, dtype=np.float64)
    if spots.shape != (3, 2):
        raise ValueError(f"spots_px must be (3, 2), not {spots.shape}")
    squared = [float(np.sum((spots[(k + 1) % 3] - spots[(k + 2) % 3]) ** 2)) for k in range(3)]
    centre = int(np.argmax(squared))  # opposite the longest side
    if sum(side == squared[centre] for side in squared) > 1:
        return None
    a, b = sorted((spots[(centre + 1) % 3], spots[(centre + 2) % 3]), key=lambda p: (p[0], p[1]))
    # roll = atan(…) of the base; shift to its middle and turn by −roll
    base = complex(*(b - a))
    shifted = complex(*(spots[centre] - 0.5 * (a + b))) / base
    return centre if hourglass.contains(shifted.real, shifted.imag) else None


@njit(cache=True, nogil=True, inline="always")
def expected_size(blur_px, radius_px):  # type: ignore[no-untyped-def]
    """σ of the window that settles on a disc of some radius under a Gaussian blur, px.

    A small disc adds its second moment, radius²/4; a large one makes the window settle at 0.631
    radii. Between them a curve fitted to computed spots (within 0.5 %).
    """
    square = radius_px * radius_px
    k = 0.5 + 0.131 * square / (square + 5.0 * blur_px * blur_px)
    return math.sqrt(blur_px * blur_px + k * k * square)


@njit(cache=True, nogil=True)
def search(  # type: ignore[no-untyped-def]
    directions, flat, sizes, peaks, order, glass, base_m, diameter_m, focal_px, blur_px,
    limits, both_ways, out,
):  # fmt: skip
    """Non-redundant triplets that pass the tests, as (left, centre, right) in ``out``.

    Args:
        directions: (N, 3) unit; flat: (N, 2) undistorted, pixels about the boresight.
        sizes, peaks: (N,) of the spots; order: (N,) spots by ``flat[:, 0]``.
        glass: (5,) `Hourglass`; base_m, diameter_m: of the triangle.
        limits: shortest and longest base (px), tolerance of sizes and of peaks (ln), largest
            foreshortening of the base, largest square of another side over the base's.
        both_ways: whether left and right are told apart.
        out: (M, 3). More than M pass: the number is −1.

    Returns:
        How many.
    """
    count = directions.shape[0]
    shortest, longest, size_tolerance, peak_tolerance, foreshortened, longest_side = limits
    reach = math.hypot(abs(glass[0]) + glass[3], abs(glass[1]) + glass[2] * glass[3] + glass[4])
    # Of each spot the bases it may belong to, as angles in pixels, from its size.
    low, high = np.empty(count), np.empty(count)
    log_size, log_peak = np.log(sizes), np.log(peaks)
    alike = _ALIKE  # sizes may differ so, by depth and tilt
    for i in range(count):
        low[i], high[i] = _bases(
            sizes[i], base_m, diameter_m, blur_px, size_tolerance, foreshortened
        )
    found = 0
    for p in range(count):
        i = order[p]
        for q in range(p + 1, count):
            j = order[q]
            bx, by = flat[j, 0] - flat[i, 0], flat[j, 1] - flat[i, 1]
            base = math.sqrt(bx * bx + by * by)
            # Off the boresight the flat picture is stretched: a rough bound first.
            if base > 1.6 * min(high[i], high[j]):
                if bx > 1.6 * high[i]:
                    break
                continue
            if base < low[i] or base < low[j] or base < shortest or base > 1.6 * longest:
                continue
            if abs(log_peak[i] - log_peak[j]) > peak_tolerance:
                continue
            if abs(log_size[i] - log_size[j]) > alike:
                continue
            dx = directions[j, 0] - directions[i, 0]
            dy = directions[j, 1] - directions[i, 1]
            dz = directions[j, 2] - directions[i, 2]
            chord = math.sqrt(dx * dx + dy * dy + dz * dz)
            true_px = chord * focal_px
            if (
                true_px > min(high[i], high[j], longest)
                or true_px < max(low[i], low[j])
                or chord == 0.0
            ):
                continue
            mx = 0.5 * (directions[i, 0] + directions[j, 0])
            my = 0.5 * (directions[i, 1] + directions[j, 1])
            mz = 0.5 * (directions[i, 2] + directions[j, 2])
            m = math.sqrt(mx * mx + my * my + mz * mz)
            dx, dy, dz = dx / chord, dy / chord, dz / chord
            # across = m × base: a quarter turn clockwise on the screen
            cx = (my * dz - mz * dy) / m
            cy = (mz * dx - mx * dz) / m
            cz = (mx * dy - my * dx) / m
            middle_x, radius = 0.5 * (flat[i, 0] + flat[j, 0]), 1.1 * reach * base
            middle_y = 0.5 * (flat[i, 1] + flat[j, 1])
            # First spot with x ≥ middle_x − radius.
            a, b = 0, count
            while a < b:
                half = (a + b) // 2
                if flat[order[half], 0] < middle_x - radius:
                    a = half + 1
                else:
                    b = half
            for r in range(a, count):
                k = order[r]
                if flat[k, 0] > middle_x + radius:
                    break
                if k in (i, j) or abs(flat[k, 1] - middle_y) > radius:
                    continue
                if abs(log_peak[k] - 0.5 * (log_peak[i] + log_peak[j])) > 0.5 * peak_tolerance:
                    continue
                if abs(log_size[k] - 0.5 * (log_size[i] + log_size[j])) > alike:
                    continue
                if true_px < 0.9 * low[k] or true_px > 1.1 * high[k]:
                    continue
                ex = directions[k, 0] - mx
                ey = directions[k, 1] - my
                ez = directions[k, 2] - mz
                x = (ex * dx + ey * dy + ez * dz) / chord
                y = (ex * cx + ey * cy + ez * cz) / chord
                # The base is the single longest side.
                square = (abs(x) + 0.5) ** 2 + y * y
                if square > longest_side:
                    continue
                if _within(glass, x, y):
                    if found == out.shape[0]:
                        return -1
                    out[found, 0], out[found, 1], out[found, 2] = i, k, j
                    found += 1
                if both_ways and _within(glass, -x, -y):
                    if found == out.shape[0]:
                        return -1
                    out[found, 0], out[found, 1], out[found, 2] = j, k, i
                    found += 1
    return found


@njit(cache=True, nogil=True, inline="always")
def _within(glass, x, y):  # type: ignore[no-untyped-def]
    dx = abs(x - glass[0])
    return dx <= glass[3] and abs(y - glass[1]) <= glass[2] * dx + glass[4]


@njit(cache=True, nogil=True)
def _bases(size, base_m, diameter_m, blur_px, tolerance, foreshortened):  # type: ignore[no-untyped-def]
    """Shortest and longest base, pixels, at which the reflectors look as large as this spot."""
    ratio = 2.0 * base_m / diameter_m  # base over the disc's radius
    least = _radius(size * math.exp(-tolerance), blur_px) * ratio
    most = _radius(size * math.exp(tolerance), blur_px) * ratio
    # Tilted, the disc looks smaller and the base shorter.
    return least * foreshortened, most / math.sqrt(foreshortened)


@njit(cache=True, nogil=True)
def _radius(size, blur_px):  # type: ignore[no-untyped-def]
    """Radius of the disc whose `expected_size` this is; 0 below the blur."""
    if size <= blur_px:
        return 0.0
    rest = math.sqrt(size * size - blur_px * blur_px)
    radius = rest / 0.55
    for _ in range(3):
        square = radius * radius
        radius = rest / (0.5 + 0.131 * square / (square + 5.0 * blur_px * blur_px))
    return radius
