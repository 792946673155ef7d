"""Where the reflectors of a pattern are, from a run of readings or a length that was measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rendezview.calibration.pattern.belief import WIDEST, Belief, weigh
from rendezview.calibration.pattern.bundle import Information, Run
from rendezview.calibration.pattern.sightings import FEWEST_SPOTS, KnownLength, Sighting
from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array
from rendezview.sensors.beacons.constellation import ReflectorPattern
from rendezview.sensors.beacons.match.acquisition import merged

_NAMED, _SUSPECT = 0.99, 0.1  # probability. Source: by construction
_ITERATIONS = 20  # Source: by construction, a bound only
_SETTLED = 0.01  # σ of the places. Source: by construction
# px: what all readings of a spot may be off by. Source: experiment reflector-accuracy, 3 m
_COMMON_PX = 0.01
_OTHER = 1.25  # × a distance in the file: a length of others. Source: by construction


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredPattern:
    """A pattern as it was measured. Its frame and size are those of the file (see `moved_m`)."""

    pattern: ReflectorPattern  # corrected; its σ cover every direction, and all reflectors together
    moved_m: Array  # (N, 3) beside the places in the file, target frame
    covariance: Array  # (3N, 3N) of these
    off: Array  # (N,) probability of each to be off by more than the others
    used: int  # readings
    given: int  # readings
    noise: float  # r.m.s. residual over the spots' σ, at least 1
    size: float  # over that of the file
    size_sigma: float
    roll_ambiguous: bool  # the names may be those of half a turn

    @property
    def named(self) -> tuple[str, ...]:
        """The reflectors that are off, each with a probability of 99 % or more."""
        return tuple(
            name for name, p in zip(self.pattern.names, self.off, strict=True) if p > _NAMED
        )

    @property
    def suspects(self) -> tuple[str, ...]:
        """Those that may be off, each with a probability of 10 to 99 %."""
        return tuple(
            name
            for name, p in zip(self.pattern.names, self.off, strict=True)
            if _SUSPECT < p <= _NAMED
        )


def measure_pattern(
    camera: Camera | None,
    patterns: Sequence[ReflectorPattern],
    sightings: Sequence[Sighting],
    *,
    lengths: Sequence[KnownLength] = (),
    blur_px: float = 0.75,
) -> MeasuredPattern:
    """The places of reflectors, the one that is off, and the σ of each place.

    One camera sees neither where on the target the pattern is nor its size. The reflectors that
    are not off fix both: they are where the file says, within the σ that it states or, where it
    states none, within a tolerance that the run shows. A length fixes the size instead.

    Args:
        camera: of the run, with its distortion and covariance; None without a run.
        patterns: the groups that there are, as `patterns_of` gives them; all are one body.
        sightings: of `sightings_of_readings` or `sightings_of_log`; none with a length only.
        lengths: that were measured.
        blur_px: σ of the optics and a pixel's width together.

    Raises:
        RendezviewError: nothing tells of the places, or the spots fit no rigid pattern.
    """
    pattern, base = merged(list(patterns)), max(each.base_m for each in patterns)
    if not sightings and not lengths:
        raise RendezviewError(
            "three reflectors always fit: their spots say nothing of their places; give a --length"
            if len(pattern) < FEWEST_SPOTS
            else "no reading has a pose of four or more spots: their places cannot be told"
        )
    if sightings and camera is None:
        raise ValueError("sightings need their camera")
    run = Run(camera, pattern, list(sightings), blur_px) if sightings and camera else None
    arms = pattern.positions_m - pattern.centre_m
    sigmas = pattern.sigmas_m.copy()
    if not all(each.sigmas_known for each in patterns):
        sigmas[sigmas == 0.0] = np.nan
    known = _of_lengths(pattern, lengths)
    prior = _Prior(known, arms, sigmas, base, bool(lengths))
    if run is None:
        belief = prior.against(None)
    else:
        belief = _settled(run, prior, np.zeros(3 * len(pattern)))
        while run.drop_strangers(WIDEST * base):
            belief = _settled(run, prior, belief.moved_m)
        belief = _settled(run, prior, belief.moved_m)  # with the noise that there is
    shifts = belief.moved_m.reshape(-1, 3)
    along = arms.ravel() / (arms**2).sum()
    ends = replace(
        pattern, positions_m=pattern.positions_m + shifts, sigmas_m=_single(belief.covariance),
        sigmas_known=True,
    )  # fmt: skip
    used, noise = (0, 1.0) if run is None else (len(run), run.noise)
    return MeasuredPattern(
        ends, shifts, belief.covariance, belief.off, used, len(sightings), noise,
        1.0 + float(along @ belief.moved_m), float(along @ belief.covariance @ along) ** 0.5,
        any(s.roll_ambiguous for s in sightings),
    )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class _Prior:
    """What is known of the places without a run."""

    lengths: Information
    arms: Array  # (N, 3) places of the file about their middle
    sigmas: Array  # (N,) that the file states, or NaN
    base_m: float
    size_open: bool

    def against(self, run: Run | None) -> Belief:
        """The posterior with a run."""
        told, least_m = self.lengths, 0.0
        if run is not None:
            seen, least_m = run.information(), _COMMON_PX * run.nearest_m / run.focal_px
            told = Information(told.matrix + seen.matrix, told.vector + seen.vector)
        return weigh(told, self.arms, self.sigmas, self.base_m, least_m, self.size_open)


def _settled(run: Run, prior: _Prior, moved_m: Array) -> Belief:
    """The posterior about its own mean."""
    for _ in range(_ITERATIONS):
        belief = prior.against(run)
        step, moved_m = belief.moved_m - moved_m, belief.moved_m
        run.move_to(moved_m)
        if (np.abs(step) <= _SETTLED * np.sqrt(np.diag(belief.covariance))).all():
            break
    return belief


def _of_lengths(pattern: ReflectorPattern, lengths: Sequence[KnownLength]) -> Information:
    """What lengths tell: along the line of two reflectors, their difference."""
    matrix, vector = np.zeros((3 * len(pattern),) * 2), np.zeros(3 * len(pattern))
    for known in lengths:
        unknown = {known.first, known.second} - set(pattern.names)
        if unknown or known.first == known.second:
            raise RendezviewError(
                f"a length is between two of {', '.join(pattern.names)}, not "
                f"{known.first!r} and {known.second!r}"
            )
        i, j = pattern.names.index(known.first), pattern.names.index(known.second)
        line = pattern.positions_m[j] - pattern.positions_m[i]
        far = float(np.linalg.norm(line))
        if not (known.sigma_m > 0.0 and 1.0 / _OTHER < known.length_m / far < _OTHER):
            raise RendezviewError(
                f"{known.first} and {known.second} are {far:.6g} m apart in the file: a length of "
                f"{known.length_m:.6g} ± {known.sigma_m:.2g} m cannot be theirs"
            )
        row = np.zeros((len(pattern), 3))
        row[i], row[j] = -line / far, line / far
        row = row.ravel() / known.sigma_m
        matrix += np.outer(row, row)
        vector += row * (known.length_m - far) / known.sigma_m
    return Information(matrix, vector)


def _single(covariance: Array) -> Array:
    """(N,) σ of independent places that is nowhere less than a covariance (3N, 3N)."""
    own = covariance.reshape(len(covariance) // 3, 3, -1, 3)
    largest = np.array([np.linalg.eigvalsh(own[k, :, k])[-1] for k in range(len(covariance) // 3)])
    sigma = np.sqrt(np.repeat(largest, 3))
    more = np.linalg.eigvalsh(covariance / np.outer(sigma, sigma))[-1]
    return np.asarray(np.sqrt(largest * more))
