"""Distances between the estimated and the true surface of a target: BOP's measures.

Hodaň et al., "BOP Challenge 2020 on 6D Object Localization", ECCVW 2020, section 2.2 (MSSD,
MSPD); Hinterstoisser et al., ACCV 2012 (ADD, ADD-S). The numbers equal those of the public BOP
toolkit, including its steps of continuous symmetries. Lengths are metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull, QhullError, cKDTree
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from rendezview.geometry.pose import Array, Pose
from rendezview.geometry.symmetry import Symmetry, common_point, discrete_turns

STEP = 0.01  # of the diameter; largest motion of a point per step. Source: BOP toolkit
_REFERENCE_WIDTH_PX = 640.0  # px; width to which BOP's thresholds refer. Source: BOP 2020, 2.2
_BLOCK = 2000  # rows of distances computed at once, to limit memory


@dataclass(frozen=True, slots=True, eq=False)
class ModelPoints:
    """The vertices of a target, and the quantities that the measures need from them."""

    points_m: Array  # (V, 3) vertices, target frame
    hull_m: Array  # (H, 3) those on the convex hull
    diameter_m: float  # largest distance of two vertices
    alike: tuple[Pose, ...]  # target_from_target of the symmetries, the identity first

    @classmethod
    def of(
        cls, points_m: npt.ArrayLike, alike: Sequence[Pose] = (), diameter_m: float | None = None
    ) -> ModelPoints:
        """Compute hull and diameter of the vertices.

        Args:
            points_m: (V, 3) vertices, target frame.
            alike: of `alike_of`; empty: no symmetry.
            diameter_m: largest distance of two vertices, if known.

        Raises:
            ValueError: no vertices, or all at one place.
        """
        points = np.asarray(points_m, dtype=np.float64)
        if points.ndim != 2 or points.shape[1:] != (3,) or not len(points):
            raise ValueError(f"points_m must be (V, 3), not {points.shape}")
        try:
            hull = points[ConvexHull(points).vertices]
        except QhullError:  # flat
            hull = np.unique(points, axis=0)
        if diameter_m is None:
            blocks = (cdist(hull[i : i + _BLOCK], hull).max() for i in range(0, len(hull), _BLOCK))
            diameter_m = float(max(blocks))
        if not diameter_m > 0.0:
            raise ValueError("all vertices are in one place")
        return cls(points, hull, diameter_m, tuple(alike) or (Pose.identity(),))


@dataclass(frozen=True, slots=True)
class SurfaceErrors:
    """Errors of one estimate; infinite if it cannot be projected."""

    mssd_m: float  # maximum symmetry-aware surface distance
    mspd_px: float  # maximum symmetry-aware projection distance, without lens distortion
    add_m: float  # mean distance of vertices
    add_s_m: float  # mean distance to the nearest vertex
    diameter_m: float  # of the target
    width_px: int  # of the picture

    @property
    def mssd_fraction(self) -> float:
        """MSSD over the diameter."""
        return self.mssd_m / self.diameter_m

    @property
    def mspd_640_px(self) -> float:
        """MSPD scaled to a picture 640 pixels wide."""
        return self.mspd_px * _REFERENCE_WIDTH_PX / self.width_px


def alike_of(symmetries: Sequence[Symmetry]) -> tuple[Pose, ...]:
    """The turns of a target's symmetries, target_from_target, the identity first.

    A continuous symmetry is sampled in 315 steps (`STEP`), as in the toolkit.

    Raises:
        ValueError: the multiples of a discrete rotation never return to the identity, or the axes
            have no common point.
    """
    centre_m = common_point(symmetries)
    discrete = [Pose(turn, centre_m - turn @ centre_m) for turn in discrete_turns(symmetries)]
    axes = [s.axis / np.linalg.norm(s.axis) for s in symmetries if s.kind == "continuous"]
    return combined(discrete, [turn for axis in axes for turn in turns_about(axis, centre_m)])


def turns_about(axis: Array, through_m: Array) -> list[Pose]:
    """Rotations about an axis (3,), unit, through a point (3,), in steps; the identity first."""
    count = int(np.ceil(np.pi / STEP))
    turns = Rotation.from_rotvec(np.arange(count)[:, None] * (2.0 * np.pi / count) * axis)
    return [Pose(turn, through_m - turn @ through_m) for turn in turns.as_matrix()]


def combined(discrete: Sequence[Pose], continuous: Sequence[Pose]) -> tuple[Pose, ...]:
    """All products of a discrete rotation and a step of the continuous ones."""
    if not continuous:
        return tuple(discrete)
    return tuple(step @ turn for turn in discrete for step in continuous)


def surface_errors(
    truth: Pose, estimate: Pose, model: ModelPoints, matrix: Array, width_px: int
) -> SurfaceErrors:
    """Errors of one estimated ``camera_from_target``.

    Args:
        truth: camera_from_target.
        estimate: the same, estimated.
        model: vertices of the target.
        matrix: (3, 3) of the camera, px.
        width_px: of the picture.
    """
    points, truths = model.points_m, [truth @ turn for turn in model.alike]
    found, true = estimate.apply(points), truth.apply(points)
    # The distance between two affine images of a point is convex, so its maximum is on the hull.
    hull = estimate.apply(model.hull_m)
    mssd = min(_norms(hull - alike.apply(model.hull_m)).max() for alike in truths)
    mspd = np.inf
    if (found_px := _projected(found, matrix)) is not None:
        for alike in truths:
            true_px = _projected(alike.apply(points), matrix)
            if true_px is not None:
                mspd = min(mspd, _norms(found_px - true_px).max())
    return SurfaceErrors(
        mssd_m=float(mssd),
        mspd_px=float(mspd),
        add_m=float(_norms(found - true).mean()),
        add_s_m=float(cKDTree(found).query(true)[0].mean()),
        diameter_m=model.diameter_m,
        width_px=width_px,
    )


def _norms(vectors: Array) -> Array:
    return np.asarray(np.sqrt(np.einsum("ij,ij->i", vectors, vectors)))


def _projected(points: Array, matrix: Array) -> Array | None:
    """(V, 2) pixels of points (V, 3); None if one is beside or behind the camera.

    The toolkit uses the mirrored pixel then, which no picture contains.
    """
    if not (points[:, 2] > 0.0).all():
        return None
    projected = points @ matrix.T
    return np.asarray(projected[:, :2] / projected[:, 2:])
