"""The size of a ring from a whole pass: all frames of a fly-around in one least squares.

Zhai et al. solve each frame for itself. Here the rectangle's sides, the ring's radius R, its
distance D_f and the offset of its axis from the rectangle's middle are the same in every frame,
and each frame has a pose of its own.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rendezview.estimation.least_squares import Equations, minimise
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array, Pose
from rendezview.sensors.ring.circle_pose import shape_of_circle
from rendezview.sensors.ring.rectangle import rectangle_pose
from rendezview.sensors.ring.ring_size import RingSight
from rendezview.sensors.ring.size_circles import Ellipses

LEAST_FRAMES = 3  # as for a circle through points. Source: by construction
_OWN, _SHARED = 6, 6  # unknowns of a frame, and of the pass. Source: by construction
_SLOPE_STEP = 1e-6  # m and rad, for numerical slopes. Source: by construction, root of rounding
# χ² of a frame of 8 degrees of freedom that noise exceeds once in 5000: it has another ellipse,
# other corners or an echo of another surface. Source: by construction, χ² distribution
_WORST = 30.0
_FREEDOM = 8  # of a frame: 14 numbers less its pose. Source: by construction
_ROUNDS = 4  # of leaving out frames, a bound only. Source: by construction


@dataclass(frozen=True, slots=True, eq=False)
class PassSize:
    """A ring as a whole pass measures it, in the rectangle's frame."""

    radius_m: float
    distance_m: float  # D_f, of the ring's plane along x
    offset_m: Array  # (2,) y, z of the ring's axis from the rectangle's middle
    sides_m: Array  # (2,) of the rectangle along y and z
    covariance: Array  # (4, 4) m² of radius, distance and offset
    used: tuple[int, ...]  # numbers of the sights that fit
    chi2: float
    freedom: int


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    poses: tuple[Pose, ...]  # camera from rectangle
    common: Array  # (6,) sides along y, z; R; D_f; offset y, z. Metres

    def moved(self, step: Array) -> _State:
        own = step[_SHARED:].reshape(-1, _OWN)
        poses = tuple(pose.perturbed(d) for pose, d in zip(self.poses, own, strict=True))
        return _State(poses, self.common + step[:_SHARED])


def ring_size_of_pass(
    camera: Camera, sights: Sequence[RingSight], common_px: float = 0.0, along_px: float = 0.0
) -> PassSize | None:
    """R, D_f and the axis' offset from all frames of a pass; None where too few frames fit.

    A frame whose 14 numbers do not fit the others is left out. The offset has a prior of half the
    rectangle's sides (one σ), which decides where all frames look from one direction.

    Args:
        camera: of all frames, without distortion.
        sights: what each frame measured.
        common_px: σ of an error of the ring's semi-axes that all frames share: a model of edges is
            wrong by the same in all of them, so more frames do not lessen it.
        along_px: σ of a shift of the ring along its axis that all pictures share: of a rim that
            shows its wall.
    """
    used, state = _start(camera, sights)
    for _ in range(_ROUNDS):
        if len(used) < LEAST_FRAMES:
            return None
        problem = _Pass(camera, [sights[k] for k in used], np.abs(state.common[:2]) / 2.0)
        found = minimise(problem.equations, _State.moved, state, cost=problem.cost)
        if found is None:
            return None
        misfits = problem.misfits(found.at)
        fits = misfits < _WORST
        if fits.all():
            size = _finished(problem, found.at, tuple(used), found.cost)
            if size is not None:
                size.covariance[0, 0] += (common_px * _metres(camera, found.at)) ** 2
                size.covariance[1, 1] += (along_px * _metres(camera, found.at, along=True)) ** 2
            return size
        # A wrong frame spoils its neighbours: those far worse than the limit go first.
        fits |= misfits < 0.1 * misfits.max()
        used = [k for k, good in zip(used, fits, strict=True) if good]
        poses = tuple(p for p, good in zip(found.at.poses, fits, strict=True) if good)
        state = _State(poses, found.at.common)
    return None


def _start(camera: Camera, sights: Sequence[RingSight]) -> tuple[list[int], _State]:
    """The sights that give a circle, and the circle and sides of all."""
    ellipses = Ellipses(camera, [[sight] for sight in sights])
    used, poses, sides, common = [], [], [], np.zeros(_SHARED)
    for number in ellipses.index[:, 0].tolist():
        sight = sights[number]
        found = rectangle_pose(camera, sight.corners_px, sight.range_m, sight.beam)
        if found is None:
            continue
        pose, _ = found
        rays = camera.rays(sight.corners_px)
        plane = float(pose.rotation[:, 0] @ pose.translation_m)
        corners = rays * (plane / (rays @ pose.rotation[:, 0]))[:, None]
        used.append(number)
        poses.append(pose)
        sides.append([np.linalg.norm(corners[0] - corners[k]) for k in (1, 2)])
    if len(used) > 1:
        common[:2] = np.median(sides, axis=0)
        for _ in range(2):
            common[2:] = ellipses.circle(common[3], np.arange(len(ellipses)))[0]
    return used, _State(tuple(poses), common)


