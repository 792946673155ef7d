"""The circles of a pass: which ellipses of its frames are pictures of one circle.

With a panel's pose, an ellipse is one circle for each distance D of a plane parallel to the panel.
The middle and radius of that circle are linear in D. So two frames give a circle by linear least
squares, and every other ellipse either agrees with it or does not. The panel's sides, the same in
every frame, are estimated with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
from scipy.special import chdtri

from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array
from rendezview.sensors.ring.ring_size import RingSight, circle_line

Bools = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]
T = TypeVar("T")

_RISK = 1 / 5000  # that noise exceeds a limit of χ². Source: by construction
COMMON, FREEDOM = 6, 8  # unknowns of a pass, numbers of an ellipse. Source: by construction
# χ² of an ellipse beside a circle, and of two beside theirs. Source: by construction, χ²
# distribution
FAR, _FAR_PAIR = chdtri((FREEDOM, 2 * FREEDOM - COMMON), _RISK)
_SURE_SHARE = 0.05  # σ of R over R, of a pair that may name a circle. Source: by construction
_START_FRAMES = 24  # whose ellipses name circles. Source: by construction, a bound of time
_TINY = 1e-6  # information on a length, m⁻². Source: by construction, less than any picture's
_ROUNDS = 3  # of members and their circle. Source: by construction


@dataclass(frozen=True, slots=True, eq=False)
class PassCircle:
    """A circle that several frames agree on, in the panel's frame."""

    numbers: Array  # (6,) radius, distance of its plane, y, z of its middle; the panel's sides; m
    covariance: Array  # (6, 6)
    members: dict[int, int]  # number of its ellipse, by frame

    @property
    def radius_m(self) -> float:
        """Its radius."""
        return float(self.numbers[0])

    @property
    def distance_m(self) -> float:
        """Of its plane from the panel's."""
        return float(self.numbers[1])

    @property
    def offset_m(self) -> Array:
        """(2,) y, z of its middle."""
        return self.numbers[2:4]

    def of(self, table: Sequence[Sequence[T]]) -> list[T]:
        """What a table of all frames and ellipses has of its members."""
        return [table[frame][k] for frame, k in self.members.items()]


class Ellipses:
    """The E ellipses of a pass as circles before the panel; those that are none are left out.

    Eight numbers of each, see `circle_line`: ``start + D rate``. Their errors are ``errors + D
    error_rates`` times 14 unit normals.
    """

    def __init__(self, camera: Camera, sights: Sequence[Sequence[RingSight]]) -> None:
        """``sights``: of each frame."""
        index, lines, errors = [], [], []
        for k, of_frame in enumerate(sights):
            for i, sight in enumerate(of_frame):
                found = circle_line(camera, sight)
                if found is not None:
                    index.append((k, i))
                    lines.append(found[0])
                    errors.append(found[1])
        self.index = np.array(index, dtype=np.int64).reshape(-1, 2)  # (E, 2) frame, ellipse
        line = np.array(lines).reshape(-1, FREEDOM, 2)
        error = np.array(errors).reshape(-1, FREEDOM, 2, 14)
        self.start, self.rate = line[..., 0], line[..., 1]
        self.errors, self.error_rates = error[:, :, 0], error[:, :, 1]
        # Slopes (E, 8, 6) of what is left by radius, distance, offset and sides.
        self.slopes = np.zeros((len(line), FREEDOM, COMMON))
        self.slopes[:, [2, 0, 1, 5, 6], [0, 2, 3, 4, 5]] = -1.0
        self.slopes[:, :, 1] = self.rate

    def __len__(self) -> int:
        return len(self.index)

    def covariances(self, distance_m: npt.ArrayLike, which: Any = slice(None)) -> Array:
        """(K, 8, 8) of the numbers of ellipses ``which`` at distances (K,) or one of all, m²."""
        far = np.asarray(distance_m, dtype=np.float64)[..., None, None]
        roots = self.errors[which] + far * self.error_rates[which]
        return np.asarray(roots @ roots.transpose(0, 2, 1))

    def radii(self, distance_m: float) -> tuple[Array, Array]:
        """(E,) radii at a distance and their σ, m."""
        sigma = np.sqrt(self.covariances(distance_m)[:, 2, 2])
        return self.start[:, 2] + self.rate[:, 2] * distance_m, sigma

    def misfits(self, numbers: Array, covariance: Array) -> Array:
        """(E,) χ² of each ellipse with a circle (6,) and its covariance (6, 6)."""
        left = self.start + self.slopes @ numbers
        spread = self.covariances(numbers[1])
        spread += self.slopes @ covariance @ self.slopes.transpose(0, 2, 1)
        return np.asarray(np.sum(left * np.linalg.solve(spread, left[..., None])[..., 0], axis=1))

    def equations(self, distance_m: npt.ArrayLike, which: Any) -> tuple[Array, Array, Array]:
        """(K, 6, 6), (K, 6) normal equations of a circle by each ellipse, (K,) squares at zero."""
        weights = np.linalg.inv(self.covariances(distance_m, which))
        start, slopes = self.start[which][..., None], self.slopes[which]
        turned = slopes.transpose(0, 2, 1) @ weights
        squares = (start.transpose(0, 2, 1) @ weights @ start)[:, 0, 0]
        return turned @ slopes, -(turned @ start)[..., 0], squares

    def circle(
        self, distance_m: float, which: Ints, prior: npt.ArrayLike = 0.0
    ) -> tuple[Array, Array, float]:
        """(6,), covariance (6, 6) and χ² of the circle of some ellipses, near a distance.

        ``prior``: information on each number being zero, m⁻².
        """
        normal, right, squares = (part.sum(axis=0) for part in self.equations(distance_m, which))
        covariance = np.linalg.inv(normal + np.asarray(prior) * np.eye(COMMON))
        numbers = covariance @ right
        return numbers, covariance, float(squares - right @ numbers)


