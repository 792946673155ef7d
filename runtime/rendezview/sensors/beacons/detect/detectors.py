"""Detections of the lights: one type for photodiodes and for pictures."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from rendezview.sensors.beacons.detect.photodiode import Response

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

UNKNOWN = -1  # the number of a light whose identity is not known. Source: by construction


@dataclass(frozen=True, slots=True, eq=False)
class Spots:
    """Places of lights on one camera's detector, in its own units (pixels, or metres)."""

    positions: Array  # (N, 2)
    sigma: Array  # (N, 2) standard deviation of each coordinate
    led: Ints  # (N,) which of the target's lights, or UNKNOWN
    brightness: Array = field(default_factory=lambda: np.empty(0))  # (N,) any unit, or empty
    identified: bool = field(init=False)  # whether every light is known by its number

    def __post_init__(self) -> None:
        positions = np.ascontiguousarray(self.positions, dtype=np.float64)
        sigma = np.ascontiguousarray(self.sigma, dtype=np.float64)
        led = np.ascontiguousarray(self.led, dtype=np.int64)
        count = len(led) if led.ndim == 1 else -1
        if positions.shape != (count, 2) or sigma.shape != (count, 2):
            raise ValueError(
                f"spots need positions (N, 2), sigma (N, 2) and led (N,), not "
                f"{positions.shape}, {sigma.shape}, {led.shape}"
            )
        if not (np.isfinite([positions, sigma]).all() and (sigma > 0.0).all()):
            raise ValueError("spots must have finite positions and a positive, finite sigma")
        object.__setattr__(self, "positions", positions)
        object.__setattr__(self, "sigma", sigma)
        object.__setattr__(self, "led", led)
        object.__setattr__(self, "identified", bool((led >= 0).all()))

    def __len__(self) -> int:
        return len(self.led)

    @classmethod
    def none(cls) -> Spots:
        """No light visible."""
        return cls(np.empty((0, 2)), np.empty((0, 2)), np.empty(0, np.int64))


@dataclass(frozen=True, slots=True, eq=False)
class Photodiode:
    """A lateral-effect photodiode whose lights are switched on one after the other.

    Raises:
        ValueError: the noise or the half-width is not positive.
    """

    response: Response
    noise: float  # r.m.s. noise of one of its currents, in the currents' unit
    half_width_m: float = 0.005  # of the sensitive area; the paper's is 1 cm × 1 cm

    def __post_init__(self) -> None:
        for name in ("noise", "half_width_m"):
            value = float(getattr(self, name))
            if not 0.0 < value < np.inf:
                raise ValueError(f"{name} must be positive, not {value}")

    def read(self, currents: npt.ArrayLike) -> Spots:
        """The lights of one sequence: (L, 4) currents x1 x2 y1 y2, row k for light k.

        A light that is too weak for a place to a twentieth of the detector, not finite, or
        off the detector is not visible.

        Raises:
            ValueError: not (L, 4).
        """
        given = np.ascontiguousarray(currents, dtype=np.float64)
        if given.ndim != 2 or given.shape[1] != 4:
            raise ValueError(f"currents must be (lights, 4), not {given.shape}")
        weakest = given.reshape(-1, 2, 2).sum(axis=2).min(axis=1)  # NaN fails the comparison
        led = np.flatnonzero((weakest > 30.0 * self.noise) & np.isfinite(given).all(axis=1))
        positions, sigma = self.response.places(given[led], self.noise)
        inside = (np.abs(positions) <= 1.05 * self.half_width_m).all(axis=1)
        return Spots(positions[inside], sigma[inside], led[inside])
