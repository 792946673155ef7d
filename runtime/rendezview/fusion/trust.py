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
_OFFSET_SCATTER = 4.0  # variance of a fault's offset over the sensor's own. Source: by construction
_SAME = 0.9  # probability that a faulty sensor's offset is as it was. Source: by construction
LOCK_AFTER = 3  # turned away in a row: locked out. Source: by construction


class Trust(NamedTuple):
    """How far one sensor is believed; a value, replaced at each measurement."""

    sensor: str
    fault: float = 0.0  # probability that it is faulty; 0: as often as an outlier
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
    trust: Trust, outliers: float, log_likelihood: float, peak: float, innovation: Array,
    root: Array,
) -> tuple[bool, float, Array | None]:  # fmt: skip
    """Whether a reading is believed; probability of a fault; the fault's offset.

    Args:
        outliers: how often a healthy sensor gives one.
        log_likelihood, peak: of the reading at the state, and at its forecast.
        innovation: (k,) mean over all models.
        root: (k, k) of the covariance that the sensor reports, lower.
    """
    size = len(innovation)
    before, offset = max(trust.fault, outliers), trust.offset
    faulty = outlier_log(peak, size)
    if offset is not None and len(offset) == size:
        away = innovation - offset
        lower = math.sqrt(_OFFSET_SCATTER) * root
        scaled = np.linalg.solve(lower, away)
        same = -0.5 * float(scaled @ scaled) - float(np.log(lower.diagonal()).sum())
        same -= 0.5 * size * math.log(2.0 * math.pi)
        faulty = float(np.logaddexp(math.log1p(-_SAME) + faulty, math.log(_SAME) + same))
    healthy = math.log1p(-before) + log_likelihood
    ill = math.log(before) + faulty
    after = 1.0 / (1.0 + math.exp(min(50.0, max(-50.0, healthy - ill))))
    believed = healthy > ill
    if believed:
        offset = None
    elif offset is None or len(offset) != size:
        offset = innovation
    else:
        offset = 0.5 * (offset + innovation)
    return believed, after * _STAYS + (1.0 - after) * outliers, offset


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
