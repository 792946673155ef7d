"""Scores of a whole sequence, as the challenges of the field define them.

- SPEED (Kisantal et al., IEEE TAES 2020): the mean of ``e_q + e_t`` over the images.
- SPEED+ (Park et al., 2023): the same; a term below the accuracy of the truth counts as 0.
- RBOT (Tjaden et al., IEEE TPAMI 2019): share of frames within 5 cm and 5°. RBOT resets its
  trackers after each failure; here the results are used as they are.
- BOP (Hodaň et al., ECCVW 2020): share of frames below ten thresholds, averaged, for MSSD (5 % to
  50 % of the diameter) and MSPD (5 to 50 px in a picture 640 px wide). Its third measure, VSD,
  needs depth pictures and is missing.
- ADD, ADD-S (Hinterstoisser et al., ACCV 2012): share of frames below a tenth of the diameter.

Shares are over all frames with truth: a frame without a pose has failed. The means of SPEED are
over the frames with a pose; the challenge defines no score for a missing pose. ``speed_plus_all``
is over all frames and counts a missing pose as the worst attitude and the whole range.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rendezview_ground.evaluate.evaluation import Evaluation, FrameResult
from rendezview_ground.evaluate.pose_errors import PoseErrors, speed_terms
from rendezview_ground.evaluate.surface import SurfaceErrors

RBOT_TRANSLATION_M = 0.05  # m. Source: Tjaden et al. 2019
RBOT_ROTATION_RAD = math.radians(5.0)  # rad. Source: Tjaden et al. 2019
ADD_FRACTION = 0.1  # of the diameter. Source: Hinterstoisser et al. 2012
RIGHT_RAD, WRONG_RAD = math.radians(5.0), math.radians(10.0)  # Source: by construction
NO_POSE = math.pi + 1.0  # rad and range: half a turn, the whole range. Source: by construction
MSSD_FRACTIONS = np.arange(0.05, 0.51, 0.05)  # of the diameter. Source: Hodaň et al. 2020
MSPD_640_PX = np.arange(5, 51, 5)  # px in a picture 640 px wide. Source: Hodaň et al. 2020


@dataclass(frozen=True, slots=True)
class Scores:
    """Scores of one sequence; None if they are unknown."""

    speed: float | None
    speed_plus: float | None
    speed_plus_all: float  # a frame without a pose counts π + 1
    right_share: float  # poses within 5° …
    wrong_share: float  # … and beyond 10°, which are given and wrong
    rbot_share: float
    add_share: float | None  # these four: None without the target's surface
    add_s_share: float | None
    mssd_recall: float | None
    mspd_recall: float | None


def scores(evaluation: Evaluation) -> Scores:
    """The scores of an evaluation."""
    surfaces = None
    if any(frame.surface is not None for frame in evaluation.frames):
        surfaces = [frame.surface for frame in evaluation.frames]

    def share(holds: Callable[[SurfaceErrors], bool]) -> float | None:
        if surfaces is None:
            return None
        return _mean([s is not None and holds(s) for s in surfaces])

    def recall(value: Callable[[SurfaceErrors], float], limits: np.ndarray) -> float | None:
        if surfaces is None:
            return None
        errors = np.array([math.inf if s is None else value(s) for s in surfaces])
        return float((errors[:, None] < limits).mean())

    found = [frame.errors for frame in evaluation.frames if frame.errors is not None]
    plus = [_speed(errors, True) for errors in found]
    count = len(evaluation.frames)
    return Scores(
        speed=_mean([_speed(errors, False) for errors in found]),
        speed_plus=_mean(plus),
        speed_plus_all=(sum(plus) + NO_POSE * (count - len(found))) / count,
        right_share=sum(errors.rotation_rad < RIGHT_RAD for errors in found) / count,
        wrong_share=sum(errors.rotation_rad > WRONG_RAD for errors in found) / count,
        rbot_share=_mean([_within_rbot(frame) for frame in evaluation.frames]) or 0.0,
        add_share=share(lambda s: s.add_m < ADD_FRACTION * s.diameter_m),
        add_s_share=share(lambda s: s.add_s_m < ADD_FRACTION * s.diameter_m),
        mssd_recall=recall(lambda s: s.mssd_fraction, MSSD_FRACTIONS),
        mspd_recall=recall(lambda s: s.mspd_640_px, MSPD_640_PX),
    )


def _speed(errors: PoseErrors, speed_plus: bool) -> float:
    return sum(speed_terms(errors.rotation_rad, errors.translation_fraction, speed_plus=speed_plus))


def _within_rbot(frame: FrameResult) -> bool:
    errors = frame.errors
    return (
        errors is not None
        and errors.translation_m < RBOT_TRANSLATION_M
        and errors.rotation_rad < RBOT_ROTATION_RAD
    )


def _mean(values: list[float] | list[bool]) -> float | None:
    return float(np.mean(values)) if values else None
