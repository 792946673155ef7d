"""Whether what was found in a frame is a pose to give, and why it is none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rendezview.geometry.symmetry import Symmetry, angle_between
from rendezview.sensors.appearance.hypothesis import Hypothesis
from rendezview.sensors.appearance.judge.found import Found, share_of
from rendezview.sensors.appearance.judge.rivals import RIVAL_RAD
from rendezview.sensors.appearance.judge.sketch_choice import NEAR_RAD
from rendezview.sensors.appearance.observation import CLOSE_MARGIN, AppearanceObservation
from rendezview.sensors.observation import Status

# Of the outline: it was whole, and refinement says why there is no pose.
_WHOLE_OUTLINE = (Status.OK, Status.AMBIGUOUS, Status.UNRECOGNIZED)
# Of a pose among its look-alikes. Source: docs/notes/rivals.md
LEAST_POSTERIOR = 0.9
# Of the range: one σ. Beyond, the frame leaves it open and no linear covariance tells how far.
_MOST_SIGMA = 0.5  # Source: by construction


def has_range(refined: Hypothesis) -> bool:
    """Whether the edges of the frame determine the range at all."""
    covariance, place_m = refined.covariance, refined.pose.translation_m
    if covariance is None:
        return False
    range_m = float(np.linalg.norm(place_m))
    along_m2 = float(place_m @ covariance[3:, 3:] @ place_m) / max(range_m, 1e-9) ** 2
    return along_m2 < (_MOST_SIGMA * range_m) ** 2


def beside_look_alikes(
    seen: AppearanceObservation, weighed: Sequence[Hypothesis], symmetries: Sequence[Symmetry]
) -> AppearanceObservation:
    """An observation of the trees alone with its probability; without its pose if others have more.

    Args:
        seen: with a pose.
        weighed: the pose and its look-alikes; see `Rivals.weigh_coarse`. (): nothing was drawn.
    """
    pose = seen.pose
    if pose is None or not weighed:
        return seen
    own = share_of(pose, weighed, symmetries)
    if own >= 0.5:
        return replace(seen, confidence=own)
    apart = [(angle_between(one.pose, pose, symmetries), one) for one in weighed]
    angle, rival = next(each for each in apart if each[0] >= RIVAL_RAD)
    return replace(
        seen,
        status=Status.AMBIGUOUS,
        reason=f"the trees' pose has a probability of {own:.2f} beside its look-alikes, one "
        f"{np.rad2deg(angle):.0f}° away {rival.probability:.2f}: refine poses, or give a prior",
        pose=None,
        covariance=None,
        confidence=own,
        outline=replace(seen.reading, points_m=np.zeros((0, 3))),
    )


def refused(
    seen: AppearanceObservation, found: Found | None, *, dark: bool = True
) -> AppearanceObservation:
    """The observation without a pose, and with the reason why refinement gives none.

    Args:
        seen: of the outline.
        dark: the sky is; else the outline does not say why.
    """
    status, reason = seen.status, seen.reason
    if found is None:
        if status in _WHOLE_OUTLINE:
            status, reason = Status.UNRECOGNIZED, "no pose of the target fits the edges"
    elif found.on_sketch and dark and status not in _WHOLE_OUTLINE:
        pass  # the outline says why
    elif len(found.weighed) > 1 and found.weighed[0].probability < LEAST_POSTERIOR:
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
        confidence=None if found is None else found.right,
        joints=None,
        outline=replace(seen.reading, points_m=np.zeros((0, 3))),
        found=found,
    )


def contradiction(given: Found, sketched: Found, symmetries: Sequence[Symmetry]) -> str | None:
    """Why a sketch speaks against a pose of grey edges; None: it does not.

    Among other things grey edges alone are no evidence: those have edges, too.
    """
    apart_rad = angle_between(given.best.pose, sketched.best.pose, symmetries)
    if apart_rad <= NEAR_RAD:
        return None
    return f"grey edges and the sketch show poses {np.rad2deg(apart_rad):.0f}° apart"


def contradicted(seen: AppearanceObservation, why: str, *, boxed: bool) -> AppearanceObservation:
    """The refused observation of a frame whose grey edges and sketch do not agree.

    ``boxed``: the box of the target is known already.
    """
    also = "" if boxed else ", or a box around the target (roi)"
    return replace(seen, status=Status.AMBIGUOUS, reason=f"{why}: give a prior{also}")


def unconfirmed(seen: AppearanceObservation) -> AppearanceObservation:
    """The observation of a pose that the next frame must confirm."""
    reason = "the pose found is far from where the target was lost; the next frame decides"
    return _open(seen, reason, seen.confidence)


def doubted(seen: AppearanceObservation, posterior: float) -> AppearanceObservation:
    """The observation of a tracked pose that another view has made doubtful."""
    reason = (
        f"the tracked pose has a probability of {posterior:.2f} beside its look-alikes: "
        "the next frame is searched anew; a prior or the Sun's direction would decide"
    )
    return _open(seen, reason, posterior)


def _open(
    seen: AppearanceObservation, reason: str, confidence: float | None
) -> AppearanceObservation:
    """The observation without its pose, which later frames decide on."""
    return replace(
        seen, status=Status.AMBIGUOUS, reason=reason, pose=None, covariance=None, joints=None,
        confidence=confidence,
    )  # fmt: skip
