"""The error of a pose by cause: what a covariance is made of, and what it leaves out."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from rendezview.geometry.pose import Array

SPOTS, _COVER = "spots", "cover"  # the causes that differ from reading to reading
# What a user can give so that a cause is known. Source: by construction, a message
_REMEDIES = {
    "camera": "the camera file has no intrinsics_covariance (calibrate camera writes it)",
    "calibration": "the rig file has no covariance (calibrate rig writes it)",
    "places": "the target file has no position_sigma_m of every reflector or light",
}


class Part(NamedTuple):
    """σ of a pose by one cause."""

    turn_rad: float  # of all three axes together
    place_m: float


Budget = dict[str, Part | None]  # by cause; None: not known, and not in the covariance


def unknown_of(**known: bool) -> dict[str, Array | None]:
    """None for each cause that is not known."""
    return {cause: None for cause, is_known in known.items() if not is_known}


def budget_of(shares: dict[str, Array | None]) -> Budget:
    """The budget of a covariance (6, 6) of each cause, None where it is not known."""
    return {cause: None if share is None else _part(share) for cause, share in shares.items()}


def common_of(shares: dict[str, Array | None]) -> Array:
    """(6, 6) of all causes that are the same in all readings of a run."""
    own = (SPOTS, _COVER)
    known = [share for cause, share in shares.items() if share is not None and cause not in own]
    return np.asarray(sum(known, np.zeros((6, 6))))


def unknown_causes(budget: Budget) -> str | None:
    """What a covariance leaves out, in words; None where it is whole."""
    missing = [_REMEDIES[cause] for cause, part in budget.items() if part is None]
    return f"σ leaves out what is not known: {'; '.join(missing)}" if missing else None


def budget_rows(budgets: Iterable[Budget]) -> list[tuple[str, str, str]]:
    """Cause, median σ of attitude (°) and of place (mm) over some readings, as text."""
    parts: dict[str, list[Part | None]] = {}
    for budget in budgets:
        whole = [part for part in budget.values() if part is not None]
        total = Part(*(math.hypot(*values) for values in zip(*whole, strict=True)))
        for cause, part in {**budget, "all": total}.items():
            parts.setdefault(cause, []).append(part)
    rows = []
    for cause, found in parts.items():
        known = [part for part in found if part is not None]
        if not known:
            rows.append((cause, "not known", "not known"))
            continue
        turn, place = np.median(known, axis=0).tolist()
        rows.append((cause, f"{math.degrees(turn):.2g}", f"{1e3 * place:.2g}"))
    return rows


def _part(share: Array) -> Part:
    a, b, c, x, y, z = share.diagonal().tolist()
    return Part(math.sqrt(max(a + b + c, 0.0)), math.sqrt(max(x + y + z, 0.0)))
