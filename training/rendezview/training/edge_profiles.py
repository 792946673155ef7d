"""Strips: the surfaces beside an edge, one after the other along its image normal.

A bevel or the rim of a panel is often narrower than a pixel of the drawn view, and moves the edge
that a camera sees by as much: so it is the triangles that say what is seen at a place, and the
pixels around it only which triangles to ask.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.geometry.pose import Array
from rendezview.sensors.appearance.edges.contours import REACH_RADII, SURFACES
from rendezview.training.crossings import KIND, STEP_RADII, depth_on
from rendezview.training.drawn_view import DrawnView

_ASIDE = 1.0 / 196.0  # of the target's radius, apart are five samples of a strip along the edge
_OUTSIDE = 2.0 / 196.0  # of an outline that its strip is looked for
# Samples along the normal, of the target's radius from the edge: up to where, and how far apart.
_SAMPLING = ((3.0 / 196.0, 1.0 / 3136.0), (6.0 / 196.0, 1.0 / 1568.0), (REACH_RADII, 1.0 / 784.0))
_NEAR = 4.0 / 196.0  # of the target's radius: what lies so deep is worth 1/e of what is at the edge
_AROUND = 0.3  # of light all around against that of the Sun, in a difference that matters
_ALIKE = 1e-4 / 196.0  # albedo² times width: such a difference does not
_STEP = 0.1**2  # albedo², of a step in depth
_FAINT = 0.25  # of the brightest stretch: the sky, rather than a surface
_ON_EDGE_PX = 1e-6
_SAME_DEPTH = 2e-6


def _places(outside: float) -> tuple[Array, Array]:
    """(M,) places along a normal, of the target's radius, inside positive; (M,) their widths."""
    depths = [0.0]
    for far, step in _SAMPLING:
        depths += list(np.arange(depths[-1] + step, far + 0.5 * step, step))
    inside = np.array(depths)
    ends = np.concatenate([-inside[inside <= outside][:0:-1], inside])
    return 0.5 * (ends[1:] + ends[:-1]), np.diff(ends)


def strips(
    crossings: Array,
    view: DrawnView,
    beside: npt.NDArray[np.int32],
    normals: Array,
    albedo: Array,
    radius_px: float,
) -> tuple[Array, Array, Array]:
    """Surfaces along the image normals of N contour points, from outside to inside.

    They are averaged as far along the edge as the picture is read; the sky counts as black.

    Args:
        crossings: (N, 10) of ``edge_crossings``.
        beside: of ``faces_beside``.
        normals: (F, 3) of ``face_normals``, camera frame.
        albedo: (F,).
        radius_px: of the target.

    Returns:
        (N, SURFACES, 3) mean normals, camera frame, weighted by albedo and so shorter than 1;
        (N, SURFACES) mean albedo; (N, SURFACES − 1, 2) where all but the first begin: inwards of
        the point in the picture, of the target's radius, and z, 0 where there is none.
    """
    corners = view.vertices[:, :2] / view.vertices[:, 2:] * view.focal + view.middle
    outer, inner = _places(_OUTSIDE), _places(REACH_RADII)
    return _strips(  # type: ignore[no-any-return]
        crossings, *outer, *inner, view.vertices, corners, view.faces, beside, view.focal,
        view.middle, view.owner, normals, albedo, radius_px,
    )  # fmt: skip


@njit(cache=True, nogil=True)
def _inside(corners, face, x, y):  # type: ignore[no-untyped-def]
    """Whether a place lies in a projected face or on its edge."""
    least, most = 1e9, -1e9
    for k in range(3):
        a, b = corners[face[k]], corners[face[(k + 1) % 3]]
        ex, ey = b[0] - a[0], b[1] - a[1]
        away = (ex * (y - a[1]) - ey * (x - a[0])) / (np.sqrt(ex * ex + ey * ey) + 1e-30)
        least, most = min(least, away), max(most, away)
    return least >= -_ON_EDGE_PX or most <= _ON_EDGE_PX


@njit(cache=True, nogil=True)
def _face_at(x, y, vertices, corners, faces, beside, focal, middle, owner, normals):  # type: ignore[no-untyped-def]
    """The face that is seen at a place between the pixels' centres; −1: none.

    Of the faces seen around it, and of those beside them, of which none may own a pixel, the
    nearest that covers it; where none does, the pixel's own, but the sky where it is seen there.
    """
    height, width = owner.shape
    column, row = int(np.rint(x)), int(np.rint(y))
    own = owner[row, column]
    rx, ry = (x - middle) / focal, (y - middle) / focal
    seen, nearest = -1, np.inf
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
                    if face < 0 or face == seen or not _inside(corners, faces[face], x, y):
                        continue
                    z = depth_on(vertices, faces, face, normals, rx, ry)
                    if z <= 0.0 or z > nearest * (1.0 + _SAME_DEPTH):
                        continue
                    # Of two faces in one plane the first, as everywhere.
                    if z < nearest * (1.0 - _SAME_DEPTH) or face < seen:
                        seen, nearest = face, min(z, nearest)
        if seen >= 0 or own >= 0:
            break
    return seen if seen >= 0 else own


