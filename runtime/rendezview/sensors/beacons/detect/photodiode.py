"""The response of a lateral-effect photodiode, and its correction (Welch et al., eq. 1, 2, 5)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

# Source: by construction
TERMS = {3: 10, 5: 21}  # of a polynomial's order: the paper's cubic, and a quintic
# Powers of x and y after the cubic's, in order.
# Source: by construction, all terms of degree 4 and 5
_QUINTIC = tuple((n - j, j) for n in (4, 5) for j in range(n + 1))
_FEWEST_FOR_EACH_TERM = 4  # places a coefficient. Source: by construction


class Normalisation(StrEnum):
    """The divisor of a difference of currents."""

    PAIR = "pair"  # x1 + x2 and y1 + y2, eq. 1 and 2
    TOTAL = "total"  # the mean of the two: the least-squares answer where both pairs share the
    # light equally, because then four currents determine three unknowns (light, x, y)


@dataclass(frozen=True, slots=True, eq=False)
class Response:
    """A polynomial for each axis from a reading of eq. 1, 2 to metres on the detector, eq. 5.

    The paper's has ten coefficients; 21 continue it to the fifth order, for a detector that
    bends more than a cubic can follow.
    """

    coefficients: Array  # (2, 10): a1 … a10 and b1 … b10; or (2, 21)
    normalisation: Normalisation = Normalisation.TOTAL

    def __post_init__(self) -> None:
        values = np.array(self.coefficients, dtype=np.float64)
        if values.shape not in [(2, n) for n in TERMS.values()] or not np.isfinite(values).all():
            raise ValueError(f"a response has (2, 10) or (2, 21) numbers, not {values.shape}")
        values.setflags(write=False)
        object.__setattr__(self, "coefficients", values)
        object.__setattr__(self, "normalisation", Normalisation(self.normalisation))

    @classmethod
    def linear(
        cls, half_width_m: float, normalisation: Normalisation = Normalisation.TOTAL
    ) -> Response:
        """A perfect detector: ±1 is its edge."""
        coefficients = np.zeros((2, TERMS[3]))
        coefficients[0, 1] = coefficients[1, 2] = half_width_m
        return cls(coefficients, normalisation)

    def positions(self, currents: npt.ArrayLike) -> Array:
        """(..., 4) currents x1 x2 y1 y2 → (..., 2) metres on the detector."""
        return self.terms(currents) @ self.coefficients.T

    def terms(self, currents: npt.ArrayLike) -> Array:
        """(..., 4) currents → (..., 10 or 21) terms of eq. 5."""
        return terms(ratios(currents, self.normalisation), self.order)

    def places(self, currents: Array, noise: float) -> tuple[Array, Array]:
        """(N, 4) currents → places on the detector and standard deviations (N, 2), metres.

        ``noise`` is the r.m.s. noise of one current. By eq. 1 ``var x = noise² 2 (1 + x²) /
        (x1 + x2)²``, with half the x² for a common divisor. Slopes of eq. 5 by the complex step.
        """
        sums, share = currents.reshape(-1, 2, 2).sum(axis=2), 1.0
        if self.normalisation is Normalisation.TOTAL:
            sums, share = np.repeat(sums.mean(axis=1, keepdims=True), 2, axis=1), 0.5
        reading = ratios(currents, self.normalisation)
        sigma = noise * np.sqrt(2.0 * (1.0 + share * reading**2)) / sums
        ends = [terms(reading + 1e-30j * axis, self.order) for axis in np.eye(2)]
        slopes = np.stack([(end @ self.coefficients.T).imag / 1e-30 for end in ends], axis=2)
        spread = np.sqrt(((slopes * sigma[:, None]) ** 2).sum(axis=2))
        return terms(reading, self.order) @ self.coefficients.T, spread

    @property
    def order(self) -> int:
        """3 as in the paper, or 5."""
        return 3 if self.coefficients.shape[1] == TERMS[3] else 5


@dataclass(frozen=True, slots=True, eq=False)
class ResponseFit:
    """A response with its statistics from the scan."""

    response: Response
    covariance: Array  # (2, T, T) of each axis' coefficients
    residuals_m: Array  # (N, 2) corrected reading less beam
    linear_residuals_m: Array  # (N, 2) the same with the best affine map in place of the cubic
    electrode_sigma: float | None  # r.m.s. noise of one current of one scan; None: one scan only

    @property
    def rms_m(self) -> float:
        """Residual, r.m.s. over both axes, counting the degrees of freedom."""
        free = self.residuals_m.size - self.response.coefficients.size
        return float(np.sqrt((self.residuals_m**2).sum() / free))

    @property
    def linear_rms_m(self) -> float:
        """The same for the best affine map."""
        free = self.linear_residuals_m.size - 6
        return float(np.sqrt((self.linear_residuals_m**2).sum() / free))


def fit_response(
    beam_m: npt.ArrayLike,
    currents: npt.ArrayLike,
    normalisation: Normalisation = Normalisation.TOTAL,
    order: int = 3,
) -> ResponseFit:
    """Least-squares coefficients of eq. 5 from a scan of the detector.

    Args:
        beam_m: (N, 2) where the beam struck, metres; the paper's 30 × 30 places.
        currents: (N, 4), or (S, N, 4) for S scans, which are averaged (the paper's 60).
        normalisation: of eq. 1 and 2.
        order: 3 as in the paper, or 5.

    Raises:
        ValueError: shapes that do not fit, fewer than 4 places for each term, numbers not
            finite, or places that do not determine the curve (all on a line).
    """
    beam = np.asarray(beam_m, dtype=np.float64)
    scans = np.asarray(currents, dtype=np.float64)
    if beam.ndim != 2 or beam.shape[1] != 2 or scans.shape[-2:] != (len(beam), 4):
        raise ValueError(
            f"beam_m must be (N, 2) and currents ([S,] N, 4), not {beam.shape}, {scans.shape}"
        )
    if order not in TERMS:
        raise ValueError(f"order must be 3 or 5, not {order}")
    if scans.ndim not in (2, 3) or len(beam) < _FEWEST_FOR_EACH_TERM * TERMS[order]:
        raise ValueError(
            f"a scan needs at least {_FEWEST_FOR_EACH_TERM * TERMS[order]} places, not {len(beam)}"
        )
    if not (np.isfinite(beam).all() and np.isfinite(scans).all()):
        raise ValueError("a scan must be finite: leave out what was not read")
    electrode_sigma = None
    if scans.ndim == 3:
        if len(scans) > 1:
            electrode_sigma = float(np.sqrt(scans.var(axis=0, ddof=1).mean()))
        scans = scans.mean(axis=0)
    reading = ratios(scans, normalisation)
    if not np.isfinite(reading).all():
        raise ValueError("a place of the scan has no light: its currents sum to nothing")
    matrix = terms(reading, order)
    if np.linalg.matrix_rank(matrix) < TERMS[order]:
        raise ValueError("the scan's places do not determine the curve: spread them over the area")
    solution, *_ = np.linalg.lstsq(matrix, beam, rcond=None)
    residuals = matrix @ solution - beam
    spread = np.linalg.inv(matrix.T @ matrix)
    variance = (residuals**2).sum(axis=0) / (len(beam) - TERMS[order])
    affine, *_ = np.linalg.lstsq(matrix[:, :3], beam, rcond=None)
    return ResponseFit(
        Response(np.asarray(solution.T, np.float64), normalisation),
        variance[:, None, None] * spread,
        residuals,
        matrix[:, :3] @ affine - beam,
        electrode_sigma,
    )


def ratios(currents: npt.ArrayLike, normalisation: Normalisation) -> Array:
    """Eq. 1 and 2: (..., 4) currents x1 x2 y1 y2 → (..., 2); NaN where there is no light."""
    given = np.asarray(currents, dtype=np.float64)
    x1, x2, y1, y2 = np.moveaxis(given, -1, 0)
    sum_x, sum_y = x1 + x2, y1 + y2
    if normalisation is Normalisation.TOTAL:
        sum_x = sum_y = 0.5 * (sum_x + sum_y)
    with np.errstate(divide="ignore", invalid="ignore"):
        both = np.stack([(x1 - x2) / sum_x, (y1 - y2) / sum_y], axis=-1)
    return np.where(np.stack([sum_x, sum_y], axis=-1) > 0.0, both, np.nan)


def terms(reading: npt.NDArray[Any], order: int) -> npt.NDArray[Any]:
    """(..., 2) → (..., 10): the terms of eq. 5 in its order; for order 5 (..., 21)."""
    x, y = reading[..., 0], reading[..., 1]
    columns = [np.ones_like(x), x, y, x * y, x * x, y * y, x * x * y, x * y * y, x**3, y**3]
    if order == 5:
        columns += [x**i * y**j for i, j in _QUINTIC]
    return np.stack(columns, axis=-1)
