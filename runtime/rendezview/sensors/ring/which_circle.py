"""Which of a frame's ellipses is which of the target's circles, and where the ring then is.

A vehicle shows many circles about the ring's axis: the ring's own edges, the foot of its adapter, a
shield, a nozzle. All are real circles, so how well an ellipse is seen does not tell which it is.
Every ellipse is proposed as the ring's edge and as each known circle, each with both poses of its
circle. A hypothesis gets a cost: −2 ln of its odds over a chance ellipse, from the range, the
memory of earlier frames, the known circles that lie where they should, and its own score.
Hypotheses that cost little more than the best and put the ring elsewhere are its rivals.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rendezview.estimation.hypotheses import choose
from rendezview.geometry.camera import Camera
from rendezview.sensors.ring.circle_pose import (
    CirclePose,
    circle_poses,
    circles_of_shapes,
    shape_of_circle,
    shapes_of_circles,
    tangent_basis,
)
from rendezview.sensors.ring.detector import RingEdge
from rendezview.sensors.ring.memory import SIZES, Memory, odds_cost

Array = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

# In place of a known circle's index: the ring's own edge. Source: by construction
RING = -1

_RANGE_FLOOR = 0.003  # of the range; least σ of the point it is measured to. Source: a rim's depth
# From the given range; with nothing nearer, and no circles listed, there is no ring. Source:
# ring-vehicle (0.1), seed 22
_FARTHEST_SIGMAS = 3.0
# Of −ln score: a long arc with companions is likelier the ring than a shadow. Source: the same
_WORTH = 2.0
RIVAL_COST = 5.0  # more than the best's; a rival within it may be the ring. Source: the same
_MOST_RIVALS = 5  # named. Source: by construction, a bound of time
# From here edges of one group are known to be of one plane. Source: the groups' own tolerance
_PLANE_TILT_RAD = math.radians(10.0)
# So near to where a known circle should be, an ellipse is no other reading: a share of its size,
# and so many px. Source: ring-vehicle (0.1), seed 22
_KNOWN_SHARE, _KNOWN_PX = 0.015, 1.0
# A ring has two edges at least. Of the circles that fitted the range by chance (ring-vehicle
# (0.1) of HST, seed 25) 19 of 26 stood alone, of the right ones on client, HST and ISS none of 194.
_ALONE = (
    "the circle that may be the ring stands alone: no other edge of the frame is about its axis"
)
# Of the known circles that lie in the frame, by a right reading, so many are among the ellipses.
# Source: pictures of tests/plain_rings.py, 57 % at 1-4 m, 44 % at 4-9 m
_SHOWN = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Knowledge:
    """What is known of the ring before a frame; all of it may be missing."""

    radius_m: float
    circles: Sequence[tuple[float, float]] = ()  # height (m, outwards) and radius (m)
    range_m: float | None = None  # to the ring's centre
    range_sigma_m: float = 0.0
    memory: Memory | None = None

    @property
    def every_circle(self) -> list[tuple[int, tuple[float, float]]]:
        """Index, height and radius of the ring and of the known circles."""
        return [(RING, (0.0, self.radius_m)), *enumerate(self.circles)]


@dataclass(frozen=True, slots=True, eq=False)
class Which:
    """The ellipse that is the ring's, and the others that may be it."""

    edge: int | None
    rivals: tuple[tuple[int, int], ...]  # (ellipse, circle), best first, without the best
    reason: str  # why there is none, or what the rivals are
    circle: int = RING  # the circle that ``edge`` is of
    # It is not sure that the ellipse is any circle of the target.
    doubtful: bool = False
    centre_m: Array | None = None  # (3,) of the ring by the best hypothesis, its
    axis: Array | None = None  # (3,) with
    other_cost: float = 0.0  # what the other of the circle's two poses costs more


@dataclass(frozen=True, slots=True, eq=False)
class _Proposed:
    """Hypotheses of a frame, one a row; the two poses of a circle follow one another."""

    edge: npt.NDArray[np.int64]  # (N,)
    circle: npt.NDArray[np.int64]  # (N,) RING or an index
    centre_m: Array  # (N, 3) of the ring
    axis: Array  # (N, 3)

    @property
    def range_m(self) -> Array:
        """(N,) of the ring."""
        return np.asarray(np.linalg.norm(self.centre_m, axis=1))