def circles_of_pass(ellipses: Ellipses, least_frames: int) -> list[PassCircle]:
    """Circles that so many frames or more agree on, of most frames first."""
    left = np.ones(len(ellipses), dtype=bool)
    starts = _starts(ellipses)
    found: list[PassCircle] = []
    while left.any():
        grown = [_grown(ellipses, *start, left) for one, start in starts if left[one]]
        kept = [one for one in grown if one is not None and len(one[1]) >= least_frames]
        best = max(kept, key=lambda one: (len(one[1]), -one[2]), default=None)
        if best is None:
            break
        circle, which, chi2 = best
        # Edges of two bodies that follow one another are one ellipse, and fit badly.
        if chi2 < chdtri(FREEDOM * len(which) - COMMON, _RISK):
            found.append(circle)
        left[which] = False
        left &= ellipses.misfits(circle.numbers, circle.covariance) > FAR  # two of one edge
    return found


def _grown(
    ellipses: Ellipses, numbers: Array, covariance: Array, left: Bools
) -> tuple[PassCircle, Ints, float] | None:
    """The circle of all ellipses that agree with a first one, their numbers, and χ²."""
    chi2 = 0.0
    for _ in range(_ROUNDS):
        misfits = ellipses.misfits(numbers, covariance)
        near = np.flatnonzero(left & (misfits < FAR))
        order = near[np.argsort(-misfits[near])]
        nearest = {int(ellipses.index[k, 0]): int(k) for k in order}  # of a frame, the last one
        if len(nearest) < 2:
            return None
        which = np.array(sorted(nearest.values()))
        numbers, covariance, chi2 = ellipses.circle(float(numbers[1]), which)
        if not numbers[0] > 0.0:
            return None
    members = {int(frame): int(k) for frame, k in ellipses.index[which]}
    return PassCircle(numbers, covariance, members), which, chi2


def _starts(ellipses: Ellipses) -> list[tuple[int, tuple[Array, Array]]]:
    """Of each ellipse the surest circle that it gives with one of another frame."""
    frame = ellipses.index[:, 0]
    frames = np.unique(frame)
    few = frames[np.linspace(0, len(frames) - 1, min(len(frames), _START_FRAMES)).astype(np.int64)]
    of_few = np.isin(frame, few)
    one, other = np.nonzero((frame[:, None] != frame) & of_few[:, None] & of_few)
    start, rate = (x[one, :3] - x[other, :3] for x in (ellipses.start, ellipses.rate))
    far = -np.sum(start * rate, axis=1) / np.fmax(np.sum(rate * rate, axis=1), _TINY)
    parts = zip(ellipses.equations(far, one), ellipses.equations(far, other), strict=True)
    normal, right, squares = (a + b for a, b in parts)
    covariance = np.linalg.inv(
        normal + _TINY * np.eye(COMMON)
    )  # two like pictures give no distance
    numbers = (covariance @ right[..., None])[..., 0]
    misfit = squares - np.sum(right * numbers, axis=1)
    sigma = np.sqrt(covariance[:, 0, 0])
    good = (misfit < _FAR_PAIR) & (sigma < _SURE_SHARE * numbers[:, 0])
    surest = {int(one[k]): k for k in np.flatnonzero(good)[np.argsort(-sigma[good])]}
    return [(i, (numbers[k], covariance[k])) for i, k in sorted(surest.items())]
