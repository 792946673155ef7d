"""The point cloud: where active nodes and refined poses put the camera, with times and weights.

Points are in the path frame, its origin at the centre of the path. Those of one frame of the
camera have one time and are stored together.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from rendezview.geometry import so3
from rendezview.geometry.pose import Array, Pose
from rendezview.trajectory.no_fit import NoFit

# One σ of an active node, each axis of its direction and of its range; those of a frame err
# together. Source: the spacing of the nodes
NODE_RAD, _NODE_RANGE = 0.12, 0.03


@dataclass(frozen=True, slots=True, eq=False)
class PointCloud:
    """Points with times, as the compiled loops want them."""

    times_s: Array  # (N,) never falling
    points: Array  # (N, 3) m for a pose; the unit direction for a node
    whitening: Array  # (N, 3, 3) see ``misfits.residuals``
    by_node: npt.NDArray[np.bool_]  # (N,)
    weights: Array  # (N,) trust, 0 … 1

    def __len__(self) -> int:
        return len(self.times_s)

    @property
    def places_m(self) -> Array:
        """(N, 3) in metres, of nodes too."""
        far = np.where(self.by_node, self.whitening[:, 2, 2], 1.0)
        return np.asarray(self.points * far[:, None])

    @classmethod
    def empty(cls) -> PointCloud:
        """No points yet."""
        return cls(
            np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0, bool), np.zeros(0)
        )

    @classmethod
    def of_nodes(
        cls, times_s: npt.ArrayLike, points_m: npt.ArrayLike, weights: npt.ArrayLike | None = None
    ) -> PointCloud:
        """Points (N, 3) of active nodes, path frame, with times (N,) and the trust in each (N,)."""
        points = np.asarray(points_m, np.float64).reshape(-1, 3)
        far = np.linalg.norm(points, axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):  # a point at the centre: refused later
            directions = points / far[:, None]
            across = np.full(len(points), 1.0 / NODE_RAD)
            along = 1.0 / (_NODE_RANGE * far)
        whitening = np.zeros((len(points), 3, 3))
        whitening[:, 0, 0], whitening[:, 1, 1], whitening[:, 2, 2] = across, along, far
        trust = np.ones(len(points)) if weights is None else np.asarray(weights, np.float64)
        times = np.broadcast_to(np.asarray(times_s, np.float64), (len(points),)).copy()
        return cls(times, directions, whitening, np.ones(len(points), bool), trust)

    @classmethod
    def of_places(
        cls,
        times_s: npt.ArrayLike,
        places_m: npt.ArrayLike,
        covariances: npt.ArrayLike | None = None,
    ) -> PointCloud:
        """Places (N, 3) of refined poses, path frame, with covariances (N, 3, 3) in m²."""
        places = np.asarray(places_m, np.float64).reshape(-1, 3)
        times = np.broadcast_to(np.asarray(times_s, np.float64), (len(places),)).copy()
        far = np.linalg.norm(places, axis=1)
        if covariances is None:
            whitening = np.eye(3) / np.maximum(1e-3 * far, 1e-9)[:, None, None]
        else:
            whitening = roots_of(np.asarray(covariances, np.float64).reshape(-1, 3, 3))
        return cls(times, places, whitening, np.zeros(len(places), bool), np.ones(len(places)))

    def joined(self, other: PointCloud) -> PointCloud:
        """Both clouds in order of time."""
        pairs = zip(self._columns, other._columns, strict=True)
        both = PointCloud(*(np.concatenate(pair) for pair in pairs))
        order = np.argsort(both.times_s, kind="stable")
        return PointCloud(*(column[order] for column in both._columns))

    def since(self, time_s: float) -> PointCloud:
        """The points from a time on."""
        first = int(np.searchsorted(self.times_s, time_s - 1e-9))
        return PointCloud(*(column[first:] for column in self._columns))

    @property
    def _columns(self) -> tuple[npt.NDArray[Any], ...]:
        return self.times_s, self.points, self.whitening, self.by_node, self.weights

    def trouble(self, frames: int) -> NoFit | None:
        """Why no segment goes through these points; None where nothing speaks against it.

        Args:
            frames: how many different times the segment needs.
        """
        if not np.isfinite(self.times_s).all():
            return NoFit("a time is not finite")
        numbers = (self.points, self.whitening, self.weights)
        if not all(np.isfinite(values).all() for values in numbers):
            return NoFit("a point, or its covariance, is not finite")
        if np.any(np.diff(self.times_s) < 0.0):
            return NoFit("the times do not rise")
        different = 1 + int(np.count_nonzero(np.diff(self.times_s))) if len(self) else 0
        if different < frames:
            return NoFit(f"points of {different} frames: a segment needs {frames}")
        places = self.places_m
        if np.all(np.ptp(places, axis=0) <= 1e-9 * np.abs(places).max()):
            return NoFit("all points are one: nothing moves")
        if not np.any(self.weights > 0.0):
            return NoFit("no point is trusted")
        return None


def camera_place(
    pose: Pose, covariance: npt.ArrayLike, centre_m: npt.ArrayLike
) -> tuple[Array, Array]:
    """Camera about a centre, target frame: place (3,) m and covariance (3, 3) of a pose's.

    c = −Rᵀ t, and with R' = exp([w]×) R, t' = t + v:  δc = −Rᵀ ([t]× w + v).
    """
    lever = -pose.rotation.T @ np.hstack([so3.hat(pose.translation_m), np.eye(3)])
    place = pose.inverse().translation_m - np.asarray(centre_m, np.float64)
    return place, lever @ np.asarray(covariance, np.float64) @ lever.T


def centre_place(
    pose: Pose, covariance: npt.ArrayLike, centre_m: npt.ArrayLike
) -> tuple[Array, Array]:
    """Camera about a centre, camera axes: place (3,) m and covariance (3, 3) of a pose's.

    −(R c + t); its error is −(w × R c + v) = [R c]× w − v. For a camera whose own attitude is
    known, so that the target's takes no part.
    """
    arm = pose.rotation @ np.asarray(centre_m, np.float64)
    lever = np.hstack([so3.hat(arm), -np.eye(3)])
    return -(arm + pose.translation_m), lever @ np.asarray(covariance, np.float64) @ lever.T


def roots_of(covariances: Array) -> Array:
    """(N, 3, 3) W with WᵀW the inverse of each covariance; NaN where it is none."""
    whitening = np.full_like(covariances, np.nan)
    sound = np.isfinite(covariances).all(axis=(1, 2))
    if sound.any():
        values, vectors = np.linalg.eigh(covariances[sound])
        values = np.maximum(values, 1e-18)
        # The symmetric root, so that the deviations of neighbouring frames have like axes.
        turned = vectors / np.sqrt(values)[:, None, :]
        whitening[sound] = turned @ np.swapaxes(vectors, 1, 2)
    return whitening
