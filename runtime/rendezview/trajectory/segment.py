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
from rendezview.trajectory.misfits import RESIDUALS, jacobian, normal_equations, residuals
from rendezview.trajectory.no_fit import NoFit
from rendezview.trajectory.scaling import held, inverse_of, robust_root, typical_sizes
from rendezview.trajectory.shapes import CODES, HOPS, SPIRAL, Shape, places
from rendezview.trajectory.start import first_guess

Carrier = Callable[[Array], Array]  # times (N,) s to places (N, 3) m

# Source: by construction, the six unknowns of an orbit, or of a spin
LEAST_FRAMES = 6
# Of circular and spiral: a less certain rate is rejected. Source: normal distribution, 0.3 %
_LEAST_TURN_SIGMA = 3.0
# Of a point's claimed σ, what all points of a segment may have in common, and half as much
# again as goes with time and its square: views alike err alike. On active nodes, poses; nodes:
# fitted to seeds 1000–1003; poses: r.m.s. over 1000–1002. Source: experiment
# trajectory-accuracy.
COMMON = (0.35, 1.1)


@dataclass(frozen=True, kw_only=True)
class FitOptions:
    """How a segment is fitted."""

    method: Method = Method.BEST  # Source: experiment trajectory-methods (0.1), seed 1


@dataclass(frozen=True, slots=True, eq=False)
class Segment:
    """A fitted segment: places at any time, in the path frame, with their covariance."""

    shape: Shape
    start_s: float
    end_s: float
    middle_s: float  # times of the parameters count from here
    parameters: Array  # (P,) see ``shapes``
    root: Array  # (P, P) L, L Lᵀ the covariance
    frames: int
    points: int
    scatter: tuple[float, float]  # of active nodes, of poses: over what they claim
    gap_sigma: float  # largest step of Gauss–Newton from the answer, in σ
    evaluations: int  # of the simplex; 0: Gauss–Newton alone
    code: int
    base: Array  # (3, 3)
    constants: Array  # mean motion rad/s, closing of hops 1/s
    carrier: Carrier | None = None

    @property
    def covariance(self) -> Array:
        """(P, P) of the parameters."""
        return np.asarray(self.root @ self.root.T)

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
        moved = self._moved(np.array([time_s]))[0]
        return np.asarray(moved @ moved.T)

    def state_covariance(self, time_s: float) -> Array:
        """(6, 6) of place, m, and velocity, m/s, at a time, within the segment or beyond."""
        step = self._step_s
        at, after, before = self._moved(np.array([time_s, time_s + step, time_s - step]))
        moved = np.vstack([at, (after - before) / (2.0 * step)])
        return np.asarray(moved @ moved.T)

    @property
    def _step_s(self) -> float:
        """Of differences in time."""
        return 1e-4 * max(self.end_s - self.start_s, 1e-3)

    def _moved(self, times_s: Array) -> Array:
        """(N, 3, P) change of the places by one σ along each column of the root."""
        part = 1e-3  # together parameters may stay linear that are not so each on its own
        moved = np.empty((len(times_s), 3, len(self.parameters)))
        for j, step in enumerate(part * self.root.T):
            ahead = self._shape_places(self.parameters + step, times_s)
            behind = self._shape_places(self.parameters - step, times_s)
            moved[:, :, j] = (ahead - behind) / (2.0 * part)
        return moved

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

    Returns:
        The segment, or why there is none. The covariance of its parameters takes the points' own
        scatter, lets those of one frame err together, and neighbouring frames as much as their
        misfits say.
    """
    options = options or FitOptions()
    code = CODES[shape]
    trouble = cloud.trouble(LEAST_FRAMES)
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
    guess = first_guess(code, times, places_m, cloud.weights, mean_motion_rad_s)
    if isinstance(guess, NoFit):
        return guess
    base, start = guess
    scales = typical_sizes(code, length_m, 0.5 * (end_s - start_s))
    data = (times, base, constants, ridden, cloud.points, cloud.whitening, cloud.by_node)
    start_at = Descent(code, start, scales, data, cloud.weights)
    fit = descend(start_at, places_m, length_m, options.method)
    if options.method is not Method.SIMPLEX:
        fit = replace(fit, parameters=fit.down()[0])
    return _finished(fit, cloud, shape, middle_s, carrier)


def _finished(
    fit: Descent, cloud: PointCloud, shape: Shape, middle_s: float, carrier: Carrier | None
) -> Segment | NoFit:
    """The segment, with the covariance where the descent has ended."""
    parameters = fit.parameters
    if not (np.isfinite(parameters).all() and np.isfinite(fit.cost())):
        return NoFit("the fit runs away: these points belong to no such segment")
    matrix, right = normal_equations(fit.code, parameters, fit.scales, fit.data, fit.weights, CUT)
    inverse = inverse_of(matrix, fit.scales)
    root = _root(fit, matrix, inverse)
    if fit.code <= SPIRAL:
        rate, rate_sigma = parameters[4], np.linalg.norm(root[4])
        if not rate > _LEAST_TURN_SIGMA * rate_sigma or parameters[3] <= 0.0:
            return NoFit(
                f"no turn about the target is significant: {rate:.2g} ± {rate_sigma:.2g} rad/s"
            )
    sigmas = np.minimum(np.sqrt(np.diag(inverse)), 0.1 * fit.scales)  # of independent points
    return Segment(
        shape=shape,
        start_s=float(cloud.times_s[0]),
        end_s=float(cloud.times_s[-1]),
        middle_s=middle_s,
        parameters=parameters,
        root=root,
        frames=1 + int(np.count_nonzero(np.diff(cloud.times_s))),
        points=len(cloud),
        scatter=(1.0 / fit.scatters[0], 1.0 / fit.scatters[1]),
        gap_sigma=float((np.abs(inverse @ right) / sigmas).max()),
        evaluations=fit.evaluations,
        code=fit.code,
        base=fit.data[1],
        constants=fit.data[2],
        carrier=carrier,
    )


def _root(fit: Descent, matrix: Array, inverse: Array) -> Array:
    times = fit.data[0]
    place, out = np.empty((len(times), 3)), np.empty((len(times), RESIDUALS))
    slopes = jacobian(fit.code, fit.parameters, fit.scales, fit.data, place, out)
    residuals(fit.code, fit.parameters, fit.data, place, out)
    squares = np.einsum("ij,ij->i", out, out)
    weights = fit.weights / (1.0 + squares / CUT) ** 2
    first = np.flatnonzero(np.concatenate([[True], np.diff(times) > 0.0]))
    share = np.where(fit.data[6], COMMON[0] * fit.scatters[0], COMMON[1] * fit.scatters[1])
    return robust_root(
        inverse, slopes, weights[:, None] * out, first, times, weights * share,
        held(matrix, fit.scales),
    )  # fmt: skip
