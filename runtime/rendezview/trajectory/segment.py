"""The fit of a segment to a point cloud, its uncertainty, and where it leads."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from rendezview.geometry import so3
from rendezview.geometry.pose import Array
from rendezview.trajectory.cloud import PointCloud
from rendezview.trajectory.descent import CUT, Descent, Method, descend
from rendezview.trajectory.no_fit import NoFit
from rendezview.trajectory.scaling import inverse_of, sigmas_of, solved, typical_sizes
from rendezview.trajectory.shapes import (
    HOPS,
    SPIRAL,
    Shape,
    code_of,
    frame_of,
    places,
)
from rendezview.trajectory.simplex import (
    RESIDUALS,
    jacobian,
    normal_equations,
    residuals,
)
from rendezview.trajectory.start import first_guess

Carrier = Callable[[Array], Array]  # times (N,) s to places (N, 3) m

_LEAST_FRAMES = 6  # Source: by construction, the six unknowns of an orbit
_MOST_CORRELATED = 0.9  # Source: by construction, a bound only
# Of a point's claimed σ, what all points of a segment may have in common, and half as much
# again as goes with time and its square: views alike err alike. On active nodes, poses; nodes:
# fitted to seeds 1000–1003; poses: r.m.s. over 1000–1002. Source: experiment
# trajectory-accuracy.
_COMMON = (0.35, 1.1)


@dataclass(frozen=True, kw_only=True)
class FitOptions:
    """How a segment is fitted."""

    method: Method = Method.BEST  # Source: experiment trajectory-methods (0.1), seed 1
    hops: bool = True  # look for hops of a V-bar approach
    # Of circular and spiral: a less certain rate is rejected. Source: normal distribution, 0.3 %
    least_turn_sigma: float = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class Segment:
    """A fitted segment: places at any time, in the path frame, with their covariance."""

    shape: Shape
    start_s: float
    end_s: float
    middle_s: float  # times of the parameters count from here
    parameters: Array  # (P,) see ``shapes``
    covariance: Array  # (P, P)
    frames: int
    points: int
    scatter: tuple[float, float]  # of active nodes, of poses: over what they claim
    gap_sigma: float  # largest step of Gauss–Newton from the answer, in σ
    evaluations: int  # of the simplex; 0: Gauss–Newton alone
    cost: float  # robust χ², of unscaled points
    code: int
    base: Array  # (3, 3)
    constants: Array  # mean motion rad/s, closing of hops 1/s
    carrier: Carrier | None = None

    def places(self, times_s: npt.ArrayLike) -> Array:
        """(N, 3) m at times (N,) s."""
        times = np.atleast_1d(np.asarray(times_s, np.float64))
        out = self._shape_places(self.parameters, times)
        return out if self.carrier is None else out + self.carrier(times)

    def velocity(self, time_s: float) -> Array:
        """(3,) m/s at a time."""
        step = self._step_s
        after, before = self.places([time_s + step, time_s - step])
        return np.asarray((after - before) / (2.0 * step))

    def place_covariance(self, time_s: float) -> Array:
        """(3, 3) m² of the place at a time, within the segment or beyond."""
        lever = self._lever(np.array([time_s]))[0]
        return np.asarray(lever @ self.covariance @ lever.T)

    def state_covariance(self, time_s: float) -> Array:
        """(6, 6) of place, m, and velocity, m/s, at a time, within the segment or beyond."""
        step = self._step_s
        at, after, before = self._lever(np.array([time_s, time_s + step, time_s - step]))
        lever = np.vstack([at, (after - before) / (2.0 * step)])
        return np.asarray(lever @ self.covariance @ lever.T)

    @property
    def _step_s(self) -> float:
        """Of differences in time."""
        return 1e-4 * max(self.end_s - self.start_s, 1e-3)

    def _lever(self, times_s: Array) -> Array:
        """(N, 3, P) change of the places by the parameters."""
        lever = np.empty((len(times_s), 3, len(self.parameters)))
        sigmas = np.sqrt(np.diag(self.covariance))
        for j, sigma in enumerate(sigmas):
            step = np.zeros(len(sigmas))
            step[j] = 1e-3 * sigma + 1e-15
            ahead = self._shape_places(self.parameters + step, times_s)
            behind = self._shape_places(self.parameters - step, times_s)
            lever[:, :, j] = (ahead - behind) / (2.0 * step[j])
        return lever

    def _shape_places(self, parameters: Array, times_s: Array) -> Array:
        out = np.empty((len(times_s), 3))
        places(self.code, parameters, times_s - self.middle_s, self.base, self.constants, out)
        return out

    @property
    def frame(self) -> Array:
        """(3, 3) of circular and spiral: columns towards the middle's place, ahead, normal."""
        return np.asarray(self.base @ so3.exp(self.parameters[:3]))

    @property
    def rate_rad_s(self) -> float | None:
        """Of circular and spiral, positive about ``frame[:, 2]``."""
        return float(self.parameters[4]) if self.code <= SPIRAL else None

    def described(self) -> dict[str, object]:
        """The parameters by name, with units, each with its one σ where it has one of its own."""
        p, sigma = self.parameters, np.sqrt(np.diag(self.covariance))
        if self.code <= SPIRAL:
            record: dict[str, object] = {
                "normal": self.frame[:, 2],
                "normal_sigma_rad": sigma[:2],
                "radius_m": p[3],
                "radius_sigma_m": sigma[3],
                "rate_rad_s": p[4],
                "rate_sigma_rad_s": sigma[4],
            }
            if self.code == SPIRAL:
                record |= {"climb_m_s": p[5], "climb_sigma_m_s": sigma[5]}
            return record
        record = {
            "place_m": p[:3],
            "place_sigma_m": sigma[:3],
            "velocity_m_s": p[3:6],
            "velocity_sigma_m_s": sigma[3:6],
        }
        if self.code == HOPS:
            record |= {"hop_m": p[6:9], "hop_sigma_m": sigma[6:9], "hop_period_s": p[9]}
            record |= {"hop_period_sigma_s": sigma[9], "hop_start_s": self.middle_s + p[10]}
        elif self.shape is Shape.DRIFT:
            record |= {"acceleration_m_s2": p[6:9], "acceleration_sigma_m_s2": sigma[6:9]}
        return record