def which_circle(
    camera: Camera, edges: Sequence[RingEdge], known: Knowledge, possible: Bools | None = None
) -> Which:
    """The best reading of a frame's ellipses, with those that may as well be right.

    Args:
        camera: of the frame.
        edges: of the frame.
        known: what is known of the ring.
        possible: (K,) edges that may be the ring, by their place; None: all.
    """
    found = _propose(camera, edges, known, possible)
    if len(found.edge) == 0:
        return Which(None, (), "no ellipse is a circle's picture")
    if known.range_m is None and known.memory is None and not known.circles:
        return _by_score(camera, edges, known.radius_m)
    score = np.array([max(edge.score, 1e-3) for edge in edges])
    cost = -_WORTH * np.log(score / score.max())[found.edge]
    share = np.array([_size_sigma(edge) for edge in edges])
    own = share[found.edge]
    cost += _cost_of_known(camera, edges, found, known, share)
    words = ["the pattern of the target's circles"] if known.circles else []
    if known.range_m is not None:
        given = math.hypot(known.range_sigma_m / known.range_m, _RANGE_FLOOR)
        spread = np.hypot(given, own)
        off = (found.range_m / known.range_m - 1.0) / spread
        if not known.circles and not (np.abs(off) < _FARTHEST_SIGMAS).any():
            return Which(None, (), "no ellipse as large as the ring should be at that range")
        cost += odds_cost(off**2, spread)
        words = [f"the range of {known.range_m:.3f} ± {known.range_sigma_m:.3f} m"]
    elif known.memory is not None:
        words = ["the memory of the last frame", *words]
    if known.memory is not None:
        cost += known.memory.cost(found.centre_m, found.axis, own)
    return _decided(camera, edges, known, found, cost, " and ".join(words))


def _propose(
    camera: Camera, edges: Sequence[RingEdge], known: Knowledge, possible: Bools | None
) -> _Proposed:
    """Every possible ellipse as every circle, with both poses."""
    centres, axes = circles_of_shapes(camera, np.array([edge.ellipse.shape for edge in edges]))
    usable = np.isfinite(centres).all(axis=(1, 2))
    if possible is not None:
        usable &= possible
    rows: list[tuple[int, int]] = []
    places, ways = [np.empty((0, 3))], [np.empty((0, 3))]
    for k in np.flatnonzero(usable).tolist():
        for j, (height_m, circle_m) in known.every_circle:
            rows += [(k, j), (k, j)]
            places.append(circle_m * centres[k] - height_m * axes[k])
            ways.append(axes[k])
    table = np.array(rows, dtype=np.int64).reshape(-1, 2)
    return _Proposed(table[:, 0], table[:, 1], np.concatenate(places), np.concatenate(ways))


def _cost_of_known(
    camera: Camera, edges: Sequence[RingEdge], found: _Proposed, known: Knowledge, share: Array
) -> Array:
    """(N,) cost of the target's other circles at each hypothesis: found, missed, or out of sight.

    What lies before or beside an edge moves its ellipse by far more than its σ now and then: with
    plain pictures and Mitsuba's the misfits are those of a Cauchy distribution.

    ``share``: (K,) σ of the ellipses' sizes, as a share of them.
    """
    cost = np.zeros(len(found.edge))
    if not known.circles:
        return cost
    shapes = np.array([edge.ellipse.shape for edge in edges])
    for j, (height_m, circle_m) in known.every_circle:
        expected = shapes_of_circles(
            camera, found.centre_m + height_m * found.axis, found.axis, circle_m
        )
        size = _size_px(expected)
        off = np.abs(expected[:, None, :] - shapes).max(axis=2)
        off[np.arange(len(cost)), found.edge] = np.inf  # an ellipse is one circle
        sigma = np.hypot(share * _size_px(shapes), share[found.edge][:, None] * size[:, None])
        shown = 2.0 / (math.pi * sigma * (1.0 + (off / sigma) ** 2))
        # A chance ellipse has any size, at either side.
        odds = shown.max(axis=1) * 0.5 * SIZES * size
        own = -2.0 * np.log(_SHOWN * odds + 1.0 - _SHOWN)
        visible = (
            (found.circle != j)
            & np.isfinite(size)
            & (expected[:, 0] >= 0.0) & (expected[:, 0] < camera.width)
            & (expected[:, 1] >= 0.0) & (expected[:, 1] < camera.height)
        )  # fmt: skip
        cost += np.where(visible, own, 0.0)
    return cost


