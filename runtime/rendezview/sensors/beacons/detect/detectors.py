"""Detections of the lights: one type for photodiodes and for pictures."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from rendezview.sensors.beacons.detect.photodiode import Normalisation, Response, place_light

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
        if not _sound(positions, sigma):
            raise ValueError("spots must have finite positions and a positive, finite sigma")
        self._set(positions, sigma, led, bool((led >= 0).all()))

    def _set(self, positions: Array, sigma: Array, led: Ints, identified: bool) -> None:
        object.__setattr__(self, "positions", positions)
        object.__setattr__(self, "sigma", sigma)
        object.__setattr__(self, "led", led)
        object.__setattr__(self, "identified", identified)

    @classmethod
    def _of_photodiode(cls, positions: Array, sigma: Array, led: Ints) -> Spots:
        """All identified and checked already: a reading takes microseconds."""
        spots = object.__new__(cls)
        spots._set(positions, sigma, led, True)
        object.__setattr__(spots, "brightness", _NO_BRIGHTNESS)
        return spots

    def __len__(self) -> int:
        return len(self.led)

    @classmethod
    def none(cls) -> Spots:
        """No light visible."""
        return cls(np.empty((0, 2)), np.empty((0, 2)), np.empty(0, np.int64))


_NO_BRIGHTNESS = np.empty(0)  # Source: by construction


@dataclass(frozen=True, slots=True, eq=False)
class Photodiode:
    """A lateral-effect photodiode whose lights are switched on one after the other.

    Raises:
        ValueError: the noise or the half-width is not positive.
    """

    response: Response
    noise: float  # r.m.s. noise of one of its currents, in the currents' unit
    half_width_m: float = 0.005  # of the sensitive area; the paper's is 1 cm × 1 cm
    # What `read_currents` asks for between the currents and its outputs.
    kernel_arguments: Any = field(init=False, repr=False)

    def __post_init__(self) -> None:
        for name in ("noise", "half_width_m"):
            value = float(getattr(self, name))
            if not 0.0 < value < np.inf:
                raise ValueError(f"{name} must be positive, not {value}")
        total = self.response.normalisation is Normalisation.TOTAL
        coefficients = np.array(self.response.coefficients)
        object.__setattr__(
            self, "kernel_arguments", (self.noise, total, coefficients, self.half_width_m)
        )

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
        positions, sigma = np.empty((len(given), 2)), np.empty((len(given), 2))
        visible = np.empty(len(given), np.bool_)
        noise, total, curve, half_width = self.kernel_arguments
        count = read_currents(given, noise, total, curve, half_width, positions, sigma, visible)
        if count == len(given):
            return Spots._of_photodiode(positions, sigma, np.arange(len(given)))
        led = np.flatnonzero(visible)
        return Spots._of_photodiode(positions[led], sigma[led], led)


@njit(cache=True, nogil=True, error_model="numpy")
def read_currents(
    currents: Array,
    noise: float,
    total: bool,
    coefficients: Array,
    half_width: float,
    positions: Array,
    sigma: Array,
    visible: npt.NDArray[np.bool_],
) -> int:
    """Fill places and standard deviations, metres, of (L, 4) currents; how many are visible."""
    count = 0
    for i in range(currents.shape[0]):
        x1, x2, y1, y2 = currents[i, 0], currents[i, 1], currents[i, 2], currents[i, 3]
        # NaN fails both comparisons
        visible[i] = min(x1 + x2, y1 + y2) > 30.0 * noise and x1 + x2 + y1 + y2 < np.inf
        if not visible[i]:
            continue
        x, y, sx, sy = place_light(x1, x2, y1, y2, noise, total, coefficients)
        visible[i] = abs(x) <= 1.05 * half_width and abs(y) <= 1.05 * half_width
        positions[i, 0], positions[i, 1], sigma[i, 0], sigma[i, 1] = x, y, sx, sy
        count += visible[i]
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def _sound(positions: Array, sigma: Array) -> bool:
    for i in range(positions.shape[0]):
        for k in range(2):
            if not (abs(positions[i, k]) < np.inf and 0.0 < sigma[i, k] < np.inf):
                return False
    return True
