"""Which of a frame's ellipses is the edge of the known radius.

A vehicle shows many circles about the ring's axis: the ring's own edges, the foot of its adapter, a
shield, a nozzle. All are real circles, so how well an ellipse is seen does not tell which it is. A
range does, with its σ; so do other circles of the target, where they are known. Every ellipse gets
a cost, −2 ln of its likelihood but for a constant. Ellipses that cost little more than the best and
give another range are its rivals.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from rendezview.geometry.camera import Camera
from rendezview.sensors.ring.circle_pose import (
    CirclePose,
    circle_poses,
    shape_of_circle,
    tangent_basis,
)
from rendezview.sensors.ring.detector import RingEdge

Array = npt.NDArray[np.float64]

_RANGE_FLOOR = 0.003  # of the range; least σ of the point it is measured to. Source: a rim's depth
# From the given range; beyond it an ellipse is none of the ring's. Source: ring-vehicle (0.1),
# seed 22
_FARTHEST_SIGMAS = 3.0
# Of −ln score: a long arc with companions is likelier the ring than a shadow. Source: the same
_WORTH = 2.0
_RIVAL_COST = 5.0  # more than the best's; a rival within it may be the ring. Source: the same
# Of the range; two edges that differ by less are one, whichever it is. Source: the 0.5 % asked for
_SAME_RANGE = 0.004
_RIVAL_SCORE = 0.05  # of the best score, without a range; a weaker one is none. Source: the same
# Of the semi-axis; circles about one axis lie no further apart. Source: a tilt of 35°, half a
# radius behind the ring
_ASIDE = 0.3
# From here edges of one group are known to be of one plane. Source: the groups' own tolerance
_PLANE_TILT_RAD = math.radians(10.0)
# How far a known circle's picture may lie from its ellipse: a share of its size, and so many px.
# Source: ring-vehicle (0.1), seed 22
_KNOWN_SHARE, _KNOWN_PX = 0.015, 1.0
# A ring has two edges at least. Of the circles that fitted the range by chance (ring-vehicle
# (0.1) of HST, seed 25) 19 of 26 stood alone, of the right ones on client, HST and ISS none of 194.
_ALONE = (
    "the circle that may be the ring stands alone: no other edge of the frame is about its axis"
)
# Cost gained by a known circle that is found, and of one that is not. Source: 2 ln of the odds of
# 60 % (client, ring-vehicle (0.1), seed 22) to 10 % (by chance)
_KNOWN_FOUND, _KNOWN_MISSED = 3.6, 1.6


@dataclass(frozen=True, slots=True, eq=False)
class Which:
    """The ellipse that is the ring's, and the others that may be it."""

    edge: int | None
    rivals: tuple[int, ...]  # best first, without ``edge``
    reason: str  # why there is none, or what the rivals are
    by_score: bool = False  # nothing but the scores chose it: it may be an inner edge
    # Ellipses that may be another known circle: (ellipse, index of the circle). The ring then lies
    # elsewhere. Best first.
    others: tuple[tuple[int, int], ...] = ()
    # The ellipse has no companion about its axis, while the frame shows other circles.
    alone: bool = False