def _decided(
    camera: Camera, edges: Sequence[RingEdge], known: Knowledge, found: _Proposed, cost: Array,
    by: str,
) -> Which:  # fmt: skip
    """The least cost, and whose that is little more and whose ring lies elsewhere."""
    best = int(np.argmin(cost))
    twin = best ^ 1  # the other pose of the same circle
    place, axis = found.centre_m[best], found.axis[best]
    ranges = found.range_m
    expected = {
        j: shape_of_circle(camera, place + h * axis, axis, r) for j, (h, r) in known.every_circle
    }

    def same(i: int, known: int) -> bool:
        k, j = int(found.edge[i]), int(found.circle[i])
        if (k, j) == (found.edge[known], found.circle[known]):
            return True
        apart_m = float(np.linalg.norm(found.centre_m[known] - found.centre_m[i]))
        if apart_m < _KNOWN_SHARE * ranges[best]:
            return True
        # Where it should lie if the best is right: the same reading of the frame, less exact.
        of_best = known == best and k != found.edge[best]
        return of_best and _miss(expected[j], edges[k].ellipse.shape) < 1.0

    choice = choose(-cost, same, within=RIVAL_COST, most=_MOST_RIVALS)
    assert choice is not None
    rivals = tuple((int(found.edge[i]), int(found.circle[i])) for i in choice.rivals)
    doubtful = bool(cost[best] > -RIVAL_COST)
    reason = ""
    if rivals:
        places = " or ".join(_words(found, i, ranges, known) for i in choice.answers)
        reason = f"{by} does not tell which circle is the ring: ellipse {places}"
    elif doubtful:
        reason = f"{by} does not tell whether {_words(found, best, ranges, known)} is the ring"
    elif not known.circles and _is_alone(edges, int(found.edge[best])) and known.memory is None:
        doubtful, reason = True, _ALONE
    return Which(
        int(found.edge[best]), rivals, reason, int(found.circle[best]),
        doubtful=doubtful, centre_m=place, axis=axis, other_cost=float(cost[twin] - cost[best]),
    )  # fmt: skip


def _words(found: _Proposed, i: int, ranges: Array, known: Knowledge) -> str:
    j = int(found.circle[i])
    own = "" if j == RING else f" as the circle of {known.circles[j][1]:g} m"
    return f"{found.edge[i]}{own} (then at {ranges[i]:.2f} m)"


def _miss(expected: Array | None, shape: Array) -> float:
    """How far an ellipse is from where a circle should be; from 1 on it is another reading."""
    if expected is None:
        return math.inf
    return float(np.abs(shape - expected).max() / _limit_px(_size_px(expected)))


def _size_px(shapes: Array) -> Array:
    """(…) mean semi-axis of ellipses (…, 5)."""
    return np.asarray(0.5 * (shapes[..., 2] + shapes[..., 4]))


def _limit_px(size_px: Array) -> Array:
    """(…) how near to a known circle an ellipse is no other reading."""
    return np.asarray(_KNOWN_SHARE * size_px + _KNOWN_PX)


def _size_sigma(edge: RingEdge) -> float:
    """σ of an ellipse's size, as a share of it."""
    shape, covariance = edge.ellipse.shape, edge.ellipse.shape_covariance
    variance = 2.0 * edge.systematic_px**2
    if covariance is not None:
        variance += float(covariance[2::2, 2::2].sum())
    return math.sqrt(max(variance, 0.0)) / float(shape[2] + shape[4])


def _is_alone(edges: Sequence[RingEdge], k: int) -> bool:
    """Whether an ellipse is none of a concentric group, and not the only one of its frame."""
    return len(edges) > 1 and sum(edge.group == edges[k].group for edge in edges) == 1


def _by_score(camera: Camera, edges: Sequence[RingEdge], radius_m: float) -> Which:
    """Nothing is known but the radius: it is that of the outermost edge of the best group.

    Other ellipses are rivals unless they are seen to lie in its plane.
    """
    best = edges[0]
    poses = circle_poses(camera, best.ellipse, radius_m, systematic_px=best.systematic_px)
    if not poses:
        return Which(None, (), "the ellipse is no circle's picture")
    centres, _ = circles_of_shapes(camera, np.array([edge.ellipse.shape for edge in edges]))
    ranges = radius_m * np.linalg.norm(centres[:, 0], axis=1)
    tilt = poses[0].tilt_rad - poses[0].axis_sigma_rad

    def same(k: int, known: int) -> bool:
        return known == 0 and edges[k].group == best.group and tilt > _PLANE_TILT_RAD

    choice = choose(-np.arange(len(edges)), same, most=_MOST_RIVALS)  # in the detector's order
    if choice is None or not choice.rivals:
        alone = sum(edge.group == best.group for edge in edges) == 1
        return Which(0, (), _ALONE if alone else "", doubtful=alone)
    places = " or ".join(f"{k} (then at {ranges[k]:.2f} m)" for k in choice.answers)
    reason = f"no range is given to tell which circle is the ring: ellipse {places}"
    return Which(0, tuple((k, RING) for k in choice.rivals), reason)


def ring_of_circle(pose: CirclePose, height_m: float, radius_m: float) -> CirclePose:
    """The ring's pose from that of a circle about its axis, ``height_m`` over the ring's plane."""
    covariance = pose.covariance
    if covariance is not None:
        carry = np.eye(5)
        carry[:3, 3:] = -height_m * tangent_basis(pose.axis)
        covariance = carry @ covariance @ carry.T
    return CirclePose(pose.centre_m - height_m * pose.axis, pose.axis, radius_m, covariance)
