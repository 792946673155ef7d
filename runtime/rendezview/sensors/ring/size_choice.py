"""Which circle of a pass is the ring's outer edge.

Circles about one axis in one plane are edges of one body. Every circle is proposed as the ring's
outer edge, and so is an outer edge that no frame shows. Each gets the logarithm of its
probability; rivals that are nearly as probable leave the radius open.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rendezview.estimation.hypotheses import choose
from rendezview.geometry.pose import Array
from rendezview.sensors.ring.concentric import PLANE_SHARE
from rendezview.sensors.ring.edge_sides import EdgeSides
from rendezview.sensors.ring.size_circles import FAR, Ellipses, PassCircle
from rendezview.sensors.ring.which_circle import RIVAL_COST

# Of 116 passes with a ring, its frames show less than half of its outer edge in 10, of its inner
# edge in 12. Source: ring-size, seed 77: plain, varied, hole and plate
_NO_OUTER, _NO_INNER = math.log(10 / 116), math.log(12 / 116)
# A circle about the ring's axis besides its two edges: larger, in one frame or more, in 1 of 113
# passes, smaller in less than 1 of 109. Source: as above
_CHANCE_OUTER, _CHANCE_INNER = math.log(1 / 113), math.log(1 / 109)
# No light comes from a ring in less than 1 of 113 passes; of 120, 2 show only its shadow. Source:
# as above
_UNLIT, _ONLY_SHADOW = math.log(1 / 113), math.log(2 / 120)
# Less than half of the frames show one of the ring's edges in 2 of 116 passes. Source: as above
_SELDOM = math.log(2 / 116)
_SIGMAS = 4.0  # by which circles differ in a number. Source: by construction, normal distribution
# χ² of 3 degrees of freedom that noise exceeds once in 5000. Source: by construction, χ²
# distribution
_FAR_AXIS = 19.7
# Circles that are one answer. Source: a fifth of a rim's width in models_cad/client
_SAME_SHARE = np.array([0.005, 0.02])  # of R, of D_f
_MOST_RIVALS = 4  # named. Source: by construction
INNER, SHADOW = "inner edge", "shadow"


@dataclass(frozen=True, slots=True, eq=False)
class Proposed:
    """What a circle may be."""

    circle: PassCircle
    score: float  # ln of its probability, up to a constant
    instead: str = ""  # what it is instead of the ring's outer edge: INNER or SHADOW

    @property
    def words(self) -> str:
        """For messages."""
        radius = f"{self.circle.radius_m:.4g} m"
        if self.instead == INNER:
            return f"more than {radius}, if that is an inner edge"
        if self.instead == SHADOW:
            return f"{radius} at another distance, if that is a shadow"
        return f"{radius} at {self.circle.distance_m:.4g} m from the panel"


def which_is_the_ring(
    circles: Sequence[PassCircle], sides: Sequence[Sequence[EdgeSides]], ellipses: Ellipses
) -> list[Proposed]:
    """The best answer, then its rivals, best first; empty where there is no circle.

    The radius is known where the best one has no rival, and is not something else instead.

    Args:
        circles: that three frames or more agree on.
        sides: of every ellipse of every frame.
        ellipses: of the pass.
    """
    proposed: list[Proposed] = []
    for body in _bodies([one for one in circles if not _is_shadow(one, circles)]):
        seen = len(set().union(*(one.members for one in body)))
        base = 0.0 if 2 * seen >= len(sides) else _SELDOM

        def often(circle: PassCircle, frames: int = seen) -> bool:
            return 2.0 * sum(side.shown for side in circle.of(sides)) >= frames

        def unlit(circle: PassCircle) -> bool:
            return 2 * sum(side.unlit for side in circle.of(sides)) > len(circle.members)

        larger = 0.0
        for k, circle in enumerate(body):
            inner = 0.0 if any(map(often, body[k + 1 :])) else _NO_INNER
            inner += 0.0 if often(circle) else _NO_OUTER
            inner += _UNLIT if unlit(circle) else 0.0
            if k == 0 and _shows_larger(circle, ellipses):
                larger += _CHANCE_OUTER
            proposed.append(Proposed(circle, base + larger + inner))
            larger += _CHANCE_OUTER
        outer = body[0]
        more = _CHANCE_INNER if sum(map(often, body)) > 1 else 0.0
        proposed.append(Proposed(outer, base + _NO_OUTER + more, INNER))
        if unlit(outer):
            proposed.append(Proposed(outer, base + _ONLY_SHADOW, SHADOW))

    def same(i: int, known: int) -> bool:
        one, other = proposed[i], proposed[known]
        if one.instead or other.instead:
            return False
        off = np.abs(one.circle.numbers - other.circle.numbers)[:2]
        return bool((off < np.abs(_SAME_SHARE * other.circle.numbers[:2])).all())

    scores = [one.score for one in proposed]
    choice = choose(scores, same, within=0.5 * RIVAL_COST, most=_MOST_RIVALS)
    return [] if choice is None else [proposed[k] for k in choice.answers]


def _bodies(circles: Sequence[PassCircle]) -> list[list[PassCircle]]:
    """Circles about one axis in one plane together, the largest first."""
    bodies: list[list[PassCircle]] = []
    for circle in sorted(circles, key=lambda one: -len(one.members)):
        body = next((b for b in bodies if _apart(b[0], circle) < _FAR_AXIS), None)
        if body is None:
            bodies.append([circle])
        else:
            body.append(circle)
    return [sorted(body, key=lambda one: -one.radius_m) for body in bodies]


def _apart(one: PassCircle, other: PassCircle) -> float:
    """χ² of the places of two circles' middles, 3 degrees of freedom."""
    away = (one.numbers - other.numbers)[1:4]
    spread = (one.covariance + other.covariance + _plane_spread(one))[1:4, 1:4]
    return float(away @ np.linalg.solve(spread, away))


def _plane_spread(circle: PassCircle) -> Array:
    """(6, 6) how far edges of one body lie from its plane and axis, m²."""
    return np.diag([0.0, 1.0, 1.0, 1.0, 0.0, 0.0]) * (PLANE_SHARE * circle.radius_m) ** 2


def _is_shadow(circle: PassCircle, circles: Sequence[PassCircle]) -> bool:
    """Whether a circle is as large as another one nearer to the camera: parallel light keeps R."""
    for other in circles:
        variances = np.diag(circle.covariance + other.covariance)[:2]
        sigma = np.sqrt(variances + (_SAME_SHARE * other.numbers[:2]) ** 2)
        larger, before = (other.numbers - circle.numbers)[:2] / sigma
        if abs(larger) < _SIGMAS and before > _SIGMAS:
            return True
    return False


def _shows_larger(circle: PassCircle, ellipses: Ellipses) -> bool:
    """Whether a frame has a larger ellipse about the axis of a circle, in its plane."""
    spread = circle.covariance + _plane_spread(circle)
    spread[0, 0] += 1e6  # any radius
    radius, sigma = ellipses.radii(circle.distance_m)
    sigma = np.hypot(sigma, math.sqrt(circle.covariance[0, 0]))
    larger = radius - circle.radius_m > _SIGMAS * sigma
    return bool((larger & (ellipses.misfits(circle.numbers, spread) < FAR)).any())
