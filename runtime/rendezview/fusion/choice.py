"""One measurement through the filter: prediction, update, and the choice among hypotheses.

Beside the main hypothesis a few rivals run (`rivals`). A rival's score is the sum of its sensors'
log-likelihood ratios to the main hypothesis, each bounded, from a prior. At `_WIN` it takes over.
Everything is a value: `step` makes the next `Snapshot` from the last, so a late measurement is
inserted at its time.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from rendezview.fusion.hypothesis import Found, Hypothesis, judged, look, mixture, moved
from rendezview.fusion.options import FusionOptions
from rendezview.fusion.prediction import estimate_of, pushed, turned
from rendezview.fusion.rivals import (
    CONTRADICTS,
    FAST_PRIOR,
    FITTING,
    LOSES,
    PATIENCE_S,
    PRIOR,
    Kind,
    Rival,
    begun,
    doubted,
    new_rivals,
    with_doubt,
)
from rendezview.fusion.state import FilterState, begin, sensor_options
from rendezview.fusion.trust import Trust, Verdict, after_reading, outlier_log
from rendezview.geometry import so3
from rendezview.geometry.pose import Array
from rendezview.sensors.measurement import (
    Measurement,
    PoseMeasurement,
    RateMeasurement,
    ThrustMeasurement,
)

# Logarithms of likelihood ratios: the most that one sensor may say, what it takes to win.
# Source: by construction: one sensor alone cannot overturn a confirmed state, two can
_CAP, _WIN = 12.0, 6.0
_FORGETS = 0.9  # of a sensor's earlier ratio at each reading. Source: by construction
# s without a reading that agrees, after which a new start has no lower prior. Source: fusion-faults
_CONTEST_S = 20.0
# σ² of a known input beside the forecast, from where it may be wrong. Source: by construction, 5 σ
_SURPRISES = 25.0
_WIDER = 4.0  # of the variance of rates that another filter has left. Source: twice the σ


class Snapshot(NamedTuple):
    """The filter after a measurement."""

    main: Hypothesis | None = None
    rivals: tuple[Rival, ...] = ()
    starts: int = 0
    note: str | None = None  # why it last restarted
    contested_s: float = -math.inf  # when a sensor last contradicted it, or a rival won

    @property
    def trusts(self) -> Mapping[str, Trust]:
        """Trust in each sensor."""
        return {} if self.main is None else self.main.trusts


def useless(state: FilterState, options: FusionOptions) -> str | None:
    """Why a forecast is no longer usable; ``None`` while it is."""
    pose, _, covariance = estimate_of(state)
    limit_m = options.lost_range_fraction * math.sqrt(pose.translation_m @ pose.translation_m)
    return useless_covariance(covariance, limit_m, options.lost_rad)


def useless_covariance(covariance: Array, limit_m: float, limit_rad: float) -> str | None:
    """As `useless`, of a (12, 12) covariance."""
    place, attitude = covariance[3:6, 3:6], covariance[:3, :3]
    if not _within(place, limit_m):
        return f"the place is known to {math.sqrt(np.linalg.eigvalsh(place)[-1]):.2g} m only"
    if not _within(attitude, limit_rad):
        sigma_deg = math.degrees(math.sqrt(np.linalg.eigvalsh(attitude)[-1]))
        return f"the attitude is known to {sigma_deg:.2g}° only"
    return None


def _within(block: Array, sigma: float) -> bool:
    """Whether the largest σ of a (3, 3) covariance is below a limit."""
    if block[0, 0] + block[1, 1] + block[2, 2] < sigma**2:  # the trace is above it
        return True
    return bool(np.linalg.eigvalsh(block)[-1] < sigma**2)


def _blind(state: FilterState) -> bool:
    """Whether the forecast is so wide that nothing can contradict it: start at the next pose."""
    place_m2 = float(state.place_m @ state.place_m)
    likeliest = state.covariances[int(state.weights.argmax())]
    variances = [float(likeliest[i, i]) for i in range(6)]
    return sum(variances[:3]) > 1.0 or sum(variances[3:]) > place_m2


def step(
    before: Snapshot, measurement: Measurement, options: FusionOptions
) -> tuple[Snapshot, Verdict]:
    """The filter after a measurement that is not earlier than those before."""
    name, time_s, size = measurement.sensor, measurement.time_s, measurement.size
    if before.main is None:
        if isinstance(measurement, PoseMeasurement):
            return _start(before, measurement, options, "begun")
        none = "no sensor has given a whole pose yet"
        return before, Verdict(name, time_s, False, none, None, size)
    if isinstance(measurement, RateMeasurement | ThrustMeasurement):
        return _told(before, before.main, measurement, options)
    main = moved(before.main, time_s, options)
    if isinstance(measurement, PoseMeasurement) and _blind(main.state):
        lost = useless(main.state, options) or "the forecast is too wide"
        return _start(before, measurement, options, f"restarted: {lost}")
    found = look(main.state, measurement, options)
    rivals = tuple(
        rival._replace(hypothesis=moved(rival.hypothesis, time_s, options))
        for rival in before.rivals
    )
    if isinstance(found, str):
        main = main._replace(trusts=_heard(main.trusts, name, time_s))
        after = before._replace(main=main, rivals=rivals)
        return after, Verdict(name, time_s, False, found, None, size)
    views = [look(rival.hypothesis.state, measurement, options) for rival in rivals]
    outliers = sensor_options(measurement, options).outliers
    peaks = [seen.comparison.peak for seen in views if not isinstance(seen, str)]
    chance = outlier_log(min([found.comparison.peak, *peaks]), size)
    own = mixture(outliers, found.log_likelihood, chance)
    forecast = main
    main, believed = judged(main, measurement, found, options)
    kept: list[Rival] = []
    for rival, seen in zip(rivals, views, strict=True):
        if isinstance(seen, str):
            kept.append(rival)
            continue
        ratio = mixture(outliers, seen.log_likelihood, chance) - own
        rival, fits = _scored(rival, measurement, seen, ratio, options)
        score = rival.score + _relief(rival, main, time_s)
        if score > _WIN and rival.fitting >= FITTING:
            after, verdict = _won(before, rival, measurement, seen, fits)
            return after._replace(rivals=_outlived(rival, main, rivals, time_s)), verdict
        if _stays(rival, score, time_s):
            kept.append(rival)
    reason: str | None = None
    doubt = main.trusts[name].doubt
    if believed and doubt >= outliers:  # likelier wrong than readings are
        fresh = doubted(forecast, main.trusts[name], measurement, found.comparison.innovation)
        kept = with_doubt(kept, fresh)
    if not believed:
        reason = f"{math.sqrt(max(found.comparison.nis, 0.0)):.1f} σ away"
        if main.trusts[name].rejected >= CONTRADICTS:
            before = before._replace(contested_s=time_s)
        if main.trusts[name].locked:
            reason += f", {main.trusts[name].rejected} times in a row: locked out"
        kept += new_rivals(forecast, kept, measurement, options)
    after = before._replace(main=main, rivals=tuple(kept))
    if believed and found.forecast.other_edge:
        reason = "another edge than the ring's: for its bearing only"
    return after, Verdict(name, time_s, believed, reason, found.comparison.nis, size)


def _told(
    before: Snapshot, main: Hypothesis, known: RateMeasurement | ThrustMeasurement,
    options: FusionOptions,
) -> tuple[Snapshot, Verdict]:  # fmt: skip
    """After an input that is known: the camera's rotation, or a thrust.

    All hypotheses take it, but that which doubts its source. One is added where it surprises.
    """

    def with_it(hypothesis: Hypothesis) -> Hypothesis:
        if isinstance(known, RateMeasurement):
            return hypothesis._replace(state=turned(hypothesis.state, known, options))
        here = moved(hypothesis, known.time_s, options)
        return here._replace(state=pushed(here.state, known))

    name, time_s = known.sensor, known.time_s
    trust = after_reading(main.trusts.get(name) or Trust(name), time_s, True, 1.0, 0)
    main = main._replace(trusts={**main.trusts, name: trust})
    without, main = moved(main, time_s, options), with_it(main)
    rivals = [
        r if r.doubts == name else r._replace(hypothesis=with_it(r.hypothesis))
        for r in before.rivals
    ]
    if _surprise(main.state, without.state) > _SURPRISES:  # it keeps a state that has fitted
        rivals = with_doubt(
            rivals, Rival(Kind.DOUBT, without, PRIOR, time_s, fitting=2, doubts=name)
        )
    after = before._replace(main=main, rivals=tuple(rivals))
    return after, Verdict(name, time_s, True, None)


def _surprise(state: FilterState, without: FilterState) -> float:
    """Squared distance, σ², of a state from that without an input: attitude and velocity."""
    off = [so3.between(without.rotation, state.rotation), state.velocity - without.velocity]
    variances = without.weights @ np.diagonal(without.covariances, axis1=1, axis2=2)
    return float((np.square(off) / variances[[[0, 1, 2], [9, 10, 11]]]).sum())


def _start(
    before: Snapshot, pose: PoseMeasurement, options: FusionOptions, reason: str
) -> tuple[Snapshot, Verdict]:
    """Begin at a pose: a slow target, and a fast one beside it."""
    motion = options.motion
    trusts = {
        name: trust._replace(fault=0.0, offset=None, rejected=0)
        for name, trust in before.trusts.items()
    }
    slow = begun(begin(pose, options), pose, trusts)
    quick = begin(pose, options, None, (motion.fast_rate, motion.fast_velocity))
    fast = Rival(Kind.FAST, begun(quick, pose, trusts), FAST_PRIOR, pose.time_s)
    after = Snapshot(slow, (fast,), before.starts + 1, reason if before.starts else None)
    return after, Verdict(pose.sensor, pose.time_s, True, reason, None, 6, began=True)


def resumed(
    pose: PoseMeasurement, rates: Array, covariance: Array, confirmed: bool, options: FusionOptions
) -> Snapshot:
    """The state of a filter that has ended: its pose, rates (6,) and their covariance (12, 12).

    What it knew of its sensors' biases is gone, so the rates get twice their σ, as in a restart.
    """
    turn = pose.pose.rotation.T
    sigmas = tuple(
        math.sqrt(_WIDER * covariance[rows, rows].trace() / 3.0)
        for rows in (slice(6, 9), slice(9, 12))
    )
    state = begin(pose, options, (turn @ rates[:3], -turn @ rates[3:]), (sigmas[0], sigmas[1]))
    state = state._replace(confirmed=confirmed)
    accepted = options.start_with if confirmed else 1
    main = Hypothesis(state, {}, accepted, pose.time_s, pose.time_s)
    return Snapshot(main, (), 1)


def _heard(trusts: Mapping[str, Trust], name: str, time_s: float) -> Mapping[str, Trust]:
    trust = trusts.get(name) or Trust(name)
    return {**trusts, name: trust._replace(received=trust.received + 1, last_s=time_s)}


def _scored(
    rival: Rival, measurement: Measurement, seen: Found, ratio: float, options: FusionOptions
) -> tuple[Rival, bool]:
    name, prior = measurement.sensor, rival.prior
    hypothesis, fits = judged(rival.hypothesis, measurement, seen, options)
    if name == rival.doubts:  # it never believes its sensor: what speaks for that speaks against it
        if fits:
            prior += _own_share(rival, seen) * math.log(hypothesis.trusts[name].fault)
            known = rival.hypothesis.trusts[name]
            known = after_reading(known, measurement.time_s, False, 1.0, seen.size)
            trusts = {**rival.hypothesis.trusts, name: known}
            hypothesis, fits = rival.hypothesis._replace(trusts=trusts), False
        ratio = 0.0  # wrong again in the same way says nothing new
    total = _FORGETS * rival.ratios.get(name, 0.0) + ratio
    ratios = {**rival.ratios, name: max(-_CAP, min(_CAP, total))}
    fitting = rival.fitting + (fits and seen.size > 1)
    rival = rival._replace(prior=prior, ratios=ratios, fitting=fitting)
    return rival._replace(hypothesis=hypothesis), fits


def _own_share(rival: Rival, seen: Found) -> float:
    """Share of an innovation's variance that is the reading's own; the state's is the same next."""
    own = np.diag(seen.forecast.root @ seen.forecast.root.T)
    whole = np.einsum(
        "m,mij,mij->i", rival.hypothesis.state.weights, *2 * (seen.comparison.lowers,)
    )
    return float(np.minimum(own / whole, 1.0).mean())


