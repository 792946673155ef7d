"""The χ² of three spots against a triangle of reflectors, by sizes and brightnesses.

A pose in weak perspective, corrected twice for the depths it finds (as in POSIT), rejects most
triplets of a crowd at a tenth of the cost of P3P. The rest are judged at the poses of P3P.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.estimation.p3p import MAX_ROOTS, p3p_roots
from rendezview.sensors.beacons.detect.discs import disc_radius, expected_size, placed, turned

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Vector = tuple[float, float, float]
Tolerances = tuple[float, float, float, float, float, float, float]

_CORRECTIONS = 2  # rounds. Source: by construction, a bound of time
# Largest errors of the quick pose in ln(size): in all, and as a multiple of (base / range)².
_SLACK, _SLACK_NEAR = 0.01, 0.2
# and without corrections, of base / range. Source: by hand; see reflector-acquisition (0.1)
_SLACK_FIRST = 0.3
# ln of a size: by so much the expected one may be smaller than the one visible. Source: by
# construction, three times the largest σ of a size
_SIZE_REACH = 0.3


@njit(cache=True, nogil=True, error_model="numpy")
def judge(
    triplets: Ints, directions: Array, sizes: Array, peaks: Array, points: Array, normals: Array,
    diameters: Array, focal_px: float, blur_px: float, tolerances: Tolerances, window: Array,
    score_limit: float, quick: bool, scores: Array, poses: Array,
) -> None:  # fmt: skip
    """χ² of every pose of every triplet: sizes at its ranges, brightnesses among themselves.

    Every pose whose reflectors all face the camera is kept. A post leaves one (Bales); three
    reflectors in one plane across the line of sight often leave two.

    Args:
        triplets: (M, 3) spots as (left, centre, right).
        directions: (N, 3) unit; sizes, peaks: (N,) of the spots.
        points, normals, diameters: (3, 3), (3, 3), (3,) of the triangle, in the same order.
        tolerances: σ of ln(size) of one spot, of ln(diameter) and ln(blur) common to all, of
            ln(brightness) of the centre and between the outer two, the least cosine between a
            normal and its line of sight, and σ of the centre's ln(brightness) a rad² of half the
            base as seen, squared: the beam has a middle.
        window: (2,) nearest and farthest range.
        score_limit: χ² that is of no use.
        quick: whether to refuse by the quick pose what has no chance.
        scores: (M, 4) result, ∞ where refused; poses: (M, 4, 12) rotation and translation.
    """
    rays = np.empty((3, 3))
    rotations, translations = np.empty((MAX_ROOTS, 3, 3)), np.empty((MAX_ROOTS, 3))
    model = np.empty(9)
    log_size, log_peak = np.empty(len(sizes)), np.empty(len(peaks))
    for s in range(len(sizes)):
        log_size[s], log_peak[s] = math.log(sizes[s]), math.log(peaks[s])
    screened = quick and _model(points, normals, diameters, model)
    for n in range(triplets.shape[0]):
        for k in range(MAX_ROOTS):
            scores[n, k] = np.inf
        if screened and _ruled_out(
            model, triplets[n, 0], triplets[n, 1], triplets[n, 2], directions, log_size, log_peak,
            focal_px, blur_px, tolerances, window, score_limit,
        ):  # fmt: skip
            continue
        for i in range(3):
            for j in range(3):
                rays[i, j] = directions[triplets[n, i], j]
        roots = p3p_roots(rays, points, 1e-3, rotations, translations)
        for k in range(roots):
            if not least_facing(rotations[k], translations[k], points, normals) > 0.0:
                continue
            scores[n, k] = _score(
                rotations[k], translations[k], points, normals, diameters, triplets[n], log_size,
                log_peak, focal_px, blur_px, tolerances, window, score_limit,
            )  # fmt: skip
            for i in range(3):
                for j in range(3):
                    poses[n, k, 3 * i + j] = rotations[k, i, j]
                poses[n, k, 9 + i] = translations[k, i]


@njit(cache=True, nogil=True, error_model="numpy")
def _score(
    rotation: Array, translation: Array, points: Array, normals: Array, diameters: Array,
    triplet: Ints, log_size: Array, log_peak: Array, focal_px: float, blur_px: float,
    tolerances: Tolerances, window: Array, score_limit: float,
) -> float:  # fmt: skip
    """χ² of sizes and brightnesses of a triplet at a pose; ∞ where the pose is refused."""
    size_sigma, diameter_sigma, blur_sigma, peak_sigma, beam_sigma, least_cosine, curve = tolerances
    errors, shine, fall, mean, common = np.empty(3), np.empty(3), np.empty(3), 0.0, 0.0
    for i in range(3):
        x, y, z = placed(rotation, translation, points, i)
        far = math.sqrt(x * x + y * y + z * z)
        if far < window[0] or far > window[1]:
            return np.inf
        nx, ny, nz = turned(rotation, normals, i)
        if -(nx * x + ny * y + nz * z) / far < least_cosine:
            return np.inf
        radius = disc_radius(focal_px, x, y, z, nx, ny, nz, 0.5 * diameters[i])
        s = triplet[i]
        expected = expected_size(blur_px, radius)
        errors[i] = log_size[s] - math.log(expected)
        mean += errors[i] / 3.0
        common += common_variance(blur_px / expected, diameter_sigma, blur_sigma) / 3.0
        # Blur thins a small disc; a retro-reflector's illumination falls with range² too.
        shine[i] = log_peak[s] + 2.0 * math.log(expected / radius)
        fall[i] = 2.0 * math.log(far)
    chi = mean * mean / (size_sigma * size_sigma / 3.0 + common)
    for i in range(3):
        chi += ((errors[i] - mean) / size_sigma) ** 2
    if not chi <= score_limit:
        return np.inf
    # Beam and return fall smoothly across the target: the middle shines like the mean, but for the
    # curve. In even light nothing falls with range: the better of both counts.
    least, base = np.inf, 0.0
    for a in range(3):
        base += (points[2, a] - points[0, a]) ** 2
    peak_sigma = math.hypot(peak_sigma, curve * 0.25 * base / math.exp(0.5 * (fall[0] + fall[2])))
    for law in range(2):
        left, middle, right = (
            shine[0] + law * fall[0], shine[1] + law * fall[1], shine[2] + law * fall[2]
        )  # fmt: skip
        uneven, bright = (left - right) / beam_sigma, (middle - 0.5 * (left + right)) / peak_sigma
        least = min(least, uneven * uneven + bright * bright)
    return float(chi + least)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def common_variance(share: float, diameter_sigma: float, blur_sigma: float) -> float:
    """Variance of ln(size) that an error of diameter and of blur makes in all spots alike.

    ``share``: blur over size; of a small spot the blur is most of its size.
    """
    blurred = min(share * share, 1.0)
    return ((1.0 - blurred) * diameter_sigma) ** 2 + (blurred * blur_sigma) ** 2


@njit(cache=True, nogil=True, error_model="numpy")
def _model(points: Array, normals: Array, diameters: Array, out: Array) -> bool:
    """Constants of a triangle for the quick pose; false where its discs differ too much for it.

    With B from left to right and P from their middle to the centre: B², P², B·P, |B × P|², the
    disc's radius, and its normal as a multiple of B, P and B × P; |B|.
    """
    b, p, n = np.empty(3), np.empty(3), np.empty(3)
    for a in range(3):
        b[a] = points[2, a] - points[0, a]
        p[a] = points[1, a] - 0.5 * (points[0, a] + points[2, a])
        n[a] = (normals[0, a] + normals[1, a] + normals[2, a]) / 3.0
    radius = (diameters[0] + diameters[1] + diameters[2]) / 6.0
    for i in range(3):
        if abs(0.5 * diameters[i] - radius) > 1e-3 * radius:
            return False
        for a in range(3):
            if abs(normals[i, a] - n[a]) > 1e-3:
                return False
    bb = b[0] * b[0] + b[1] * b[1] + b[2] * b[2]
    pp = p[0] * p[0] + p[1] * p[1] + p[2] * p[2]
    bp = b[0] * p[0] + b[1] * p[1] + b[2] * p[2]
    nb = n[0] * b[0] + n[1] * b[1] + n[2] * b[2]
    np_ = n[0] * p[0] + n[1] * p[1] + n[2] * p[2]
    cx, cy, cz = b[1] * p[2] - b[2] * p[1], b[2] * p[0] - b[0] * p[2], b[0] * p[1] - b[1] * p[0]
    area = cx * cx + cy * cy + cz * cz
    out[0], out[1], out[2], out[3], out[4] = bb, pp, bp, area, radius
    out[5], out[6] = (nb * pp - np_ * bp) / area, (np_ * bb - nb * bp) / area
    out[7] = (n[0] * cx + n[1] * cy + n[2] * cz) / area
    out[8] = math.sqrt(bb)
    return True


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def _ruled_out(
    model: Array, left: int, centre: int, right: int, directions: Array, log_size: Array,
    log_peak: Array, focal_px: float, blur_px: float, tolerances: Tolerances, window: Array,
    score_limit: float,
) -> bool:  # fmt: skip
    """Whether neither of the two poses in weak perspective comes near the score that is needed.

    On the plane across the middle m of the base's two rays, in units of the range Z to the base's
    middle, the spots are at (−t, 0), (X, Y) and (t, 0). With w the square of the base's length as
    seen, in metres, and (x, y) the centre over that length:
    ``(B·P − x w)² = (B² − w)(P² − (x² + y²) w)``; its smaller root is the pose.
    """
    size_sigma, diameter_sigma, blur_sigma, peak_sigma, beam_sigma, least_cosine, curve = tolerances
    bb, pp, bp, area, radius = model[0], model[1], model[2], model[3], model[4]
    chord = _length(_chord(directions, left, right))
    s0, s1, s2 = log_size[left], log_size[centre], log_size[right]
    bright = log_peak[centre] - 0.5 * (log_peak[left] + log_peak[right])
    reach, steep = math.sqrt(score_limit), 1.0 / least_cosine
    peak_sigma = math.hypot(peak_sigma, curve * 0.25 * (steep * chord) ** 2)
    if not chord > 0.0 or _unlike(
        chord, s0, s1, s2, bright, pp / bb, reach, steep, size_sigma, peak_sigma
    ):
        return True
    t, along, across, m, u, v = _base_frame(directions, left, centre, right, chord)
    size = (s0 + s1 + s2) / 3.0
    z = _scaled(bb, pp, bp, area, 2.0 * t, along, across)[1]  # a distant one needs no corrections
    if z < 0.7 * window[0] or z > 1.4 * window[1]:
        return True
    share = blur_px / math.exp(size - _SIZE_REACH)
    common = 1.1 * common_variance(share, diameter_sigma, blur_sigma) + diameter_sigma**2
    mean_sigma = math.sqrt(0.34 * size_sigma * size_sigma + common)
    limit = reach * mean_sigma + _SLACK + _SLACK_FIRST * math.sqrt(bb) / z
    if _size_off(radius * focal_px / z, m[2], size, limit, least_cosine, blur_px):
        return True
    for k in range(2):
        z, o0, o1, o2, disc = _weak_pose(
            model, 1.0 - 2.0 * k, t, along, across, m, u, v, focal_px, window
        )
        if z < 0.0:
            continue
        expected = expected_size(blur_px, disc)
        # Of a disc farther by a share o, ln(size) is less by fall · o.
        fall = 1.0 - (blur_px / expected) ** 2
        slack = _SLACK + _SLACK_NEAR * bb / (z * z)
        mean = size - math.log(expected) + fall * o1 / 3.0
        chi = (max(abs(mean) - slack, 0.0) / mean_sigma) ** 2
        if chi > score_limit:
            continue
        for i in range(3):
            spot, o = (left, o0) if i == 0 else (centre, o1) if i == 1 else (right, o2)
            own = abs(log_size[spot] - size + fall * (o - o1 / 3.0)) - slack
            chi += (max(own, 0.0) / size_sigma) ** 2
        across_ = log_peak[left] - log_peak[right]
        for law in range(2):  # even light, and light that falls with range²
            rise = 2.0 * (1.0 + law - fall)
            uneven = max(abs(across_ + rise * (o0 - o2)) - 4.0 * slack, 0.0) / beam_sigma
            middle = max(abs(bright + rise * o1) - 4.0 * slack, 0.0) / peak_sigma
            if chi + uneven**2 + middle**2 <= score_limit:
                return False
    return True


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def _size_off(
    radius_px: float, cosine: float, size: float, limit: float, least_facing: float,
    blur_px: float,
) -> bool:  # fmt: skip
    """Whether ln(size) is further than ``limit`` from that of every tilt; cosine: off boresight."""
    largest = radius_px / (cosine * cosine)
    least = 0.97 * math.sqrt(0.5 + 0.5 * least_facing * least_facing) * cosine * largest
    factor, visible = math.exp(limit), math.exp(size)
    return visible > factor * expected_size(blur_px, largest) or (
        visible * factor < expected_size(blur_px, least)
    )


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def _chord(directions: Array, left: int, right: int) -> tuple[float, float, float]:
    return (
        directions[right, 0] - directions[left, 0],
        directions[right, 1] - directions[left, 1],
        directions[right, 2] - directions[left, 2],
    )


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def _length(v: Vector) -> float:
    return math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def _unlike(
    chord: float, s0: float, s1: float, s2: float, bright: float, ratio: float, reach: float,
    steep: float, size_sigma: float, peak_sigma: float,
) -> bool:  # fmt: skip
    """Whether sizes and brightnesses differ by more than the score and any tilt allow.

    Tilt explains differences of no more than ``steep`` of the base.
    """
    post = 1.1 * steep * math.sqrt(ratio) * chord + 0.02
    base = 1.1 * steep * chord + 0.02
    return (
        (abs(bright) > reach * peak_sigma + 4.0 * post)
        | (abs(s1 - 0.5 * (s0 + s2)) > 1.23 * reach * size_sigma + post)
        | (abs(s0 - s2) > 1.42 * reach * size_sigma + base)
    )


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def _base_frame(
    directions: Array, left: int, centre: int, right: int, chord: float
) -> tuple[float, float, float, Vector, Vector, Vector]:
    """Three spots on the plane across the middle m of the base's two rays.

    Returns half the length t of the base on the plane, the centre spot along and across the base,
    and the unit vectors m, u along the base, v across it.
    """
    d0x, d0y, d0z = directions[left, 0], directions[left, 1], directions[left, 2]
    d1x, d1y, d1z = directions[centre, 0], directions[centre, 1], directions[centre, 2]
    d2x, d2y, d2z = directions[right, 0], directions[right, 1], directions[right, 2]
    ux, uy, uz = _chord(directions, left, right)
    mx, my, mz = d0x + d2x, d0y + d2y, d0z + d2z
    f = 1.0 / math.sqrt(mx * mx + my * my + mz * mz)
    mx, my, mz = mx * f, my * f, mz * f
    f = 1.0 / chord
    ux, uy, uz = ux * f, uy * f, uz * f
    vx, vy, vz = my * uz - mz * uy, mz * ux - mx * uz, mx * uy - my * ux
    t = 0.5 * chord / (d2x * mx + d2y * my + d2z * mz)
    f = 1.0 / (d1x * mx + d1y * my + d1z * mz)
    along, across = f * (d1x * ux + d1y * uy + d1z * uz), f * (d1x * vx + d1y * vy + d1z * vz)
    return t, along, across, (mx, my, mz), (ux, uy, uz), (vx, vy, vz)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def _weak_pose(
    model: Array, sign: float, t: float, along: float, across: float, m: Vector, u: Vector,
    v: Vector, focal_px: float, window: Array,
) -> tuple[float, float, float, float, float]:  # fmt: skip
    """One of the two poses in weak perspective, corrected for the depths that it finds.

    Returns:
        The range Z (negative: refused), the depths of left, centre and right beyond the base's
        middle over Z, and the discs' radius in the picture, px.
    """
    bb, pp, bp, area, radius = model[0], model[1], model[2], model[3], model[4]
    o0 = o1 = o2 = 0.0
    beta = depth = w = z = x = y = 0.0
    for _ in range(1 + _CORRECTIONS):
        wide = t * (2.0 + o0 + o2)
        w, z, x, y = _scaled(
            bb, pp, bp, area, wide,
            (1.0 + o1) * along - 0.5 * t * (o2 - o0), (1.0 + o1) * across,
        )  # fmt: skip
        beta = sign * math.sqrt(max(bb - w, 0.0))
        depth = sign * math.copysign(math.sqrt(max(pp - (x * x + y * y) * w, 0.0)), bp - x * w)
        o1, o2 = depth / z, 0.5 * beta / z
        o0 = -o2
    if z < 0.85 * window[0] or z > 1.15 * window[1]:
        return -1.0, 0.0, 0.0, 0.0, 0.0
    # The normal on (u, v, m): a B + b P + c B × P.
    root = math.sqrt(w)
    nu = model[5] * root + model[6] * x * root - model[7] * beta * y * root
    nv = model[6] * y * root + model[7] * (beta * x * root - root * depth)
    nm = model[5] * beta + model[6] * depth + model[7] * w * y
    if nm >= 0.1:  # faces away
        return -1.0, 0.0, 0.0, 0.0, 0.0
    nx = nu * u[0] + nv * v[0] + nm * m[0]
    ny = nu * u[1] + nv * v[1] + nm * m[1]
    nz = nu * u[2] + nv * v[2] + nm * m[2]
    p, q = m[0] / m[2], m[1] / m[2]
    a, b = nx - nz * p, ny - nz * q
    spread = max(0.5 * (2.0 + p * p + q * q - a * a - b * b), 1e-6)
    return z, o0, o1, o2, radius * focal_px / (z * m[2]) * math.sqrt(spread)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _scaled(
    bb: float, pp: float, bp: float, area: float, wide: float, along: float, across: float
) -> tuple[float, float, float, float]:
    """Square of the base as seen (m²), range, and the centre in lengths of the base."""
    x, y = along / wide, across / wide
    h = bb * (x * x + y * y) + pp - 2.0 * bp * x
    w = 2.0 * area / (h + math.sqrt(max(h * h - 4.0 * y * y * area, 0.0)))
    return w, math.sqrt(w) / wide, x, y


@njit(cache=True, nogil=True, error_model="numpy")
def least_facing(rotation: Array, translation: Array, points: Array, normals: Array) -> float:
    """Least cosine between a reflector's normal and its line of sight; below 0 one faces away."""
    least = 1.0
    for i in range(points.shape[0]):
        x, y, z = placed(rotation, translation, points, i)
        nx, ny, nz = turned(rotation, normals, i)
        least = min(least, -(nx * x + ny * y + nz * z) / math.sqrt(x * x + y * y + z * z))
    return float(least)


@njit(cache=True, nogil=True, error_model="numpy")
def facing_root(
    rotations: Array, translations: Array, count: int, points: Array, normals: Array
) -> int:
    """Of the roots the one whose least-facing reflector faces the camera most; −1 if none does.

    With a post (Bales) it is the only one; of reflectors in a plane there may be others.
    """
    best, chosen = 0.0, -1
    for k in range(count):
        least = least_facing(rotations[k], translations[k], points, normals)
        if least > best:
            best, chosen = least, k
    return chosen