def fit_segment(
    cloud: PointCloud,
    shape: Shape,
    *,
    mean_motion_rad_s: float = 0.0,
    carrier: Carrier | None = None,
    previous: Segment | None = None,
    options: FitOptions | None = None,
) -> Segment | NoFit:
    """The segment of a shape that fits a cloud best, by a robust cost.

    Cleghorn & Sternberg (1991), "Trajectory": the downhill simplex is theirs, as are circular,
    spiral and V-bar. See ``descent`` for the simplex, Gauss–Newton, and when each is used.

    Args:
        cloud: points about the path's centre.
        mean_motion_rad_s: of orbit and drift, whose axes must then be Hill's.
        carrier: a path that the shape is a deviation from; for orbit and drift, whose thrusts
            are then the carrier's own.
        previous: the fit to the points so far: where to start.

    Returns:
        The segment, or why there is none. The covariance of its parameters takes the points' own
        scatter, lets those of one frame err together, and neighbouring frames as much as their
        misfits say.
    """
    options = options or FitOptions()
    code = code_of(shape)
    trouble = cloud.trouble(_LEAST_FRAMES)
    if trouble is not None:
        return trouble
    start_s, end_s = float(cloud.times_s[0]), float(cloud.times_s[-1])
    middle_s = 0.5 * (start_s + end_s)
    times = cloud.times_s - middle_s
    ridden = np.zeros((len(cloud), 3))
    if carrier is not None:
        ridden[:] = carrier(cloud.times_s)  # in rows, whatever its order: loops are compiled for it
    constants = np.array([mean_motion_rad_s, 0.0])
    places_m = cloud.places_m - ridden
    length_m = float(np.median(np.linalg.norm(cloud.places_m, axis=1)))
    guess: tuple[Array, Array] | NoFit | None = None
    if previous is not None and previous.shape is shape:
        guess = _moved(previous, middle_s)
    near = guess is not None
    if guess is None:
        guess = first_guess(code, times, places_m, cloud.weights, mean_motion_rad_s)
    if isinstance(guess, NoFit):
        return guess
    base, start = guess
    scales = typical_sizes(code, length_m, 0.5 * (end_s - start_s))
    data = (times, base, constants, ridden, cloud.points, cloud.whitening, cloud.by_node)
    fit = descend(
        Descent(code, start, scales, data, cloud.weights),
        places_m,
        length_m,
        options.method,
        hops=options.hops,
        near=near,
    )
    return _finished(fit, cloud, shape, middle_s, carrier, options)


