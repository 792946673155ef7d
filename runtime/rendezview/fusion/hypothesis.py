"""A hypothesis: a state, and which sensors are to be believed if it is true.

`look` compares a reading with its state, `judged` believes the reading or not, and learns from it
how much of the sensor's noise is white and how much the camera swings.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from rendezview.fusion.models import Forecast, forecasts
from rendezview.fusion.options import FusionOptions, MotionOptions
from rendezview.fusion.prediction import predict
from rendezview.fusion.state import FilterState, sensor_options, with_slot
from rendezview.fusion.trust import Trust, after_reading, judge, lasting
from rendezview.fusion.update import (
    Comparison,
    compared,
    corrected,
    jitter_step,
    renewed,
    white_share,
)
from rendezview.geometry.pose import Array
from rendezview.sensors.measurement import Measurement, PoseMeasurement

# Readings over which the white share and the jitter are learnt: at first, and at last. Source:
# drawn white errors: 0.7 and 0.8 after 100 readings, 0.8 and 1.0 after 200
_SHARE_FIRST, _JITTER_FIRST, _LAST = 8.0, 5.0, 40.0
_LEAST_SHARE, _MOST_SHARE = 0.05, 4.0  # Source: by construction, twice the reported σ
# Ratio of two σ: slower changes are those of range and time, which biases follow. Source:
# fusion-approach and fusion-faults: 1 restarts a camera 10 σ off, 0.7 to 0.9 are alike
_SAME_SIGMA = 0.8
# rad. Source: fusion-approach, a still camera: with 1e-4 1.4 × the error at 45–60 m; plain
# situations, a tumbling target: 0 leaves it too sure
_LEAST_JITTER = 3e-5


class Hypothesis(NamedTuple):
    """A state, and which sensors are to be believed if it is true."""

    state: FilterState
    trusts: Mapping[str, Trust]
    accepted: int = 1  # readings that fit
    seen_s: float = -math.inf  # time of the last pose or ring that fits
    last_accepted_s: float = -math.inf


class Found(NamedTuple):
    """The likeliest meaning of a reading at a state."""

    state: FilterState
    forecast: Forecast
    comparison: Comparison
    log_likelihood: float

    @property
    def size(self) -> int:
        return len(self.comparison.innovation)


def moved(hypothesis: Hypothesis, time_s: float, options: FusionOptions) -> Hypothesis:
    ahead_s = max(time_s - hypothesis.state.time_s, 0.0)
    return hypothesis._replace(state=predict(hypothesis.state, ahead_s, options))


def look(state: FilterState, measurement: Measurement, options: FusionOptions) -> Found | str:
    """The likeliest meaning of a reading at a state; words where there is none."""
    state = with_slot(state, measurement, sensor_options(measurement, options))
    meanings = forecasts(state, measurement, options)
    if isinstance(meanings, str):
        return meanings
    best: Found | None = None
    given = state
    for forecast in meanings:
        state = _with_new_bias(given, measurement.sensor, forecast)
        comparison = compared(state, forecast.design, forecast.noise, forecast.residual)
        if comparison is None or not math.isfinite(comparison.total):
            continue
        total = comparison.total + forecast.log_prior
        if best is None or total > best.log_likelihood:
            best = Found(state, forecast, comparison, total)
    return best or "its covariance cannot be used"


def _with_new_bias(state: FilterState, sensor: str, forecast: Forecast) -> FilterState:
    """The state beside a reading of quite another σ than the last: its bias is new in part.

    A sensor that sees other things at once, such as nearer parts, says so by its σ. What is kept
    of the bias is the ratio of both.
    """
    last = state.sigmas.get(sensor)
    if last is None or forecast.other_edge:
        return state
    kept = np.minimum(forecast.sigmas, last) / np.maximum(forecast.sigmas, last)
    if kept.min() > _SAME_SIGMA:
        return state
    return renewed(state, state.slots[sensor].start, kept)


def mixture(outliers: float, log_likelihood: float, chance: float) -> float:
    """Log-likelihood of a reading that may be an outlier."""
    return float(np.logaddexp(math.log1p(-outliers) + log_likelihood, math.log(outliers) + chance))


def judged(
    before: Hypothesis, measurement: Measurement, found: Found, options: FusionOptions
) -> tuple[Hypothesis, bool]:
    """The hypothesis after a reading that it may believe."""
    name, time_s = measurement.sensor, measurement.time_s
    trust = before.trusts.get(name) or Trust(name)
    root, seen = found.forecast.root, found.comparison
    outliers = sensor_options(measurement, options).outliers
    spread = np.einsum("m,mij,mkj->ik", before.state.weights, seen.lowers, seen.lowers)
    believed, wrong, hidden, offset = judge(
        trust, outliers, found.log_likelihood, seen.peak, seen.nis, seen.innovation, root, spread
    )
    level, fault = seen.nis / found.size, lasting(wrong, outliers, trust.rejected)
    trust = after_reading(trust, time_s, believed, level, found.size)._replace(
        fault=fault, doubt=hidden, offset=offset
    )
    trusts = {**before.trusts, name: trust}
    if not believed:
        return before._replace(trusts=trusts), False
    whole = found.size > 1
    accepted = before.accepted + (whole and not found.forecast.other_edge)
    state = _taken(found, measurement, options.motion)
    if accepted >= options.start_with and not state.confirmed:
        state = state._replace(confirmed=True)
    seen_s = time_s if whole else before.seen_s
    return Hypothesis(state, trusts, accepted, seen_s, time_s), True


def _taken(found: Found, measurement: Measurement, motion: MotionOptions) -> FilterState:
    """The state after a reading, and what it teaches about noise and jitter."""
    state, forecast, name = found.state, found.forecast, measurement.sensor
    after = corrected(state, found.comparison)
    white, count = state.white, state.readings.get(name, 0)
    span = min(_LAST, _JITTER_FIRST + count)
    sigmas = state.sigmas
    if not forecast.other_edge:
        sigmas = {**sigmas, name: forecast.sigmas}
    if forecast.teaches:
        gained = white_share(forecast.shares, forecast.root, after.weights, found.comparison)
        share = np.clip(
            forecast.shares + gained / min(_LAST, _SHARE_FIRST + count), _LEAST_SHARE, _MOST_SHARE
        )
        white, count = {**white, name: share}, count + 1
    jitter, pose_s = state.jitter, state.pose_s
    if isinstance(measurement, PoseMeasurement):
        since_s = measurement.time_s - pose_s
        known = state.turning is not None and state.turning_s >= pose_s  # nothing to learn from
        if since_s > 1e-3 and not known:
            jitter = _learnt_jitter(state, found, after.weights, since_s, span, motion)
        pose_s = measurement.time_s
    return after._replace(
        white=white, readings={**state.readings, name: count}, sigmas=sigmas, jitter=jitter,
        pose_s=pose_s,
    )  # fmt: skip


def _learnt_jitter(
    state: FilterState, found: Found, weights: Array, since_s: float, span: float,
    motion: MotionOptions,
) -> float:  # fmt: skip
    gained = 1.0 - math.exp(-2.0 * min(since_s, 10.0) / motion.jitters_s[0])
    step_rad2 = jitter_step(
        found.forecast.design, weights, found.comparison, gained, len(motion.jitters)
    )
    return math.sqrt(max(state.jitter**2 + step_rad2 / span, _LEAST_JITTER**2))
