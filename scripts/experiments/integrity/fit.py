"""Fits the numbers of protection levels to logs of integrity-draw."""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from scipy.optimize import minimize
from scipy.special import fdtri

from experiments.integrity.draw import tracks
from rendezview.estimation.protection import Overbound
from rendezview.sensors.appearance.integrity import model
from rendezview.sensors.appearance.integrity.monitor import IntegrityMonitor, IntegrityOptions

NAMES = model.FRAME_FEATURES + model.TRACK_FEATURES
SMOOTHING, ALLOWANCE, MOST = 0.3, 1.0, 4.0
# Degrees of freedom of the tails that are tried; none is lighter, because no log shows their ends.
DEGREES = (3.0, 4.0, 5.0, 6.0, 8.0, 12.0)
TURN_BIASES = tuple(np.deg2rad([0.0, 0.25, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0]))  # that are tried
MOVE_BIASES = (0.0, 0.0015, 0.003, 0.006, 0.01, 0.015, 0.02, 0.03)  # of the range
LEAST_SCALE = 0.2  # of a standard deviation; the bias does not take all of it
# The factor of the covariance is fitted to this moment of the errors: to their tails, not their
# middle. With 2 the levels are a third longer, with 8 one condition pays for another.
MOMENT = 4.0
SPREAD_RIDGE = 0.02  # of the squared weights of features of unit variance
RISKS = np.geomspace(2e-4, 0.3, 40)  # at which the tails must lie above the errors'
DEFAULT_RISK = 1e-3  # the tail that gives the shortest level there is taken
LEAST_EXCEEDING = 3  # errors; the tail beyond them is extrapolated
DRAWS = 30  # of the tracks of a condition
# Wrong poses are rare, so the odds of one begin with what is known without the logs: the confidence
# is a calibrated probability of one frame; a track that its motion bears out for long is wrong less
# often; a wrong pose and a sketch agree by chance in 5 %, a right one and one disagree in 15 %.
PRIOR = {"constant": -3.0, "doubt": 1.0, "young": 3.0, "second_agrees": -3.0,
         "second_disagrees": 1.8}  # fmt: skip
PRIOR_SPREAD = 1.0  # of each weight; the logs move them from there
ALONE = 0.2  # of a pose's weight: five frames of a track tell no more than one that stands alone
LEAST_LIMIT = 8.0  # standard deviations; three large innovations in a row are a drift, one is none
FOLDS = 5
DRIFT_SHARE = 2e-3  # of the right poses may have a larger sum than the limit
HALF = 0.5  # of the risk, for wrong poses of a small probability


@dataclass(frozen=True, slots=True, eq=False)
class Poses:
    """All poses of the logs, one a row."""

    features: np.ndarray  # (N, 21)
    wrong: np.ndarray  # (N,)
    at_rival: np.ndarray  # (N,) the rival is within reach of the truth
    turn: np.ndarray  # (N, 4) length of the error, largest variance, trace over it, unit
    move: np.ndarray  # (N, 4)
    drift: np.ndarray  # (N,)
    condition: np.ndarray  # (N,)
    track: np.ndarray  # (N,) number of the track
    misled: np.ndarray  # (N,) the track began at a wrong pose on purpose

    def of(self, which: np.ndarray) -> Poses:
        """Some of them."""
        columns = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return Poses(**{name: values[which] for name, values in columns.items()})


def gather(folder: Path) -> Poses:
    """Every track through a monitor: what it computes from."""
    plain = model.IntegrityModel(
        attitude=Overbound(1.0, 3.0), position=Overbound(1.0, 3.0), wrong=np.zeros(len(NAMES)),
        attitude_spread=model.Spread.none(), position_spread=model.Spread.none(),
        at_rival=0.0, smoothing=SMOOTHING, allowance=ALLOWANCE, most=MOST, limit=math.inf,
    )  # fmt: skip
    rows = []
    for number, track in enumerate(tracks(folder)):
        monitor = IntegrityMonitor(IntegrityOptions(), plain)
        for look in track:
            if look.evidence is None:
                continue
            protection = monitor.judge(look.evidence, look.ask)
            spread, range_m = look.evidence.covariance, look.evidence.range_m
            # A wrong pose is at the rival where that is as far from it as the truth is.
            rival = abs(look.turn_rad - look.evidence.rival_rad) < np.deg2rad(10.0)
            rows.append((
                monitor.features, look.wrong, look.wrong and rival,
                _normalised(look.turn_rad, spread[:3, :3], 1.0),
                _normalised(look.move_m, spread[3:6, 3:6], range_m),
                protection.drift, look.condition, number, look.misled,
            ))  # fmt: skip
    return Poses(*(np.array(column) for column in zip(*rows, strict=True)))


