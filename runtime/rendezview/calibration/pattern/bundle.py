"""Bundle adjustment of a run: every pose, and what the spots then tell of the places.

The poses are eliminated (the Schur complement of bundle adjustment). What is left is quadratic in
the places and in the camera's errors, so that any prior of the places can be held against it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from rendezview.calibration.pattern.sightings import Sighting
from rendezview.errors import RendezviewError
from rendezview.geometry.camera import Camera
from rendezview.geometry.pose import Array
from rendezview.geometry.so3 import exp
from rendezview.sensors.beacons.constellation import ReflectorPattern
from rendezview.sensors.beacons.detect.discs import camera_doubts, camera_numbers, project_all

_STEP = 1e-5  # rad and share of the range. Source: by construction, cube root of rounding
_CHANCE = 1e-6  # with which a good reading is left out. Source: by construction
_MOST_NOISE = 3.0  # × the spots' σ: no rigid pattern then. Source: by construction
# Of a camera whose file states no σ: focal length, and centre over the width. Source: by
# construction, a data sheet's
_OPEN_FOCAL, _OPEN_CENTRE = 0.02, 0.02


@dataclass(frozen=True, slots=True, eq=False)
class Information:
    """−½ dᵀ Λ d + λᵀ d, the log-likelihood of displacements d (3N,) of the places, m."""

    matrix: Array  # Λ (3N, 3N), 1/m²
    vector: Array  # λ (3N,), 1/m


@dataclass(slots=True, eq=False)
class _View:
    """A reading while it is adjusted, and its equations about where it is."""

    sighting: Sighting
    rotation: Array  # (3, 3) camera from target
    shift: Array  # (3,) of the reflectors' middle, camera frame
    by_pose: Array  # (2K, 6) over σ, as the others
    by_rest: Array  # (2K, 3N + P) places and the camera's errors
    residual: Array  # (2K,)

    @property
    def spare(self) -> int:
        """Equations over unknowns of its pose."""
        return len(self.residual) - 6

    def left(self, values: Array) -> Array:
        """What no pose can make of values (2K, …)."""
        return np.asarray(values - self.by_pose @ np.linalg.lstsq(self.by_pose, values)[0])


class Run:
    """The readings of a run, adjusted about places that may move.

    Args:
        camera: its errors are unknowns, as the law of the discs' light is, of the σ that its file
            states; where it states none, focal length and centre are almost open.
        pattern: the places as the file says.
        sightings: of four or more spots.
        blur_px: σ of the optics and a pixel's width together.
    """

    def __init__(
        self, camera: Camera, pattern: ReflectorPattern, sightings: list[Sighting], blur_px: float
    ) -> None:
        if camera.covariance is None:
            both = np.zeros((4, 4))
            both[:2, :2] = np.outer((camera.fx, camera.fy), (camera.fx, camera.fy))
            both *= _OPEN_FOCAL**2
            both[2:, 2:] = (_OPEN_CENTRE * camera.width) ** 2 * np.eye(2)
            camera = replace(camera, covariance=tuple(map(tuple, both.tolist())))
        self._pattern, self._numbers = pattern, camera_numbers(camera, blur_px)
        self._doubts = camera_doubts(camera)
        self._doubts = self._doubts[(self._doubts != 0.0).any(axis=1)]
        self._count = 3 * len(pattern)
        self._at = np.zeros(self._count + len(self._doubts))  # places (m) and errors (σ)
        empty = np.empty(0)
        self._views = [
            _View(s, np.array(s.pose.rotation), s.pose.apply(pattern.centre_m), empty, empty, empty)
            for s in sightings
        ]
        self.noise = 1.0  # r.m.s. residual over σ where the places are free, at least 1
        self._linearise()

    def __len__(self) -> int:
        return len(self._views)

    @property
    def nearest_m(self) -> float:
        """Range of the nearest reading."""
        return min((float(np.linalg.norm(view.shift)) for view in self._views), default=np.inf)

    @property
    def focal_px(self) -> float:
        """The camera's focal length."""
        return float(self._numbers[0])

    def information(self) -> Information:
        """What the spots tell of the places, for any poses and any errors of the camera."""
        normal, right = self._equations()
        n = self._count
        by_errors = np.linalg.solve(normal[n:, n:], np.column_stack([normal[n:, :n], right[n:]]))
        matrix = normal[:n, :n] - normal[:n, n:] @ by_errors[:, :n]
        vector = right[:n] - normal[:n, n:] @ by_errors[:, n]
        return Information(0.5 * (matrix + matrix.T) / self.noise**2, vector / self.noise**2)

    def move_to(self, moved_m: Array) -> None:
        """Put the reflectors (3N,) beside their places in the file, and adjust everything else."""
        normal, right = self._equations()
        n = self._count
        errors = np.linalg.solve(normal[n:, n:], right[n:] - normal[n:, :n] @ moved_m)
        there = np.append(moved_m, errors)
        for view in self._views:
            rest = view.residual - view.by_rest @ (there - self._at)
            step = np.linalg.lstsq(view.by_pose, rest)[0].astype(np.float64)
            view.rotation, view.shift = exp(step[:3]) @ view.rotation, view.shift + step[3:]
        self._at = there
        self._linearise()

    def drop_strangers(self, wide_m: float) -> bool:
        """Leave out readings that no places within ``wide_m`` explain; whether there were any.

        One at a time, that without which the others fit best: it draws the others' fit to itself.

        Raises:
            RendezviewError: half of the readings, or all, do not fit.
        """
        whole, dropped = len(self._views), 0
        while self._views:
            cost, gains = self._gains(wide_m)
            spare = np.array([view.spare for view in self._views])
            free = self._count - 7  # the shape's
            level = max(1.0, float(np.median(cost / chdtri(spare, 0.5))))
            self.noise = max(1.0, float(cost.sum()) / max(spare.sum() - free, 1)) ** 0.5
            odd = gains / chdtri(spare, _CHANCE) / level
            worst = int(odd.argmax())
            if odd[worst] < 1.0:
                break
            del self._views[worst]
            dropped += 1
        if dropped > 0.5 * whole or self.noise > _MOST_NOISE:
            raise RendezviewError(
                f"the spots do not fit one rigid pattern: {dropped} of {whole} readings contradict "
                f"the others, which are off by {self.noise:.1f} times their noise: are the camera "
                "file and its distortion of this camera, and the reflectors at rest on the target?"
            )
        return dropped > 0

    def _gains(self, wide_m: float) -> tuple[Array, Array]:
        """χ² (V,) of each reading, and by how much that of all falls without it."""
        held = np.append(np.full(self._count, 1.0 / wide_m), np.ones(len(self._doubts)))
        off, own = held * self._at, np.empty((len(self._views), len(held) + 1, len(held) + 1))
        for view, products in zip(self._views, own, strict=True):
            left = view.left(np.column_stack([view.by_rest / held, view.residual]))
            products[:] = left.T @ left
        whole = own.sum(axis=0)  # of slopes and residual; with the prior, which is a reading, too
        whole[:-1, :-1] += np.eye(len(held))
        whole[:-1, -1] -= off
        whole[-1, :-1] -= off
        whole[-1, -1] += off @ off
        toward = np.append(-np.linalg.solve(whole[:-1, :-1], whole[:-1, -1]), 1.0)
        without = whole - own
        inner = np.linalg.solve(without[:, :-1, :-1], without[:, :-1, -1:])[:, :, 0]
        rest = without[:, -1, -1] - np.einsum("vi,vi->v", without[:, :-1, -1], inner)
        return np.einsum("i,vij,j->v", toward, own, toward), whole[-1] @ toward - rest

    def _equations(self) -> tuple[Array, Array]:
        """Normal matrix and right side of places and errors, absolute; errors have their prior."""
        normal = np.diag(np.append(np.zeros(self._count), np.ones(len(self._doubts))))
        right = np.zeros(len(self._at))
        for view in self._views:
            left = view.left(view.by_rest)
            normal += left.T @ view.by_rest
            right += left.T @ (view.residual + view.by_rest @ self._at)
        return 0.5 * (normal + normal.T), right

    def _linearise(self) -> None:
        moved, errors = self._at[: self._count].reshape(-1, 3), self._at[self._count :]
        arms = self._pattern.positions_m - self._pattern.centre_m + moved
        numbers: Array = self._numbers + errors @ self._doubts
        for view in self._views:
            self._of_view(view, arms, numbers)

    def _of_view(self, view: _View, arms: Array, numbers: Array) -> None:
        which, out = view.sighting.reflectors, np.empty((len(arms), 2))
        pattern = self._pattern

        def spots(rotation: Array, shift: Array, lens: Array) -> Array:
            project_all(lens, arms, pattern.normals, pattern.diameters_m, rotation, shift, out)
            return out[which]

        def slope(of: tuple[Array, Array, Array], less: tuple[Array, Array, Array]) -> Array:
            return np.asarray((spots(*of) - spots(*less)) / view.sighting.sigma_px[:, None])

        turn, shift, far = view.rotation, view.shift, float(np.linalg.norm(view.shift))
        by_pose = np.empty((len(which), 2, 6))
        for k, unit in enumerate(np.eye(3)):
            by_pose[:, :, k] = slope(
                (exp(_STEP * unit) @ turn, shift, numbers),
                (exp(-_STEP * unit) @ turn, shift, numbers),
            ) / (2.0 * _STEP)  # fmt: skip
            away = _STEP * far * unit
            by_pose[:, :, 3 + k] = slope(
                (turn, shift + away, numbers), (turn, shift - away, numbers)
            ) / (2.0 * _STEP * far)
        by_rest = np.zeros((len(which), 2, len(self._at)))
        for i, reflector in enumerate(which):  # its place moves its spot as the target's does
            own = slice(3 * reflector, 3 * reflector + 3)
            by_rest[i, :, own] = by_pose[i, :, 3:] @ turn
        for k, doubt in enumerate(self._doubts):
            by_rest[:, :, self._count + k] = 0.5 * slope(
                (turn, shift, numbers + doubt), (turn, shift, numbers - doubt)
            )
        off = (view.sighting.spots_px - spots(turn, shift, numbers)).ravel()
        view.residual = off / np.repeat(view.sighting.sigma_px, 2)
        view.by_pose, view.by_rest = by_pose.reshape(-1, 6), by_rest.reshape(-1, len(self._at))
