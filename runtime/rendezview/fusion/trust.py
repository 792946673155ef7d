"""Trust in a sensor: a chain of two states, healthy and faulty, and what it has said so far.

A faulty sensor stays with its last offset: while the offset lasts, its readings are likelier from
the fault than from chance, and it is not believed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rendezview.geometry.pose import Array

_STAYS = 0.95  # probability that a fault lasts to the next reading. Source: by construction
_BLOW = 10.0  # σ of an outlier over that of the innovation. Source: by construction
_HIDDEN = 5.0  # the same of an outlier that is hard to see. Source: glare in `rendezview fly`
_SAME = 0.9  # probability that a faulty sensor's offset is as it was. Source: by construction
LOCK_AFTER = 3  # turned away in a row: locked out. Source: by construction


class Trust(NamedTuple):
    """How far one sensor is believed; a value, replaced at each measurement."""

    sensor: str
    fault: float = 0.0  # probability that it is faulty; 0: as often as an outlier
    doubt: float = 0.0  # probability that its last reading was wrong
    offset: Array | None = None  # (k,) its innovation when it was turned away
    received: int = 0  # measurements in all
    accepted: int = 0
    rejected: int = 0  # in a row
    mean_nis: float = 1.0  # over degrees of freedom; 1 is as it should be
    last_s: float = -math.inf  # of its last measurement
    last_accepted_s: float = -math.inf
    lockouts: int = 0
    poses: bool = False  # it gives whole poses

    @property
    def locked(self) -> bool:
        """Whether it has been turned away several times in a row."""
        return self.rejected >= LOCK_AFTER


@dataclass(frozen=True, slots=True)
class Verdict:
    """What became of a measurement."""

    sensor: str
    time_s: float
    accepted: bool
    reason: str | None  # words, where it was not accepted or began something
    nis: float | None = None  # squared distance in σ; None: not compared
    size: int = 0  # its degrees of freedom
    began: bool = False  # the filter started or restarted here


def outlier_log(peak: float, size: int) -> float:
    """Log-likelihood of any reading that is an outlier.

    Args:
        peak: log-likelihood of a reading at the forecast.
    """
    return peak - size * math.log(_BLOW)


def judge(
    trust: Trust, outliers: float, log_likelihood: float, peak: float, nis: float,
    innovation: Array, root: Array, spread: Array,
) -> tuple[bool, float, float, Array | None]:  # fmt: skip
    """Whether a reading is believed; probabilities that it is wrong by far, or by little; offset.

    Args:
        outliers: how often a healthy sensor gives one.
        log_likelihood, peak, nis: of the reading at the state, at its forecast, and in σ².
        innovation: (k,) mean over all models.
        root: (k, k) of the covariance that the sensor reports, lower.
        spread: (k, k) covariance of the innovation: an offset is known no better than the state.
    """
    size = len(innovation)
    before, offset = max(trust.fault, outliers), trust.offset
    same = -math.inf
    if offset is not None and len(offset) == size:
        around = root @ root.T
        if trust.locked:  # the offset is the sensor's; since then the state has moved
            around = around + spread
        lower = np.linalg.cholesky(around)
        scaled = np.linalg.solve(lower, innovation - offset)
        same = -0.5 * float(scaled @ scaled) - float(np.log(lower.diagonal()).sum())
        same += math.log(_SAME) - 0.5 * size * math.log(2.0 * math.pi)
    healthy = math.log1p(-before) + log_likelihood

    def wrong(chance: float) -> float:
        """Probability that it is, where an outlier has a log-likelihood."""
        if offset is not None:
            chance += math.log1p(-_SAME)
        ill = math.log(before) + float(np.logaddexp(chance, same))
        return 1.0 / (1.0 + math.exp(min(50.0, max(-50.0, healthy - ill))))

    after = wrong(outlier_log(peak, size))
    hidden = wrong(peak - size * math.log(_HIDDEN) - 0.5 * nis / _HIDDEN**2)
    believed = after < 0.5
    if believed:
        offset = None
    elif offset is None or len(offset) != size:
        offset = innovation
    else:
        own = np.minimum((root * root).sum(axis=1) / spread.diagonal(), 1.0).mean()
        offset = offset + 0.5 * (float(own) if trust.locked else 1.0) * (innovation - offset)
    return believed, after, hidden, offset


def lasting(wrong: float, outliers: float, rejected: int) -> float:
    """Probability that a sensor is faulty at its next reading, by that of this one.

    A fault that has lasted for many readings lasts for as many more (Laplace's rule of succession).

    Args:
        rejected: readings turned away in a row before this one.
    """
    goes = 1.0 / (1.0 / (1.0 - _STAYS) + rejected)
    return wrong * (1.0 - goes) + (1.0 - wrong) * outliers


def after_reading(trust: Trust, time_s: float, believed: bool, level: float, size: int) -> Trust:
    """The counts after a reading; ``level`` is its NIS per degree of freedom."""
    count = trust.received + 1
    mean = trust.mean_nis + (level - trust.mean_nis) / min(count, _WINDOW)
    rejected = 0 if believed else trust.rejected + 1
    return trust._replace(
        received=count, accepted=trust.accepted + believed, rejected=rejected,
        mean_nis=mean if believed else trust.mean_nis, last_s=time_s,
        last_accepted_s=time_s if believed else trust.last_accepted_s,
        lockouts=trust.lockouts + (rejected == LOCK_AFTER), poses=size == 6,
    )  # fmt: skip


_WINDOW = 20  # measurements over which NIS is averaged. Source: their mean scatters by 0.3