def by_range(
    camera: Camera,
    edges: Sequence[RingEdge],
    radius_m: float,
    range_m: float,
    sigma_m: float,
    circles: Sequence[tuple[float, float]] = (),
    possible: npt.NDArray[np.bool_] | None = None,
) -> Which:
    """The edge whose circle of the known radius lies at a given range.

    Args:
        camera: of the frame.
        edges: of the frame.
        radius_m: of the ring's edge.
        range_m: to the ring's centre.
        sigma_m: its error, one σ.
        circles: known circles about the same axis: height over the ring's plane (m, outwards
            positive) and radius (m).
        possible: (K,) edges that may be it, by their place; None: all.
    """
    poses = [circle_poses(camera, edge.ellipse, radius_m) for edge in edges]
    ranges = np.array([np.linalg.norm(p[0].centre_m) if p else np.inf for p in poses])
    spread = math.hypot(sigma_m, _RANGE_FLOOR * range_m)
    off = np.abs(ranges - range_m) / spread
    near = off < _FARTHEST_SIGMAS
    if possible is not None:
        near &= possible
    if not near.any():
        return Which(None, (), "no ellipse as large as the ring should be at that range")
    cost = np.where(near, off**2, np.inf)
    for k in np.flatnonzero(near).tolist():
        cost[k] -= _WORTH * math.log(max(edges[k].score, 1e-3))
        cost[k] += _cost_of_known(camera, edges, k, poses[k], radius_m, circles)
    by = f"the range of {range_m:.3f} ± {sigma_m:.3f} m"
    which = _decided(cost, ranges, by)
    assert which.edge is not None
    known = [float(ranges[k]) for k in (which.edge, *which.rivals)]
    others, words = [], []
    limit = float(cost[which.edge]) + _RIVAL_COST
    for found in _as_others(camera, edges, radius_m, circles, range_m, spread, possible):
        own, at_m, k, j = found
        if own > limit or any(abs(at_m / r - 1.0) < _SAME_RANGE for r in known):
            continue
        # Where it should lie if the best is the ring: the same reading of the frame, less exact.
        same = k != which.edge and any(
            _miss(camera, pose, circles[j], edges[k].ellipse.shape) < 1.0
            for pose in poses[which.edge]
        )
        if not same:
            known.append(at_m)
            others.append((k, j))
            words.append(f"{k} as the circle of {circles[j][1]:g} m (then at {at_m:.2f} m)")
    if not others:
        isolated = not circles and not which.rivals and _is_alone(edges, which.edge)
        return replace(which, alone=True, reason=_ALONE) if isolated else which
    reason = which.reason or _words(which.edge, [which.edge], ranges, f"{by} does not tell")
    if not which.reason:
        reason = reason.rsplit(" or ", 1)[0]
    return replace(which, others=tuple(others), reason=" or ".join([reason, *words]))


def _is_alone(edges: Sequence[RingEdge], k: int) -> bool:
    """Whether an ellipse is none of a concentric group, and not the only one of its frame."""
    return len(edges) > 1 and sum(edge.group == edges[k].group for edge in edges) == 1


def _as_others(
    camera: Camera,
    edges: Sequence[RingEdge],
    radius_m: float,
    circles: Sequence[tuple[float, float]],
    range_m: float,
    spread_m: float,
    possible: npt.NDArray[np.bool_] | None,
) -> list[tuple[float, float, int, int]]:
    """Ellipses as known circles other than the ring: cost, range of the ring, ellipse, circle."""
    found = []
    for j, (height_m, circle_m) in enumerate(circles):
        rest = [(h - height_m, r) for i, (h, r) in enumerate(circles) if i != j]
        rest.append((-height_m, radius_m))
        for k, edge in enumerate(edges):
            poses = circle_poses(camera, edge.ellipse, circle_m)
            if not poses or (possible is not None and not possible[k]):
                continue
            at_m = float(np.linalg.norm(poses[0].centre_m - height_m * poses[0].axis))
            off = (at_m - range_m) / spread_m
            if abs(off) < _FARTHEST_SIGMAS:
                cost = off**2 - _WORTH * math.log(max(edge.score, 1e-3))
                cost += _cost_of_known(camera, edges, k, poses, circle_m, rest)
                found.append((cost, at_m, k, j))
    return sorted(found)


def ring_of_circle(pose: CirclePose, height_m: float, radius_m: float) -> CirclePose:
    """The ring's pose from that of a circle about its axis, ``height_m`` over the ring's plane."""
    covariance = pose.covariance
    if covariance is not None:
        carry = np.eye(5)
        carry[:3, 3:] = -height_m * tangent_basis(pose.axis)
        covariance = carry @ covariance @ carry.T
    return CirclePose(pose.centre_m - height_m * pose.axis, pose.axis, radius_m, covariance)


