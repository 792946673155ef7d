"""Keys of the lines of sensors' logs, and the sizes of numbers that the filter can use."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import BaseModel, Field, FiniteFloat

from rendezview.errors import RendezviewError
from rendezview.io.pose_log import PoseKeys
from rendezview.sensors.measurement import (
    Measurement,
    PoseMeasurement,
    RangeMeasurement,
    RateMeasurement,
    ThrustMeasurement,
)

_LEAST, _MOST = 1e-20, 1e12  # m², rad²; variances that the filter can use in 64-bit floats
_MOST_M = 1e9  # m; places farther away are refused. Source: a chosen limit
_MOST_CHANGE = 1e5  # rad/s, m/s of a known rate or thrust. Source: a chosen limit
_MOST_S = 1e10  # s, either side of zero. Source: a chosen limit

_Three = Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)]
_Six = Annotated[list[FiniteFloat], Field(min_length=6, max_length=6)]
_Matrix6 = Annotated[list[_Six], Field(min_length=6, max_length=6)]


class SurfaceKeys(BaseModel, extra="forbid"):
    """A surface that a ranger's beam may meet, as `BeamSurface`; outer_m null: it has no end."""

    point_m: _Three
    normal: _Three
    relief_m: FiniteFloat = 0.0
    inner_m: FiniteFloat = 0.0
    outer_m: FiniteFloat | None = None


class LogLine(BaseModel):
    """Of any sensor."""

    time_s: FiniteFloat | None = None  # of a line with a measurement, `Measurement` requires it


class _Protection(BaseModel):
    alarm: bool = False


class PoseLine(LogLine):
    """Of ``track``, ``reflectors`` and ``stereo track``."""

    pose: PoseKeys | None
    covariance: _Matrix6 | None = None
    common_covariance: _Matrix6 | None = None
    roll_ambiguous: bool | None = None
    protection: _Protection | None = None


class _Circle(BaseModel):
    centre_m: _Three
    axis: _Three
    covariance: list[list[float | None]] | None  # null where it is not known


class RingLine(LogLine):
    """Of ``ring``."""

    poses: list[_Circle]


class RangeLine(LogLine):
    """Of a laser ranger."""

    range_m: FiniteFloat | None
    sigma_m: FiniteFloat | None = None
    origin_m: _Three = [0.0, 0.0, 0.0]
    direction: _Three = [0.0, 0.0, 1.0]


class RateLine(LogLine):
    """Of a gyroscope."""

    rate_rad_s: _Three | None
    sigma_rad_s: FiniteFloat | None = None


class ThrustLine(LogLine):
    """Of thrusters."""

    velocity_change_m_s: _Three | None
    sigma_m_s: FiniteFloat | None = None


def check_size(measurement: Measurement, where: str) -> None:
    """Check that the filter can use the numbers of a measurement.

    Raises:
        RendezviewError: a time beyond 10¹⁰ s, a place beyond 10⁹ m, a change beyond 10⁵ m/s or
            rad/s, or a variance that no sensor has.
    """
    most = _MOST_M
    if isinstance(measurement, PoseMeasurement):
        places = [measurement.pose.translation_m]
        variances = np.diagonal(measurement.covariance)
    elif isinstance(measurement, RangeMeasurement):
        places = [np.array([measurement.range_m]), measurement.origin_m]
        variances = np.square([min(measurement.sigma_m, _MOST)])
    elif isinstance(measurement, RateMeasurement):
        places, most = [measurement.rate_rad_s], _MOST_CHANGE
        variances = np.square([min(measurement.sigma_rad_s, _MOST)])
    elif isinstance(measurement, ThrustMeasurement):
        places, most = [measurement.velocity_change_m_s], _MOST_CHANGE
        variances = np.square([min(measurement.sigma_m_s, _MOST)])
    else:
        places = [c.centre_m for c in measurement.candidates]
        variances = np.concatenate([np.diagonal(c.covariance)[:3] for c in measurement.candidates])
    if abs(measurement.time_s) > _MOST_S:
        raise RendezviewError(f"{where}: time_s must be within ±{_MOST_S:g}")
    if any(np.abs(place).max() > most for place in places):
        what = "places must be" if most == _MOST_M else "rates and changes of velocity must be"
        raise RendezviewError(f"{where}: {what} within {most:g} m, rad/s or m/s")
    if not (variances.min() >= _LEAST and variances.max() <= _MOST):
        raise RendezviewError(
            f"{where}: variances must be {_LEAST:g} … {_MOST:g}, in rad² and m², not "
            f"{variances.min():.3g} … {variances.max():.3g}"
        )
