"""The target's attitude and spin: six numbers and their uncertainty.

About a fixed axis, or tumbling free of torque with unknown ratios of its moments of inertia.
"With the two vehicles at constant distance the attitude and rate calculation is entirely
equivalent to the trajectory determination" (Cleghorn & Sternberg 1991): there the reference is
the line of sight, which is fixed. Where the chaser's own attitude is given, the reference is
that in which it is given.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from rendezview.estimation.least_squares import Equations, minimise
from rendezview.geometry.pose import Array, Pose, minimal_rotation
from rendezview.trajectory.cloud import NODE_RAD, roots_of
from rendezview.trajectory.descent import CUT
from rendezview.trajectory.no_fit import NoFit
from rendezview.trajectory.rotation import rotations
from rendezview.trajectory.scaling import robust_root
from rendezview.trajectory.segment import COMMON, LEAST_FRAMES

# χ² that a tumble must save over constant spin to be reported. Source: by construction, 5 σ
_WORTH = 25.0


@dataclass(frozen=True, slots=True, eq=False)
class Spin:
    """Attitude and angular velocity of a target at one time, and what follows from them."""

    time_s: float  # of the numbers: the middle of what was fitted
    rotation: Array  # (3, 3) reference_from_target
    rate_rad_s: Array  # (3,) target axes
    covariance: Array  # (6, 6) rotation vector, reference frame, on the left; rate, target axes
    tumbling: bool
    moments: Array  # (3,) principal moments over the first, on the target's axes
    moments_sigma: Array | None  # (2,) of the second and third; None for constant spin
    start_s: float
    end_s: float
    frames: int
    scatter: float  # of the attitudes, over what they claim
    roll_known: bool = True  # False where only directions were observed: roll is then a convention

    @property
    def speed_rad_s(self) -> float:
        """Size of the angular velocity."""
        return float(np.linalg.norm(self.rate_rad_s))

    @property
    def speed_sigma_rad_s(self) -> float:
        """One σ of it."""
        axis = self.axis
        return float(np.sqrt(axis @ self.covariance[3:, 3:] @ axis))

    @property
    def axis(self) -> Array:
        """(3,) unit, target frame."""
        return np.asarray(self.rate_rad_s / max(self.speed_rad_s, 1e-300))

    @property
    def axis_reference(self) -> Array:
        """(3,) unit, reference frame."""
        return np.asarray(self.rotation @ self.axis)

    @property
    def axis_sigma_rad(self) -> float:
        """One σ of the axis, in its worse direction."""
        across = np.eye(3) - np.outer(self.axis, self.axis)
        spread = across @ self.covariance[3:, 3:] @ across
        return float(np.sqrt(np.linalg.eigvalsh(spread)[-1])) / max(self.speed_rad_s, 1e-300)

    def at(self, times_s: npt.ArrayLike) -> tuple[Array, Array]:
        """Attitudes (N, 3, 3) reference_from_target and rates (N, 3), target axes, at times."""
        times = np.atleast_1d(np.asarray(times_s, np.float64)) - self.time_s
        order = np.argsort(times, kind="stable")
        turned, rates = np.empty((len(times), 3, 3)), np.empty((len(times), 3))
        rotations(self.moments, self.rotation, self.rate_rad_s, times[order], turned, rates)
        back = np.argsort(order)
        return turned[back], rates[back]


def in_line_of_sight(pose: Pose, centre_m: npt.ArrayLike) -> Array:
    """(3, 3) sight_from_target: the camera turned, by the least turn, to look at the centre."""
    sight = pose.apply(np.asarray(centre_m, np.float64))
    return np.asarray(minimal_rotation(sight, [0.0, 0.0, 1.0]) @ pose.rotation)


def fit_spin(
    times_s: npt.ArrayLike,
    attitudes: npt.ArrayLike,
    covariances: npt.ArrayLike | None = None,
    *,
    tumbling: bool | None = None,
) -> Spin | NoFit:
    """Spin from attitudes ``reference_from_target``.

    Args:
        times_s: (N,) rising.
        attitudes: (N, 3, 3).
        covariances: (N, 3, 3) rad², reference frame, rotation vector on the left.
        tumbling: fit Euler's equations with unknown moments about the target's axes; False: a
            fixed axis; None: tumble if it explains the attitudes better.
    """
    times, turned = np.asarray(times_s, np.float64), np.asarray(attitudes, np.float64)
    trouble = _trouble(times, turned)
    if trouble is not None:
        return trouble
    if covariances is None:
        roots = np.tile(np.eye(3) / 1e-3, (len(times), 1, 1))
    else:
        given = np.asarray(covariances, np.float64)
        if not np.isfinite(given).all():
            return NoFit("a covariance is not finite")
        roots = roots_of(given)
    middle_s = 0.5 * (times[0] + times[-1])
    near = int(np.argmin(np.abs(times - middle_s)))
    turns = Rotation.from_matrix(turned[1:] @ np.swapaxes(turned[:-1], 1, 2)).as_rotvec()
    body = np.einsum("nji,nj->ni", turned[:-1], turns) / np.diff(times)[:, None]
    data = _Data(times - middle_s, turned, roots, None)
    return _best(data, turned[near], np.median(body, axis=0), tumbling, middle_s)


def fit_spin_of_directions(
    times_s: npt.ArrayLike,
    directions: npt.ArrayLike,
    weights: npt.ArrayLike | None = None,
    *,
    tumbling: bool | None = None,
) -> Spin | NoFit:
    """Spin from directions to the camera, target frame: from active nodes only, range held.

    The reference is the line of sight, its −z towards the camera. Roll about it is unobservable: at
    the middle the attitude is given as the least turn from the target's axes. A turn about the
    line of sight shows only as far as the arc of the directions is curved.

    Args:
        times_s: (N,) never falling; nodes of one frame have one time.
        directions: (N, 3), any length.
        weights: (N,) trust in each.
    """
    times, observed = np.asarray(times_s, np.float64), np.asarray(directions, np.float64)
    trust = np.ones(len(times)) if weights is None else np.asarray(weights, np.float64)
    if not (np.isfinite(times).all() and np.isfinite(observed).all() and np.isfinite(trust).all()):
        return NoFit("a time, direction or weight is not finite")
    if len(times) == 0 or np.any(np.diff(times) < 0.0):
        return NoFit("the times do not rise")
    first = np.flatnonzero(np.concatenate([[True], np.diff(times) > 0.0]))
    unit = observed / np.maximum(np.linalg.norm(observed, axis=1), 1e-300)[:, None]
    mean = np.add.reduceat(trust[:, None] * unit, first)
    length = np.linalg.norm(mean, axis=1)
    if np.any(length < 1e-9):
        return NoFit("the directions of a frame cancel each other")
    mean /= length[:, None]
    frames = times[first]
    if len(frames) < LEAST_FRAMES:
        return NoFit(f"{len(frames)} frames: a spin needs {LEAST_FRAMES}")
    middle_s = 0.5 * (frames[0] + frames[-1])
    start = mean[np.argmin(np.abs(frames - middle_s))]
    # Rate across the sight: directions move by −ω × u in target axes, so ω = −u × u'.
    slope = np.polyfit(frames - middle_s, mean, 1)[0]
    rate = -np.cross(start, slope)
    rotation = minimal_rotation(start, [0.0, 0.0, -1.0])
    sigma = NODE_RAD / np.sqrt(np.maximum(np.add.reduceat(trust, first), 1e-3))
    roots = np.eye(3)[None] / sigma[:, None, None]
    data = _Data(frames - middle_s, mean, roots, np.array([0.0, 0.0, -1.0]))
    return _best(data, rotation, rate, bool(tumbling), middle_s)


@dataclass(frozen=True, slots=True, eq=False)
class _Data:
    times: Array  # (N,) from the middle
    observed: Array  # (N, 3, 3) attitudes, or (N, 3) unit directions in the target frame
    roots: Array  # (N, 3, 3) root of the information
    sight: Array | None  # (3,) of the directions, reference frame; None for attitudes

    def misfits(self, state: _SpinState) -> Array:
        """(N, 3) in standard deviations."""
        count = len(self.times)
        turned, rates = np.empty((count, 3, 3)), np.empty((count, 3))
        rotations(state.moments, state.rotation, state.rate, self.times, turned, rates)
        if self.sight is None:
            off = Rotation.from_matrix(turned @ np.swapaxes(self.observed, 1, 2)).as_rotvec()
        else:
            off = np.einsum("nji,j->ni", turned, self.sight) - self.observed
        return np.asarray(np.einsum("nij,nj->ni", self.roots, off))


@dataclass(frozen=True, slots=True, eq=False)
class _SpinState:
    rotation: Array
    rate: Array
    ratios: Array  # (2,) logarithms of Σ m y² and Σ m z² over Σ m x²: any belong to a body

    @property
    def moments(self) -> Array:
        """(3,) over the first: I_x = Σ m (y² + z²) and so on."""
        x, y, z = 1.0, *np.exp(self.ratios)
        return np.array([1.0, (x + z) / (y + z), (x + y) / (y + z)])

    def moved(self, step: Array) -> _SpinState:
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        ratios = self.ratios + step[6:] if len(step) > 6 else self.ratios
        return _SpinState(turn @ self.rotation, self.rate + step[3:6], ratios)


def _trouble(times: Array, turned: Array) -> NoFit | None:
    if len(times) < LEAST_FRAMES:
        return NoFit(f"{len(times)} frames: a spin needs {LEAST_FRAMES}")
    if not (np.isfinite(times).all() and np.isfinite(turned).all()):
        return NoFit("a time or attitude is not finite")
    if np.any(np.diff(times) <= 0.0):
        return NoFit("the times do not rise")
    return None


def _best(
    data: _Data, rotation: Array, rate: Array, tumbling: bool | None, middle_s: float
) -> Spin | NoFit:
    still = _down(data, _SpinState(rotation, rate, np.zeros(2)), 6, np.inf)
    dof = 3 if data.sight is None else 2
    variance = _variance(data, still, dof)
    still = _down(data, still, 6, CUT * variance)
    if tumbling is False:
        return _answer(data, still, 6, dof, middle_s)
    cut = CUT * _variance(data, still, dof)
    best = _down(data, still, 8, cut)
    least, variance = _cost(data, best, cut), _variance(data, best, dof)
    if tumbling is None and _cost(data, still, CUT * variance) - least < _WORTH * variance:
        return _answer(data, still, 6, dof, middle_s)
    best = _down(data, best, 8, CUT * variance)
    return _answer(data, best, 8, dof, middle_s)


def _variance(data: _Data, state: _SpinState, dof: int) -> float:
    squares = np.sum(data.misfits(state) ** 2, axis=1)
    return max(float(np.median(squares)) / float(chdtri(dof, 0.5)), 1e-12)


def _cost(data: _Data, state: _SpinState, cut: float) -> float:
    squares = np.sum(data.misfits(state) ** 2, axis=1)
    return float(np.sum(squares / (1.0 + squares / cut)))


def _slopes(data: _Data, state: _SpinState, size: int) -> Array:
    """(N, 3, size) by central differences."""
    span = max(float(np.abs(data.times).max()), 1e-9)
    steps = np.concatenate([np.full(3, 1e-5), np.full(3, 1e-5 / span), np.full(2, 1e-4)])
    columns = []
    for j in range(size):
        step = np.zeros(size)
        step[j] = steps[j]
        after, before = (data.misfits(state.moved(sign * step)) for sign in (1.0, -1.0))
        columns.append((after - before) / (2.0 * steps[j]))
    return np.stack(columns, axis=-1)


def _normal(
    data: _Data, state: _SpinState, size: int, cut: float
) -> tuple[Array, Array, Array, Array]:
    """Matrix, right side, slopes and weighted misfits of one robust Gauss–Newton step."""
    misfits = data.misfits(state)
    slopes = _slopes(data, state, size)
    weights = 1.0 / (1.0 + np.sum(misfits**2, axis=1) / cut) ** 2
    weighted = weights[:, None] * misfits
    matrix = np.einsum("n,nia,nib->ab", weights, slopes, slopes)
    return matrix, -np.einsum("nia,ni->a", slopes, weighted), slopes, weighted


def _loose(data: _Data, size: int) -> Array:
    """Prior: one radian, ten radians over the span, ratios to a factor of e.

    It keeps the unobservable (roll of directions, ratios of a slow tumble) finite.
    """
    span = max(float(np.abs(data.times).max()), 1e-9)
    sigmas = np.concatenate([np.full(3, 1.0), np.full(3, 10.0 / span), np.full(2, 1.0)])
    return np.diag(sigmas[:size] ** -2.0)


def _down(data: _Data, state: _SpinState, size: int, cut: float) -> _SpinState:
    """Levenberg–Marquardt down the robust cost; the unobservable stays where it is."""
    loose = _loose(data, size)

    def equations(state: _SpinState) -> Equations:
        matrix, right, _, _ = _normal(data, state, size, cut)
        return _cost(data, state, cut), matrix + loose, right

    found = minimise(equations, _SpinState.moved, state, cost=lambda s: _cost(data, s, cut))
    return state if found is None else found.at


def _answer(data: _Data, state: _SpinState, size: int, dof: int, middle_s: float) -> Spin | NoFit:
    """The answer with its covariance: scatter of the frames, and what they have in common."""
    variance = _variance(data, state, dof)
    matrix, _, slopes, weighted = _normal(data, state, size, CUT * variance)
    loose = variance * _loose(data, size)
    inverse = np.asarray(np.linalg.inv(matrix + loose), np.float64)
    frames = len(data.times)
    root = robust_root(
        inverse, slopes, weighted, np.arange(frames), data.times, np.full(frames, COMMON[1]),
        np.sqrt(variance * np.diag(loose)),
    )  # fmt: skip
    if not np.isfinite(root).all():
        return NoFit("the fit runs away: these attitudes belong to no such motion")
    return Spin(
        time_s=float(middle_s),
        rotation=state.rotation,
        rate_rad_s=state.rate,
        covariance=root[:6] @ root[:6].T,
        tumbling=size > 6,
        moments=state.moments,
        moments_sigma=_moments_sigma(state, root) if size > 6 else None,
        start_s=float(middle_s + data.times[0]),
        end_s=float(middle_s + data.times[-1]),
        frames=frames,
        scatter=float(np.sqrt(variance)),
        roll_known=data.sight is None,
    )


def _moments_sigma(state: _SpinState, root: Array) -> Array:
    """(2,) one σ of the second and third moment over the first."""
    slopes = np.empty((2, 2))
    for j in range(2):
        step = np.zeros(8)
        step[6 + j] = 1e-5
        change = state.moved(step).moments - state.moved(-step).moments
        slopes[:, j] = change[1:] / 2e-5
    return np.asarray(np.linalg.norm(slopes @ root[6:], axis=1))
