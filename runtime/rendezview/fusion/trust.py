"""Trust in a sensor: gate, lock-out, and readmission.

A sensor is locked out when several measurements in a row fail the gate, or when its NIS stays too
high although each measurement passes. It is readmitted when it agrees with the forecast. The
agreement counts only if the forecast is sharp or the residual has left its earlier outlier: a
forecast that has coasted for long agrees with every outlier.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from rendezview.fusion.models import gate_of
from rendezview.fusion.options import SensorOptions
from rendezview.fusion.update import Innovation
from rendezview.geometry.pose import Array

# Of a forecast: mean variance of an innovation over the sensor's own. Source: by construction,
# three times the σ
_SHARP = math.log(9.0)
# s without a measurement, after which a sensor returns. Source: by construction, as
# coasting_after_s
_SILENT_S = 5.0
_WHOLE = 6  # degrees of freedom of a pose. Source: by construction
# Squared distance of a place, in σ of another edge. Source: χ² distribution, mean of three degrees
_BESIDE = 3.0
# Weight of the latest residual in the running mean of an outlier. Source: by hand; uncritical
# halved or doubled
_FOLLOW = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Trust:
    """How far one sensor is believed; a value, replaced at each measurement."""

    sensor: str
    locked: bool = False
    received: int = 0  # measurements in all
    accepted: int = 0
    rejected: int = 0  # in a row
    agreed: int = 0  # in a row, while locked out
    mean_nis: float = 1.0  # over degrees of freedom; 1 is as it should be
    last_s: float = -math.inf  # of its last measurement
    last_accepted_s: float = -math.inf
    fault: Array | None = None  # (m,) its residual when it was rejected
    lockouts: int = 0
    returned: bool = False  # it was silent before, so the forecast may be wrong
    loose: int = 0  # in a row: neither the ring's edge nor about it


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


def judge(
    trust: Trust, found: Innovation, time_s: float, options: SensorOptions
) -> tuple[Trust, str | None]:
    """The sensor's trust after a measurement, and why it is not taken (``None``: it is)."""
    gate = gate_of(found.size, options.gate)
    passes = found.nis <= gate
    count = trust.received + 1
    level = trust.mean_nis + (found.nis / found.size - trust.mean_nis) / min(count, options.window)
    loose = trust.loose + 1 if found.loose and _beside(found) else 0
    noisy = count > options.window and level > options.nis_limit
    if passes and not trust.locked and not noisy and loose < options.loose_after:
        return (
            Trust(
                trust.sensor, False, count, trust.accepted + 1, 0, 0, level, time_s, time_s,
                lockouts=trust.lockouts, loose=loose,
            ),
            None,
        )  # fmt: skip
    returned = trust.returned or time_s - trust.last_s > _SILENT_S
    after = replace(trust, received=count, last_s=time_s, returned=returned)
    if after.locked:
        return _locked(after, found, passes and not found.loose, time_s, options)
    if passes and loose >= options.loose_after:
        reason = f"an edge beside the ring, {loose} times in a row: locked out"
        return _lock(replace(after, fault=found.raw, loose=0)), reason
    if passes:
        return (
            _lock(replace(after, mean_nis=level, fault=found.raw)),
            f"mean NIS {level:.1f} of a degree of freedom, at most {options.nis_limit:g}: "
            "locked out",
        )
    row = after.rejected + 1
    after = replace(after, rejected=row, fault=_followed(after.fault, found.raw))
    away = f"{math.sqrt(found.nis):.1f} σ away, the gate is at {math.sqrt(gate):.1f}"
    if row >= options.lock_after:
        return _lock(after), f"{away}, {row} times in a row: locked out"
    return after, away


def _lock(trust: Trust) -> Trust:
    return replace(trust, locked=True, agreed=0, lockouts=trust.lockouts + 1)


def _locked(
    trust: Trust,
    found: Innovation,
    passes: bool,
    time_s: float,
    options: SensorOptions,
) -> tuple[Trust, str | None]:
    total = found.white + found.bias
    same = trust.fault is not None and _still(trust.fault, found, total, options)
    sharp = is_sharp(found)
    if not passes or (same and not sharp):
        fault = _followed(trust.fault if same else None, found.raw)
        reason = "locked out, and still off" if not passes else (
            "locked out: it agrees only because the forecast is wide"
        )  # fmt: skip
        return replace(trust, agreed=0, rejected=trust.rejected + 1, fault=fault), reason
    agreed = trust.agreed + 1
    if agreed < options.unlock_after:
        reason = f"locked out, agrees {agreed} of {options.unlock_after} times"
        return replace(trust, agreed=agreed, rejected=0), reason
    return (
        replace(
            trust, locked=False, agreed=0, rejected=0, fault=None, mean_nis=1.0, returned=False,
            accepted=trust.accepted + 1, last_accepted_s=time_s,
        ),
        None,
    )  # fmt: skip


def _followed(fault: Array | None, residual: Array) -> Array:
    return residual if fault is None else fault + _FOLLOW * (residual - fault)


def is_sharp(found: Innovation) -> bool:
    """Whether the forecast is nearly as precise as the sensor."""
    total = found.white + found.bias
    return bool(found.log_volume - _log_volume(total) < _SHARP * found.size)


def _beside(found: Innovation) -> bool:
    """Whether an edge taken for another edge of the ring is too far from the ring to be one."""
    total = found.white + found.bias
    place = found.raw[:3]
    return bool(place @ np.linalg.solve(total[:3, :3], place) > _BESIDE)


def _still(fault: Array, found: Innovation, total: Array, options: SensorOptions) -> bool:
    """Whether the sensor still has the fault that it was rejected for.

    A constant offset of a whole pose stays within its noise. The fault of a ring or a range
    changes with the mistaken feature: it has ended when the residual halves at once. A forecast
    that drifts towards a fault takes many measurements for that; the fault is updated meanwhile.
    """
    if found.size == _WHOLE:
        away = found.raw - fault
        spread = 2.0 * found.white + 0.2 * found.bias
        return bool(away @ np.linalg.pinv(spread) @ away <= gate_of(found.size, options.gate))
    weight = np.linalg.pinv(total)
    return bool(found.raw @ weight @ found.raw > 0.25 * (fault @ weight @ fault))


def _log_volume(matrix: Array) -> float:
    sign, value = np.linalg.slogdet(matrix)
    return float(value) if sign > 0 else -math.inf