def _relief(rival: Rival, main: Hypothesis, time_s: float) -> float:
    """What is added to the score of a new start that the main hypothesis has reason to fear."""
    if rival.kind is not Kind.START:
        return 0.0
    supporters = sum(ratio > 0.5 * _CAP for ratio in rival.ratios.values())
    if time_s - main.seen_s > _CONTEST_S or supporters > 1:
        return max(PRIOR - rival.prior, 0.0)
    return 0.0


def _stays(rival: Rival, score: float, time_s: float) -> bool:
    """Whether a rival is still of use: a doubt, while it has something else to go by."""
    doubt = rival.kind is Kind.DOUBT
    since_s = rival.hypothesis.seen_s if doubt else rival.born_s
    patient = time_s - since_s <= PATIENCE_S[rival.kind] or (score >= 0.0 and not doubt)
    return patient and (score > LOSES or not doubt)


def _outlived(
    winner: Rival, loser: Hypothesis, rivals: tuple[Rival, ...], time_s: float
) -> tuple[Rival, ...]:
    """The doubts that remain: those before, and the loser where it alone locks a sensor out.

    A doubt explains its sensor's readings as well as the winner does: the others count against it.
    """
    if winner.kind is Kind.START:
        return ()
    found = {rival.doubts: rival for rival in rivals if rival.kind is Kind.DOUBT}
    found.pop(winner.doubts, None)  # it has become the state
    for name, trust in loser.trusts.items():
        known = winner.hypothesis.trusts.get(name)  # None: it could not be compared with a reading
        if trust.locked and (known is None or not known.locked):
            found[name] = Rival(Kind.DOUBT, loser, 0.0, time_s, fitting=0, doubts=name)
    return tuple(
        doubt._replace(prior=doubt.prior - winner.score + winner.ratios.get(name or "", 0.0))
        for name, doubt in found.items()
    )


def _won(
    before: Snapshot, rival: Rival, measurement: Measurement, seen: Found, fits: bool
) -> tuple[Snapshot, Verdict]:
    """The rival takes over; only a new start is another state, and restarts the filter."""
    restarted = rival.kind is Kind.START
    agree = sum(ratio > 0.0 for ratio in rival.ratios.values())
    said = f"{agree} sensor{'s speak' if agree != 1 else ' speaks'} for {rival.kind}"
    reason = f"restarted: {said}" if restarted else said
    after = before._replace(
        main=rival.hypothesis, rivals=(), starts=before.starts + restarted,
        contested_s=before.contested_s if rival.kind is Kind.FAST else measurement.time_s,
        note=reason if restarted else before.note,
    )  # fmt: skip
    sensor, nis = measurement.sensor, seen.comparison.nis
    return after, Verdict(sensor, measurement.time_s, fits, reason, nis, seen.size, restarted)