class _Pass:
    """The equations of a pass: six unknowns of its own for each frame, and six of all."""

    def __init__(self, camera: Camera, sights: list[RingSight], offset_sigma_m: Array) -> None:
        self.camera, self.sights = camera, sights
        self.measured = [sight.measured() for sight in sights]
        self.weights = [np.linalg.inv(sight.noise()) for sight in sights]
        self.prior = np.zeros(_SHARED)
        self.prior[4:] = offset_sigma_m**-2.0

    def predict(self, k: int, pose: Pose, common: Array) -> Array | None:
        """(14,) as `RingSight.measured`; None where the camera would not see it."""
        across, up, radius, distance, off_y, off_z = common
        y, z = 0.5 * across, 0.5 * up
        corners = np.array([[0, y, z], [0, -y, z], [0, y, -z], [0, -y, -z]])
        places_px = self.camera.project(pose.apply(corners))
        axis, beam = pose.rotation[:, 0], self.sights[k].beam
        centre = pose.apply([distance, off_y, off_z])
        shape = shape_of_circle(self.camera, centre, axis, radius) if radius > 0.0 else None
        along = float(axis @ beam.direction)
        if shape is None or not np.isfinite(places_px).all() or abs(along) < 1e-9:
            return None
        range_m = float(axis @ (pose.translation_m - beam.origin_m)) / along
        return np.concatenate([places_px.ravel(), shape, [range_m]])

    def misfits(self, state: _State) -> Array:
        """(N,) χ² of each frame, infinite where it cannot be."""
        out = np.full(len(self.sights), np.inf)
        for k, pose in enumerate(state.poses):
            predicted = self.predict(k, pose, state.common)
            if predicted is not None:
                left = self.measured[k] - predicted
                out[k] = left @ self.weights[k] @ left
        return out

    def cost(self, state: _State) -> float:
        return float(self.misfits(state).sum() + self.prior @ state.common**2)

    def equations(self, state: _State) -> Equations:
        size = _SHARED + _OWN * len(self.sights)
        normal, right, cost = np.zeros((size, size)), np.zeros(size), self.cost(state)
        normal[range(_SHARED), range(_SHARED)] = self.prior
        right[:_SHARED] = -self.prior * state.common
        for k, pose in enumerate(state.poses):
            base = self.predict(k, pose, state.common)
            slopes = self._slopes(k, pose, state.common)
            if base is None or slopes is None:
                return np.inf, normal, right
            at = _SHARED + _OWN * k
            rows = np.concatenate([np.arange(_SHARED), np.arange(at, at + _OWN)])
            weighted = slopes.T @ self.weights[k]
            normal[np.ix_(rows, rows)] += weighted @ slopes
            right[rows] += weighted @ (self.measured[k] - base)
        return cost, normal, right

    def _slopes(self, k: int, pose: Pose, common: Array) -> Array | None:
        """(14, 12) by central differences: the shared unknowns, then the frame's own."""
        slopes = np.empty((14, _SHARED + _OWN))
        for j in range(_SHARED + _OWN):
            step = np.zeros(_SHARED + _OWN)
            step[j] = _SLOPE_STEP
            ahead, behind = (
                self.predict(k, pose.perturbed(s[_SHARED:]), common + s[:_SHARED])
                for s in (step, -step)
            )
            if ahead is None or behind is None:
                return None
            slopes[:, j] = (ahead - behind) / (2.0 * _SLOPE_STEP)
        return slopes


def _finished(problem: _Pass, state: _State, used: tuple[int, ...], chi2: float) -> PassSize | None:
    _, normal, _ = problem.equations(state)
    freedom = _FREEDOM * len(used) - _SHARED
    try:
        covariance = np.asarray(np.linalg.inv(normal)[2:_SHARED, 2:_SHARED], dtype=np.float64)
    except np.linalg.LinAlgError:
        return None
    covariance = covariance * max(1.0, chi2 / freedom)  # frames that scatter more than they claim
    sides, (radius, distance) = state.common[:2], state.common[2:4]
    offset = state.common[4:]
    return PassSize(float(radius), float(distance), offset, sides, covariance, used, chi2, freedom)


def _metres(camera: Camera, state: _State, along: bool = False) -> float:
    """How long a pixel is at the ring, across the line of sight or along the ring's axis, m."""
    centre = np.array([state.common[3], *state.common[4:]])
    places = np.array([pose.apply(centre) for pose in state.poses])
    across = 1.0
    if along:
        sights = places / np.linalg.norm(places, axis=1)[:, None]
        axes = np.array([pose.rotation[:, 0] for pose in state.poses])
        across = float(np.mean(np.linalg.norm(np.cross(sights, axes), axis=1)))
    return float(places[:, 2].mean()) / math.sqrt(camera.fx * camera.fy) / across
