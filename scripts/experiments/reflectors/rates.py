"""Rates of moving targets: the filters beside a line through eight readings, and the bound."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from experiments.frame import nees, show, table_of
from experiments.reflectors.plain import plain
from rendezview.estimation.rates import RateBank, RateOptions
from rendezview.geometry.pose import Pose
from rendezview.geometry.so3 import between

SIGMA = np.array([3e-3, 3e-3, 3e-4, 1e-3, 1e-3, 5e-3])  # rad and m: reflectors at 5 m
SECONDS, SETTLED_S = 20.0, 4.0
FINE_S = 1.0 / 600.0  # s, step of motions that are integrated


@dataclass(frozen=True, slots=True)
class Motion:
    """Poses and rates (6,) over time; the law of each part, for the bound.

    A law is the angular frequency of a swing about a steady rate, 0 where there is none, and its
    amplitudes (3,); None: the part has no law.
    """

    at: Callable[[float], tuple[Pose, np.ndarray]]
    turns: tuple[float, np.ndarray] | None
    moves: tuple[float, np.ndarray] | None


def swinging(rng: np.random.Generator, swing: float, spin: float, speed: float) -> Motion:
    """A target that swings by ``swing`` rad, turns at ``spin`` rad/s and moves to and fro."""
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)

    def at(t: float) -> tuple[Pose, np.ndarray]:
        rate = 0.7 * swing * math.cos(0.7 * t) + spin
        place = np.array([speed * math.sin(0.6 * t), 0.0, 5.0 - 0.2 * speed * t])
        velocity = [0.6 * speed * math.cos(0.6 * t), 0.0, -0.2 * speed]
        turn = plain.turn(axis, swing * math.sin(0.7 * t) + spin * t)
        return Pose(turn, place), np.append(rate * axis, velocity)

    return Motion(
        at, (0.7 if swing else 0.0, swing * axis), (0.6 if speed else 0.0, np.array([speed, 0, 0]))
    )


def integrated(turn: np.ndarray, rates: np.ndarray) -> Motion:
    """A motion from rates (N, 3) every `FINE_S` and rotations (N, 3, 3)."""

    def at(t: float) -> tuple[Pose, np.ndarray]:
        k = round(t / FINE_S)
        return Pose(turn[k], np.array([0.0, 0.0, 5.0])), np.append(rates[k], np.zeros(3))

    return Motion(at, None, (0.0, np.zeros(3)))


def tumbling(rng: np.random.Generator) -> Motion:
    """A free body with three unlike moments of inertia, Euler's equations by Runge and Kutta."""
    inertia, spin = np.array([1.0, 2.0, 2.6]), rng.normal(size=3)
    spin *= 0.17 / np.linalg.norm(spin)

    def change(w: np.ndarray) -> np.ndarray:
        return np.asarray(np.cross(inertia * w, w) / inertia)

    turn, turns, rates = np.eye(3), [], []
    for _ in range(round(SECONDS / FINE_S) + 1):
        turns.append(turn)
        rates.append(turn @ spin)
        a = change(spin)
        b = change(spin + 0.5 * FINE_S * a)
        c = change(spin + 0.5 * FINE_S * b)
        middle = spin + 0.5 * FINE_S * b
        spin = spin + FINE_S / 6.0 * (a + 2.0 * b + 2.0 * c + change(spin + FINE_S * c))
        turn = turn @ plain.turn(middle, FINE_S * float(np.linalg.norm(middle)))
    return integrated(np.array(turns), np.array(rates))


def pushed(rng: np.random.Generator) -> Motion:
    """A steady turn that a push of 3°/s² an axis (one σ) changes for a second, every six."""
    rate, turn, turns, rates = rng.normal(0.0, 0.05, 3), np.eye(3), [], []
    push = np.zeros(3)
    for k in range(round(SECONDS / FINE_S) + 1):
        if k * FINE_S % 6.0 < FINE_S:
            push = rng.normal(0.0, 0.05, 3)
        turns.append(turn)
        rates.append(rate)
        middle = rate + 0.5 * FINE_S * push * (k * FINE_S % 6.0 < 1.0)
        rate = rate + FINE_S * push * (k * FINE_S % 6.0 < 1.0)
        turn = plain.turn(middle, FINE_S * float(np.linalg.norm(middle))) @ turn
    return integrated(np.array(turns), np.array(rates))


MOTIONS: dict[str, Callable[[np.random.Generator], Motion]] = {
    "swings": lambda rng: swinging(rng, 0.25, 0.0, 0.3),
    "turns": lambda rng: swinging(rng, 0.0, 0.14, 0.1),
    "rests": lambda rng: swinging(rng, 0.0, 0.0, 0.0),
    "tumbles": tumbling,
    "pushed": pushed,
}