def _normalised(length: float, covariance: np.ndarray, unit: float) -> tuple[float, ...]:
    largest = float(np.linalg.eigvalsh(covariance)[-1])
    return length, largest, float(np.trace(covariance)) / largest, unit


def wrong_odds(poses: Poses) -> np.ndarray:
    """(21,) log odds, the likeliest ones after the prior and the logs.

    Misled tracks tell what a wrong pose looks like, not how often there is one: all weights are
    fitted to all tracks, then the constant anew to those that nobody misled (Prentice & Pyke,
    Biometrika 66, 1979).
    """
    prior = np.array([PRIOR.get(name, 0.0) for name in NAMES])
    weights = _likeliest(poses.features, poses.wrong, prior)
    plain = poses.of(~poses.misled)
    predicted = plain.features[:, 1:] @ weights[1:]
    constant = _likeliest(plain.features[:, :1], plain.wrong, prior[:1], predicted)
    return np.concatenate([constant, weights[1:]])


def _likeliest(
    features: np.ndarray, wrong: np.ndarray, prior: np.ndarray, predicted: np.ndarray | float = 0.0
) -> np.ndarray:
    """The weights of some features beside the odds that others tell."""
    sign = np.where(wrong, 1.0, -1.0)

    def unlikely(weights: np.ndarray) -> tuple[float, np.ndarray]:
        odds = sign * (features @ weights + predicted)
        away = (weights - prior) / PRIOR_SPREAD**2
        loss = ALONE * np.logaddexp(0.0, -odds).sum() + 0.5 * away @ (weights - prior)
        slope = ALONE * features.T @ (-sign / (1.0 + np.exp(np.clip(odds, -500, 500))))
        return float(loss), slope + away

    return minimize(unlikely, prior, jac=True, method="L-BFGS-B", options={"maxiter": 2000}).x


def raised(poses: Poses) -> float:
    """What the constant is raised by: few wrong poses have a probability below a risk.

    Each track is judged by a fit to the others. At each risk, poses that are wrong and have a
    smaller probability are at most half the risk of all poses. Misled tracks are not judged.
    """
    odds = np.empty(len(poses.wrong))
    folds = poses.track % FOLDS
    for fold in range(FOLDS):
        out = folds == fold
        odds[out] = poses.features[out] @ wrong_odds(poses.of(~out))
    odds, wrong = odds[~poses.misled], poses.wrong[~poses.misled]
    lift = 0.0
    for risk in (1e-2, 1e-3):
        allowed = int(HALF * risk * len(odds))
        lowest = np.sort(odds[wrong])
        if len(lowest) > allowed:
            lift = max(lift, math.log(risk / (1.0 - risk)) - lowest[allowed])
    return float(lift)


def spread(features: np.ndarray, errors: np.ndarray, conditions: np.ndarray) -> model.Spread:
    """The factor by which errors exceed their covariance, log-linear in what the frame shows.

    The likeliest one of a generalised normal distribution of power ``MOMENT``, all conditions
    weighing the same. ``features``: (N, 16) ``FRAME_FEATURES``, the first constant; ``errors``:
    (N, 4) as in ``overbound``.
    """
    length, largest, axes, unit = errors.T
    sigma = np.sqrt(largest * axes)
    columns = np.column_stack([features, np.log(sigma / unit)])
    middle, width = columns.mean(0), np.maximum(columns.std(0), 1e-6)
    middle[0], width[0] = 0.0, 1.0
    plain = (columns - middle) / width
    names, of, counts = np.unique(conditions, return_inverse=True, return_counts=True)
    weight = 1.0 / (len(names) * counts[of])
    ratio = np.log(np.maximum(length / sigma, 1e-3))
    penalty = np.append(0.0, np.full(plain.shape[1] - 1, SPREAD_RIDGE))

    def unlikely(w: np.ndarray) -> tuple[float, np.ndarray]:
        predicted = plain @ w
        power = np.exp(np.clip(MOMENT * (ratio - predicted), -50.0, 50.0))
        loss = float(weight @ (power + MOMENT * predicted) + penalty @ w**2)
        slope = plain.T @ (weight * MOMENT * (1.0 - power)) + 2.0 * penalty * w
        return loss, slope

    found = minimize(unlikely, np.zeros(plain.shape[1]), jac=True, method="L-BFGS-B").x
    weights = found / width
    weights[0] = found[0] - float(weights[1:] @ middle[1:])
    predicted = columns @ weights
    return model.Spread(weights, float(predicted.min()), float(predicted.max()))