def without_range(
    camera: Camera,
    edges: Sequence[RingEdge],
    radius_m: float,
    circles: Sequence[tuple[float, float]] = (),
) -> Which:
    """The best ellipse, with those that may as well be the ring's.

    With known circles the pattern of all tells which one it is. Otherwise the radius is taken for
    that of the outermost edge of the best group; circles about the same line of sight are rivals
    unless they are seen to lie in the ring's plane.
    """
    poses = [circle_poses(camera, edge.ellipse, radius_m) for edge in edges]
    ranges = np.array([np.linalg.norm(p[0].centre_m) if p else np.inf for p in poses])
    if circles:
        cost = np.array(
            [
                -_WORTH * math.log(max(edge.score, 1e-3))
                + _cost_of_known(camera, edges, k, poses[k], radius_m, circles)
                if poses[k]
                else np.inf
                for k, edge in enumerate(edges)
            ]
        )
        if np.isfinite(cost).any():
            return _decided(cost, ranges, "the pattern of the target's circles")
    best = edges[0]
    rivals = []
    tilt = poses[0][0].tilt_rad if poses[0] else 0.0
    for k in range(1, len(edges)):
        edge = edges[k]
        long = max(best.ellipse.semi_axes_px[0], edge.ellipse.semi_axes_px[0])
        aside = float(np.linalg.norm(edge.ellipse.centre_px - best.ellipse.centre_px))
        one_plane = edge.group == best.group and tilt > _PLANE_TILT_RAD
        weak = edge.score < _RIVAL_SCORE * best.score
        same = abs(ranges[k] / ranges[0] - 1.0) < _SAME_RANGE
        if aside < _ASIDE * long and not (one_plane or weak or same):
            rivals.append(k)
    if not rivals and not circles and _is_alone(edges, 0):
        return Which(0, (), _ALONE, by_score=True, alone=True)
    return Which(0, tuple(rivals), _words(0, rivals, ranges, "no range is given to tell"), True)


def _decided(cost: Array, ranges: Array, by: str) -> Which:
    order = np.argsort(cost, kind="stable")
    best = int(order[0])
    rivals = [
        int(k)
        for k in order[1:]
        if cost[k] < cost[best] + _RIVAL_COST and abs(ranges[k] / ranges[best] - 1.0) > _SAME_RANGE
    ]
    return Which(best, tuple(rivals), _words(best, rivals, ranges, f"{by} does not tell"))


def _words(best: int, rivals: Sequence[int], ranges: Array, why: str) -> str:
    if not rivals:
        return ""
    places = " or ".join(f"{k} (then at {ranges[k]:.2f} m)" for k in (best, *rivals))
    return f"{why} which circle is the ring: ellipse {places}"


def _cost_of_known(
    camera: Camera,
    edges: Sequence[RingEdge],
    k: int,
    poses: Sequence[CirclePose],
    radius_m: float,
    circles: Sequence[tuple[float, float]],
) -> float:
    """Cost of the known circles if edge ``k`` is the ring's; of its two poses the better one."""
    if not circles or not poses:
        return 0.0
    shapes = np.array([edge.ellipse.shape for j, edge in enumerate(edges) if j != k])
    best = math.inf
    for pose in poses:
        cost = 0.0
        for height_m, circle_m in circles:
            centre = pose.centre_m + height_m * pose.axis
            shape = shape_of_circle(camera, centre, pose.axis, circle_m)
            if shape is None or not _inside(camera, shape):
                continue
            size = 0.5 * (shape[2] + shape[4])
            miss = np.abs(shapes - shape).max(axis=1) if len(shapes) else np.array([math.inf])
            found = float(miss.min()) < _KNOWN_SHARE * size + _KNOWN_PX
            cost += -_KNOWN_FOUND if found else _KNOWN_MISSED
        best = min(best, cost)
    return best


def _miss(camera: Camera, pose: CirclePose, circle: tuple[float, float], shape: Array) -> float:
    """How far an ellipse is from where a circle about a ring's axis should be; 1 is the limit."""
    expected = shape_of_circle(camera, pose.centre_m + circle[0] * pose.axis, pose.axis, circle[1])
    if expected is None:
        return math.inf
    size = float(0.5 * (expected[2] + expected[4]))
    return float(np.abs(shape - expected).max()) / (_KNOWN_SHARE * size + _KNOWN_PX)


def _inside(camera: Camera, shape: Array) -> bool:
    """Whether the middle of a circle's picture lies in the frame."""
    return bool(0.0 <= shape[0] < camera.width and 0.0 <= shape[1] < camera.height)
