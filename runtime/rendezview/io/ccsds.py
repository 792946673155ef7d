"""Fitted path and attitude for flight dynamics: CCSDS OEM and AEM, KVN.

Orbit Ephemeris Message 2.0 (CCSDS 502.0-B-2) and Attitude Ephemeris Message 1.0 (504.0-B-1). The
orbit message describes the chaser about the target: ``CENTER_NAME`` is the target. Lengths
in the file are kilometres, as the standard requires. Covariances follow in the form that version
3.0 (502.0-B-3) shares with 2.0.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import numpy as np
from scipy.spatial.transform import Rotation

from rendezview.errors import RendezviewError
from rendezview.geometry.pose import Array

_UNIX, _J2000 = datetime(1970, 1, 1, tzinfo=UTC), datetime(2000, 1, 1, 12, tzinfo=UTC)
DATED_S = 3e8  # s; later times are dates since 1970, not a duration: 9.5 years. Source: chosen
_FIRST_YEAR, _LAST_YEAR = 1957, 2200  # Source: Sputnik; a typing error is further away


@dataclass(frozen=True, kw_only=True)
class Names:
    """Names in the headers."""

    chaser: str = "CHASER"
    chaser_id: str = "0000-000A"  # international designator; this value means none
    target: str = "TARGET"
    target_id: str = "0000-000B"
    originator: str = "RENDEZVIEW"


def parse_epoch(text: str) -> datetime:
    """The UTC date and time of a sequence's time 0, ISO 8601.

    Raises:
        RendezviewError: not a date and time.
    """
    try:
        epoch = datetime.fromisoformat(text)
    except ValueError:
        raise RendezviewError(
            f"--epoch must be a UTC date and time such as 2031-05-04T12:00:00, not {text!r}"
        ) from None
    moment = (epoch if epoch.tzinfo else epoch.replace(tzinfo=UTC)).astimezone(UTC)
    if not _FIRST_YEAR <= moment.year <= _LAST_YEAR:
        raise RendezviewError(f"--epoch: the year {moment.year} is no date of a spacecraft")
    return moment


def epoch_of(text: str | None, times_s: Sequence[float]) -> tuple[datetime, str | None]:
    """The UTC date of time 0 of a sequence, and what a user should know of it.

    Without ``--epoch``, times since 1970, as ROS and MCAP stamp pictures, count from there, and
    others from J2000.

    Raises:
        RendezviewError: the epoch is none, or contradicts times since 1970.
    """
    dated = bool(times_s) and times_s[0] > DATED_S
    if text is None:
        if dated:
            return _UNIX, None
        return _J2000, f"no --epoch: OEM and AEM take {_stamp(_J2000, 0.0)[:19]} as time 0"
    epoch = parse_epoch(text)
    if dated and epoch != _UNIX:
        raise RendezviewError(
            f"--epoch {text}: the times of the sequence are dates themselves, from "
            f"{_stamp(_UNIX, times_s[0])[:19]} on: leave --epoch out"
        )
    return epoch, None


def orbit_message(
    epoch: datetime,
    times_s: Sequence[float] | Array,
    places_m: Array,
    velocities_m_s: Array,
    *,
    frame: str,
    covariances: Array | None = None,
    names: Names | None = None,
    created: datetime | None = None,
) -> str:
    """An OEM of positions and velocities (N, 3) about the target.

    Args:
        frame: ``REF_FRAME``: ``RSW_ROTATING`` for Hill's frame, else a name the reader knows.
        covariances: (N, 6, 6) of place, m, and velocity, m/s, in that frame.

    Raises:
        ValueError: no states, times that do not rise, or values that are not finite.
    """
    names = names or Names()
    times, states = _checked(times_s, np.hstack([places_m, velocities_m_s]))
    lines = [
        "CCSDS_OEM_VERS = 2.0",
        *_head(names, created),
        "",
        "META_START",
        f"OBJECT_NAME = {names.chaser}",
        f"OBJECT_ID = {names.chaser_id}",
        f"CENTER_NAME = {names.target}",
        f"REF_FRAME = {frame}",
        "TIME_SYSTEM = UTC",
        f"START_TIME = {_stamp(epoch, times[0])}",
        f"STOP_TIME = {_stamp(epoch, times[-1])}",
        "META_STOP",
        "",
    ]
    for time_s, state in zip(times, states, strict=True):
        numbers = " ".join(f"{value / 1000.0:.12e}" for value in state)
        lines.append(f"{_stamp(epoch, time_s)} {numbers}")
    if covariances is not None:
        lines += ["", "COVARIANCE_START"]
        _, spreads = _checked(times, np.asarray(covariances).reshape(len(times), 36))
        for time_s, spread in zip(times, spreads.reshape(-1, 6, 6), strict=True):
            lines.append(f"EPOCH = {_stamp(epoch, time_s)}")
            for row in range(6):  # km², km²/s, km²/s²; the lower triangle
                lines.append(" ".join(f"{1e-6 * n:.9e}" for n in spread[row, : row + 1]))
        lines.append("COVARIANCE_STOP")
    return "\n".join(lines) + "\n"


def attitude_message(
    epoch: datetime,
    times_s: Sequence[float] | Array,
    reference_from_target: Array,
    *,
    frame: str,
    names: Names | None = None,
    created: datetime | None = None,
) -> str:
    """An AEM of the target's attitudes (N, 3, 3), as quaternions, scalar last.

    The quaternion is that of ``target_from_reference``: the change of coordinates from the
    reference frame A to the body frame B. Its sign is continuous from line to line, for
    interpolation.

    Raises:
        ValueError: no states, times that do not rise, or values that are not finite.
    """
    names = names or Names()
    times, turned = _checked(times_s, np.asarray(reference_from_target).reshape(-1, 9))
    # CCSDS: the quaternion of the frame rotation from A to B is that of the body axes in A.
    quats = Rotation.from_matrix(turned.reshape(-1, 3, 3)).as_quat()
    for k in range(1, len(quats)):
        if quats[k] @ quats[k - 1] < 0.0:
            quats[k] *= -1.0
    lines = [
        "CCSDS_AEM_VERS = 1.0",
        *_head(names, created),
        "",
        "META_START",
        f"OBJECT_NAME = {names.target}",
        f"OBJECT_ID = {names.target_id}",
        f"REF_FRAME_A = {frame}",
        "REF_FRAME_B = SC_BODY_1",
        "ATTITUDE_DIR = A2B",
        "TIME_SYSTEM = UTC",
        f"START_TIME = {_stamp(epoch, times[0])}",
        f"STOP_TIME = {_stamp(epoch, times[-1])}",
        "ATTITUDE_TYPE = QUATERNION",
        "QUATERNION_TYPE = LAST",
        "META_STOP",
        "",
        "DATA_START",
    ]
    for time_s, quat in zip(times, quats, strict=True):
        numbers = " ".join(f"{value:.12f}" for value in quat)
        lines.append(f"{_stamp(epoch, time_s)} {numbers}")
    return "\n".join([*lines, "DATA_STOP"]) + "\n"


def _head(names: Names, created: datetime | None) -> list[str]:
    when = created or datetime.now(UTC)
    return [f"CREATION_DATE = {_stamp(when, 0.0)}", f"ORIGINATOR = {names.originator}"]


def _stamp(epoch: datetime, time_s: float) -> str:
    try:
        moment = epoch + timedelta(seconds=float(time_s))
    except OverflowError:
        raise RendezviewError(
            f"a time of {time_s:.6g} s is no date: give times in seconds"
        ) from None
    return re.sub(r"\+00:00$", "", moment.isoformat(timespec="microseconds"))


def _checked(times_s: Sequence[float] | Array, values: Array) -> tuple[Array, Array]:
    times = np.asarray(times_s, np.float64)
    if len(times) == 0 or len(times) != len(values):
        raise ValueError(f"{len(times)} times and {len(values)} states make no ephemeris")
    if not (np.isfinite(times).all() and np.isfinite(values).all()):
        raise ValueError("an ephemeris must be finite")
    if np.any(np.diff(times) <= 0.0):
        raise ValueError("the times of an ephemeris must rise")
    return times, values
