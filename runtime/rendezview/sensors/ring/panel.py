"""The four corners of a rectangular panel in a grey picture, from straight lines along its sides.

Zhai et al. take the corners as given. Here the panel is the largest quadrilateral that is brighter
or darker than what is round it; a blurred step is fitted to the grey levels across each side, a
straight line to the steps, and the corners are where the lines meet.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
import numpy.typing as npt

from rendezview.estimation.edge_profile import REACH, step_filters
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array
from rendezview.sensors.ring.detector import Grey
from rendezview.sensors.ring.rectangle import rectangle_attitude

Floats = npt.NDArray[np.float32]

_LEVELS = 9  # thresholds between the darkest and the brightest percentile. Source: by construction
_LEAST_AREA = 0.003  # of the picture. Source: by construction, a panel 70 × 50 px of 1024 × 1024
_CORNER_SHARE = (
    0.02  # of the outline, by which a quadrilateral may miss it. Source: OpenCV's sample
)
_SAMPLE_PX = 2.0  # between profiles along a side. Source: by construction, an edge's blur
_NEAR_CORNER = (
    0.06  # share of a side left out at either end, where two edges meet. Source: as above
)
_LEAST_EDGES = 0.6  # of a side's profiles that must show the line. Source: by construction
_CUT_SPREADS = 3.5  # of steps from their line. Source: by construction, normal distribution
_FLOOR_PX = 0.03  # σ added to a corner, the edge model's. Source: `RingOptions.floor_px`


@dataclass(frozen=True, slots=True, eq=False)
class Panel:
    """A rectangle in the picture."""

    corners_px: Array  # (4, 2) in order round it, of the camera without its distortion
    sigma_px: float  # of a corner's coordinate, one σ

    def ordered(self, camera: Camera, before: Array | None = None) -> tuple[Array, Array] | None:
        """Corners in the order of `rectangle_attitude`, and that attitude (3, 3).

        The x axis points towards the camera. Of the four orders that leaves, the nearest to the
        attitude ``before``; without one, y runs along the longer side and z up in the picture.
        """
        best: tuple[float, Array, Array] | None = None
        for shift in range(4):
            for sense in (1, -1):
                a, b, c, d = np.roll(self.corners_px[::sense], shift, axis=0)
                corners = np.array([a, b, d, c])
                found = rectangle_attitude(camera, corners)
                if found is None or found.rotation[:, 0] @ found.rays.mean(axis=0) > 0.0:
                    continue
                if before is not None:
                    worth = float(np.trace(found.rotation.T @ before))
                else:
                    q1, q2, q3, _ = found.depth_ratios[:, None] * found.rays
                    ratio = np.linalg.norm(q2 - q1) / np.linalg.norm(q3 - q1)
                    worth = float(ratio - 1e-6 * found.rotation[1, 2])
                if best is None or worth > best[0] + 1e-9:
                    best = (worth, corners, found.rotation)
        return None if best is None else (best[1], best[2])

    def holds(self, point_px: Array) -> bool:
        """Whether a point (2,) lies within."""
        outline = self.corners_px.astype(np.float32)
        return bool(
            cv2.pointPolygonTest(outline, (float(point_px[0]), float(point_px[1])), False) > 0
        )


def find_panel(image: Grey, camera: Camera, blur_px: float = 0.9) -> Panel | None:
    """The largest quadrilateral with four sharp straight sides; None where there is none.

    Args:
        image: (H, W) uint8.
        camera: its distortion is taken from the sides before lines are fitted.
        blur_px: σ of an edge in the picture.
    """
    filters = step_filters(blur_px)[0]
    grey = np.asarray(image, dtype=np.float32)
    for corners, outline in _quadrilaterals(image):
        sides = []
        for start, end in pairwise([*corners, corners[0]]):
            side = _side(grey, camera, start, end, outline, filters)
            if side is None:
                break
            sides.append(side)
        if len(sides) < 4:
            continue
        meets = [sides[k - 1].meets(sides[k]) for k in range(4)]
        places = np.array([place for place, _ in meets])
        variance = float(np.mean([spread for _, spread in meets]))
        if np.isfinite(places).all():
            return Panel(places, float(np.hypot(np.sqrt(variance), _FLOOR_PX)))
    return None


@dataclass(frozen=True, slots=True, eq=False)
class _Line:
    """A straight line in the picture, px."""

    middle: Array  # (2,)
    direction: Array  # (2,) unit
    shift_variance: float  # across it at the middle
    turn_variance: float  # rad²

    @classmethod
    def fit(cls, points: Array) -> _Line | None:
        """Through points (N, 2), those far off left out; None where too many are."""
        if len(points) < 8:
            return None
        keep = np.ones(len(points), dtype=bool)
        for _ in range(3):
            middle = points[keep].mean(axis=0)
            arms = points[keep] - middle
            direction = np.linalg.eigh(arms.T @ arms)[1][:, 1]
            away = (points - middle) @ np.array([-direction[1], direction[0]])
            spread = 1.4826 * float(np.median(np.abs(away[keep]))) + 1e-3
            keep = np.abs(away) < _CUT_SPREADS * spread
            if keep.sum() < _LEAST_EDGES * len(points):
                return None
        count, arm = int(keep.sum()), (points[keep] - middle) @ direction
        variance = float(away[keep] @ away[keep]) / (count - 2)
        return cls(middle, direction, variance / count, variance / float(arm @ arm))

    def meets(self, other: _Line) -> tuple[Array, float]:
        """Where two lines meet (2,), and the variance of a coordinate; NaN where parallel."""
        columns = np.column_stack([self.direction, -other.direction])
        if abs(np.linalg.det(columns)) < 0.05:
            return np.full(2, np.nan), np.nan
        far = np.linalg.solve(columns, other.middle - self.middle)
        shifts = [
            line.shift_variance + t * t * line.turn_variance
            for line, t in zip((self, other), far, strict=True)
        ]
        across = np.linalg.inv([[-d[1], d[0]] for d in (self.direction, other.direction)])
        variance = float(np.trace(across @ np.diag(shifts) @ across.T)) / 2.0
        return self.middle + far[0] * self.direction, variance


def _quadrilaterals(image: Grey) -> list[tuple[Array, Array]]:
    """Four corners (4, 2) px and the outline (N, 2) of convex regions, the largest first."""
    height, width = image.shape
    smooth = cv2.GaussianBlur(image, (0, 0), 1.0)
    low, high = np.percentile(smooth, (1.0, 99.5))
    found: list[tuple[float, Array, Array]] = []
    for level in np.linspace(low, high, _LEVELS + 2)[1:-1]:
        mask = (smooth > level).astype(np.uint8)
        for outline in cv2.findContours(mask, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0]:
            area = cv2.contourArea(outline)
            if area < _LEAST_AREA * width * height:
                continue
            hull = cv2.convexHull(outline)
            near = _CORNER_SHARE * cv2.arcLength(hull, True)
            corners = cv2.approxPolyDP(hull, near, True).reshape(-1, 2).astype(np.float64)
            inside = (corners > 1).all() and (corners < (width - 2, height - 2)).all()
            if len(corners) == 4 and inside and area > 0.8 * cv2.contourArea(hull):
                found.append((area, corners, outline.reshape(-1, 2).astype(np.float64)))
    return [(corners, line) for _, corners, line in sorted(found, key=lambda one: -one[0])]


def _side(
    grey: Floats, camera: Camera, start: Array, end: Array, outline: Array, filters: Array
) -> _Line | None:
    """The line of a side, in pixels of the camera without distortion."""
    long = float(np.linalg.norm(end - start))
    along = (end - start) / long
    across = np.array([-along[1], along[0]])
    shares = np.linspace(_NEAR_CORNER, 1.0 - _NEAR_CORNER, max(int(long / _SAMPLE_PX), 8))
    base = start + shares[:, None] * (end - start)
    # The region's outline gives the side to a pixel, steps of the grey levels the rest.
    share, away = (outline - start) @ along / long, (outline - start) @ across
    mine = (share > shares[0]) & (share < shares[-1]) & (np.abs(away) < _CORNER_SHARE * 4.0 * long)
    line = _Line.fit(outline[mine])
    for _ in range(2):
        if line is None:
            return None
        across = np.array([-line.direction[1], line.direction[0]])
        places = line.middle + ((base - line.middle) @ line.direction)[:, None] * line.direction
        _, contrast, shifted = filters @ _profiles(grey, places, across, REACH).T
        usual = float(np.median(contrast))
        good = contrast * np.sign(usual) > 0.3 * abs(usual)
        steps = np.divide(shifted, contrast, out=np.full_like(contrast, np.inf), where=good)
        good &= np.abs(steps) < REACH - 1.0
        if good.sum() < _LEAST_EDGES * len(shares):
            return None
        places = places[good] + steps[good, None] * across
        line = _Line.fit(places)
    rays = camera.rays(places)
    return _Line.fit(rays[:, :2] * (camera.fx, camera.fy) + (camera.cx, camera.cy))


def _profiles(grey: Floats, places: Array, across: Array, reach: int) -> Array:
    """(N, 2 reach + 1) grey levels across a side, 1 px apart."""
    taps = places[:, None, :] + np.arange(-reach, reach + 1)[None, :, None] * across
    x, y = (np.ascontiguousarray(taps[..., k], dtype=np.float32) for k in (0, 1))
    profiles = cv2.remap(grey, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(profiles, dtype=np.float64)
