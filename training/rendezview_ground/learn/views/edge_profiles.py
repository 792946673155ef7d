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
from rendezview.geometry.zbuffer import Int32s
from rendezview.sensors.appearance.model.contours import REACH_RADII, SURFACES
from rendezview_ground.learn.views.drawn_view import DrawnView
from rendezview_ground.render.crossings import KIND, STEP_RADII
from rendezview_ground.render.faces_along import Scratch, faces_along, scratch_for

# Lengths are shares of the target's radius in the picture. 1/196 is one pixel of a view 400 px
# wide, in which the target's radius is 196 px.
# Distance from a point of the two lines across its edge that are averaged. Source: two lines at
# ± √2 px have the spread of five at 0, ± 1 and ± 2 px
_ASIDE = np.sqrt(2.0) / 196.0
_OUTSIDE = 2.0 / 196.0  # the profile of an outline starts that far outside
# Samples along the normal: (up to this distance from the edge, spacing).
_SAMPLING = ((3.0 / 196.0, 1.0 / 3136.0), (6.0 / 196.0, 1.0 / 1568.0), (REACH_RADII, 1.0 / 784.0))
_NEAR = 4.0 / 196.0  # the weight of a sample falls by 1/e over this depth
_AROUND = 0.3  # share of sunlight; light from all around, in a difference that matters
_ALIKE = 1e-4 / 196.0  # albedo² × width; a smaller difference is negligible
_STEP = 0.1**2  # albedo²; the difference that a step in depth counts as
_FAINT = 0.25  # of the brightest stretch; fainter ones may be merged with the sky


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
    outer, inner = _places(_OUTSIDE), _places(REACH_RADII)
    return _profiles(
        crossings, *outer, *inner, view.vertices, view.points, view.faces, beside, view.focal,
        view.middle, view.owner, normals, albedo, radius_px,
    )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
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
            for k in range(4):
                mean[parts, k] = samples[i, k]
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
            for k in range(4):
                mean[i, k] = mean[i + 1, k]
        parts -= 1
    return first[:parts]


@njit(cache=True, nogil=True, error_model="numpy")
def _sample(
    point: Array, tx: float, ty: float, places_px: Array, aside: float, vertices: Array,
    corners: Array, faces: Int32s, beside: Int32s, focal: float, middle: float, owner: Int32s,
    normals: Array, albedo: Array, scratch: Scratch, samples: Array, depth: Array,
) -> None:  # fmt: skip
    """Light at places along one normal, averaged over two lines beside it; depth of the first."""
    count = len(places_px)
    samples[:count], depth[:count] = 0.0, 0.0
    for b in range(-1, 2, 2):
        line = np.array([point[0] + aside * b * tx, point[1] + aside * b * ty, -ty, tx])
        faces_along(
            line, places_px, vertices, corners, faces, beside, focal, middle, owner, normals,
            scratch,
        )  # fmt: skip
        for i in range(count):
            face = scratch.visible[i]
            if face < 0:
                continue
            share = albedo[face] / 2.0
            for k in range(3):
                samples[i, k] += share * normals[face, k]
            samples[i, 3] += share * _AROUND
            if b < 0:
                depth[i] = 1.0 / scratch.nearness[i]


@njit(cache=True, nogil=True, error_model="numpy")
def _nearest_start(first: npt.NDArray[np.int64], places: Array, wide: Array) -> int:
    """The stretch that begins nearest to the edge itself; stretches before it are sky."""
    sky, nearest = 0, np.inf
    for k in range(1, len(first)):
        begins = places[first[k]] - 0.5 * wide[first[k]]
        if abs(begins) < nearest:
            nearest, sky = abs(begins), k
    return sky


@njit(cache=True, nogil=True, error_model="numpy")
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


@njit(cache=True, nogil=True, error_model="numpy")
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
    scratch = scratch_for(len(inner), faces.shape[0])
    outer_px, inner_px = radius_px * outer, radius_px * inner
    outer_weights = outer_wide * np.exp(-np.abs(outer) / _NEAR)
    inner_weights = inner_wide * np.exp(-np.abs(inner) / _NEAR)
    for j in range(points.shape[0]):
        x, y, z = points[j, 2], points[j, 3], points[j, 4]
        tx, ty = points[j, 5] - x / z * points[j, 7], points[j, 6] - y / z * points[j, 7]
        length = np.sqrt(tx * tx + ty * ty) + 1e-30
        tx, ty = tx / length, ty / length
        outline = points[j, KIND] == 0.0
        step = STEP_RADII * radius_px * z / focal
        places, wide = (outer, outer_wide) if outline else (inner, inner_wide)
        weights = outer_weights if outline else inner_weights
        count = len(places)
        _sample(
            points[j], tx, ty, outer_px if outline else inner_px, aside, vertices, corners, faces,
            beside, focal, middle, owner, normals, albedo, scratch, samples, depth,
        )  # fmt: skip
        first = _joined(samples[:count], depth[:count], weights, SURFACES + outline, step)
        sky = _nearest_start(first, places, wide) if outline else 0
        _average(first, sky, places, wide, weights, samples, depth, normal[j], colour[j], starts[j])
    return normal, colour, starts