@njit(cache=True, nogil=True)
def _joined(seen, depth, weights, most, step):  # type: ignore[no-untyped-def]
    """Samples (M, 4) along a line as at most ``most`` even stretches; first samples of each.

    The two neighbours that are most alike are joined, time and again (Ward, 1963), as long as
    there are too many or the difference does not matter. Only what is faint is joined to the sky.
    Surfaces of which one lies ``step`` deeper than the other differ: it may lie in a shadow.
    """
    count = seen.shape[0]
    first, mean, weight = np.empty(count, np.int64), np.empty((count, 4)), np.empty(count)
    parts = 0
    for i in range(count):
        same = parts > 0 and abs(depth[i] - depth[i - 1]) < step
        if same:
            for k in range(4):
                same = same and abs(seen[i, k] - mean[parts - 1, k]) < 1e-4
        if same:
            weight[parts - 1] += weights[i]
        else:
            first[parts], weight[parts] = i, weights[i]
            mean[parts] = seen[i]
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
def _strips(  # type: ignore[no-untyped-def]
    points, outer, outer_wide, inner, inner_wide, vertices, corners, faces, beside, focal, middle,
    owner, normals, albedo, radius_px,
):  # fmt: skip
    height, width = owner.shape
    aside = _ASIDE * radius_px
    towards = np.zeros((points.shape[0], SURFACES, 3))
    colour = np.zeros((points.shape[0], SURFACES))
    starts = np.zeros((points.shape[0], SURFACES - 1, 2))
    starts[:, :, 0] = REACH_RADII
    seen, depth = np.empty((len(inner), 4)), np.empty(len(inner))
    for j in range(points.shape[0]):
        x, y, z = points[j, 2], points[j, 3], points[j, 4]
        tx, ty = points[j, 5] - x / z * points[j, 7], points[j, 6] - y / z * points[j, 7]
        length = np.sqrt(tx * tx + ty * ty) + 1e-30
        tx, ty = tx / length, ty / length
        outline = points[j, KIND] == 0.0
        step = STEP_RADII * radius_px * z / focal
        places, wide = (outer, outer_wide) if outline else (inner, inner_wide)
        count = len(places)
        for i in range(count):
            inside = places[i] * radius_px
            seen[i], depth[i] = 0.0, 0.0
            for b in range(-2, 3):
                u = points[j, 0] - inside * ty + aside * b * tx
                v = points[j, 1] + inside * tx + aside * b * ty
                if not (0.0 <= u <= width - 1.0 and 0.0 <= v <= height - 1.0):
                    continue
                face = _face_at(
                    u, v, vertices, corners, faces, beside, focal, middle, owner, normals
                )  # fmt: skip
                if face < 0:
                    continue
                for k in range(3):
                    seen[i, k] += 0.2 * albedo[face] * normals[face, k]
                seen[i, 3] += 0.2 * albedo[face] * _AROUND
                if b == 0:
                    rx, ry = (u - middle) / focal, (v - middle) / focal
                    depth[i] = depth_on(vertices, faces, face, normals, rx, ry)
        weights = wide * np.exp(-np.abs(places) / _NEAR)
        first = _joined(seen[:count], depth[:count], weights, SURFACES + outline, step)
        sky = 0
        if outline:
            nearest = np.inf
            for k in range(1, len(first)):
                begins = places[first[k]] - 0.5 * wide[first[k]]
                if abs(begins) < nearest:
                    nearest, sky = abs(begins), k
        for part in range(SURFACES):
            k = min(part + sky, len(first) - 1)
            start = first[k]
            end = first[k + 1] if k + 1 < len(first) else count
            total = 0.0
            for i in range(start, end):
                total += weights[i]
                for a in range(3):
                    towards[j, part, a] += weights[i] * seen[i, a]
                colour[j, part] += weights[i] * seen[i, 3] / _AROUND
            colour[j, part] /= total
            if colour[j, part] > 0.0:
                towards[j, part] /= total * colour[j, part]
            if part > 0 and part + sky < len(first):
                starts[j, part - 1, 0] = places[start] - 0.5 * wide[start]
                # What ends there is the nearer of the two surfaces.
                before, here = depth[start - 1], depth[start]
                nearer = min(before, here) if before > 0.0 and here > 0.0 else max(before, here)
                starts[j, part - 1, 1] = nearer
    return towards, colour, starts