def bound(hertz: float, law: tuple[float, np.ndarray] | None, sigma: np.ndarray) -> float:
    """Cramér–Rao bound of three rates, r.m.s. over a run, of who knows the law of the motion.

    The law: an angle or place an axis c + b t + A sin kt + B cos kt, with one k; where k is 0,
    c + b t. All numbers are unknown, and all readings until then are used.
    """
    if law is None:
        return math.nan
    (k, amplitude), variances = law, []
    times = np.arange(0.0, SECONDS, 1.0 / hertz)
    for n in range(2, len(times) + 1):
        t, seen = times[n - 1], times[:n]
        if t < SETTLED_S:
            continue
        sine, cosine = np.sin(k * seen), np.cos(k * seen)
        own = [np.ones(n), seen, sine, cosine][: 4 if k else 2]
        ends = [0.0, 1.0, k * math.cos(k * t), -k * math.sin(k * t)][: 4 if k else 2]
        size = len(own)
        slopes, wanted = np.zeros((3, n, 3 * size + 1)), np.zeros((3, 3 * size + 1))
        for i in range(3):
            slopes[i, :, i * size : (i + 1) * size] = np.column_stack(own)
            slopes[i, :, -1] = amplitude[i] * seen * cosine
            slopes[i] /= sigma[i]
            wanted[i, i * size : (i + 1) * size] = ends
            wanted[i, -1] = amplitude[i] * (math.cos(k * t) - k * t * math.sin(k * t))
        flat = slopes.reshape(3 * n, -1)
        if not k:
            flat, wanted = flat[:, :-1], wanted[:, :-1]
        variances.append(np.trace(wanted @ np.linalg.solve(flat.T @ flat, wanted.T)) / 3.0)
    return math.sqrt(float(np.mean(variances)))


def shaken(pose: Pose, jitter_rad: float, rng: np.random.Generator) -> Pose:
    """A pose as a camera sees it that points off by a turn about all axes, one σ each."""
    turn = rng.normal(0.0, jitter_rad, 3) if jitter_rad else np.zeros(3)
    angle = float(np.linalg.norm(turn))
    return Pose(plain.turn(turn, angle) if angle else np.eye(3), np.zeros(3)) @ pose


def run(
    *, runs: int = 10, seed: int = 8, kind: str = "", least_weight: float = 0.0,
    jitter: float = 0.0,
) -> None:  # fmt: skip
    """Rates of moving targets: the filters beside a line through eight readings, same poses.

    Poses with the errors of reflectors at 5 m; errors from 4 s on. The target swings at up to
    10°/s, turns steadily at 8°/s, rests, tumbles freely with three unlike moments of inertia, or is
    pushed: 3°/s² an axis (one σ) for one second of six. The bound (Cramér–Rao) is that of the
    motion's own law with unknown numbers: no method that uses past readings and is right on average
    is below it. NEES: 6 is right, 3 of each part. --kind: the beginning of a motion.
    --least-weight: of a filter, see `RateOptions`. --jitter: pointing error of each reading, °, one
    σ about each axis; the bound does not know it.
    """
    options = RateOptions(least_weight=least_weight)
    table = table_of(
        f"{runs} runs of {SECONDS:g} s, seed {seed}, jitter {jitter:g}°; rms of turn, °/s, and "
        "velocity, mm/s",
        "motion | Hz | turn: line | ours | bound | mm/s: line | ours | bound"
        " | NEES | median | of turns | of velocities",
        left=1,
    )
    for name, make in MOTIONS.items():
        if not name.startswith(kind):
            continue
        for hertz in (2.0, 5.0, 10.0, 30.0):
            rng, ours, line, errors, bounds = np.random.default_rng(seed), [], [], [], []
            for _ in range(runs):
                motion, bank, kept = make(rng), RateBank(options), []
                bounds.append(
                    (bound(hertz, motion.turns, SIGMA[:3]), bound(hertz, motion.moves, SIGMA[3:]))
                )
                for t in np.arange(0.0, SECONDS, 1.0 / hertz):
                    true, truth = motion.at(float(t))
                    seen = shaken(true, math.radians(jitter), rng)
                    pose = seen.perturbed(rng.normal(0.0, SIGMA))
                    found = bank.add(float(t), pose, np.diag(SIGMA**2))
                    kept = [*kept, (float(t), pose)][-8:]
                    if found is None or t < SETTLED_S:
                        continue
                    times = np.array([k[0] for k in kept])
                    turns = [between(k[1].rotation, pose.rotation) for k in kept]
                    moves = [k[1].translation_m for k in kept]
                    line.append(np.polyfit(times, np.hstack([turns, moves]), 1)[0] - truth)
                    ours.append(found.rates - truth)
                    own = found.covariance
                    parts = nees(ours[-1][:3], own[:3, :3]), nees(ours[-1][3:], own[3:, 3:])
                    errors.append((nees(ours[-1], own), *parts))
            cells, least = [], np.sqrt(np.mean(np.square(bounds), axis=0))
            for part, unit in ((0, math.degrees(1.0)), (1, 1e3)):
                own = slice(3 * part, 3 * part + 3)
                for values in (line, ours):
                    rms = math.sqrt(float(np.mean(np.square(np.array(values)[:, own]))))
                    cells.append(f"{unit * rms:.3f}")
                cells.append(f"{unit * least[part]:.3f}" if math.isfinite(least[part]) else "–")
            mean, of_turns, of_moves = np.mean(errors, axis=0)
            cells += [f"{x:.1f}" for x in (mean, np.median(errors, axis=0)[0], of_turns, of_moves)]
            table.add_row(name, f"{hertz:g}", *cells)
    show(table)