def widened(predicted: model.Spread, features: np.ndarray, errors: np.ndarray) -> np.ndarray:
    """(N, 4) the errors with their variance as the monitor widens it."""
    out = errors.copy()
    for k, (_, largest, axes, unit) in enumerate(errors):
        out[k, 1] *= predicted.factor(math.sqrt(largest * axes) / unit, features[k]) ** 2
    return out


def overbound(
    errors: np.ndarray, conditions: np.ndarray, track: np.ndarray, biases: tuple[float, ...]
) -> Overbound:
    """The tail above those of every condition whose levels at 1e-3 are lowest, log mean.

    The frames of a track err together. So each condition is drawn many times, track by track, and
    the tail lies above all but the highest of these draws. ``errors``: (N, 4) length of each error,
    largest variance, trace over it, unit of the bias; ``track``: (N,) number of each track.
    """
    rng = np.random.default_rng(0)
    drawn = []
    for name in np.unique(conditions):
        here = np.flatnonzero(conditions == name)
        parts = [here[track[here] == number] for number in np.unique(track[here])]
        drawn.append([
            np.concatenate([parts[k] for k in rng.integers(len(parts), size=len(parts))])
            for _ in range(DRAWS)
        ])  # fmt: skip
    best: tuple[float, Overbound] | None = None
    for bias, degrees in itertools.product(biases, DEGREES):
        length, largest, axes, unit = errors.T
        # The scale at which each error has each risk.
        over = np.maximum(length - bias * unit, 0.0) / np.sqrt(largest * axes)
        reach = np.sqrt(fdtri(axes[None], degrees, 1.0 - RISKS[:, None]))
        scale = max(np.sort([_least_scale(over[one], reach[:, one]) for one in draws])[-2]
                    for draws in drawn)  # fmt: skip
        bound = Overbound(max(float(scale), LEAST_SCALE), degrees, bias)
        at = np.sqrt(fdtri(axes, degrees, 1.0 - DEFAULT_RISK))
        levels = float(np.mean(np.log(bias * unit + bound.scale * np.sqrt(largest * axes) * at)))
        if best is None or levels < best[0]:
            best = levels, bound
    assert best is not None
    return best[1]


def _least_scale(over: np.ndarray, reach: np.ndarray) -> float:
    """The least scale at which no risk is exceeded more often than it says.

    ``over``: (N,) errors over their standard deviation; ``reach``: (R, N) standard deviations of
    the tail at each risk, for a scale of 1.
    """
    needed = np.sort(over[None] / reach, axis=1)[:, ::-1]  # the largest first
    allowed = np.maximum(RISKS * len(over), LEAST_EXCEEDING - 1).astype(int)
    allowed = np.minimum(allowed, len(over) - 1)
    return float(needed[np.arange(len(RISKS)), allowed].max())


def run(
    folder: Annotated[Path, "logs of integrity-draw"], *,
    write: Annotated[bool, "into the package"] = False,
) -> None:  # fmt: skip
    """Fit tails, the odds of a wrong pose and the limit of drifts to logs of integrity-draw."""
    everything = gather(folder)
    weights = wrong_odds(everything)
    lift = raised(everything)
    weights[0] += lift
    poses = everything.of(~everything.misled)
    right = ~poses.wrong
    sure = poses.of(right)
    shown = sure.features[:, : len(model.FRAME_FEATURES)]
    spreads = [spread(shown, errors, sure.condition) for errors in (sure.turn, sure.move)]
    turn, move = widened(spreads[0], shown, sure.turn), widened(spreads[1], shown, sure.move)
    drift = float(np.ceil(np.quantile(poses.drift[right], 1.0 - DRIFT_SHARE)))
    fitted = model.IntegrityModel(
        attitude=overbound(turn, sure.condition, sure.track, TURN_BIASES),
        position=overbound(move, sure.condition, sure.track, MOVE_BIASES),
        attitude_spread=spreads[0], position_spread=spreads[1], wrong=weights,
        at_rival=float((poses.at_rival.sum() + 1) / (poses.wrong.sum() + 2)),  # Laplace's rule
        smoothing=SMOOTHING, allowance=ALLOWANCE, most=MOST, limit=max(LEAST_LIMIT, drift),
        provenance={
            "experiment": "integrity-fit", "logs": folder.name, "poses": len(poses.wrong),
            "tracks": len(np.unique(poses.track)), "wrong": int(poses.wrong.sum()),
            "misled": int(everything.misled.sum()),
            "misled_tracks": len(np.unique(everything.track[everything.misled])),
            "raised": lift, "prior": PRIOR,
        },
    )  # fmt: skip
    text = json.dumps(fitted.record(), indent=1) + "\n"
    print(text)
    if write:
        model.PACKAGED.write_text(text, encoding="utf-8")
