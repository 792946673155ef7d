"""Candidate triplets of spots: Book et al.'s tests, for any triangle of reflectors.

Base (one side is the single longest), hourglass (where the centre spot may stand over the base
at ±40° of yaw and pitch, figure 2), sizes and brightness alike. Here the tests run on directions
instead of pixels, so that they mean the same at the rim of the picture. A spot's size limits the
length of its base, which keeps hundreds of false spots cheap.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.geometry.pose import Array
from rendezview.sensors.beacons.constellation import ReflectorPattern

Ints = npt.NDArray[np.int64]


# ln of the sizes of two spots of equal reflectors, at most. Source: by hand; see
# reflector-acquisition (0.1)
_ALIKE = 0.3
# … and that of the base's ends a rad of the base as seen: near by one is much farther, and seen at
# another angle. Source: by construction, tan 45° for the range and half of that for the angle
_ALIKE_CHORD = 1.5
# sides nearer in length than this share tie. Source: Book et al.: no base where two sides tie; by
# construction
_TIE = 0.02


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

    @property
    def longest_side(self) -> float:
        """Square that the other two sides over the base stay below; ∞ where the base may tie."""
        x, y = abs(self.x0) + self.x_intercept, abs(self.y0)
        y += self.slope * self.x_intercept + self.y_intercept
        limit = (1.0 - _TIE) ** 2
        return limit if (x + 0.5) ** 2 + y * y < limit else math.inf


# For the target 14.5 in wide with a post of 4 in, ±40° of yaw and pitch. Source: Book et al. 1992,
# fig. 2
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

    def projected(v: Array, depth: Array | float) -> tuple[Array, Array, Array]:
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
        lx, ly, _ = projected(-0.5 * base, depth)
        rx, ry, _ = projected(0.5 * base, depth)
        cx, cy, _ = projected(post, depth)
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


@njit(cache=True, nogil=True, error_model="numpy")
def search(
    directions: Array, flat: Array, sizes: Array, peaks: Array, order: Ints, glass: Array,
    base_m: float, diameters_m: Array, focal_px: float, blur_px: float,
    limits: tuple[float, ...], both_ways: bool, out: Ints,
) -> int:  # fmt: skip
    """Number of non-redundant triplets that pass the tests, (left, centre, right) in ``out``.

    Args:
        directions: (N, 3) unit; flat: (N, 2) undistorted, pixels about the boresight.
        sizes, peaks: (N,) of the spots; order: (N,) spots by ``flat[:, 0]``.
        glass: (5,) `Hourglass`; base_m: of the triangle; diameters_m: (3,) of its reflectors.
        limits: shortest and longest base (px), tolerance of sizes, of peaks and of blur (ln),
            largest foreshortening of the base, largest square of another side over the base's.
        both_ways: whether left and right are distinguished.
        out: (M, 3). More than M pass: the number is −1.
    """
    count = directions.shape[0]
    shortest, longest, size_tolerance, peak_tolerance, blur_tolerance = limits[:5]
    foreshortened, longest_side = limits[5:]
    # Reflectors of different diameters: small spots look alike, large ones differ by the ratio.
    unlike = _unlikeness(diameters_m)
    alike, peak_tolerance = _ALIKE + unlike, peak_tolerance + 4.0 * unlike
    # Of the hourglass, in base lengths; 1.1 for the stretch of the flat picture
    along = 1.1 * min(abs(glass[0]) + glass[3], math.sqrt(longest_side))
    over = 1.1 * min(abs(glass[1]) + glass[2] * glass[3] + glass[4], math.sqrt(longest_side))
    shortest, longest = shortest / focal_px, longest / focal_px
    low, high, log_size, log_peak, at, ray, widest = _by_column(
        directions, flat, sizes, peaks, order, base_m, diameters_m, focal_px, blur_px,
        size_tolerance, blur_tolerance, foreshortened,
    )  # fmt: skip
    found: int = np.int64(0)  # type: ignore[assignment]  # a 0 would be a type of its own for callees
    for i in range(count):
        least, most = max(low[i], shortest), min(high[i], longest)
        break_px = widest * most * focal_px
        for j in range(i + 1, count):
            bx = at[j, 0] - at[i, 0]
            if bx > break_px:
                break
            dx, dy, dz = ray[j, 0] - ray[i, 0], ray[j, 1] - ray[i, 1], ray[j, 2] - ray[i, 2]
            square, off = dx * dx + dy * dy + dz * dz, abs(log_size[i] - log_size[j])
            lower, upper = max(least, low[j]), min(most, high[j])
            # One branch: no processor can guess how each of these turns out.
            if not (
                (square <= upper * upper)
                & (square >= lower * lower)
                & ((off <= alike) | ((off - unlike) ** 2 <= _ALIKE_CHORD**2 * square))
                & (abs(log_peak[i] - log_peak[j]) <= peak_tolerance)
                & (square > 0.0)
            ):
                continue
            found = _centres(
                i, j, math.sqrt(square), ray, at, log_size, log_peak, low, high, order, glass,
                (along, over, alike, peak_tolerance, longest_side), both_ways, found, out,
            )  # fmt: skip
            if found < 0:
                return -1
    return found


@njit(cache=True, nogil=True, error_model="numpy")
def _by_column(
    directions: Array, flat: Array, sizes: Array, peaks: Array, order: Ints, base_m: float,
    diameters_m: Array, focal_px: float, blur_px: float, size_tolerance: float,
    blur_tolerance: float, foreshortened: float,
) -> tuple[Array, Array, Array, Array, Array, Array, float]:  # fmt: skip
    """The spots by rising x: least and most base by size (chords), ln size, ln peak, places, rays.

    Then by how much the flat picture is stretched off the boresight: as much as 1 / cos².
    """
    count = directions.shape[0]
    low, high = np.empty(count), np.empty(count)
    largest, smallest = _extremes(diameters_m)
    soft, sharp = blur_px * math.exp(blur_tolerance), blur_px * math.exp(-blur_tolerance)
    log_size, log_peak = np.empty(count), np.empty(count)
    at, ray = np.empty((count, 2)), np.empty((count, 3))
    widest = 0.0
    for p in range(count):
        s = order[p]
        # Shortest and longest base, pixels, at which a reflector looks as large as this spot.
        least = _radius(sizes[s] * math.exp(-size_tolerance), soft) * 2.0 * base_m / largest
        most = _radius(sizes[s] * math.exp(size_tolerance), sharp) * 2.0 * base_m / smallest
        # Tilted, the disc looks smaller and the base shorter.
        low[p] = least * foreshortened / focal_px
        high[p] = most / (math.sqrt(foreshortened) * focal_px)
        log_size[p], log_peak[p] = math.log(sizes[s]), math.log(peaks[s])
        at[p, 0], at[p, 1] = flat[s, 0], flat[s, 1]
        for axis in range(3):
            ray[p, axis] = directions[s, axis]
        widest = max(widest, 1.0 / (ray[p, 2] * ray[p, 2]))
    return low, high, log_size, log_peak, at, ray, widest


@njit(cache=True, nogil=True, error_model="numpy")
def _centres(
    i: int, j: int, chord: float, ray: Array, at: Array, log_size: Array, log_peak: Array,
    low: Array, high: Array, order: Ints, glass: Array,
    limits: tuple[float, float, float, float, float], both_ways: bool, found: int, out: Ints,
) -> int:  # fmt: skip
    """Write the triplets of the base i, j; the number found so far, −1 where ``out`` is full."""
    along, over, alike, peak_tolerance, longest_side = limits
    square = chord * chord
    dx, dy, dz = ray[j, 0] - ray[i, 0], ray[j, 1] - ray[i, 1], ray[j, 2] - ray[i, 2]
    mx, my, mz = (
        0.5 * (ray[i, 0] + ray[j, 0]),
        0.5 * (ray[i, 1] + ray[j, 1]),
        0.5 * (ray[i, 2] + ray[j, 2]),
    )
    m = chord * math.sqrt(mx * mx + my * my + mz * mz)
    # across = m × base: a quarter turn clockwise on the screen; both over the chord²
    cx, cy, cz = (my * dz - mz * dy) / m, (mz * dx - mx * dz) / m, (mx * dy - my * dx) / m
    cx, cy, cz = cx / chord, cy / chord, cz / chord
    dx, dy, dz = dx / square, dy / square, dz / square
    size, peak = 0.5 * (log_size[i] + log_size[j]), 0.5 * (log_peak[i] + log_peak[j])
    bx, by = at[j, 0] - at[i, 0], at[j, 1] - at[i, 1]
    middle_x, middle_y = 0.5 * (at[i, 0] + at[j, 0]), 0.5 * (at[i, 1] + at[j, 1])
    # The box of the hourglass, turned with the base.
    wide, tall = along * abs(bx) + over * abs(by), along * abs(by) + over * abs(bx)
    first = i  # spots rise with x
    while first > 0 and at[first - 1, 0] >= middle_x - wide:
        first -= 1
    for k in range(first, at.shape[0]):
        if at[k, 0] > middle_x + wide:
            break
        if (
            (abs(at[k, 1] - middle_y) > tall)
            | (abs(log_size[k] - size) > alike)
            | (chord < 0.9 * low[k])
        ):
            continue
        ex, ey, ez = ray[k, 0] - mx, ray[k, 1] - my, ray[k, 2] - mz
        x = ex * dx + ey * dy + ez * dz
        y = ex * cx + ey * cy + ez * cz
        inside, turned = _within(glass, x, y), _within(glass, -x, -y) & both_ways
        if not (
            (inside | turned)
            & ((abs(x) + 0.5) ** 2 + y * y <= longest_side)  # the base is the longest
            & (abs(log_peak[k] - peak) <= 0.5 * peak_tolerance)
            & (chord <= 1.1 * high[k])
            & (k != i)
            & (k != j)
        ):
            continue
        if found + inside + turned > out.shape[0]:
            return -1
        if inside:
            out[found, 0], out[found, 1], out[found, 2] = order[i], order[k], order[j]
            found += 1
        if turned:
            out[found, 0], out[found, 1], out[found, 2] = order[j], order[k], order[i]
            found += 1
    return found


@njit(cache=True, nogil=True, error_model="numpy")
def _extremes(values: Array) -> tuple[float, float]:
    """The largest and the least; ``np.max`` and ``np.min`` take longer to compile."""
    most = least = values[0]
    for value in values:
        most, least = max(most, value), min(least, value)
    return most, least


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _unlikeness(diameters_m: Array) -> float:
    """ln of the largest over the least."""
    most, least = _extremes(diameters_m)
    return math.log(most / least)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _within(glass: Array, x: float, y: float) -> bool:
    dx = abs(x - glass[0])
    return bool((dx <= glass[3]) & (abs(y - glass[1]) <= glass[2] * dx + glass[4]))


@njit(cache=True, nogil=True, error_model="numpy")
def _radius(size: float, blur_px: float) -> float:
    """Radius of the disc whose `expected_size` this is; 0 below the blur."""
    if size <= blur_px:
        return 0.0
    rest = math.sqrt(size * size - blur_px * blur_px)
    radius = rest / 0.55
    for _ in range(3):
        square = radius * radius
        radius = rest / (0.5 + 0.131 * square / (square + 5.0 * blur_px * blur_px))
    return radius
