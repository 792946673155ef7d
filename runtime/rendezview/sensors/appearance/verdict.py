"""Whether what was found in a frame is a pose to give, and why it is none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rendezview.sensors.appearance.edges.refinement import Refined
from rendezview.sensors.appearance.judge.confidence import Found
from rendezview.sensors.appearance.judge.sketch_found import SketchFound
from rendezview.sensors.appearance.observation import CLOSE_MARGIN, AppearanceObservation
from rendezview.sensors.observation import Status

# Of the outline: it was whole, and refinement says why there is no pose.
_WHOLE_OUTLINE = (Status.OK, Status.AMBIGUOUS, Status.UNRECOGNIZED)
# Rad; error of a pose whose joint is at a wrong angle. Source: experiment pose-joints (0.1)
NEAR_RAD = np.deg2rad(8.0)
# Of a pose among its look-alikes. Source: docs/notes/rivals.md
LEAST_POSTERIOR = 0.9
# Share of the craft that its picture may leave unexplained, to contradict a sketch. Source:
# docs/notes/rivals.md: half of the Mitsuba frames have less, a sixth of the photographs
_MOST_UNEXPLAINED = 0.2
_SURE = 0.9  # confidence of grey edges. Source: docs/notes/rivals.md
# Rad, and of the range: one σ. Beyond, the frame leaves the pose open and no linear covariance
# tells how far. Source: by construction
_MOST_SIGMA = 0.5


def agree(weighed: Found | None, other: Found) -> bool:
    """Whether another pose is the likeliest beside its look-alikes, if their pictures tell."""
    if weighed is None or not tells(weighed):
        return True
    apart = weighed.best.pose.angle_to(other.best.pose)
    return weighed.posterior >= LEAST_POSTERIOR and apart < NEAR_RAD


def tells(found: Found) -> bool:
    """Whether drawn pictures explain the frame, or its grey edges are sure.

    Of foil and black paint often none does.
    """
    explained = len(found.weighed) > 0 and found.weighed[0].share < _MOST_UNEXPLAINED
    return explained or (len(found.weighed) > 1 and found.confidence >= _SURE)


def is_known(refined: Refined) -> bool:
    """Whether the edges of the frame determine the pose at all: σ of attitude and of range."""
    covariance, place_m = refined.covariance, refined.pose.translation_m
    range_m = float(np.linalg.norm(place_m))
    along_m2 = float(place_m @ covariance[3:, 3:] @ place_m) / max(range_m, 1e-9) ** 2
    turn_rad2 = float(np.trace(covariance[:3, :3]))
    return turn_rad2 < _MOST_SIGMA**2 and along_m2 < (_MOST_SIGMA * range_m) ** 2


def refused(seen: AppearanceObservation, found: Found | None) -> AppearanceObservation:
    """The observation without a pose, and with the reason why refinement gives none."""
    status, reason = seen.status, seen.reason
    if found is None:
        if status in _WHOLE_OUTLINE:
            status, reason = Status.UNRECOGNIZED, "no pose of the target fits the edges"
    elif isinstance(found, SketchFound) and status not in _WHOLE_OUTLINE:
        pass  # the outline says why
    elif found.weighed and found.posterior < LEAST_POSTERIOR:
        first, second = found.weighed[:2]
        apart = first.pose.angle_to(second.pose)
        status = Status.AMBIGUOUS
        reason = (
            f"{np.rad2deg(apart):.0f}° apart, two poses explain this frame with probabilities "
            f"{first.probability:.2f} and {second.probability:.2f}: give a prior, the Sun's "
            "direction, or more frames"
        )
    elif not found.weighed and found.rival is not None and found.margin < CLOSE_MARGIN:
        apart = found.best.pose.angle_to(found.rival.pose)
        status = Status.AMBIGUOUS
        reason = (
            f"two poses {np.rad2deg(apart):.0f}° apart fit this frame: "
            "give a prior, or look at more frames"
        )
    else:
        status = Status.LOST
        reason = (
            f"the best pose explains {100 * found.best.outline:.0f} % of its outline and "
            f"{100 * found.best.inner:.0f} % of its inner edges: too little to be confident"
        )
    return replace(
        seen,
        status=status,
        reason=reason,
        pose=None,
        covariance=None,
        confidence=None if found is None else found.confidence,
        joints=None,
        outline=replace(seen.reading, points_m=np.zeros((0, 3))),
        found=found,
    )