def _finished(
    fit: Descent,
    cloud: PointCloud,
    shape: Shape,
    middle_s: float,
    carrier: Carrier | None,
    options: FitOptions,
) -> Segment | NoFit:
    """The segment, with the covariance where the descent has ended."""
    parameters, least = fit.parameters, fit.cost()
    if options.method is not Method.SIMPLEX:
        parameters, least = fit.down()
    if not (np.isfinite(parameters).all() and np.isfinite(least)):
        return NoFit("the fit runs away: these points belong to no such segment")
    matrix, right = normal_equations(fit.code, parameters, fit.scales, fit.data, fit.weights, CUT)
    gap = np.abs(solved(matrix, right, fit.scales)) / sigmas_of(matrix, fit.scales)
    covariance = _covariance(fit, parameters, matrix)
    if fit.code <= SPIRAL:
        if parameters[4] < 0.0:  # the other way round is about the opposite normal
            fit, parameters, covariance = _turned_over(fit, parameters, covariance)
        rate, rate_sigma = parameters[4], np.sqrt(covariance[4, 4])
        if not rate > options.least_turn_sigma * rate_sigma or parameters[3] <= 0.0:
            return NoFit(
                f"no turn about the target is significant: {rate:.2g} ± {rate_sigma:.2g} rad/s"
            )
    return Segment(
        shape=shape,
        start_s=float(cloud.times_s[0]),
        end_s=float(cloud.times_s[-1]),
        middle_s=middle_s,
        parameters=parameters,
        covariance=covariance,
        frames=1 + int(np.count_nonzero(np.diff(cloud.times_s))),
        points=len(cloud),
        scatter=(1.0 / fit.scatters[0], 1.0 / fit.scatters[1]),
        gap_sigma=float(gap.max()),
        evaluations=fit.evaluations,
        cost=float(least),
        code=fit.code,
        base=fit.data[1],
        constants=fit.data[2],
        carrier=carrier,
    )


def _covariance(fit: Descent, parameters: Array, matrix: Array) -> Array:
    """(P, P) from the points' own misfits, summed over each frame before they are squared."""
    times = fit.data[0]
    place, out = np.empty((len(times), 3)), np.empty((len(times), RESIDUALS))
    slopes = jacobian(fit.code, parameters, fit.scales, fit.data, place, out)
    residuals(fit.code, parameters, fit.data, place, out)
    squares = np.einsum("ij,ij->i", out, out)
    weights = fit.weights / (1.0 + squares / CUT) ** 2
    first = np.flatnonzero(np.concatenate([[True], np.diff(times) > 0.0]))
    scores = np.add.reduceat(weights[:, None] * np.einsum("nip,ni->np", slopes, out), first)
    frames, size = len(first), len(parameters)
    inverse = inverse_of(matrix, fit.scales)
    spread = scores.T @ scores * frames / max(frames - size, 1)
    # Misfits of neighbouring frames alike: fewer frames than it seems.
    means = np.add.reduceat(weights[:, None] * out, first)
    square = float(np.sum(means**2))
    alike = float(np.sum(means[1:] * means[:-1])) / square if square > 0.0 else 0.0
    alike = min(max(alike, 0.0), _MOST_CORRELATED)
    covariance = inverse @ spread @ inverse * (1.0 + alike) / (1.0 - alike)
    by_node = fit.data[6]
    share = np.where(by_node, _COMMON[0] * fit.scatters[0], _COMMON[1] * fit.scatters[1])
    along = times / max(float(np.abs(times).max()), 1e-12)
    for slow in (np.ones_like(along), along, 1.5 * along**2 - 0.5):
        moved = inverse @ np.einsum("n,nip->pi", weights * share * slow, slopes)
        covariance += moved @ moved.T
    return np.asarray(0.5 * (covariance + covariance.T))


def _turned_over(
    fit: Descent, parameters: Array, covariance: Array
) -> tuple[Descent, Array, Array]:
    """The same circle with its normal on the other side, so that the rate is positive."""
    turned = so3.exp(parameters[:3])
    over = np.diag([1.0, -1.0, -1.0])  # half a turn about the place of the middle
    times, base, *rest = fit.data
    change = np.eye(len(parameters))
    change[:3, :3] = over @ turned.T  # small turns, now on the right of all
    change[4, 4] = -1.0
    moved = parameters.copy()
    moved[:3], moved[4] = 0.0, -parameters[4]
    fit = replace(fit, data=(times, base @ turned @ over, *rest))
    return fit, moved, change @ covariance @ change.T


def _moved(previous: Segment, middle_s: float) -> tuple[Array, Array] | None:
    """The fit so far as the start of a fit about another middle; None where it cannot be."""
    shift_s = middle_s - previous.middle_s
    if previous.code == HOPS:
        return None  # a new search of the hops costs less than a wrong one
    place = previous._shape_places(previous.parameters, np.array([middle_s]))[0]
    if previous.code <= SPIRAL:
        p = previous.parameters.copy()
        p[:3] = 0.0
        if previous.code == SPIRAL:
            p[3] += p[5] * shift_s
        return frame_of(previous.frame[:, 2], place), p
    p = previous.parameters.copy()
    step = 1e-3
    times = np.array([middle_s - step, middle_s + step])
    before, after = previous._shape_places(previous.parameters, times)
    p[:3], p[3:6] = place, (after - before) / (2.0 * step)
    return np.eye(3), p
