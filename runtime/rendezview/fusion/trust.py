"""Whether a sensor is believed: gate, lock-out, and the way back in.

A sensor that is turned away several times in a row, or whose NIS stays too high although each
measurement passes, is locked out. It is let in again when it agrees, and when its agreement says
something: the forecast must be sharp, or the sensor must have left the place where it lied. A
forecast that has coasted for long agrees with every lie.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from rendezview.fusion.models import gate_of
from rendezview.fusion.options import SensorOptions
from rendezview.fusion.state import Innovation
from rendezview.geometry.pose import Array

_SHARP = math.log(9.0)  # of a forecast: mean variance of an innovation over the sensor's own
_SILENT_S = 5.0  # of a sensor, before its next word
_WHOLE = 6  # degrees of freedom of a pose
_BESIDE = 3.0  # squared distance of a place, in σ of another edge
_FOLLOW = 0.5  # weight of the latest residual in the place of a lie


@dataclass(frozen=True, slots=True, eq=False)
class Trust:
    """What is thought of one sensor; a value, replaced at each measurement."""

    sensor: str
    locked: bool = False
    heard: int = 0  # measurements in all
    accepted: int = 0
    turned_away: int = 0  # in a row
    agreed: int = 0  # in a row, while locked out
    mean_nis: float = 1.0  # over degrees of freedom; 1 is as it should be
    last_s: float = -math.inf  # when it last spoke
    last_accepted_s: float = -math.inf
    lie: Array | None = None  # (m,) where its residuals stood when it was turned away
    lockouts: int = 0
    returned: bool = False  # it was silent before, so that the forecast may be what is wrong
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
    began: bool = False  # the filter began here, or began anew


def judge(
    trust: Trust, found: Innovation, time_s: float, options: SensorOptions
) -> tuple[Trust, str | None]:
    """The sensor's trust after a measurement, and why it is not taken (``None``: it is)."""
    gate = gate_of(found.size, options.gate)
    passes = found.nis <= gate
    count = trust.heard + 1
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
    heard = replace(trust, heard=count, last_s=time_s, returned=returned)
    if heard.locked:
        return _locked(heard, found, passes and not found.loose, time_s, options)
    if passes and loose >= options.loose_after:
        told = f"an edge beside the ring, {loose} times in a row: locked out"
        return _lock(replace(heard, lie=found.raw, loose=0)), told
    if passes:
        return (
            _lock(replace(heard, mean_nis=level, lie=found.raw)),
            f"mean NIS {level:.1f} of a degree of freedom, at most {options.nis_limit:g}: "
            "locked out",
        )
    row = heard.turned_away + 1
    heard = replace(heard, turned_away=row, lie=_followed(heard.lie, found.raw))
    away = f"{math.sqrt(found.nis):.1f} σ away, the gate is at {math.sqrt(gate):.1f}"
    if row >= options.lock_after:
        return _lock(heard), f"{away}, {row} times in a row: locked out"
    return heard, away


def _lock(trust: Trust) -> Trust:
    return replace(trust, locked=True, agreed=0, lockouts=trust.lockouts + 1)


def _locked(
    trust: Trust,
    found: Innovation,
    passes: bool,
    time_s: float,
    options: SensorOptions,
) -> tuple[Trust, str | None]:
    total = found.white + found.lasting
    same = trust.lie is not None and _still(trust.lie, found, total, options)
    sharp = is_sharp(found)
    if not passes or (same and not sharp):
        lie = _followed(trust.lie if same else None, found.raw)
        reason = "locked out, and still off" if not passes else (
            "locked out: it agrees only because the forecast is wide"
        )  # fmt: skip
        return replace(trust, agreed=0, turned_away=trust.turned_away + 1, lie=lie), reason
    agreed = trust.agreed + 1
    if agreed < options.unlock_after:
        told = f"locked out, agrees {agreed} of {options.unlock_after} times"
        return replace(trust, agreed=agreed, turned_away=0), told
    return (
        replace(
            trust, locked=False, agreed=0, turned_away=0, lie=None, mean_nis=1.0, returned=False,
            accepted=trust.accepted + 1, last_accepted_s=time_s,
        ),
        None,
    )  # fmt: skip


def _followed(lie: Array | None, residual: Array) -> Array:
    return residual if lie is None else lie + _FOLLOW * (residual - lie)


def is_sharp(found: Innovation) -> bool:
    """Whether the forecast knows nearly as much as the sensor says."""
    total = found.white + found.lasting
    return bool(found.log_volume - _log_volume(total) < _SHARP * found.size)


def _beside(found: Innovation) -> bool:
    """Whether another edge than the ring's is not even about the ring: then it is no edge."""
    total = found.white + found.lasting
    place = found.raw[:3]
    return bool(place @ np.linalg.solve(total[:3, :3], place) > _BESIDE)


def _still(lie: Array, found: Innovation, total: Array, options: SensorOptions) -> bool:
    """Whether a residual is where the sensor lied before.

    A whole pose that lies by a constant is there to within its noise. Of a ring or a range the lie
    wanders with what is taken for them: it is left when the residual at once falls by half. A
    forecast that drifts towards a lie takes many measurements for that, and the lie is followed.
    """
    if found.size == _WHOLE:
        away = found.raw - lie
        spread = 2.0 * found.white + 0.2 * found.lasting
        return bool(away @ np.linalg.pinv(spread) @ away <= gate_of(found.size, options.gate))
    weight = np.linalg.pinv(total)
    return bool(found.raw @ weight @ found.raw > 0.25 * (lie @ weight @ lie))


def _log_volume(matrix: Array) -> float:
    sign, value = np.linalg.slogdet(matrix)
    return float(value) if sign > 0 else -math.inf
