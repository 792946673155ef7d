"""Grey levels of a frame along the normal of an edge, and which of them white pixels clip."""

from __future__ import annotations

from numba import njit

from rendezview.geometry.pose import Array
from rendezview.io.grey_frame import WHITE_GREY, Picture
from rendezview.sensors.appearance.edges.profile_fit import Flags
from rendezview.sensors.appearance.model.view_tables import ProjectedEdge

_BORDER_PX = 2.0  # px; the lines read stay inside the image by this. Source: by construction
_LINES_APART_PX = 1.5  # px. Source: by hand, seeds of docs/notes/refinement.md
# A level above half of white may be one that white pixels take part in. Source: by construction
_MAYBE_WHITE = 0.5 * WHITE_GREY
_NEAR_PX = 5  # px; of an edge's profile. Source: by construction, the window of its fit and a move
# Of a level's pixels are white: it is a lower bound. Source: by construction, of 12 pixels
_WHITE_SHARE = 0.1


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def read_profile(
    image: Picture, u: float, v: float, nx: float, ny: float, back: int, ahead: int, lines: int,
    profile: Array,
) -> bool:  # fmt: skip
    """Grey levels from ``back`` pixels inside an edge to ``ahead`` outside, bilinear.

    The mean of parallel lines; False where they leave the image. ``profile`` gets the levels.
    """
    height, width = image.shape
    u0, v0 = u - back * nx, v - back * ny
    u1, v1 = u + ahead * nx, v + ahead * ny
    if not (
        min(u0, u1) >= _BORDER_PX
        and min(v0, v1) >= _BORDER_PX
        and max(u0, u1) < width - 1.0 - _BORDER_PX
        and max(v0, v1) < height - 1.0 - _BORDER_PX
    ):
        return False
    count = back + ahead + 1
    for i in range(count):
        profile[i] = 0.0
    share = 1.0 / lines
    for line in range(lines):
        shift = _LINES_APART_PX * (line - 0.5 * (lines - 1))
        a, b = u0 - shift * ny, v0 + shift * nx
        for i in range(count):
            column, row = int(a), int(b)
            fa, fb = a - column, b - row
            upper = image[row, column] * (1.0 - fa) + image[row, column + 1] * fa
            lower = image[row + 1, column] * (1.0 - fa) + image[row + 1, column + 1] * fa
            profile[i] += share * (upper + fb * (lower - upper))
            a += nx
            b += ny
    return True


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, forceinline=True)
def mark_clipped(
    image: Picture, edge: ProjectedEdge, back: int, at: float, count: int, lines: int,
    profile: Array, clipped: Flags,
) -> bool:  # fmt: skip
    """Which levels of a ``profile`` of ``read_profile`` white pixels take part in; whether any.

    Those near the place ``at``, pixels outwards of the one at ``back``, are marked in ``clipped``.
    """
    some, middle = False, int(at) + back
    for i in range(count):
        clipped[i] = False
        if profile[i] < _MAYBE_WHITE or abs(i - middle) > _NEAR_PX:
            continue
        share = 0.0
        for line in range(lines):
            shift = _LINES_APART_PX * (line - 0.5 * (lines - 1))
            a = edge.u + (i - back) * edge.nx - shift * edge.ny
            b = edge.v + (i - back) * edge.ny + shift * edge.nx
            column, row = int(a), int(b)
            fa, fb = a - column, b - row
            share += (1.0 - fa) * (1.0 - fb) * (image[row, column] >= WHITE_GREY)
            share += fa * (1.0 - fb) * (image[row, column + 1] >= WHITE_GREY)
            share += (1.0 - fa) * fb * (image[row + 1, column] >= WHITE_GREY)
            share += fa * fb * (image[row + 1, column + 1] >= WHITE_GREY)
        if share > _WHITE_SHARE * lines:
            clipped[i] = some = True
    return some
