"""The centroid of a spot: one for all sensors.

It is the point about which a Gaussian window of the spot's own size finds no first moment. For
a Gaussian spot in white noise this is the least-squares place: its error σ_noise √(2/π) / peak an
axis is the Cramér–Rao bound for any spot size. A window narrower than 1 px would follow the
noise and the pixels' grid. It stays that wide for a smaller spot, and what the grid makes of
both moments is taken from a Gaussian of the spot's size, integrated over the pixels.

The background is a plane through a ring about the spot. The ring's scatter beyond that of
neighbouring pixels is texture, which moves a centroid more than white noise does.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.geometry.pose import Array

Grey = npt.NDArray[np.uint8]

LEAST_WINDOW_PX = 1.0  # σ. Source: experiment reflector-real-spots (0.1), stars of 2 px FWHM
LARGEST_WINDOW_PX = 40.0  # σ: a disc of 125 px. Source: by construction
_CLIPS = 6  # rounds without what is far off. Source: by construction, two neighbouring spots
_REACH = 3.0  # of the window, in its σ: the weight there is 1 %. Source: by construction
_ROUNDS = 20  # iterations at most; five do for most spots. Source: by construction
_SETTLED_PX = 2e-4  # px, of a step: the end. Source: by construction, a hundredth of the error
_LEAST_SPREAD = 0.04  # px², of a spot before the pixels. Source: by construction, σ = 0.2 px
# Scatter over that of neighbours by which chance does not go: 3 σ of 60 pixels. Source: by
# construction, √(2 / 57) = 0.19
_CHANCE = 1.6
# px²: area over which texture is one grey level, for its error. Source: experiment reflector-nees
_GRAIN_PX2 = 14.0
_GRAIN_PX = 4.0  # px along the frame, likewise. Source: by construction, the root of that
# σ of a slope that counts, where one is kept and where none is. Source: by construction, the risk
# of James and Stein's estimate of 2 σ and of 0
_DOUBT, _FLAT = 1.2, 0.5

# Two opposite pixels of one spot differ by less than so many σ of their noise, and by less than so
# much of its peak, for which linear interpolation errs on the rim of a blurred disc (0.05) or on a
# Gaussian of σ px (0.25 / σ²). Source: by construction, twice these
_OPPOSITE_SIGMA, _OPPOSITE_RIM, _OPPOSITE_ROUND = 5.0, 0.1, 0.5
# × the shift, for what is below these limits. Source: experiment reflector-nees --kind clutter
_BELOW_LIMIT = 1.5

Moments = tuple[float, float, float, float, float, float]


@njit(cache=True, nogil=True, error_model="numpy")
def window_moments(
    image: Grey, dark: Grey, background: float, x: float, y: float, sigma: float,
    box: tuple[int, int, int, int], columns: Array, rows: Array,
) -> Moments:  # fmt: skip
    """Sums over a box of pixels, with w a Gaussian about (x, y) and v the grey above background.

    Args:
        image: (H, W) picture; ``dark``: one to subtract, or (0, 0).
        background: grey level to subtract.
        x, y, sigma: of the window, px.
        box: first and last column, first and last row, all inclusive.
        columns, rows: scratch, at least as long as the box is wide and high.

    Returns:
        Σ w v, Σ w v dx, Σ w v dy, Σ w v dx², Σ w v dy², Σ w² (dx² + dy²) / 2.
    """
    x0, x1, y0, y1 = box
    has_dark = dark.shape[0] > 0
    f = -0.5 / (sigma * sigma)
    for u in range(x0, x1 + 1):
        columns[u - x0] = math.exp(f * (u - x) * (u - x))
    for v in range(y0, y1 + 1):
        rows[v - y0] = math.exp(f * (v - y) * (v - y))
    total = mx = my = mxx = myy = lever = 0.0
    for v in range(y0, y1 + 1):
        dy, row = v - y, rows[v - y0]
        a = ax = axx = q = qxx = 0.0
        for u in range(x0, x1 + 1):
            value = float(image[v, u]) - background
            if has_dark:
                value -= dark[v, u]
            w, dx = columns[u - x0], u - x
            wv = w * value
            a += wv
            ax += wv * dx
            axx += wv * dx * dx
            q += w * w
            qxx += w * w * dx * dx
        total += row * a
        mx += row * ax
        my += row * a * dy
        mxx += row * axx
        myy += row * a * dy * dy
        lever += row * row * 0.5 * (qxx + q * dy * dy)
    return total, mx, my, mxx, myy, lever


@njit(cache=True, nogil=True, error_model="numpy")
def pixel_moments(
    x: float, spread: float, window: float, first: int, last: int
) -> tuple[float, float]:
    """First and second moment about x, along one axis, of a Gaussian spot under a window.

    The spot (variance ``spread``, px², at x) is integrated over the pixels ``first`` to ``last``,
    the window (σ ``window``, at x) is sampled at their centres: what `window_moments` does.
    """
    scale, f = 1.0 / math.sqrt(2.0 * spread), -0.5 / (window * window)
    total = mean = square = 0.0
    before = math.erf((first - 0.5 - x) * scale)
    for u in range(first, last + 1):
        after = math.erf((u + 0.5 - x) * scale)
        d = u - x
        weight = (after - before) * math.exp(f * d * d)
        before = after
        total += weight
        mean += weight * d
        square += weight * d * d
    if not total > 0.0:
        return 0.0, window * window * spread / (window * window + spread)
    return mean / total, square / total


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _on_pixels(
    x: float, y: float, spread: float, sigma: float, box: tuple[int, int, int, int], moment: float
) -> tuple[float, float, float]:
    """What the pixels make of both first moments; the spread with which they give the second."""
    ax, axx = pixel_moments(x, spread, sigma, box[0], box[1])
    ay, ayy = pixel_moments(y, spread, sigma, box[2], box[3])
    square = sigma * sigma
    slope = ((square + spread + 1.0 / 12.0) / square) ** 2
    spread += (moment - 0.5 * (axx + ayy)) * slope
    return ax, ay, min(max(spread, _LEAST_SPREAD), square)


@njit(cache=True, nogil=True, error_model="numpy")
def centre_spot(
    image: Grey, dark: Grey, plane: tuple[float, float, float, float],
    start: tuple[float, float, float], noise: float, columns: Array, rows: Array,
) -> tuple[float, float, float, float, float]:  # fmt: skip
    """Place x, y, size, amplitude and error of one spot; error 0 where there is none.

    Args:
        image: (H, W) picture; ``dark``: one to subtract, or (0, 0).
        plane: of the background: grey at the start, its slopes and their error, grey a px.
        start: x, y and σ of the first window, px.
        noise: of a pixel as one error of a white one, grey: of `ring_plane`.
        columns, rows: scratch, at least as long as the picture is wide and high.

    Returns:
        x, y px; σ of the Gaussian that has the spot's size, pixels included, px; grey of its peak;
        one standard deviation of x and of y, px.
    """
    height, width = image.shape
    x, y, sigma = start
    level, slope_x, slope_y, slope_error = plane
    sigma = min(max(sigma, LEAST_WINDOW_PX), LARGEST_WINDOW_PX)
    size, amplitude, error, spread = sigma, 0.0, 0.0, max(sigma * sigma - 1.0 / 12.0, 0.25)
    settled = False
    for turn in range(_ROUNDS):
        reach, square = _REACH * sigma, sigma * sigma
        x0, x1 = max(math.ceil(x - reach), 0), min(math.floor(x + reach), width - 1)
        y0, y1 = max(math.ceil(y - reach), 0), min(math.floor(y + reach), height - 1)
        if x1 < x0 or y1 < y0:
            break
        here = level + slope_x * (x - start[0]) + slope_y * (y - start[1])
        total, mx, my, mxx, myy, lever = window_moments(
            image, dark, here, x, y, sigma, (x0, x1, y0, y1), columns, rows
        )
        if not total > 0.0:
            return x, y, size, 0.0, 0.0
        tilt = 2.0 * math.pi * square * square  # Σ w dx² of the background's slope
        mx, my, m = (mx - tilt * slope_x) / total, (my - tilt * slope_y) / total, mxx + myy
        m *= 0.5 / total
        # Newton on "no first moment": d(mx)/dx = mxx / σ² − total, −total/2 for a Gaussian.
        fx = max(1.0 - mxx / (total * square), 0.25)
        fy = max(1.0 - myy / (total * square), 0.25)
        error = math.hypot(noise * math.sqrt(lever), tilt * slope_error) / total
        error *= 0.5 * (1.0 / fx + 1.0 / fy)
        wide = math.sqrt(2.0 * max(m, 0.0))  # of the window that is as wide as the spot
        if wide < LEAST_WINDOW_PX and sigma == LEAST_WINDOW_PX:
            ax, ay, spread = _on_pixels(x, y, spread, sigma, (x0, x1, y0, y1), m)
            mx, my, size = mx - ax, my - ay, math.sqrt(spread + 1.0 / 12.0)
            amplitude = total * (square + size * size) / (2.0 * math.pi * (square * size * size))
        else:
            size, amplitude = sigma, total / (math.pi * square)  # a Gaussian's peak, at any phase
        step_x, step_y = mx / fx, my / fy
        x, y = x + min(max(step_x, -sigma), sigma), y + min(max(step_y, -sigma), sigma)
        if settled and abs(step_x) + abs(step_y) < _SETTLED_PX:
            break
        # Window of the spot's own size: under a window as wide, its second moment halves.
        wide = min(max(wide, LEAST_WINDOW_PX), LARGEST_WINDOW_PX)
        settled = settled or abs(wide - sigma) < 0.005 * sigma or turn >= 12
        if not settled or wide == LEAST_WINDOW_PX:
            sigma = wide
    return x, y, size, amplitude, error


@njit(cache=True, nogil=True, error_model="numpy")
def elongation(
    image: Grey, dark: Grey, spot: tuple[float, float, float], plane: tuple[float, float, float]
) -> tuple[float, float]:
    """How far from round a spot is: (xx − yy, 2 xy) / (xx + yy) of its moments, by its own window.

    Args:
        image: (H, W) picture; ``dark``: one to subtract, or (0, 0).
        spot: x, y and size of `centre_spot`.
        plane: of the background: grey at pixel (0, 0), and its slopes, grey a px.
    """
    height, width = image.shape
    x, y, size = spot
    sigma = max(size, LEAST_WINDOW_PX)
    reach, f, xx, yy, xy = _REACH * sigma, -0.5 / (sigma * sigma), 0.0, 0.0, 0.0
    for v in range(max(math.ceil(y - reach), 0), min(math.floor(y + reach), height - 1) + 1):
        for u in range(max(math.ceil(x - reach), 0), min(math.floor(x + reach), width - 1) + 1):
            value = float(image[v, u]) - plane[0] - plane[1] * u - plane[2] * v
            if dark.shape[0] > 0:
                value -= dark[v, u]
            dx, dy = u - x, v - y
            value *= math.exp(f * (dx * dx + dy * dy))
            xx, yy, xy = xx + value * dx * dx, yy + value * dy * dy, xy + value * dx * dy
    return ((xx - yy) / (xx + yy), 2.0 * xy / (xx + yy)) if xx + yy > 0.0 else (0.0, 0.0)


@njit(cache=True, nogil=True, error_model="numpy")
def overlap_error(
    image: Grey, dark: Grey, spot: tuple[float, float, float, float], slopes: tuple[float, float],
    noise: float,
) -> float:  # fmt: skip
    """How far another light in its window may have moved the centre of a spot, px.

    A spot looks the same from both sides of its centre. Where opposite pixels differ by more than
    noise and interpolation explain, something else shines. The window's centre moves until
    the first moment of that light is balanced by the spot's other side, so that half the moment of
    all differences is the light's.

    Args:
        image: (H, W) picture; ``dark``: one to subtract, or (0, 0).
        spot: x, y, size and amplitude of `centre_spot`.
        slopes: of the background, grey a px along x and y.
        noise: of a pixel, grey.
    """
    height, width = image.shape
    has_dark = dark.shape[0] > 0
    x, y, size, amplitude = spot
    sigma = max(size, LEAST_WINDOW_PX)
    reach, f = _REACH * sigma, -0.5 / (sigma * sigma)
    round_off = amplitude * max(_OPPOSITE_RIM, _OPPOSITE_ROUND / (sigma * sigma))
    limit = max(_OPPOSITE_SIGMA * math.sqrt(2.0) * noise, round_off)
    moment = 0.0
    for v in range(max(math.ceil(y - reach), 0), min(math.floor(y), height - 1) + 1):
        ov = 2.0 * y - v
        row = int(ov)
        if row + 1 >= height:
            continue
        b = ov - row
        for u in range(max(math.ceil(x - reach), 0), min(math.floor(x + reach), width - 1) + 1):
            ou = 2.0 * x - u
            column = int(ou)
            if ou < 0.0 or column + 1 >= width:
                continue
            a = ou - column
            value, opposite = float(image[v, u]), 0.0
            for j in range(2):
                for i in range(2):
                    share = (a if i else 1.0 - a) * (b if j else 1.0 - b)
                    grey = float(image[row + j, column + i])
                    if has_dark:
                        grey -= dark[row + j, column + i]
                    opposite += share * grey
            if has_dark:
                value -= dark[v, u]
            dx, dy = u - x, v - y
            off = abs(value - opposite - 2.0 * (slopes[0] * dx + slopes[1] * dy))
            if off > limit:
                far2 = dx * dx + dy * dy
                moment += math.exp(f * far2) * off * math.sqrt(far2)
    # Half of it, over the total (π σ² amplitude) and Newton's slope, which is a half too.
    share = math.pi * sigma * sigma * amplitude
    return _BELOW_LIMIT * moment / share if share > 0.0 else 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def ring_plane(
    image: Grey, dark: Grey, box: tuple[int, int, int, int], noise: float
) -> tuple[float, float, float, float, float]:
    """Background about a spot: grey at the box's middle, two slopes, noise, error of a slope.

    A plane through the pixels of a frame about the box, without those far off the rest. The noise
    is that of the picture, or that of the frame: its scatter beyond the steps between neighbours is
    texture, which counts as white noise of so many more grey levels as its grains are large. A
    slope that chance explains is none: it would move a wide spot by as much as all its noise.

    Args:
        image: (H, W) picture; ``dark``: one to subtract, or (0, 0).
        box: first and last column, first and last row of the spot.
        noise: of a pixel of the picture (of the difference), grey.
    """
    height, width = image.shape
    mx, my, half_x, half_y = _frame_about(box)
    level = slope_x = slope_y = 0.0
    limit, scatter, steps = np.inf, 0.0, 0.0
    for _ in range(_CLIPS):
        n = sv = sx = sy = sxx = syy = sxy = svx = svy = svv = sd = nd = 0.0
        before, near = 0.0, False
        for k in range(4 * (half_x + half_y)):
            u, v = _on_frame(k, half_x, half_y)
            u, v = u + int(mx), v + int(my)
            if u < 0 or v < 0 or u >= width or v >= height:
                near = False
                continue
            value = float(image[v, u])
            if dark.shape[0] > 0:
                value -= dark[v, u]
            dx, dy = u - mx, v - my
            if abs(value - level - slope_x * dx - slope_y * dy) > limit:
                near = False
                continue
            n, sv, sx, sy = n + 1.0, sv + value, sx + dx, sy + dy
            sxx, syy, svv = sxx + dx * dx, syy + dy * dy, svv + value * value
            svx, svy, sxy = svx + value * dx, svy + value * dy, sxy + dx * dy
            if near:
                sd, nd = sd + (value - before) ** 2, nd + 1.0
            before, near = value, True
        if n < 8.0:
            return level, 0.0, 0.0, noise, 0.0
        level = sv / n
        cx, cy, cxy = sxx - sx * sx / n, syy - sy * sy / n, sxy - sx * sy / n
        bx, by, slope_x, slope_y = svx - level * sx, svy - level * sy, 0.0, 0.0
        if cx * cy - cxy * cxy > n * n:
            slope_x = (bx * cy - by * cxy) / (cx * cy - cxy * cxy)
            slope_y = (by * cx - bx * cxy) / (cx * cy - cxy * cxy)
        rest = svv - n * level * level - slope_x * bx - slope_y * by
        scatter, steps = max(rest, 0.0) / max(n - 3.0, 1.0), 0.5 * sd / max(nd, 1.0)
        level -= (slope_x * sx + slope_y * sy) / n
        limit = 2.5 * math.sqrt(max(scatter, noise * noise))
    white = steps if steps > _CHANCE * noise * noise else noise * noise
    grain = max(scatter - _CHANCE * white, 0.0)
    variance = 2.0 * (white + _GRAIN_PX * grain) / (cx + cy)
    kept_x, kept_y = _kept(slope_x, variance), _kept(slope_y, variance)
    level += ((slope_x - kept_x) * sx + (slope_y - kept_y) * sy) / n
    doubt = math.sqrt(variance) * (_DOUBT if kept_x != 0.0 or kept_y != 0.0 else _FLAT)
    return level, kept_x, kept_y, math.sqrt(white + _GRAIN_PX2 * grain), doubt


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _kept(slope: float, variance: float) -> float:
    """The slope less what chance adds to it; 0 up to two of its σ (James and Stein)."""
    square = slope * slope
    return slope * (1.0 - 4.0 * variance / square) if square > 4.0 * variance else 0.0


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _frame_about(box: tuple[int, int, int, int]) -> tuple[float, float, int, int]:
    """Middle and half sides of the frame about a box: half as far again, and 3 px."""
    x0, x1, y0, y1 = box
    grow = 3 + (max(x1 - x0, y1 - y0) + 1) // 2
    return 0.5 * (x0 + x1), 0.5 * (y0 + y1), (x1 - x0) // 2 + grow, (y1 - y0) // 2 + grow


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _on_frame(k: int, half_x: int, half_y: int) -> tuple[int, int]:
    """Pixel k of the frame ±half_x, ±half_y, clockwise from its first corner."""
    wide, high = 2 * half_x, 2 * half_y
    if k < wide:
        return k - half_x, -half_y
    if k < wide + high:
        return half_x, k - wide - half_y
    if k < 2 * wide + high:
        return half_x - (k - wide - high), half_y
    return -half_x, half_y - (k - 2 * wide - high)
