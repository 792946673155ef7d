"""Edge profiles: the sequence of surfaces beside an edge, along its image normal.

A bevel or the rim of a panel is often narrower than a pixel of the drawn view, but moves the edge
in a camera's picture by its width. So the visible surface at a place is computed from triangles;
the pixels around it only select the triangles to test.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.geometry.pose import Array
from rendezview.sensors.appearance.edges.contours import REACH_RADII, SURFACES
from rendezview.training.crossings import KIND, STEP_RADII, depth_on
from rendezview.training.drawn_view import DrawnView
from rendezview.training.zbuffer import Int32s

# Lengths are shares of the target's radius in the picture. 1/196 is one pixel of a view 400 px
# wide, in which the target's radius is 196 px.
_ASIDE = 1.0 / 196.0  # distance of the five samples along the edge that are averaged
_OUTSIDE = 2.0 / 196.0  # the profile of an outline starts that far outside
# Samples along the normal: (up to this distance from the edge, spacing).
_SAMPLING = ((3.0 / 196.0, 1.0 / 3136.0), (6.0 / 196.0, 1.0 / 1568.0), (REACH_RADII, 1.0 / 784.0))
_NEAR = 4.0 / 196.0  # the weight of a sample falls by 1/e over this depth
_AROUND = 0.3  # share of sunlight; light from all around, in a difference that matters
_ALIKE = 1e-4 / 196.0  # albedo² × width; a smaller difference is negligible
_STEP = 0.1**2  # albedo²; the difference that a step in depth counts as
_FAINT = 0.25  # of the brightest stretch; fainter ones may be merged with the sky
_ON_EDGE_PX = 1e-6  # px; a place that close to an edge lies on it
_SAME_DEPTH = 2e-6  # relative; closer depths are equal


def _places(outside: float) -> tuple[Array, Array]:
    """(M,) places along a normal, in target radii, positive inside, and (M,) their widths."""
    depths = [0.0]
    for far, step in _SAMPLING:
        depths += list(np.arange(depths[-1] + step, far + 0.5 * step, step))
    inside = np.array(depths)
    ends = np.concatenate([-inside[inside <= outside][:0:-1], inside])
    return 0.5 * (ends[1:] + ends[:-1]), np.diff(ends)


def edge_profiles(
    crossings: Array,
    view: DrawnView,
    beside: npt.NDArray[np.int32],
    normals: Array,
    albedo: Array,
    radius_px: float,
) -> tuple[Array, Array, Array]:
    """Surfaces along the image normals of N contour points, from outside to inside.

    Each profile is averaged over the length of edge that the refinement reads. The sky is black.

    Args:
        crossings: (N, 10) of ``edge_crossings``.
        beside: of ``faces_beside``.
        normals: (F, 3) of ``face_normals``, camera frame.
        albedo: (F,).
        radius_px: of the target in the picture.

    Returns:
        (N, SURFACES, 3) mean normals, camera frame, weighted by albedo and so shorter than 1;
        (N, SURFACES) mean albedo; (N, SURFACES − 1, 2) where all surfaces but the first begin:
        the distance inwards of the point, in target radii, and z, 0 where there is no surface.
    """
    corners = view.vertices[:, :2] / view.vertices[:, 2:] * view.focal + view.middle
    outer, inner = _places(_OUTSIDE), _places(REACH_RADII)
    return _profiles(
        crossings, *outer, *inner, view.vertices, corners, view.faces, beside, view.focal,
        view.middle, view.owner, normals, albedo, radius_px,
    )  # fmt: skip


@njit(cache=True, nogil=True)
def _inside(corners: Array, face: Int32s, x: float, y: float) -> bool:
    """Whether a place lies in a projected face or on its edge."""
    least, most = 1e9, -1e9
    for k in range(3):
        a, b = corners[face[k]], corners[face[(k + 1) % 3]]
        ex, ey = b[0] - a[0], b[1] - a[1]
        away = (ex * (y - a[1]) - ey * (x - a[0])) / (np.sqrt(ex * ex + ey * ey) + 1e-30)
        least, most = min(least, away), max(most, away)
    return least >= -_ON_EDGE_PX or most <= _ON_EDGE_PX


@njit(cache=True, nogil=True)
def _face_at(
    x: float, y: float, vertices: Array, corners: Array, faces: Int32s, beside: Int32s,
    focal: float, middle: float, owner: Int32s, normals: Array,
) -> int:  # fmt: skip
    """The visible face at a place between pixel centres; −1: none.

    It is the nearest face that covers the place, among the faces of the 3 × 3 pixels around and
    then the faces beside those, which may own no pixel. If no face covers the place, the result
    is the pixel's own face, or the sky if a pixel around shows it.
    """
    height, width = owner.shape
    column, row = int(np.rint(x)), int(np.rint(y))
    own = owner[row, column]
    rx, ry = (x - middle) / focal, (y - middle) / focal
    visible, nearest = -1, np.inf
    for around in range(2):
        last = -1
        for dy in range(-1, 2):
            for dx in range(-1, 2):
                if not (0 <= row + dy < height and 0 <= column + dx < width):
                    continue
                owning = owner[row + dy, column + dx]
                if owning < 0:
                    own = -1
                if owning < 0 or owning == last:
                    continue
                last = owning
                for side in range(3 if around else 1):
                    face = beside[owning, side] if around else owning
                    if face < 0 or face == visible or not _inside(corners, faces[face], x, y):
                        continue
                    z = depth_on(vertices, faces, face, normals, rx, ry)
                    if z <= 0.0 or z > nearest * (1.0 + _SAME_DEPTH):
                        continue
                    # Of two coplanar faces the first, as in the z-buffer.
                    if z < nearest * (1.0 - _SAME_DEPTH) or face < visible:
                        visible, nearest = face, min(z, nearest)
        if visible >= 0 or own >= 0:
            break
    return visible if visible >= 0 else own


@njit(cache=True, nogil=True)
def _joined(
    samples: Array, depth: Array, weights: Array, most: int, step: float
) -> npt.NDArray[np.int64]:
    """Merge samples (M, 4) along a line into at most ``most`` uniform stretches.

    The two most similar neighbours are merged repeatedly (Ward, 1963), while there are too many
    stretches or the difference is negligible. Only faint stretches are merged with the sky. A
    surface that lies ``step`` deeper counts as different, because it may lie in a shadow.

    Returns:
        The number of the first sample of each stretch.
    """
    count = samples.shape[0]
    first, mean, weight = np.empty(count, np.int64), np.empty((count, 4)), np.empty(count)
    parts = 0
    for i in range(count):
        same = parts > 0 and abs(depth[i] - depth[i - 1]) < step
        if same:
            for k in range(4):
                same = same and abs(samples[i, k] - mean[parts - 1, k]) < 1e-4
        if same:
            weight[parts - 1] += weights[i]
        else:
            first[parts], weight[parts] = i, weights[i]
            mean[parts] = samples[i]
            parts += 1
    brightest = 0.0
    for i in range(parts):
        brightest = max(brightest, mean[i, 3])
    while parts > 1:
        least, at = np.inf, -1
        for i in range(parts - 1):
            fainter, other = min(mean[i, 3], mean[i + 1, 3]), max(mean[i, 3], mean[i + 1, 3])
            if fainter < 1e-6 and other > _FAINT * brightest:
                continue
            at_step = abs(depth[first[i + 1]] - depth[first[i + 1] - 1]) >= step
            apart = _STEP if at_step else 0.0
            for k in range(4):
                apart += (mean[i, k] - mean[i + 1, k]) ** 2
            cost = apart * weight[i] * weight[i + 1] / (weight[i] + weight[i + 1])
            if cost < least:
                least, at = cost, i
        if at < 0 or (parts <= most and least > _ALIKE):
            break
        total = weight[at] + weight[at + 1]
        for k in range(4):
            mean[at, k] = (weight[at] * mean[at, k] + weight[at + 1] * mean[at + 1, k]) / total
        weight[at] = total
        for i in range(at + 1, parts - 1):
            first[i], weight[i] = first[i + 1], weight[i + 1]
            mean[i] = mean[i + 1]
        parts -= 1
    return first[:parts]


@njit(cache=True, nogil=True)
def _sample(
    point: Array, tx: float, ty: float, places: Array, aside: float, radius_px: float,
    vertices: Array, corners: Array, faces: Int32s, beside: Int32s, focal: float, middle: float,
    owner: Int32s, normals: Array, albedo: Array, samples: Array, depth: Array,
) -> None:  # fmt: skip
    """Light and depth at places along one normal, averaged over five lines along the edge."""
    height, width = owner.shape
    for i in range(len(places)):
        inside = places[i] * radius_px
        samples[i], depth[i] = 0.0, 0.0
        for b in range(-2, 3):
            u = point[0] - inside * ty + aside * b * tx
            v = point[1] + inside * tx + aside * b * ty
            if not (0.0 <= u <= width - 1.0 and 0.0 <= v <= height - 1.0):
                continue
            face = _face_at(u, v, vertices, corners, faces, beside, focal, middle, owner, normals)
            if face < 0:
                continue
            for k in range(3):
                samples[i, k] += 0.2 * albedo[face] * normals[face, k]
            samples[i, 3] += 0.2 * albedo[face] * _AROUND
            if b == 0:
                rx, ry = (u - middle) / focal, (v - middle) / focal
                depth[i] = depth_on(vertices, faces, face, normals, rx, ry)


@njit(cache=True, nogil=True)
def _nearest_start(first: npt.NDArray[np.int64], places: Array, wide: Array) -> int:
    """The stretch that begins nearest to the edge itself; stretches before it are sky."""
    sky, nearest = 0, np.inf
    for k in range(1, len(first)):
        begins = places[first[k]] - 0.5 * wide[first[k]]
        if abs(begins) < nearest:
            nearest, sky = abs(begins), k
    return sky


@njit(cache=True, nogil=True)
def _average(
    first: npt.NDArray[np.int64], sky: int, places: Array, wide: Array, weights: Array,
    samples: Array, depth: Array, normal: Array, colour: Array, starts: Array,
) -> None:  # fmt: skip
    """Mean normal, albedo and start of each stretch of one profile, from stretch ``sky`` on."""
    count = len(places)
    for part in range(SURFACES):
        k = min(part + sky, len(first) - 1)
        start = first[k]
        end = first[k + 1] if k + 1 < len(first) else count
        total = 0.0
        for i in range(start, end):
            total += weights[i]
            for a in range(3):
                normal[part, a] += weights[i] * samples[i, a]
            colour[part] += weights[i] * samples[i, 3] / _AROUND
        colour[part] /= total
        if colour[part] > 0.0:
            normal[part] /= total * colour[part]
        if part > 0 and part + sky < len(first):
            starts[part - 1, 0] = places[start] - 0.5 * wide[start]
            # The border belongs to the nearer of the two surfaces.
            before, here = depth[start - 1], depth[start]
            nearer = min(before, here) if before > 0.0 and here > 0.0 else max(before, here)
            starts[part - 1, 1] = nearer


@njit(cache=True, nogil=True)
def _profiles(
    points: Array, outer: Array, outer_wide: Array, inner: Array, inner_wide: Array,
    vertices: Array, corners: Array, faces: Int32s, beside: Int32s, focal: float, middle: float,
    owner: Int32s, normals: Array, albedo: Array, radius_px: float,
) -> tuple[Array, Array, Array]:  # fmt: skip
    """See ``edge_profiles``."""
    aside = _ASIDE * radius_px
    normal = np.zeros((points.shape[0], SURFACES, 3))
    colour = np.zeros((points.shape[0], SURFACES))
    starts = np.zeros((points.shape[0], SURFACES - 1, 2))
    starts[:, :, 0] = REACH_RADII
    samples, depth = np.empty((len(inner), 4)), np.empty(len(inner))
    for j in range(points.shape[0]):
        x, y, z = points[j, 2], points[j, 3], points[j, 4]
        tx, ty = points[j, 5] - x / z * points[j, 7], points[j, 6] - y / z * points[j, 7]
        length = np.sqrt(tx * tx + ty * ty) + 1e-30
        tx, ty = tx / length, ty / length
        outline = points[j, KIND] == 0.0
        step = STEP_RADII * radius_px * z / focal
        places, wide = (outer, outer_wide) if outline else (inner, inner_wide)
        count = len(places)
        _sample(
            points[j], tx, ty, places, aside, radius_px, vertices, corners, faces, beside, focal,
            middle, owner, normals, albedo, samples, depth,
        )  # fmt: skip
        weights = wide * np.exp(-np.abs(places) / _NEAR)
        first = _joined(samples[:count], depth[:count], weights, SURFACES + outline, step)
        sky = _nearest_start(first, places, wide) if outline else 0
        _average(first, sky, places, wide, weights, samples, depth, normal[j], colour[j], starts[j])
    return normal, colour, starts
